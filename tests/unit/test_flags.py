"""A world that becomes NaN is flagged and does not touch its neighbours."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Flag, Heightfield, Hinge, SceneBuilder, Sphere, step
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


@pytest.mark.parametrize(
    ("leaf", "value"),
    [("friction", -0.1), ("friction", jnp.nan), ("friction", jnp.inf), ("restitution", 1.5), ("restitution", jnp.nan)],
)
def test_surfaces_that_no_body_has_are_flagged(leaf, value):
    models, states = batch(lambda: sphere_on_plane(height=0.2, restitution=0.7, friction=0.5))
    wrong = dataclasses.replace(models, **{leaf: getattr(models, leaf).at[BAD, 1].set(value)})
    flags = np.asarray(advance_worlds(wrong, states, 1).flags)
    np.testing.assert_array_equal(flags, np.where(np.arange(WORLDS) == BAD, int(Flag.INVALID_PARAMETER), 0))


@pytest.mark.parametrize("value", [-0.1, 0.0, jnp.nan])
def test_sizes_that_no_shape_has_are_flagged(value):
    models, states = batch(SCENES["boxes"])
    half = models.shapes["box"]["half_extents"].at[BAD, 0, 1].set(value)
    wrong = dataclasses.replace(models, shapes=models.shapes | {"box": {"half_extents": half}})
    flags = np.asarray(advance_worlds(wrong, states, 1).flags)
    np.testing.assert_array_equal(flags & int(Flag.INVALID_PARAMETER) != 0, np.arange(WORLDS) == BAD)


def test_moments_that_a_program_for_cubes_does_not_know_are_flagged():
    """They were taken along the axes of the world."""
    models, states = batch(SCENES["boxes"])
    flags = np.asarray(advance_worlds(dataclasses.replace(models, inertia=2.0 * models.inertia), states, 1).flags)
    assert not flags.any()
    unequal = dataclasses.replace(models, inertia=models.inertia.at[BAD, 1, 0].multiply(1.5))
    flags = np.asarray(advance_worlds(unequal, states, 1).flags)
    np.testing.assert_array_equal(flags & int(Flag.INVALID_PARAMETER) != 0, np.arange(WORLDS) == BAD)


def test_bodies_larger_than_what_is_searched_of_a_heightfield_are_flagged():
    """A box made larger fell through a spike beside the cells that the built one could touch."""
    builder = SceneBuilder()
    builder.add_body(Heightfield(np.zeros((9, 9)), 0.1), static=True)
    builder.add_body(Box((0.05, 0.1, 0.05)), mass=1.0, position=(0, 0.3, 0))
    model, state = builder.build()
    factors = jnp.asarray([1.0, 1.1, 5.0])

    def flags(factor):
        box = {"half_extents": model.shapes["box"]["half_extents"] * factor}
        return step(dataclasses.replace(model, shapes=model.shapes | {"box": box}), state).flags

    found = np.asarray(jax.jit(jax.vmap(flags))(factors))
    np.testing.assert_array_equal(found & int(Flag.INVALID_PARAMETER) != 0, [False, False, True])


RESISTANCES = ("joint_damping", "joint_friction", "joint_stiffness", "joint_armature")
WRONG_OF_JOINTS = [
    *((leaf, value) for leaf in RESISTANCES for value in (-0.1, jnp.nan, jnp.inf)),
    ("joint_limits", (1.0, -1.0)),
    ("joint_limits", (-1.0, jnp.nan)),
    ("joint_swing", -0.1),
    *((leaf, -1.0) for leaf in ("motor_limit", "motor_cap", "motor_stiffness", "motor_damping")),
    ("size", -1.0),
    ("size", jnp.inf),
]


def test_joints_that_nobody_builds_are_flagged():
    """One world for each leaf that is out of range, and a last one with a stop that is no more, which is none."""
    builder = SceneBuilder()
    arms = [builder.add_body(Sphere(0.1), mass=1.0, position=(i, 0, 0)) for i in range(3)]
    features = {"damping": 0.1, "friction": 0.1, "stiffness": 1.0, "armature": 0.1}
    driven = builder.add_joint(Hinge(arms[0], arms[1], (0.5, 0, 0), (0, 0, 1), limits=(-1.0, 1.0), **features))
    builder.add_joint(BallAndSocket(arms[1], arms[2], (1.5, 0, 0), axis=(1, 0, 0), swing=0.5, damping=0.1))
    builder.add_motor(driven, kind="position", stiffness=1.0, damping=0.1, cap=1.0)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0, 9, 0))
    model, state = builder.build()
    worlds = [
        dataclasses.replace(model, **{leaf: getattr(model, leaf).at[0].set(value)}) for leaf, value in WRONG_OF_JOINTS
    ]
    worlds.append(
        dataclasses.replace(model, joint_limits=jnp.full_like(model.joint_limits, jnp.inf) * jnp.array([-1, 1]))
    )
    models = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    flags = np.asarray(advance_worlds(models, repeat(state, len(worlds)), 1, jnp.zeros((len(worlds), 1))).flags)
    for case, flag in zip([*WRONG_OF_JOINTS, None], flags, strict=True):
        assert bool(flag & Flag.INVALID_PARAMETER) == (case is not None), case


def test_leaves_that_do_not_fit_are_named():
    model, state = box_stack(3)
    half = jnp.full((4, 3), 0.1)
    with pytest.raises(ValueError, match=r"model\.shapes\['box'\]\['half_extents'\] must have an entry for each box"):
        step(dataclasses.replace(model, shapes=model.shapes | {"box": {"half_extents": half}}), state)
    with pytest.raises(ValueError, match=r"model\.mass must be an array, got a list"):
        step(dataclasses.replace(model, mass=[1.0] * 4), state)
