"""Oblique collision and Newton's cradle (benchmark A13)."""

import numpy as np
import pytest

from mathota_jax import SceneBuilder, Sphere
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import advance, undamped, with_dt


def two_balls():
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 0.9, "friction": 0.0}
    builder.add_body(Sphere(0.2), mass=1.0, velocity=(2.0, 0.0, 0.0), **surface)
    builder.add_body(Sphere(0.2), mass=2.0, position=(1.0, 0.2, 0.0), **surface)
    return builder.build(undamped(impact_events=1))


def cradle(gap, velocity_iterations=10, impact_events=0):
    builder = SceneBuilder(gravity=(0, 0, 0))
    for index in range(5):
        builder.add_body(
            Sphere(0.05),
            mass=1.0,
            position=(index * (0.1 + gap), 0.0, 0.0),
            velocity=(1.0 if index == 0 else 0.0, 0.0, 0.0),
            restitution=1.0,
            friction=0.0,
        )
    return builder.build(undamped(dt=1 / 240, velocity_iterations=velocity_iterations, impact_events=impact_events))


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
def test_oblique_collision(precision, dt, gate):
    model, state = two_balls()
    final = advance(with_dt(model, dt), state, round(1 / dt))
    truth = np.array([[0.720910347, -0.738482756, 0.0], [1.639544827, 0.569241378, 0.0]])
    gate(f"positions after 1 s, dt {dt:.4f} [m]", final.position - truth, 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_cradle_passes_the_whole_velocity_on(precision, gate):
    model, state = cradle(1e-3, impact_events=3)  # a ball needs 1 ms for a gap: up to four impacts in a step
    final = advance(model, state, 24)
    gate("velocity of the last ball, missing [m/s]", max(0.0, 1 - final.velocity[4, 0]), 1e-3)
    gate("velocities of the others [m/s]", final.velocity[:4], 1e-3)
    gate("momentum [kg m/s]", final.velocity[:, 0].sum() - 1.0, {"float32": 1e-6, "float64": 1e-9}[str(precision)])


@pytest.mark.parametrize("impact_events", [0, 1])
def test_touching_cradle_keeps_momentum_and_energy(float64, impact_events, gate):
    """Which balls leave is not decided by rigid-body theory; momentum and energy are.

    Steps that split resolve what approaches before what only touches: then the last ball leaves alone, as real ones do.
    """
    model, state = cradle(0.0, velocity_iterations=100, impact_events=impact_events)
    final = advance(model, state, 24)
    if impact_events:
        gate("velocity of the last ball, missing [m/s]", final.velocity[4, 0] - 1.0, 1e-9)
    gate("momentum [kg m/s]", final.velocity[:, 0].sum() - 1.0, 1e-9)
    gate("energy / start - 1", np.sum(np.asarray(final.velocity) ** 2) - 1.0, 1e-6)
