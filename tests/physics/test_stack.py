"""Ten boxes stand still, and every level carries exactly what lies above it."""

import jax
import numpy as np
import pytest

from mathota_jax import Box, Options, Sphere, contact_forces, contacts
from tests.benchmarks.hard_scenes import column
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import (
    advance,
    advance_worlds,
    body_on_plane,
    box_stack,
    motion_and_penetration,
    record_worlds,
    repeat,
    stack,
    undamped,
)

COUNT, DEFAULT_GRAVITY = 10, 9.81


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_ten_boxes_stand(precision, gate):
    model, state = box_stack(COUNT)
    final, record = record_worlds(repeat(model, 1), repeat(state, 1), 1200, motion_and_penetration)
    start = np.asarray(state.position, dtype=float)[1:]
    moved = np.asarray(record["position"], dtype=float)[:, 0, 1:] - start
    gate("penetration in 5 s [m]", record["penetration"], 1e-3)
    gate("horizontal drift in 5 s [m]", np.linalg.norm(moved[..., [0, 2]], axis=-1), 1e-3)
    gate("vertical drift of any box in 5 s [m]", moved[..., 1], 1e-3)
    gate("speed at the end [m/s]", final.velocity[0, 1:], 1e-3)
    assert int(final.flags[0]) == 0


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_ten_boxes_stay_in_place(precision, gate):
    model, state = box_stack(COUNT)
    final, record = record_worlds(repeat(model, 1), repeat(state, 1), 1200, motion_and_penetration)
    moved = np.asarray(record["position"], dtype=float)[:, 0, 1:] - np.asarray(state.position, dtype=float)[1:]
    gate("penetration in 5 s [m]", record["penetration"], 1e-3)
    gate("horizontal drift in 5 s [m]", np.linalg.norm(moved[..., [0, 2]], axis=-1), 1e-3)
    gate("height lost between the second and the last second [m]", moved[-1, :, 1] - moved[240, :, 1], 1e-4)
    gate("speed at the end [m/s]", final.velocity[0, 1:], 1e-3)
    assert int(final.flags[0]) == 0


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_each_level_carries_the_weight_above_it(precision, gate):
    model, state = box_stack(COUNT)
    final = advance(model, state, 480)
    found = jax.jit(contacts)(model, final)
    forces = np.asarray(jax.jit(contact_forces)(model, final), dtype=float)
    lower = np.minimum(np.asarray(found.body_a), np.asarray(found.body_b))
    upper = np.maximum(np.asarray(found.body_a), np.asarray(found.body_b))
    sign = np.where(np.asarray(found.body_b) == upper, 1.0, -1.0)  # the force acts on B
    weight = float(model.mass[1]) * DEFAULT_GRAVITY
    for level in range(COUNT):
        between = (lower == level) & (upper == level + 1)
        carried = np.sum(sign[between, None] * forces[between], axis=0)
        gate(f"force under box {level + 1} / weight above", carried / ((COUNT - level) * weight) - [0, 1, 0], 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("warm_start", [True, False])
def test_warm_start_is_what_carries_a_tall_stack(float64, warm_start):
    """Cold sweeps need about 1.86 N^2 = 186 iterations for ten boxes (benchmark B3); ten of them must fall short."""
    model, state = box_stack(COUNT, options=Options(dt=1 / 240, warm_start=warm_start))
    final = advance(model, state, 240)
    sink = float(state.position[-1, 1] - final.position[-1, 1])
    assert (sink < 1e-3) == warm_start


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_dropped_boxes_come_to_rest(precision, gate):
    """Sweeps that lengthen their steps too far leave boxes creeping at mm/s after they have landed."""
    orientations = np.random.default_rng(0).normal(size=(16, 4))
    scenes = [
        body_on_plane(
            Box((0.1, 0.1, 0.1)),
            position=(0, 0.5, 0),
            orientation=tuple(q / np.linalg.norm(q)),
            friction=0.4,
            restitution=0.3,
            options=undamped(dt=1 / 240),
        )
        for q in orientations
    ]
    models, states = (stack(part) for part in zip(*scenes, strict=True))
    after = [advance_worlds(models, states, steps) for steps in (720, 960)]
    moved = [np.asarray(state.position, dtype=float)[:, 1] for state in after]
    gate("motion in the fourth second [m]", moved[1] - moved[0], 1e-5)
    gate("height above the ground [m]", moved[1][:, 1] - 0.1, 1e-4)


@pytest.mark.parametrize("solver", slow_but(("soft_step",), ("pgs", "soft_step")))
def test_a_column_of_balls_stays_aligned_to_the_last_bit(solver):
    """Nothing but round-off that goes sideways could start the lean of an equilibrium that is not stable."""
    model, state = column(8, Sphere(0.5), Options(dt=1 / 60, solver=solver))
    final = advance(model, state, 120)
    for moved in (final.position[:, ::2], final.velocity[:, ::2], final.angular_velocity):
        assert not np.asarray(moved).any()
    assert 7.4 < float(final.position[-1, 1]) < 7.5
