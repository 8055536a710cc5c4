"""The scenes in MuJoCo C, one thread, stepped inside C by `mj_step(model, data, nstep)`.

Slide is shown with the default solver and with projected Gauss-Seidel at our number of sweeps. MuJoCo's convex contact
model lifts a fast sliding cube off the plane, so that most of its steps have no contact at all; therefore the resting
cube with its four contacts is timed too. Bounce uses the direct stiffness and damping form of `solref`, with the
damping ratio that gives the restitution in continuous time, at two stiffnesses.
"""

from __future__ import annotations

import math

import numpy as np

from tests.benchmarks import scenes
from tests.benchmarks.settings import TIME_STEP
from tests.benchmarks.timing import Block, Contestant

try:
    import mujoco
except ImportError:
    mujoco = None

SETTLE_STEPS = 480
ERROR_WORLDS = 16
SLIDE_VARIANTS = {
    "MuJoCo, Newton, pyramidal cone (its default)": {"solver": "Newton", "cone": "pyramidal", "iterations": 100},
    "MuJoCo, PGS 10 sweeps, elliptic cone": {"solver": "PGS", "cone": "elliptic", "iterations": 10},
}
BOUNCE_FREQUENCIES = (50.0, 150.0)
"""Angular frequencies of the contact spring [1/s]; above about 150 the impact is shorter than the steps resolve."""


def missing() -> str | None:
    """Why MuJoCo can not take part, or None."""
    return "mujoco is not installed (pip install mujoco)" if mujoco is None else None


def slide_xml(dt: float, solver: str, cone: str, iterations: int) -> str:
    """MJCF of the sliding cube; lengths in m."""
    half, friction = scenes.SLIDE_HALF_EXTENT, f'friction="{scenes.SLIDE_FRICTION} 0 0"'
    return f"""<mujoco>
      <option timestep="{dt}" gravity="0 0 -{scenes.GRAVITY}" solver="{solver}" cone="{cone}"
              iterations="{iterations}"/>
      <worldbody>
        <geom type="plane" size="0 0 1" {friction}/>
        <body pos="0 0 {half}">
          <freejoint/><geom type="box" size="{half} {half} {half}" mass="{scenes.MASS}" {friction}/>
        </body>
      </worldbody></mujoco>"""


def bounce_xml(dt: float, frequency: float) -> str:
    """MJCF of the bouncing sphere; `frequency` of the contact spring in 1/s."""
    logarithm = math.log(scenes.BOUNCE_RESTITUTION)
    damping_ratio = -logarithm / math.hypot(math.pi, logarithm)
    contact = f'solref="{-(frequency**2)} {-2 * damping_ratio * frequency}" solimp="0.99 0.99 0.001"'
    radius = scenes.BOUNCE_RADIUS
    return f"""<mujoco>
      <option timestep="{dt}" gravity="0 0 -{scenes.GRAVITY}"/>
      <worldbody>
        <geom type="plane" size="0 0 1" {contact}/>
        <body pos="0 0 {radius}"><freejoint/><geom type="sphere" size="{radius}" mass="{scenes.MASS}" {contact}/></body>
      </worldbody></mujoco>"""


def slide_contestants() -> dict[str, Contestant]:
    """Sliding with two solvers, and resting with the default one."""
    steps, contestants = scenes.SLIDE_TIMED_STEPS, {}
    for name, variant in SLIDE_VARIANTS.items():
        run = SlideRun(TIME_STEP, **variant)
        contestants[name] = Contestant(run.rollout(steps), {"dt": TIME_STEP, **variant}, run.error())
    name, variant = next(iter(SLIDE_VARIANTS.items()))
    rest = SlideRun(TIME_STEP, **variant).rollout(steps, speed=0.0)
    contestants[f"{name}, at rest on four contacts"] = Contestant(rest, {"dt": TIME_STEP, **variant})
    return contestants


def bounce_contestants() -> dict[str, Contestant]:
    """Bouncing on a softer and a stiffer contact."""
    contestants = {}
    for frequency in BOUNCE_FREQUENCIES:
        run = BounceRun(TIME_STEP, frequency)
        settings = {"dt": TIME_STEP, "solver": "Newton", "contact frequency": frequency}
        block = run.rollout(scenes.BOUNCE_TIMED_STEPS)
        contestants[f"MuJoCo, contact frequency {frequency:g}/s"] = Contestant(block, settings, run.error())
    return contestants


class SlideRun:
    """One simulation of the cube, settled, that can be thrown again and again."""

    def __init__(self, dt: float, solver: str, cone: str, iterations: int):
        self.dt = dt
        self.model = mujoco.MjModel.from_xml_string(slide_xml(dt, solver, cone, iterations))
        self.data = mujoco.MjData(self.model)
        mujoco.mj_step(self.model, self.data, nstep=SETTLE_STEPS)
        self.rest_position = self.data.qpos.copy()
        self.rest_velocity = np.zeros(6)

    def throw(self, speed: float) -> None:
        """Puts the settled cube at the start with a speed along x."""
        self.data.qpos[:] = self.rest_position
        self.data.qvel[:] = self.rest_velocity
        self.data.qvel[0] = speed

    def rollout(self, steps: int, speed: float = 0.5 * sum(scenes.SLIDE_SPEEDS)) -> Block:
        """Block that runs the thrown cube for some steps."""

        def run() -> int:
            self.throw(speed)
            mujoco.mj_step(self.model, self.data, nstep=steps)
            return steps

        return run

    def error(self) -> dict:
        """Errors of the stopping distance, and how often and how far the cube left the plane while sliding."""
        speeds = scenes.spread(scenes.SLIDE_SPEEDS, ERROR_WORLDS)
        distances, contacts, heights = [], [], []
        for speed in speeds:
            self.throw(speed)
            start = self.data.qpos[0]
            for step in range(scenes.step_count(scenes.SLIDE_SECONDS, self.dt)):
                mujoco.mj_step(self.model, self.data)
                if step < scenes.SLIDE_TIMED_STEPS:
                    contacts.append(self.data.ncon)
                    heights.append(self.data.qpos[2] - self.rest_position[2])
            distances.append(self.data.qpos[0] - start)
        return {
            **scenes.slide_errors(speeds, np.array(distances), self.dt),
            "mean_contacts": float(np.mean(contacts)),
            "largest_lift": float(np.max(heights)),
        }


class BounceRun:
    """One simulation of the sphere."""

    def __init__(self, dt: float, frequency: float):
        self.dt = dt
        self.model = mujoco.MjModel.from_xml_string(bounce_xml(dt, frequency))
        self.data = mujoco.MjData(self.model)

    def drop(self, gap: float) -> None:
        """Puts the sphere at rest above the plane."""
        self.data.qpos[:] = (0, 0, scenes.BOUNCE_RADIUS + gap, 1, 0, 0, 0)
        self.data.qvel[:] = 0

    def rollout(self, steps: int) -> Block:
        """Block that runs the dropped sphere for some steps."""

        def run() -> int:
            self.drop(0.5 * sum(scenes.BOUNCE_GAPS))
            mujoco.mj_step(self.model, self.data, nstep=steps)
            return steps

        return run

    def error(self) -> dict:
        """Errors of the first apex."""
        gaps = scenes.spread(scenes.BOUNCE_GAPS, ERROR_WORLDS)
        track = np.empty((scenes.step_count(scenes.BOUNCE_SECONDS, self.dt), ERROR_WORLDS))
        for world, gap in enumerate(gaps):
            self.drop(gap)
            for step in range(len(track)):
                mujoco.mj_step(self.model, self.data)
                track[step, world] = self.data.qpos[2] - scenes.BOUNCE_RADIUS
        return {**scenes.bounce_errors(gaps, scenes.first_apex(track)), "largest_penetration": float(-track.min())}
