"""Rays from within a compound: its parts are one solid. Truth: dense samples of the union, float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax import Box, Capsule, Compound, Cylinder, SceneBuilder, Sphere, raycast
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.unit.test_raycast import POSITION, TURN, cast, level, scene

BRANCHES = Compound(
    [
        (Box((0.5, 0.1, 0.1)), ((0, 0, 0), (1, 0, 0, 0))),
        (Box((0.1, 0.4, 0.1)), ((0.45, 0.35, 0), (0.98, 0, 0, 0.199))),
        (Cylinder(0.12, 0.4), ((-0.45, 0.35, 0), (0.995, 0.0999, 0, 0))),
        (Capsule(0.05, 0.15), ((0.05, 0.15, 0.05), (1, 0, 0, 0))),
        (Sphere(0.15), ((0.0, 0.6, 0.0), (1, 0, 0, 0))),
    ]
)
"""Parts that reach into each other, with gaps through which a ray comes back to its body, and one that stands apart."""


def level_of_parts(compound, p):
    """(part, ...) of `level`."""
    return np.stack([level(part.shape, (p - part.position) @ part.rotation) for part in compound.parts])


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_rays_from_within_a_compound_see_it_where_they_come_back(precision):
    """Against the union of the parts; in a scene with another compound and a body of one shape."""
    rng = np.random.default_rng(3)
    candidates = rng.uniform(-0.8, 1.0, (20_000, 3)) * [1, 1, 0.3]
    depth = level_of_parts(BRANCHES, candidates).min(0)
    origin = np.concatenate([candidates[depth < -0.01][:600], candidates[depth > 0.01][:300]])
    unit = rng.normal(size=origin.shape) * [1, 1, 0.2]
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    t = np.linspace(0, 2.5, 1251)
    values = level_of_parts(BRANCHES, origin + t[:, None, None] * unit).min(0)

    def entry(values):
        enters = (values[:-1] > 0) & (values[1:] <= 0)
        return np.where(enters.any(0), t[enters.argmax(0) + 1], np.inf)

    # Beyond doubt: the answer is the same for a body that is a little thicker or thinner.
    expected, thicker, thinner = entry(values), entry(values - 2e-3), entry(values + 2e-3)
    clear = np.isclose(thicker, thinner, rtol=0, atol=0.01)
    returning = clear & (depth_at_start := values[0] < 0) & ~np.isinf(expected)
    assert returning.sum() > 20 and (clear & depth_at_start & np.isinf(expected)).sum() > 100
    assert (clear & ~depth_at_start & ~np.isinf(expected)).sum() > 20

    builder = SceneBuilder()
    turned = TURN.as_quat()[[3, 0, 1, 2]]
    builder.add_body(Sphere(0.2), static=True, position=(0, 9, 0))
    body = builder.add_body(BRANCHES, static=True, position=POSITION, orientation=turned)
    builder.add_body(
        Compound([(Sphere(0.1), ((0, 0, k), (1, 0, 0, 0))) for k in (0, 1)]), static=True, position=(9, 9, 9)
    )
    found = cast(*builder.build(), TURN.apply(origin) + POSITION, TURN.apply(unit))
    distance = np.where(np.asarray(found.body) == body, found.distance, np.inf)
    np.testing.assert_array_equal(np.isinf(distance)[clear], np.isinf(expected)[clear])
    both = clear & ~np.isinf(expected)
    np.testing.assert_allclose(distance[both], expected[both], atol=2.1e-3)  # of the samples


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_parts_that_lie_flush_hide_their_common_face(precision):
    """Two cubes side by side are a convex block, wherever it stands: who sits in it sees nothing of it."""
    block = Compound([(Box((0.1, 0.1, 0.1)), ((x, 0, 0), (1, 0, 0, 0))) for x in (-0.1, 0.1)])
    rng = np.random.default_rng(5)
    unit = rng.normal(size=(2000, 3)) * [0.1, 1, 1]  # most of them flat to the face
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    inside = rng.uniform(-0.09, 0.09, (2000, 3)) + rng.choice([-0.1, 0.1], (2000, 1)) * [1, 0, 0]
    for position in (np.zeros(3), np.array([30.0, -20.0, 50.0])):
        found = cast(*scene(block, position), TURN.apply(inside) + position, TURN.apply(unit))
        assert not np.any(found.hit)
        away = cast(*scene(block, position), TURN.apply(5 * unit + inside) + position, -TURN.apply(unit))
        assert np.all(away.hit)


def test_derivatives_of_rays_from_within_a_compound(float64):
    """By the part that is met; those that the ray leaves first, one in the other, do not matter."""
    row = Compound([(Box((0.1 if x else 0.5, 0.1, 0.1)), ((x, 0, 0), (1, 0, 0, 0))) for x in (0.0, 0.5, 1.0)])
    model, state = scene(row, np.zeros(3), Rotation.identity())

    def distance(model, state):
        return raycast(model, state, jnp.array([0.1, 0.0, 0.01]), jnp.array([2.0, 0.0, 0.0])).distance

    by_model, by_state = jax.grad(distance, argnums=(0, 1), allow_int=True)(model, state)
    assert float(distance(model, state)) == pytest.approx(0.8)
    np.testing.assert_allclose(by_model.shapes["box"]["half_extents"], [[0, 0, 0], [0, 0, 0], [-1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(by_model.shapes["box"]["local_position"], [[0, 0, 0], [0, 0, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(by_state.position, [[1, 0, 0]], atol=1e-12)
