"""Torque-free tumbling of a box about its middle axis (benchmark A7, the tennis-racket flip)."""

import functools

import numpy as np
import pytest

from mathota_jax import Box, SceneBuilder
from tests.scenes import (
    advance_worlds,
    angle_between,
    motion,
    record_worlds,
    rotation_matrix,
    stack,
    torque_free,
    undamped,
    with_dt,
)

INERTIA = np.array([0.13, 0.10, 0.05]) / 3
SPINS = {"a": np.array([0.1, 10.0, 0.0]), "b": np.array([1.0, 10.0, 0.0])}
# Benchmark A7: body angular velocity and orientation at t = 10 s.
END = {
    "a": ([1.040004502, 9.887924581, 1.292946483], [-0.46322809, -0.050736984, -0.882937049, -0.057163462]),
    "b": ([2.722619486, -9.309225194, -3.162869696], [-0.247483571, -0.073146581, 0.070432482, -0.963556291]),
}
FLIP_INTERVAL = {"a": 2.341891, "b": 1.378374}


@functools.cache
def reference(case):
    return torque_free(INERTIA, SPINS[case], 10)


def tumbling_worlds():
    worlds = []
    for spin in SPINS.values():
        builder = SceneBuilder(gravity=(0, 0, 0))
        builder.add_body(Box((0.1, 0.2, 0.3)), mass=1.0, angular_velocity=spin)
        worlds.append(builder.build(undamped()))
    return stack([model for model, _ in worlds]), stack([state for _, state in worlds])


def spin_invariants(orientation, omega):
    rotation = rotation_matrix(orientation)
    body_omega = np.einsum("...ji,...j->...i", rotation, np.asarray(omega, dtype=float))
    momentum = np.einsum("...ij,...j->...i", rotation, INERTIA * body_omega)
    return momentum, 0.5 * np.sum(INERTIA * body_omega**2, axis=-1), body_omega


@pytest.mark.parametrize("case", ["a", "b"])
def test_two_independent_references_agree(case):
    omega, orientation = END[case]
    np.testing.assert_allclose(reference(case)[4:], omega, atol=2e-8)
    assert angle_between(reference(case)[:4], orientation) < 2e-8


def test_principal_inertia_of_the_box(precision, gate):
    models, _ = tumbling_worlds()
    gate("inertia / truth - 1", np.sort(models.inertia[0, 0]) / np.sort(INERTIA) - 1, 1e-6)


def test_momentum_and_energy_are_kept_and_do_not_drift(precision, gate):
    models, states = tumbling_worlds()
    _, record = record_worlds(with_dt(models, 1e-2), states, 10_000, motion)
    orientation, omega = record["orientation"][:, :, 0], record["angular_velocity"][:, :, 0]
    momentum, energy, body_omega = spin_invariants(orientation, omega)
    for world, (case, spin) in enumerate(SPINS.items()):
        start = INERTIA * spin
        start_energy = 0.5 * np.sum(INERTIA * spin**2)
        error = np.linalg.norm(momentum[:, world] - start, axis=-1) / np.linalg.norm(start)
        drift = energy[:, world] / start_energy - 1
        gate(f"{case}: momentum over 10 s, dt 0.01", error[:1000], {"float32": 1e-5, "float64": 1e-6}[str(precision)])
        gate(f"{case}: energy over 10 s, dt 0.01", drift[:1000], 1e-3)
        gate(f"{case}: energy over 100 s, dt 0.01 (no secular part)", drift, 1e-3)

        middle = body_omega[:1000, world, 1]
        flips = 1e-2 * (np.flatnonzero(np.diff(np.sign(middle)) != 0) + 1.5)
        assert flips.size >= 3, "the box never flips: is the gyroscopic term missing?"
        gate(f"{case}: mean flip interval / truth - 1", np.mean(np.diff(flips)) / FLIP_INTERVAL[case] - 1, 0.02)


def test_end_state_converges_to_the_reference_at_second_order(float64, gate):
    models, states = tumbling_worlds()
    errors = {}
    for dt in (2e-3, 1e-3):
        final = advance_worlds(with_dt(models, dt), states, round(10 / dt))
        _, _, body_omega = spin_invariants(final.orientation[:, 0], final.angular_velocity[:, 0])
        for world, case in enumerate(SPINS):
            truth = reference(case)
            errors[case, dt] = float(angle_between(final.orientation[world, 0], truth[:4]))
            if dt == 1e-3:
                gate(f"{case}: orientation at 10 s, dt 0.001 [rad]", errors[case, dt], 0.05)
                gate(f"{case}: body angular velocity at 10 s / |omega|", (body_omega[world] - truth[4:]) / 10, 0.05)
    for case in SPINS:
        ratio = errors[case, 2e-3] / errors[case, 1e-3]
        assert ratio > 3 or errors[case, 2e-3] < 1e-8, f"{case}: halving dt divides the error by {ratio:.2f} only"
