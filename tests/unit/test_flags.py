"""A world that becomes NaN is flagged and does not touch its neighbours."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.scenes import advance_worlds, box_stack, repeat, sphere_on_plane

WORLDS, BAD = 5, 2


def batch(scene):
    model, state = scene()
    states = repeat(state, WORLDS)
    push = 0.1 * jnp.arange(WORLDS)
    return repeat(model, WORLDS), dataclasses.replace(states, velocity=states.velocity.at[:, -1, 0].add(push))


SCENES = {
    "sphere": lambda: sphere_on_plane(height=0.2),
    "bouncing sphere": lambda: sphere_on_plane(height=0.2, restitution=0.7),
    "boxes": lambda: box_stack(3),
}


@pytest.mark.parametrize("field", ["position", "orientation", "velocity", "angular_velocity"])
@pytest.mark.parametrize("scene", SCENES)
def test_nan_world_is_flagged_and_the_others_are_bit_identical(scene, field):
    models, states = batch(SCENES[scene])
    poisoned = dataclasses.replace(states, **{field: getattr(states, field).at[BAD, -1, 0].set(jnp.nan)})
    clean = advance_worlds(models, states, 20)
    mixed = advance_worlds(models, poisoned, 20)
    healthy = np.arange(WORLDS) != BAD
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(clean), jax.tree.leaves(mixed), strict=True):
        name = jax.tree_util.keystr(path)
        np.testing.assert_array_equal(np.asarray(a)[healthy], np.asarray(b)[healthy], err_msg=name)
    np.testing.assert_array_equal(np.asarray(mixed.flags) != 0, ~healthy)
    assert not np.any(np.asarray(clean.flags))


def test_infinity_is_flagged_too():
    models, states = batch(SCENES["sphere"])
    poisoned = dataclasses.replace(states, velocity=states.velocity.at[BAD, -1, 1].set(jnp.inf))
    flags = np.asarray(advance_worlds(models, poisoned, 1).flags)
    np.testing.assert_array_equal(flags != 0, np.arange(WORLDS) == BAD)


@pytest.mark.parametrize("value", [jnp.nan, 0.0, -1.0])
@pytest.mark.parametrize("name", ["mass", "inertia"])
def test_bad_parameter_of_one_world_is_flagged(name, value):
    models, states = batch(SCENES["sphere"])
    models = dataclasses.replace(models, **{name: getattr(models, name).at[BAD, -1].set(value)})
    final = advance_worlds(models, states, 40)
    np.testing.assert_array_equal(np.asarray(final.flags) != 0, np.arange(WORLDS) == BAD)


def test_flag_stays_until_the_user_clears_it():
    """A flag is a record: a world whose state is mended keeps it, and may be cleared with `replace`."""
    models, states = batch(SCENES["sphere"])
    poisoned = dataclasses.replace(states, velocity=states.velocity.at[BAD, -1, 0].set(jnp.nan))
    flagged = advance_worlds(models, poisoned, 1)
    mended = dataclasses.replace(states, flags=flagged.flags)
    assert int(advance_worlds(models, mended, 3).flags[BAD]) != 0
    cleared = dataclasses.replace(states, flags=jnp.zeros_like(flagged.flags))
    assert not np.any(np.asarray(advance_worlds(models, cleared, 3).flags))
