"""One world of eight is given what can not be, or a time step out of all proportion (benchmark B15).

What a builder refuses is in `test_builder_errors`, overflow of capacities in `test_broadphase` and `test_many_bodies`,
identical and contradicting joints in `test_mechanism_steps`.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Flag, Hinge, Plane, SceneBuilder, energy, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, advance_worlds, repeat, undamped

WORLDS, BAD = 8, 3
HEALTHY = np.arange(WORLDS) != BAD


@functools.cache
def scene(x64, swings=True):
    """Two boxes at rest on each other, and one that swings from the upper of them; `x64` belongs to the key."""
    del x64
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, restitution=0.5)
    for level in range(2):
        builder.add_body(Box((0.5, 0.5, 0.5)), mass=10.0, position=(0, 0.5 + level, 0), restitution=0.5)
    arm = builder.add_body(Box((0.1, 0.3, 0.1)), mass=1.0, position=(0.0, 1.2, 0.8))
    if swings:
        builder.add_joint(Hinge(2, arm, (0, 1.5, 0.8), (0, 0, 1), limits=(-1.0, 1.0)))
    return builder.build(undamped(dt=1 / 60))


def batch(**options):
    model, state = scene(jax.config.jax_enable_x64, **options)
    states = repeat(state, WORLDS)
    push = jnp.linspace(0.1, 2.0, WORLDS)
    return repeat(model, WORLDS), dataclasses.replace(states, velocity=states.velocity.at[:, 3, 0].set(push))


def of_state(field, entry, value):
    def change(models, states):
        leaf = getattr(states, field)
        return models, dataclasses.replace(states, **{field: leaf.at[(BAD, *entry)].set(value)})

    return change


def of_model(field, value, *entry):
    def change(models, states):
        leaf = getattr(models, field)
        return dataclasses.replace(models, **{field: leaf.at[(BAD, *entry)].set(value)}), states

    return change


def no_size(models, states):
    shapes = {
        kind: {name: leaf.at[BAD].set(0.0) for name, leaf in leaves.items()} if kind == "box" else leaves
        for kind, leaves in models.shapes.items()
    }
    return dataclasses.replace(models, shapes=shapes, size=models.size.at[BAD, 1:].set(0.0)), states


BAD_WORLDS = {
    "position NaN": of_state("position", (1, 0), jnp.nan),
    "velocity infinite": of_state("velocity", (2, 1), jnp.inf),
    "orientation 0": of_state("orientation", (1,), 0.0),
    "mass 0": of_model("mass", 0.0, 1),
    "mass negative": of_model("mass", -1.0, 1),
    "mass NaN": of_model("mass", jnp.nan, 1),
    "inertia 0": of_model("inertia", 0.0, 1),
    "size 0": no_size,
    "friction -1": of_model("friction", -1.0),
    "restitution 2": of_model("restitution", 2.0),
    "gravity infinite": of_model("gravity", jnp.inf),
    "dt 0": of_model("dt", 0.0),
    "dt 1e-12": of_model("dt", 1e-12),
    "dt 1": of_model("dt", 1.0),
    "dt 100": of_model("dt", 100.0),
    "dt -1/60": of_model("dt", -1 / 60),
    "dt NaN": of_model("dt", jnp.nan),
}


def finite(states):
    """Whether each world is."""
    leaves = [states.position, states.orientation, states.velocity, states.angular_velocity]
    return np.all([np.isfinite(leaf).all((1, 2)) for leaf in leaves], axis=0)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_bad_world_leaves_the_others_alone(precision):
    """The other seven are the same to the bit; the bad one is finite or flagged."""
    models, states = batch()
    clean = advance_worlds(models, states, 20)
    assert finite(clean).all() and not np.asarray(clean.flags).any()
    for name, change in BAD_WORLDS.items():
        mixed = advance_worlds(*change(models, states), 20)
        for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(clean), jax.tree.leaves(mixed), strict=True):
            where = f"{name}: {jax.tree_util.keystr(path)}"
            np.testing.assert_array_equal(np.asarray(a)[HEALTHY], np.asarray(b)[HEALTHY], err_msg=where)
        flagged = bool(np.asarray(mixed.flags)[BAD] & Flag.NON_FINITE)
        assert flagged or finite(mixed)[BAD], f"{name}: not finite, and not flagged"


@jax.jit
def slopes(models, states):
    """Of where the bodies are after a step, by the velocities before it and the masses, in each world."""

    def places(model, state, velocity, mass):
        after = step(dataclasses.replace(model, mass=mass), dataclasses.replace(state, velocity=velocity))
        return jnp.sum(after.position)

    return jax.vmap(jax.grad(places, (2, 3)))(models, states, states.velocity, models.mass)


@pytest.mark.slow
@pytest.mark.parametrize("swings", [False, True])
def test_a_bad_world_leaves_the_derivatives_of_the_others_alone(swings):
    """The same to the bit, and finite."""
    models, states = batch(swings=swings)
    clean = [np.asarray(slope)[HEALTHY] for slope in slopes(models, states)]
    assert all(np.isfinite(slope).all() and slope.any() for slope in clean)
    for name, change in BAD_WORLDS.items():
        for slope, mixed in zip(clean, slopes(*change(models, states)), strict=True):
            np.testing.assert_array_equal(slope, np.asarray(mixed)[HEALTHY], err_msg=name)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize(
    ("steps", "swings"),
    [
        pytest.param((1e-12, 1e-6, 1e-3, 1 / 60, 0.1, 0.3, 0.6, 1.0), True, id="up to 1 s"),
        pytest.param((10.0, 100.0), True, id="10 and 100 s"),
        pytest.param((30.0, 100.0), False, id="no joint, 30 and 100 s"),
    ],
)
def test_time_steps_out_of_all_proportion(precision, steps, swings, gate):
    """Finite; nothing gains energy, from whatever side of round-off it starts."""
    models, states = batch(swings=swings)
    times = np.resize(steps, WORLDS)
    nudge = 1e-6 * np.random.default_rng(0).normal(size=states.position[:, 1:].shape)
    states = dataclasses.replace(
        states,
        position=states.position.at[:, 1:].add(jnp.asarray(nudge, states.position.dtype)),
        velocity=jnp.zeros_like(states.velocity),
    )
    models = dataclasses.replace(models, dt=jnp.asarray(times, models.dt.dtype))
    before = np.asarray(jax.vmap(energy)(models, states), float)
    rise = np.zeros(WORLDS)
    for _ in range(20):
        states = advance_worlds(models, states, 1)
        rise = np.maximum(rise, np.asarray(jax.vmap(energy)(models, states), float) - before)
    assert finite(states).all()
    # 10 kg and 10 kg lifted by their height.
    gate("energy gained / that of the boxes", rise / (2 * 10 * 9.81), 0.01)
