"""Large batches are computed some worlds at a time: every world as in a small batch, in less memory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, step
from mathota_jax.spatial.world_parts import FEWEST, LANES, MOST, by_parts, part_size, part_size_of_derivative
from tests.marks import slow_but
from tests.scenes import repeat, undamped

WORLDS, SMALL, STEPS = 600, 200, 4


def sliding():
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.5)
    builder.add_body(Box((0.5, 0.5, 0.5)), mass=1.0, position=(0, 0.5, 0), friction=0.5)
    return builder.build(undamped(dt=1 / 240))


def flying():
    builder = SceneBuilder()
    builder.add_body(Box((0.5, 0.5, 0.5)), mass=1.0)
    return builder.build(undamped(dt=1 / 240))


def speeds():
    rng = np.random.default_rng(3)
    return jnp.asarray(rng.uniform([-2, -0.2, -2, 0.2], [2, 0.0, 2, 0.8], (WORLDS, 4)))


def outcome(parameters):
    """Position, velocity and spin after some steps, by velocity and friction."""
    model, state = sliding()
    model = dataclasses.replace(model, friction=jnp.full_like(model.friction, parameters[3]))
    state = dataclasses.replace(state, velocity=state.velocity.at[1].set(parameters[:3]))
    final = jax.lax.scan(lambda state, _: (step(model, state), None), state, length=STEPS)[0]
    return jnp.concatenate([final.position[1], final.velocity[1], final.angular_velocity[1]])


def outcome_of_shared_model(speed):
    """The same with one model for all worlds."""
    model, state = sliding()
    state = dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(speed[0]))
    return step(model, state).velocity[1]


def along(parameters):
    return jax.jvp(outcome, (parameters,), (jnp.ones_like(parameters),))[1]


FUNCTIONS = {
    "values": outcome,
    "shared model": outcome_of_shared_model,
    "gradient": jax.grad(lambda parameters: jnp.sum(jnp.sin(outcome(parameters)))),
    "tangent": along,
}


def program(function, batch, platform):
    """The program for a batch, as text."""
    return jax.jit(jax.vmap(function)).trace(batch).lower(lowering_platforms=(platform,)).as_text()


@pytest.mark.parametrize("name", slow_but(("values", "shared model"), FUNCTIONS))
def test_worlds_are_those_of_small_batches(float64, name):
    batch = speeds()
    mapped = jax.jit(jax.vmap(FUNCTIONS[name]))
    small = [mapped(batch[first : first + SMALL]) for first in range(0, WORLDS, SMALL)]
    np.testing.assert_allclose(mapped(batch), np.concatenate(small), rtol=1e-11, atol=1e-12)


@pytest.mark.slow
def test_gradient_by_what_all_worlds_share(float64):
    """A friction that belongs to no world gets the sum over all parts."""
    batch = speeds()

    def cost(friction, rows):
        of_world = jax.vmap(lambda row: outcome(row.at[3].set(friction)))(rows)
        return jnp.sum(jnp.sin(of_world))

    gradient = jax.jit(jax.grad(cost))
    small = [gradient(0.4, batch[first : first + SMALL]) for first in range(0, WORLDS, SMALL)]
    np.testing.assert_allclose(gradient(0.4, batch), np.sum(small), rtol=1e-11)


def test_a_broken_world_leaves_the_others_of_its_part_alone():
    model, state = sliding()
    states = repeat(state, WORLDS)
    broken = dataclasses.replace(states, velocity=states.velocity.at[450].set(jnp.nan))
    mapped = jax.jit(jax.vmap(step, in_axes=(None, 0)))
    others = np.arange(WORLDS) != 450
    healthy, found = mapped(model, states), mapped(model, broken)
    np.testing.assert_array_equal(found.position[others], healthy.position[others])
    assert np.asarray(found.flags)[~others].all() and not np.asarray(found.flags)[others].any()


def loops_more(make, platform):
    """Whether the program for many worlds has one loop more than that for few, beside those of the step."""
    model, state = make()

    def one(state):
        return step(model, state)

    counts = [program(one, repeat(state, count), platform).count("stablehlo.while") for count in (SMALL, WORLDS)]
    return counts[1] - counts[0]


def test_only_where_it_pays():
    assert loops_more(sliding, "cpu") == 1
    assert loops_more(flying, "cpu") == 0
    assert loops_more(sliding, "cuda") == 0


def test_memory_of_many_worlds():
    """A part's intermediate results, not a batch's."""
    model, state = sliding()

    def bytes_a_world(count):
        compiled = jax.jit(jax.vmap(lambda state: step(model, state))).lower(repeat(state, count)).compile()
        analysis = compiled.memory_analysis()
        assert analysis is not None
        return analysis.temp_size_in_bytes / count

    assert bytes_a_world(16 * SMALL) < 0.5 * bytes_a_world(SMALL)


@pytest.mark.parametrize("worlds", [1, 63, 64, 383, 384, 600, 1000, 4096, 4097])
@pytest.mark.parametrize("numbers", [0, 55, 1000, 10**6])
def test_part_size(worlds, numbers):
    size = part_size(worlds, [np.zeros((0 if worlds == 1 else numbers, worlds), np.float32), np.zeros((5, 1))])
    if size < worlds:
        assert size % LANES == 0
        assert FEWEST / 1.5 <= size <= MOST * 1.5
        assert worlds <= -(-worlds // size) * size < worlds + 2 * size
    else:
        assert worlds < 1.5 * MOST


@pytest.mark.parametrize(("kilobytes", "expected"), [(40, 256), (230, 256), (1000, 64), (10000, 64)])
def test_derivatives_of_what_computes_much_go_in_smaller_parts(kilobytes, expected):
    """As measured: a sliding box, five links, five stacked boxes; and a pile."""

    program = jax.make_jaxpr(lambda x: jnp.sin(jnp.sin(x)))(jnp.zeros((125 * kilobytes, 256), jnp.float32))
    assert part_size_of_derivative(1024, program, 256) == expected
    assert part_size_of_derivative(1024, program, 64) == 64  # never larger than of the function
    assert part_size_of_derivative(40, program, 40) == 40


@pytest.mark.parametrize("worlds, size", [(96, 32), (100, 32), (33, 32)])
def test_parts_that_do_not_come_out_even(worlds, size):
    wide, shared = jnp.arange(3.0 * worlds).reshape(3, worlds), jnp.full((1, 1), 7.0)
    sums, constant = by_parts(lambda arrays: [arrays[0].sum(0) * arrays[1][0], arrays[1]], [wide, shared], size)
    np.testing.assert_array_equal(sums, wide.sum(0) * 7.0)
    np.testing.assert_array_equal(constant, shared)
