"""Bodies that a step finds deep inside one another are flagged: half the inner radius of the smaller one is deep."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Flag, Plane, SceneBuilder, Sphere
from tests.marks import slow_but
from tests.scenes import advance_worlds, box_stack, motion_and_penetration, record_worlds, repeat, undamped

RADII = (1.0, 0.2)
OPTIONS = {
    "pgs": {},
    "listed": {"broadphase": "sort_and_sweep"},
    "soft_step": {"solver": "soft_step"},
    "converged": {"solver": "converged"},
    "impact_events": {"impact_events": 2},
}


def balls(overlap, **options):
    """Two balls that float, one above the other, overlapping by (world,) [m]; above a ground that is far away."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Plane((0, 1, 0)), static=True)
    for radius in RADII:
        builder.add_body(Sphere(radius), mass=1.0, position=(0, 10, 0), restitution=0.5)
    model, state = builder.build(undamped(dt=1 / 240, **options))
    states = repeat(state, len(overlap))
    height = 10.0 + sum(RADII) - jnp.asarray(overlap)
    return repeat(model, len(overlap)), dataclasses.replace(states, position=states.position.at[:, 2, 1].set(height))


@pytest.mark.parametrize("name", slow_but(("pgs",), tuple(OPTIONS)))
def test_half_of_the_inner_radius_of_the_smaller_body_is_deep(name):
    share = np.array([-1.0, 0.0, 0.3, 0.49, 0.51, 1.0, 1.7])
    models, states = balls(share * RADII[1], **OPTIONS[name])
    flags = np.asarray(advance_worlds(models, states, 1).flags)
    np.testing.assert_array_equal(flags, np.where(share > 0.5, int(Flag.DEEP_OVERLAP), 0))


@pytest.mark.parametrize("conjugate", slow_but((False,), (False, True)))
def test_a_heavy_body_that_is_pressed_through_a_light_one_does_not_pass_silently(conjugate):
    """B1: with ten sweeps 100 kg fall through 1 kg, unless they go along conjugate directions."""
    half = 0.1
    model, state = box_stack(2, half, undamped(dt=1 / 60, conjugate=conjugate))
    ratio = jnp.array([1.0, 100.0])
    models, states = repeat(model, 2), repeat(state, 2)
    models = dataclasses.replace(
        models, mass=models.mass.at[:, 2].set(ratio), inertia=models.inertia.at[:, 2].multiply(ratio[:, None])
    )
    final, record = record_worlds(models, states, 60, motion_and_penetration)
    deepest = np.asarray(record["penetration"])[:-1].max(0)  # steps look at where they start
    assert deepest[0] < 0.02 * half and (deepest[1] < 0.5 * half) == conjugate
    np.testing.assert_array_equal(np.asarray(final.flags), np.where(deepest > 0.5 * half, int(Flag.DEEP_OVERLAP), 0))
