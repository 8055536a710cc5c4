"""The scenes in MuJoCo Warp, MuJoCo for NVIDIA's GPUs; on a CPU it runs too, for tests of this file."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from tests.benchmarks.timing import Block
from tests.benchmarks.work_precision import mujoco_engine
from tests.benchmarks.work_precision.scenes import Scene, kept_steps, start_of
from tests.benchmarks.work_precision.worlds import Motion, stack
from tests.scenes import rotation_matrix

try:
    import mujoco
    import mujoco_warp
    import warp
except ImportError:
    mujoco = mujoco_warp = warp = None

CONTACTS, ROWS = 8, 4
"""Room for contacts of each close pair of a scene, and for rows of each contact."""
FEWEST_PAIRS = 4


def missing() -> str | None:
    """Why MuJoCo Warp can not take part, or None."""
    return "mujoco_warp is not installed (pip install mujoco-warp)" if mujoco_warp is None else None


class WarpProgram:
    """A batch of worlds with default options; `table` (step, world, moving body, 3) pushes the bodies, None leaves them."""

    def __init__(self, scene: Scene, dt: float, worlds: int, table: Any = None):
        self.scene, self.count = scene, worlds
        self.described = mujoco.MjModel.from_xml_string(mujoco_engine.xml(scene, "default", dt))
        room = CONTACTS * (scene.capacity or FEWEST_PAIRS)
        begin = time.perf_counter()
        self.model = mujoco_warp.put_model(self.described)
        self.data = mujoco_warp.put_data(
            self.described, mujoco.MjData(self.described), nworld=worlds, nconmax=room, njmax=ROWS * room
        )
        self.table = None if table is None else warp.array(self._wrenches(np.asarray(table)), dtype=warp.spatial_vector)
        self.graphs: list[Any] = []
        self._advance(1)
        if warp.get_device().is_cuda:
            for turn in range(1 if self.table is None else len(self.table)):
                with warp.ScopedCapture() as capture:
                    self._step(turn)
                self.graphs.append(capture.graph)
        warp.synchronize()
        self.compile_seconds = time.perf_counter() - begin
        self.reset()

    def reset(self) -> None:
        """All worlds at their start."""
        start = start_of(self.scene.name, self.count)
        spin = np.einsum("...ji,...j->...i", rotation_matrix(start.orientation), start.angular_velocity)
        place = np.concatenate([start.position, start.orientation], axis=-1).reshape(self.count, -1)
        velocity = np.concatenate([start.velocity, spin], axis=-1).reshape(self.count, -1)
        warp.copy(self.data.qpos, warp.array(place, dtype=float))
        warp.copy(self.data.qvel, warp.array(velocity, dtype=float))

    def record(self) -> Motion:
        """Kept frames of the different worlds."""
        self.reset()
        frames, done = [], 0
        for step in kept_steps(self.scene, float(self.described.opt.timestep)):
            self._advance(int(step - done))
            frames.append(self.motion())
            done = step
        return stack(frames)

    def motion(self) -> Motion:
        """The moving bodies of the different worlds as they are."""
        worlds = self.scene.worlds
        place = self.data.qpos.numpy()[:worlds].astype(float).reshape(worlds, -1, 7)
        linear, spin = np.moveaxis(self.data.qvel.numpy()[:worlds].astype(float).reshape(worlds, -1, 2, 3), 2, 0)
        turn = place[..., 3:]
        return Motion(place[..., :3], turn, linear, np.einsum("...ij,...j->...i", rotation_matrix(turn), spin))

    def block_of(self, steps: int) -> Block:
        """Runs a number of steps from the start."""

        def run() -> int:
            self.reset()
            self._advance(steps)
            warp.synchronize()
            return self.count * steps

        return run

    def _advance(self, steps: int) -> None:
        for turn in range(steps):
            if self.graphs:
                warp.capture_launch(self.graphs[turn % len(self.graphs)])
            else:
                self._step(turn)

    def _step(self, turn: int) -> None:
        if self.table is not None:
            warp.copy(self.data.xfrc_applied, self.table[turn % len(self.table)])
        mujoco_warp.step(self.model, self.data)

    def _wrenches(self, table: np.ndarray) -> np.ndarray:
        wrenches = np.zeros((*table.shape[:2], self.described.nbody, 6), np.float32)
        wrenches[:, :, self.described.nbody - table.shape[2] :, :3] = table
        return wrenches
