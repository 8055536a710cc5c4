"""A scene in an engine that holds one world at a time."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.timing import Block
from tests.benchmarks.work_precision.scenes import Scene, kept_steps, start_of, steps_of
from tests.benchmarks.work_precision.worlds import Motion, stack


class OneWorldProgram:
    """Runs the different worlds of a scene one after the other, at one time step."""

    def __init__(self, scene: Scene, dt: float):
        self.scene, self.dt = scene, dt
        self.start = start_of(scene.name, scene.worlds)

    def _reset(self, world: int) -> None:
        """Puts the bodies where one of the worlds starts."""
        raise NotImplementedError

    def _advance(self, steps: int) -> None:
        raise NotImplementedError

    def _motion(self) -> Motion:
        """The moving bodies as they are."""
        raise NotImplementedError

    def record(self) -> Motion:
        """Kept frames of the different worlds."""
        worlds = []
        for world in range(self.scene.worlds):
            self._reset(world)
            frames, done = [], 0
            for step in kept_steps(self.scene, self.dt):
                self._advance(int(step - done))
                frames.append(self._motion())
                done = step
            worlds.append(stack(frames))
        return stack(worlds).map(lambda leaf: np.moveaxis(leaf, 0, 1))

    def block(self) -> Block:
        """Runs the whole horizon in one of the different worlds after the other."""
        steps = steps_of(self.scene, self.dt)

        def run() -> int:
            for world in range(self.scene.worlds):
                self._reset(world)
                self._advance(steps)
            return self.scene.worlds * steps

        return run
