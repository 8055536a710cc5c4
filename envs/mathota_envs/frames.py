"""`FrameMaker`: pictures for the wrappers, all from one viewpoint, so that a film does not wobble."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np


class FrameMaker:
    """Draws states of an environment.

    Args:
        environment: functional environment on the engine (``model`` and ``rest_state``).
        width: columns of pixels.
        height: rows of pixels.
        camera: viewpoint (`mathota_envs.camera.Camera`); None frames the scene as built.
    """

    def __init__(self, environment: Any, width: int = 480, height: int = 360, camera: Any = None) -> None:
        self.environment = environment
        self.width = width
        self.height = height
        self.camera = camera

    def frame(self, state: Any) -> np.ndarray:
        """Picture of one world's simulation state, ``(height, width, 3)`` uint8, writable."""
        # Imported here because the ray caster is of no use to the many programs that never draw.
        from mathota_envs.camera import default_camera
        from mathota_envs.render import render_rgb

        if self.camera is None:
            aspect = self.width / self.height
            self.camera = default_camera(self.environment.model, self.environment.rest_state, aspect)
        return np.array(render_rgb(self.environment.model, state, self.width, self.height, self.camera))

    def frames(self, states: Any, worlds: Iterable[int]) -> tuple[np.ndarray, ...]:
        """Pictures of some worlds of states with a leading world axis."""
        return tuple(self.frame(jax.tree.map(operator.itemgetter(world), states)) for world in worlds)
