"""What lies below bears what lies above, from the first step on (`Options.conjugate`): columns of balls against statics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, GRAVITY, undamped

RADIUS = 0.1
COLUMNS = {
    "like masses": (1.0, 1.0, 1.0, 1.0),
    "heavy on light": (1.0, 1000.0, 1.0, 1.0),
    "heavy on light twice": (1.0, 100.0, 1.0, 100.0),
}
STEP = jax.jit(step)


def column(masses):
    """Balls that touch, upwards; they start without any impulse to begin with."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    for k, mass in enumerate(masses):
        builder.add_body(Sphere(RADIUS), mass=mass, position=(0, (2 * k + 1) * RADIUS, 0))
    return builder.build(undamped(dt=1 / 60, conjugate=True))


@pytest.mark.parametrize("masses", COLUMNS.values(), ids=COLUMNS)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_at_once(precision, masses, gate):
    """Ten sweeps alone leave a heavy ball on a light one all but falling."""
    state = STEP(*column(masses))
    pushes = np.linalg.norm(np.asarray(state.contact_force), axis=-1)
    borne = GRAVITY * np.cumsum(masses[::-1])[::-1]
    tolerance = 2e-4 if precision == "float32" else 1e-9
    gate("what contacts bear", np.sort(pushes)[::-1][: len(masses)] / np.sort(borne)[::-1] - 1, tolerance)
    gate("speed / that of a fall in one step", np.asarray(state.velocity) * 60 / GRAVITY, tolerance)


@pytest.mark.parametrize("masses", [COLUMNS["like masses"], (1.0, 100.0)], ids=["like masses", "heavy on light"])
def test_derivatives_by_the_masses(masses, gate):
    """What the ground bears grows by gravity with each mass."""
    model, state = column(masses)

    def borne(mass):
        return jnp.abs(step(dataclasses.replace(model, mass=mass), state).contact_force[:, 1]).max()

    found = jax.jit(jax.grad(borne))(model.mass)[1:]
    gate("derivative / gravity - 1", found / GRAVITY - 1, 5e-3)


def test_beside_one_that_slides():
    """A world is solved in the same way, whatever slides in another one."""
    model, state = column(COLUMNS["heavy on light"])
    thrown = dataclasses.replace(state, velocity=state.velocity.at[1:, 0].set(3.0))
    both = jax.tree.map(lambda *parts: jnp.stack(parts), state, thrown)
    alike = jax.tree.map(lambda *parts: jnp.stack(parts), state, state)
    steps = jax.jit(jax.vmap(step, (None, 0)))
    found, expected = steps(model, both), steps(model, alike)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b[0]), found, expected)
    assert np.abs(np.asarray(found.velocity[1])).max() > 1
