"""A function of some of many pairs: the same numbers, whichever way it is computed, and nothing else is touched."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Cylinder, Options, Polyhedron, SceneBuilder, step
from mathota_jax.spatial import wanted as module
from mathota_jax.spatial.wanted import LANES, of_wanted
from tests.hulls import BOX_CORNERS

CUBE = Polyhedron(0.5 * BOX_CORNERS)


def mixed(values, _):
    """Of numbers of every kind, some of which pairs, worlds or all share."""
    own, of_pair, of_world, of_all, code = values
    total = own + of_pair[0] + of_pair[1] * of_all
    return {"float": total + of_world, "int": code + 1, "bool": (total > 0) & (code > 0)}


@pytest.mark.parametrize(("pairs", "worlds"), [(1, 1), (3, 1), (1, 5), (7, 3 * LANES // 4)])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_every_wanted_pair_and_no_other(pairs, worlds, share, float64):
    rng = np.random.default_rng(pairs + worlds)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape))  # noqa: E731
    values = (
        draw(pairs, worlds),
        draw(2, pairs, 1),
        draw(1, worlds),
        draw(1, 1),
        jnp.asarray(rng.integers(-5, 5, (pairs, worlds)), jnp.int32),
    )
    wanted = jnp.asarray(rng.uniform(size=(pairs, worlds)) < share)
    otherwise = {
        "float": draw(pairs, worlds),
        "int": jnp.full((pairs, worlds), 77, jnp.int32),
        "bool": jnp.asarray(rng.uniform(size=(pairs, worlds)) < 0.5),
    }
    found = jax.jit(lambda *args: of_wanted(mixed, *args))(wanted, values, otherwise)
    at_once = module._at_once(mixed, wanted, values, otherwise)
    for name, truth in mixed(values, wanted).items():
        for way in (found, at_once):
            expected = np.where(wanted, truth, otherwise[name])
            np.testing.assert_allclose(way[name], expected, rtol=1e-15, atol=1e-15)
            assert way[name].dtype == otherwise[name].dtype


def test_batches_of_tables(float64):
    """As where chunks of a list are worked on at once."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 4, 50))
    wanted = rng.uniform(size=values.shape) < 0.3
    found = jax.jit(jax.vmap(lambda w, v: of_wanted(lambda v, _: jnp.exp(v), w, v, v)))(wanted, values)
    np.testing.assert_allclose(found, np.where(wanted, np.exp(values), values), rtol=1e-15)


@pytest.mark.parametrize(
    "shape", [pytest.param(CUBE, id="hulls"), pytest.param(Cylinder(0.5, 0.5), id="cylinders", marks=pytest.mark.slow)]
)
def test_programs_for_gpus(shape):
    """Close pairs are worked on at once there, chunks of them side by side; forwards and with derivatives."""
    builder = SceneBuilder()
    for k in range(3):
        builder.add_body(shape, mass=1.0, position=(0, 0.9 * k, 0))
    model, state = builder.build(Options(broadphase="all_pairs"))

    def heights(speed):
        return step(model, dataclasses.replace(state, velocity=state.velocity + speed)).position[:, 1].sum()

    for program in (heights, jax.grad(heights)):
        text = jax.jit(program).trace(0.0).lower(lowering_platforms=("cuda",)).as_text()
        assert "optimization_barrier" in text
