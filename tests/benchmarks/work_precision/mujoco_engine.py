"""The scenes in MuJoCo C, one thread, stepped inside C by `mj_step(model, data, nstep)`, at two profiles.

"default" is what MuJoCo does when nothing is set (Newton solver, pyramidal cones, semi-implicit Euler), but for contacts
that bounce, which need a `solref` of their own. "tuned" is what `Scene.tuned` says: the Runge-Kutta integrator for
what moves, elliptic cones and the stiffest contacts that its guard allows for what rests.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mathota_jax import Box, Plane, Sphere
from tests.benchmarks import scenes as closed_forms
from tests.benchmarks.work_precision.one_world import OneWorldProgram
from tests.benchmarks.work_precision.scenes import Scene
from tests.benchmarks.work_precision.worlds import Body, Motion

try:
    import mujoco
except ImportError:
    mujoco = None

PROFILES = ("default", "tuned")


def missing() -> str | None:
    """Why MuJoCo can not take part, or None."""
    return "mujoco is not installed (pip install mujoco)" if mujoco is None else None


def xml(scene: Scene, profile: str, dt: float) -> str:
    """The scene as MJCF; Y stays up."""
    extra = getattr(scene, profile)
    option = {
        "timestep": f"{dt:.17g}",
        "gravity": _numbers(scene.world.gravity),
        **_filled(extra.get("option", {}), dt),
    }
    geom = _filled(extra.get("geom", {}), dt)
    meshes, bodies, closing = [], [], 0
    previous = np.zeros(3)
    anchors = iter(scene.world.anchors)
    for index, body in enumerate(scene.world.bodies):
        shape = {**_geom(body, index, meshes), **geom}
        if body.mass is None:
            bodies.append(_element("geom", shape) + "</geom>")
            continue
        place = np.array(body.position)
        if scene.world.anchors:
            joint = {"type": "hinge", "axis": "0 0 1", "pos": _numbers(np.array(next(anchors)) - place)}
            here = {"pos": _numbers(place - previous)}
            bodies.append(_element("body", here) + _element("joint", joint) + "</joint>" + _element("geom", shape))
            bodies.append("</geom>")
            closing, previous = closing + 1, place
        else:
            here = {"pos": _numbers(place), "quat": _numbers(body.orientation)}
            bodies.append(f"{_element('body', here)}<freejoint/>{_element('geom', shape)}</geom></body>")
    return (
        f"<mujoco>{_element('option', option)}</option><asset>{''.join(meshes)}</asset>"
        f"<worldbody>{''.join(bodies)}{'</body>' * closing}</worldbody></mujoco>"
    )


def _geom(body: Body, index: int, meshes: list[str]) -> dict[str, str]:
    shape = body.shape
    common = {"friction": f"{body.friction} 0 0", "condim": "3" if body.friction else "1"}
    if not body.collides:
        common |= {"contype": "0", "conaffinity": "0"}
    if isinstance(shape, Plane):
        place = shape.offset * shape.normal
        return {"type": "plane", "size": "0 0 1", "zaxis": _numbers(shape.normal), "pos": _numbers(place), **common}
    common["mass"] = f"{body.mass}"
    if isinstance(shape, Sphere):
        return {"type": "sphere", "size": f"{shape.radius:.17g}", **common}
    if isinstance(shape, Box):
        return {"type": "box", "size": _numbers(shape.half_extents), **common}
    meshes.append(f'<mesh name="mesh{index}" vertex="{_numbers(np.ravel(shape.vertices))}" inertia="exact"/>')
    return {"type": "mesh", "mesh": f"mesh{index}", **common}


def _filled(attributes: dict[str, str], dt: float) -> dict[str, str]:
    """Fills in what depends on dt, and springs whose damping gives the restitution in continuous time."""
    logarithm = math.log(closed_forms.BOUNCE_RESTITUTION)
    ratio = -logarithm / math.hypot(math.pi, logarithm)
    words = {"stiffest": 2 * dt}
    for frequency in (50, 150):
        words[f"spring{frequency}"] = f"{-(frequency**2)} {-2 * ratio * frequency}"
    return {name: value.format(**words) for name, value in attributes.items()}


def _numbers(values: Any) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _element(name: str, attributes: dict[str, str]) -> str:
    return f"<{name} " + " ".join(f'{key}="{value}"' for key, value in attributes.items()) + ">"


class MujocoProgram(OneWorldProgram):
    """One scene at one profile and time step."""

    def __init__(self, scene: Scene, profile: str, dt: float):
        super().__init__(scene, dt)
        self.model = mujoco.MjModel.from_xml_string(xml(scene, profile, dt))
        self.data = mujoco.MjData(self.model)
        self.first = self.model.nbody - len(scene.world.moving)

    def bytes_per_world(self) -> float:
        """What one `MjData` holds, with the most that its arena was filled to so far."""
        return float(self.data.nbuffer + self.data.maxuse_arena)

    def _reset(self, world: int) -> None:
        mujoco.mj_resetData(self.model, self.data)
        if self.scene.world.anchors:
            return
        for body in range(len(self.scene.world.moving)):
            turn = self.start.orientation[world, body]
            self.data.qpos[7 * body : 7 * body + 7] = [*self.start.position[world, body], *turn]
            spin = np.empty(3)
            conjugate = turn * [1, -1, -1, -1]
            mujoco.mju_rotVecQuat(spin, self.start.angular_velocity[world, body], conjugate)
            self.data.qvel[6 * body : 6 * body + 6] = [*self.start.velocity[world, body], *spin]

    def throw(self, world: int, speed: float, steps: int) -> None:
        """Runs a world whose first body starts with another speed along X."""
        self._reset(world)
        self.data.qvel[0] = speed
        self._advance(steps)

    def _motion(self) -> Motion:
        mujoco.mj_kinematics(self.model, self.data)
        position, orientation = self.data.xpos[self.first :].copy(), self.data.xquat[self.first :].copy()
        velocity, spin = np.zeros_like(position), np.zeros_like(position)
        if not self.scene.world.anchors:
            velocity, local = np.moveaxis(self.data.qvel.reshape(-1, 2, 3), 1, 0)
            for body, turn in enumerate(orientation):
                mujoco.mju_rotVecQuat(spin[body], local[body].copy(), turn)
        return Motion(position, orientation, velocity.copy(), spin)

    def _advance(self, steps: int) -> None:
        mujoco.mj_step(self.model, self.data, nstep=steps)
