"""The programs for GPUs: what they compute, with kernels that are interpreted, and that all kinds of scenes have one.

Their truth is what the same step computes turn by turn, which other tests compare with closed forms.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from mathota_jax import Box, Hinge, Options, Plane, SceneBuilder, Sphere, batching, step
from mathota_jax.solver import rows, sweeps, visits
from mathota_jax.spatial import chunks
from mathota_jax.spatial.lanes import entries, written_out
from mathota_jax.spatial.settle import store
from mathota_jax.spatial.spread import add_slices, spread
from tests.marks import slow_but
from tests.scenes import repeat

WORLDS, STEPS = 3, 3


def boxes(count, options):
    """Boxes on each other and on a plane, pushed to the side."""
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0)), static=True)
    for k in range(count):
        builder.add_body(
            Box((0.2, 0.1, 0.2)), mass=1.0 + k, position=(0.01 * k, 0.1 + 0.2 * k, 0), velocity=(1, 0, 0.3)
        )
    return builder.build(options)


def balls(options):
    """Balls on a plane that run into each other."""
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0)), static=True)
    for k in range(4):
        place = (0.199 * k, 0.1, 0)
        builder.add_body(Sphere(0.1), mass=1.0, position=place, velocity=(1.0 - k, 0, 0), restitution=0.3)
    return builder.build(options)


def arm(options):
    """A driven arm of two links that pushes a box."""
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0)), static=True)
    post = builder.add_body(Sphere(0.02), static=True, position=(0, 0.5, 0), collides=False)
    upper = builder.add_body(Box((0.2, 0.02, 0.02)), mass=1.0, position=(0.2, 0.5, 0), collides=False)
    lower = builder.add_body(Box((0.02, 0.2, 0.02)), mass=1.0, position=(0.4, 0.3, 0))
    builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(0.5195, 0.1, 0))
    builder.add_joint(Hinge(post, upper, (0, 0.5, 0), (0, 0, 1), limits=(-0.3, 0.3)))
    elbow = builder.add_joint(Hinge(upper, lower, (0.4, 0.5, 0), (0, 0, 1)))
    builder.add_motor(elbow, kind="velocity")
    return builder.build(options)


SCENES = {
    "box": lambda: boxes(1, Options(dt=1 / 240)),
    "boxes": lambda: boxes(3, Options(dt=1 / 240)),
    "boxes by places": lambda: boxes(4, Options(dt=1 / 240, pair_capacity=8)),
    "boxes along directions": lambda: boxes(3, Options(dt=1 / 240, conjugate=True)),
    "boxes by places along directions": lambda: boxes(4, Options(dt=1 / 240, pair_capacity=8, conjugate=True)),
    "boxes in soft steps": lambda: boxes(2, Options(dt=1 / 240, solver="soft_step")),
    "boxes, converged": lambda: boxes(2, Options(dt=1 / 240, solver="converged")),
    "balls by places": lambda: balls(Options(dt=1 / 240, pair_capacity=10)),
    "balls at their impacts": lambda: balls(Options(dt=1 / 240, impact_events=2)),
    "arm": lambda: arm(Options(dt=1 / 240)),
}


DERIVATIVES = ("box", "balls by places")


def motion(name):
    """The scene, different speeds of some worlds, and the function that moves these: (model, speeds) -> state."""
    model, state = SCENES[name]()
    speeds = jnp.asarray(np.random.default_rng(0).normal(size=(WORLDS, *state.velocity.shape)), state.velocity.dtype)

    def move(model, speeds):
        start = dataclasses.replace(repeat(state, WORLDS), velocity=state.velocity + 0.1 * speeds)
        action = jnp.ones((WORLDS, len(model.scene.motors)))
        return jax.lax.fori_loop(0, STEPS, lambda _, now: jax.vmap(step, (None, 0, 0))(model, now, action), start)

    return model, speeds, move


@pytest.fixture
def make_for_gpu(monkeypatch):
    """() -> None: from then on programs are those for GPUs, whose kernels are interpreted."""

    def make():
        for module in (chunks, rows, sweeps):
            monkeypatch.setattr(module, "by_platform", lambda anywhere, on_gpu, result, *args: on_gpu(*args))
        monkeypatch.setattr(visits, "run", functools.partial(visits.run, interpret=True))
        forget_traces()

    yield make
    monkeypatch.undo()
    forget_traces()


def forget_traces():
    batching._traced.cache_clear()
    jax.clear_caches()


@pytest.mark.parametrize("name", slow_but(("box",), SCENES))
def test_a_step_is_the_same(name, make_for_gpu, gate):
    model, speeds, move = motion(name)
    expected = jax.jit(move)(model, speeds)
    make_for_gpu()
    found = jax.jit(move)(model, speeds)
    assert np.ptp(expected.position, axis=0).max() > 1e-4
    for leaf in ("position", "orientation", "velocity", "angular_velocity"):
        gate(leaf, getattr(found, leaf) - getattr(expected, leaf), 2e-5)
    np.testing.assert_array_equal(found.flags, expected.flags)


@pytest.mark.slow
@pytest.mark.parametrize("name", DERIVATIVES)
def test_its_derivatives_are_the_same(name, make_for_gpu, gate):
    model, speeds, move = motion(name)
    weights = np.random.default_rng(1).normal(size=speeds.shape)

    def total(model, speeds):
        state = jax.vmap(step, (None, 0))(model, move(model, speeds))
        return (weights * (state.velocity + state.angular_velocity)).sum()

    derivative = jax.grad(total, argnums=(0, 1), allow_int=True)
    expected = jax.jit(derivative)(model, speeds)
    make_for_gpu()
    found = jax.jit(derivative)(model, speeds)
    gate("by speed", found[1] - expected[1], 1e-4)
    gate("by friction", found[0].friction - expected[0].friction, 1e-4)
    gate("by mass", found[0].mass - expected[0].mass, 1e-4)


@pytest.mark.parametrize("name", SCENES)
def test_programs_for_gpus_can_be_made_anywhere(name):
    """Lowering for CUDA writes the kernels out, and says if it does not know how."""
    model, speeds, move = motion(name)
    text = jax.jit(move).trace(model, speeds).lower(lowering_platforms=("cuda",)).as_text()
    assert ("xla.gpu.triton" in text) == (name not in ("boxes, converged", "boxes in soft steps"))


def test_a_function_is_written_out():
    """All kinds of operations that rows need, for vectors of 4 columns and 5 worlds, against the function of arrays."""
    random = np.random.default_rng(0)
    values, factors = random.normal(size=(2, 3, 4, 5)), random.normal(size=(3, 1, 5))

    def function(number, values, factors):
        first, others = values[:, :1], values[:, 1:]
        turned = jnp.concatenate([others, -first], axis=1).transpose(1, 0, 2, 3)
        summed = add_slices(spread(factors, values[0].shape) * values, 2)
        chosen = jnp.where(number < 2, turned, jnp.sqrt(jnp.abs(turned)))
        least = jnp.stack(lax.split(chosen, (1, 2), 0)[1:]).min(0)
        return {"sum": summed, "chosen": store(chosen, chosen), "least": least / 3, "count": (values > 0).sum(0) * 2}

    def of_rows(array, columns):
        flat = array.reshape(-1, *array.shape[-1 - columns :])
        shape = array.shape[: -1 - columns]
        return entries(shape, [jnp.asarray(x).reshape(-1, 5) for x in flat], bool(columns))

    for number in (1, 3):
        expected = function(number, jnp.asarray(values), jnp.asarray(factors))
        found = written_out(function, 4, jnp.int32(number), of_rows(values, 1), of_rows(factors, 0))
        for name, truth in expected.items():
            together = [jnp.broadcast_to(x, (4 if found[name].columns else 1, 5)) for x in found[name].vectors.flat]
            np.testing.assert_allclose(np.reshape(together, truth.shape), truth, rtol=1e-6)


@pytest.mark.parametrize("function", [lambda x: x[:, :1], jnp.sort, lambda x: x.reshape(-1, x.shape[-1])])
def test_what_can_not_be_written_out_is_named(function):
    array = entries((2,), [jnp.ones((4, 5))] * 2, columns=True)
    with pytest.raises(NotImplementedError, match="written_out"):
        written_out(function, 4, array)
