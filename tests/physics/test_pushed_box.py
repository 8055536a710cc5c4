"""A box on a plane that is pushed and turned by less than friction and its weight hold: at rest, whatever its proportions.

The truth is rest, and derivatives of 0, as long as the ground can bear the load: friction times weight above the push, and
the point where the load meets the ground inside the face. A push at the middle of a cube turns it, and both the normals
and the tangents of its points answer; where they do so at once the sweeps of a cube diverge.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, GRAVITY, HALVES_BY_PROPORTION, advance, undamped

FRICTION = 0.5
LOAD = np.array([0.3, 0.0, 0.2, 0.02, 0.0, -0.03])
"""Force [N/kg] and torque [N m/kg] per length of the body, a tenth of what friction and the narrowest face bear."""


def on_plane(half, **options):
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=FRICTION)
    builder.add_body(Box(half), mass=1.0, position=(0, half[1], 0), friction=FRICTION)
    return builder.build(undamped(dt=1 / 60, **options))


def loaded(state, load):
    return dataclasses.replace(
        state,
        applied_force=state.applied_force.at[1].set(load[:3]),
        applied_torque=state.applied_torque.at[1].set(load[3:]),
    )


def motion_after_two_steps(load, model, state):
    for _ in range(2):
        state = step(model, loaded(state, load))
    return jnp.concatenate([state.velocity[1], state.angular_velocity[1]])


motion = jax.jit(motion_after_two_steps)
forward, reverse = (jax.jit(derivative(motion_after_two_steps)) for derivative in (jax.jacfwd, jax.jacrev))


def put_down_askew(model, state, gate):
    """The state 60 steps after the box was tilted by a microradian, in which it must lie flat."""
    tilt = jnp.asarray(np.array([0.7, -1.1, 0.9]) * 1e-6, state.orientation.dtype)
    state = dataclasses.replace(state, orientation=state.orientation.at[1, 1:].set(tilt))
    final = advance(model, state, 60)
    gate("tilt [rad]", 2 * final.orientation[1, 1:], 5e-6)
    return final


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("name", HALVES_BY_PROPORTION)
def test_it_stays_at_rest(precision, name, gate):
    """Of the speed that the load alone would give it, 7 to 10 mm/s in two steps."""
    model, state = on_plane(HALVES_BY_PROPORTION[name])
    gate("speed [m/s, rad/s]", motion(jnp.asarray(LOAD, precision), model, state), 2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", HALVES_BY_PROPORTION)
def test_its_derivatives_are_zero(float64, name, gate):
    """Free, they are dt / mass = 0.033 and more."""
    model, state = on_plane(HALVES_BY_PROPORTION[name])
    gate("forward", forward(jnp.asarray(LOAD), model, state), 1e-5)
    gate("reverse", reverse(jnp.asarray(LOAD), model, state), 1e-5)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("sweeps", [10, 40, pytest.param(160, marks=pytest.mark.slow)])
def test_more_sweeps_do_not_shake_a_cube(precision, sweeps, gate):
    """Put down tilted by a microradian it lies flat, within what the sweeps leave: 40 shook it by 2 mrad."""
    model, state = on_plane(HALVES_BY_PROPORTION["cube"], velocity_iterations=sweeps)
    final = put_down_askew(model, state, gate)
    gate("speed [m/s]", final.velocity[1], 1e-5)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize(("half", "dt"), [(0.5, 1.0), (0.5, 3.0), (0.5e-3, 1 / 60)])
def test_long_steps_do_not_shake_a_cube(precision, half, dt, gate):
    """What matters is ``gravity dt^2 / size``: 20 and 180 here, and 5 for a cube of a millimetre at 1/60 s."""
    model, state = on_plane((half,) * 3)
    model = dataclasses.replace(model, dt=jnp.asarray(dt, precision))
    final = put_down_askew(model, state, gate)
    gate("drop / size", (final.position[1, 1] - half) / half, 1e-5)
    assert GRAVITY * dt**2 / half > 5
