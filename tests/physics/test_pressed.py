"""Bodies that a force of many times their weight presses onto the ground stay there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import apply_force, contact_forces, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import GRAVITY, box_stack, sphere_on_plane, undamped

DT = 1 / 60


def press(model, state, force):
    """The force acts downwards on the last body, at its centre."""
    down = jnp.array([0.0, -1.0, 0.0]) * force
    return apply_force(state, len(model.mass) - 1, down, state.position[-1])


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("solver", ["pgs", "converged"])
def test_a_falling_ball_that_is_pressed_down_stops_where_it_lands(precision, solver, gate):
    """Of what its contact does in the step only the share that stops it acts for all of the step, the load by half of it."""
    model, state = sphere_on_plane(velocity=(0.0, -0.5, 0.0), options=undamped(dt=DT, solver=solver))
    new = jax.jit(lambda state, force: step(model, press(model, state, force)))
    for force in (0.0, 10.0, 1e3, 1e4):
        moved = float(new(state, force).position[1, 1]) - 0.1
        gate(f"moved under {force:g} N / fall without the ground", moved / (0.5 * DT), 5e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("count", [1, 3])
def test_a_force_that_grows_lifts_nothing(precision, count, gate):
    """To a thousand times the weight of a box in 2 s; a column hopped by four times its height."""
    model, state = box_stack(count, 0.5, undamped(dt=DT), friction=0.6)

    def body(current, force):
        new = step(model, press(model, current, force))
        return new, new

    force = 1000 * GRAVITY * np.minimum(np.arange(1, 151) / 120, 1.0)
    final, record = jax.jit(lambda state: jax.lax.scan(body, state, jnp.asarray(force, state.velocity.dtype)))(state)
    moved = np.asarray(record.position - state.position, float)[:, 1:, 1]
    gate("lifted [m]", np.maximum(moved, 0.0), 1e-4)
    gate("pressed in [m]", np.minimum(moved, 0.0), 5e-3)
    gate("speed at the end [m/s]", np.asarray(final.velocity), 1e-3)
    # Of the contacts the four of the lowest box bear most.
    borne = np.sort(np.abs(np.asarray(contact_forces(model, final), float)[:, 1]))[-4:].sum()
    gate("borne by the ground / truth - 1", borne / (force[-1] + count * GRAVITY) - 1, 1e-4)
