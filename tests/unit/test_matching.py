"""Contacts known again from step to step, against a search in NumPy (guide 7.3)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Cylinder, Options, step
from mathota_jax.constraints.warm_start import Marks, matched_points
from mathota_jax.spatial.vector import Vec3
from tests.scenes import body_on_plane, box_stack, undamped

PAIRS, POINTS, WORLDS, REACH = 5, 4, 64, 0.3


def drawn():
    """Points of which some are gone, some new, some have their feature, and some are where others were."""
    rng = np.random.default_rng(0)
    shape = (PAIRS, POINTS, WORLDS)
    old = rng.uniform(-1, 1, (3, *shape))
    order = rng.permuted(np.broadcast_to(np.arange(POINTS)[:, None], shape), axis=1)
    new = np.take_along_axis(old, order[None], 2) + rng.choice([0.0, 0.1, 0.5], shape) * rng.normal(size=(3, *shape))
    # Different in each slot, as manifolds have them.
    number = rng.permuted(np.broadcast_to(np.arange(POINTS)[:, None], shape), axis=1)
    feature = np.where(rng.random(shape) < 0.3, -1, number)
    later = np.take_along_axis(number, order, 1) + POINTS * (rng.random(shape) < 0.6)
    return old, new, feature, later, rng.random(shape) < 0.8, rng.normal(size=(3, *shape))


def truth(old, new, feature, later, active, force, steady):
    """One pair at a time: equal features first, then those that are nearest to each other."""
    found = np.zeros_like(force)
    for pair, world in np.ndindex(PAIRS, WORLDS):
        f, g, on = feature[pair, :, world], later[pair, :, world], active[pair, :, world]
        known = {j: i for j in range(POINTS) for i in range(POINTS) if on[j] and f[i] == g[j]}
        fresh = [j for j in range(POINTS) if on[j] and j not in known]
        gone = [i for i in range(POINTS) if f[i] >= 0 and i not in known.values()]
        if fresh and gone and not steady:
            between = new[:, pair, fresh, world][:, :, None] - old[:, pair, gone, world][:, None]
            distance = np.linalg.norm(between, axis=0)
            for row, j in enumerate(fresh):
                column = int(np.argmin(distance[row]))
                if np.argmin(distance[:, column]) == row and distance[row, column] <= REACH:
                    known[j] = gone[column]
        for j, i in known.items():
            found[:, pair, j, world] = force[:, pair, i, world]
    return found


@pytest.mark.parametrize("steady", [True, False])
def test_against_a_search(float64, steady):
    old, new, feature, later, active, force = drawn()

    def match(old, new, feature, later, active, force):
        marks = Marks(feature, Vec3(*old)), Marks(later, Vec3(*new))
        return jnp.stack(matched_points(*marks, active, Vec3(*force), REACH, steady))

    found = np.asarray(jax.jit(match)(*(jnp.asarray(x) for x in (old, new, feature, later, active, force))))
    expected = truth(old, new, feature, later, active, force, steady)
    np.testing.assert_array_equal(found.reshape(expected.shape), expected)
    assert (expected != 0).any(0).mean() > (0.1 if steady else 0.2)


def test_only_scenes_with_unsteady_features_keep_places():
    def text(scene):
        return jax.jit(step).lower(*scene).as_text()

    with_it, without = (box_stack(2, options=undamped(warm_start_match=match)) for match in (0.02, 0.0))
    assert with_it[1].contact_offset is None
    assert text(with_it) == text(without)
    settings = Options(), Options(warm_start_match=0.0), Options(warm_start=False)
    for options, kept in zip(settings, (True, False, False), strict=True):
        _, state = body_on_plane(Cylinder(0.1, 0.2), position=(0, 0.2, 0), options=options)
        assert (state.contact_offset is not None) == kept
