"""Chains of hinges (benchmark A5) and a loop that constrains itself twice over."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Hinge, SceneBuilder, Sphere
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, invariants, motion, record_worlds, repeat, rotation_matrix, undamped

SOLVERS = {"default": {}, "converged": {"solver": "converged"}, "sweeps": {"exact_joints": False}}
QUICK_AND_SLOW = ["default", pytest.param("converged", marks=pytest.mark.slow)]

# links: tip at 0.5 s and at 1 s (DOP853, relative tolerance 1e-12).
TIPS = {
    1: ((-0.09022921, -0.99592103), (-0.99996659, -0.00817452)),
    2: ((-0.21397677, -0.93692736), (-0.96440938, 0.04204959)),
    5: ((-0.25748235, -0.89089700), (-0.88458095, -0.10800545)),
    10: ((-0.26464511, -0.86354675), (-0.89431685, -0.14656506)),
    20: ((-0.26447250, -0.85023480), (-0.89684465, -0.16633447)),
}


def chain(links, thickness=None, tip_mass=0.0, **options):
    """A chain 1 m long of 1 kg, hinged at the origin, level; with a `tip_mass` [kg], a point mass at its end.

    The motion is plane: a ball with the moment of a thin rod, ``m l^2 / 12``, moves as the rod does. With a `thickness`
    [fraction of the length] the links are boxes.
    """
    builder = SceneBuilder(gravity=DOWN)
    last, length = builder.add_body(Sphere(0.02), static=True, collides=False), 1 / links
    for link in range(links):
        shape = Sphere(length * np.sqrt(5 / 24))
        if thickness:
            shape = Box((length / 2, thickness * length / 2, thickness * length / 2))
        body = builder.add_body(shape, mass=1 / links, position=((link + 0.5) * length, 0, 0), collides=False)
        builder.add_joint(Hinge(last, body, (link * length, 0, 0), (0, 0, 1)))
        last = body
    if tip_mass:
        end = builder.add_body(Sphere(0.02), mass=tip_mass, position=(1.0, 0, 0), collides=False)
        builder.add_joint(BallAndSocket(last, end, (1.0, 0, 0)))
    return builder.build(undamped(**options))


def swing(links, dt, duration, **options):
    """Largest gap of any joint over a link, tip at the end, energy over that of the swing; positions of all steps."""
    model, state = chain(links, dt=dt, **options)
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), round(duration / dt), motion)
    record = {name: np.asarray(values, dtype=float)[:, 0, 1:] for name, values in record.items()}
    half = rotation_matrix(record["orientation"])[..., :, 0] * (0.5 / links)
    ends = np.concatenate([np.zeros_like(half[:, :1]), (record["position"] + half)[:, :-1]], axis=1)
    gap = np.linalg.norm(record["position"] - half - ends, axis=-1).max() * links
    order = ("position", "orientation", "velocity", "angular_velocity")
    leaves = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    energy = invariants(leaves, *(record[name] for name in order))[0] + 9.81 / links * record["position"][..., 1].sum(1)
    return gap, (record["position"] + half)[:, -1], energy / 4.905


@pytest.mark.parametrize("solver", QUICK_AND_SLOW)
def test_ten_links_stay_joined(float64, solver, gate):
    gap, tip, _ = swing(10, 1 / 240, 1.0, **SOLVERS[solver])
    gate("largest gap / link", gap, 1e-4)
    gate("tip at 0.5 s [m]", tip[119, :2] - TIPS[10][0], 1e-2)


@pytest.mark.parametrize("solver", QUICK_AND_SLOW)
@pytest.mark.parametrize("links", slow_but((20,), (2, 20)))
def test_chain_does_not_blow_up_at_a_large_step(links, solver, gate):
    _, tip, energy = swing(links, 1 / 60, 2.0, **SOLVERS[solver])
    assert np.isfinite(tip).all()
    gate("energy gained / swing energy", max(0.0, energy.max()), 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("solver", QUICK_AND_SLOW)
@pytest.mark.parametrize("links", [1, 5, 10])
def test_other_chains_do_not_blow_up_at_a_large_step(links, solver, gate):
    test_chain_does_not_blow_up_at_a_large_step(links, solver, gate)


@pytest.mark.parametrize("solver", [*QUICK_AND_SLOW, pytest.param("sweeps", marks=pytest.mark.slow)])
def test_thin_rods_do_not_blow_up_at_a_large_step(float64, solver, gate):
    _, tip, energy = swing(2, 1 / 60, 2.0, thickness=0.01, **SOLVERS[solver])
    assert np.isfinite(tip).all()
    gate("energy gained / swing energy", max(0.0, energy.max()), 0.05)


@pytest.mark.parametrize("links", slow_but((2,), (1, 2)))
def test_short_chains_swing_as_they_should(float64, links, gate):
    gap, tip, energy = swing(links, 1 / 960, 1.0, velocity_iterations=80)
    gate("largest gap / link", gap, 1e-4)
    gate("tip at 0.5 s [m]", tip[479, :2] - TIPS[links][0], 2e-3)
    gate("tip at 1 s [m]", tip[959, :2] - TIPS[links][1], 4e-3)
    gate("energy / swing energy", energy, 2e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_chain_with_a_heavy_end(precision, gate):
    """Benchmark A5, variant H: 10 kg at the end of 20 links of 50 g; MuJoCo's implicit integrator is NaN at 1/100 s."""
    model, state = chain(20, tip_mass=10.0, dt=1 / 240)
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 240, motion)
    position = np.asarray(record["position"], dtype=float)[:, 0]
    half = rotation_matrix(record["orientation"][:, 0])[..., :, 0] * 0.025
    gaps = np.linalg.norm(position[:, 2:21] - half[:, 2:21] - position[:, 1:20] - half[:, 1:20], axis=-1)
    gate("largest gap / link", gaps * 20, 1e-4)
    gate(
        "largest gap at the end / link",
        np.linalg.norm(position[:, 20] + half[:, 20] - position[:, 21], axis=-1) * 20,
        1e-4,
    )
    gate("end at 0.5 s [m]", position[119, 21, :2] - (0.37298612, -0.92743830), 5e-3)
    gate("end at 1 s [m]", position[239, 21, :2] - (-0.98749542, -0.15169382), 5e-2)


QUICK_CASES = [(20, None, 60), (10, 0.05, 60)]
SLOW_CASES = [
    (links, thickness, rate)
    for links in (5, 10, 20)
    for thickness in (None, 0.2, 0.05)
    for rate in (60, 120, 240)
    if (links, thickness, rate) not in QUICK_CASES
]


@pytest.mark.parametrize(
    ("links", "thickness", "rate"),
    [*QUICK_CASES, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW_CASES)],
)
def test_passive_chains_gain_no_energy(links, thickness, rate, gate):
    """Four chains pushed at random, out of their plane too."""
    model, state = chain(links, thickness, dt=1 / rate)
    states = repeat(state, 4)
    push = 3.0 * np.random.default_rng(0).normal(size=(4, links, 3))
    spin = states.angular_velocity.at[:, 1:].add(jnp.asarray(push, state.velocity.dtype))
    states = dataclasses.replace(states, angular_velocity=spin)
    _, record = record_worlds(repeat(model, 4), states, 2 * rate, motion)
    record = {name: np.asarray(values, dtype=float)[:, :, 1:] for name, values in record.items()}
    leaves = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    order = ("position", "orientation", "velocity", "angular_velocity")
    energy = invariants(leaves, *(record[name] for name in order))[0] + 9.81 / links * record["position"][..., 1].sum(
        -1
    )
    assert np.isfinite(energy).all()
    gate("energy gained / swing energy", np.maximum(energy - energy[0], 0.0) / 4.905, 2e-3)
    gate("energy left: it swings", -np.minimum((energy - energy[0]) / 4.905, 0.0), 1.0)


@pytest.mark.slow
def test_four_bar_loop(precision, gate):
    """Four hinges about parallel axes leave one freedom but forbid 20 of 18: the rows agree, and the bars swing."""
    builder = SceneBuilder(gravity=DOWN)
    ground = builder.add_body(Sphere(0.02), static=True, collides=False)
    corners = np.array([(0, 0, 0), (0.5, 0, 0), (1.0, 0, 0), (1.0, 0.5, 0), (0, 0.5, 0)])
    bars = [((0, 0.25, 0), (0.02, 0.25, 0.02)), ((0.5, 0.5, 0), (0.5, 0.02, 0.02)), ((1, 0.25, 0), (0.02, 0.25, 0.02))]
    handles = [builder.add_body(Box(half), mass=1.0, position=place, collides=False) for place, half in bars]
    for parent, child, corner in (
        (ground, handles[0], corners[0]),
        (handles[0], handles[1], corners[4]),
        (handles[1], handles[2], corners[3]),
        (ground, handles[2], corners[2]),
    ):
        builder.add_joint(Hinge(parent, child, corner, (0, 0, 1)))
    model, state = builder.build(undamped(dt=1 / 240))
    # A push along x: the loop is a parallelogram that falls over.
    rate = 1.0
    spin = np.array([(0, 0, 0), (0, 0, -rate), (0, 0, 0), (0, 0, -rate)])
    velocity = np.array([(0, 0, 0), (0.25 * rate, 0, 0), (0.5 * rate, 0, 0), (0.25 * rate, 0, 0)])
    state = dataclasses.replace(
        state,
        velocity=jnp.asarray(velocity, state.velocity.dtype),
        angular_velocity=jnp.asarray(spin, state.velocity.dtype),
    )
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 240, motion)
    record = {name: np.asarray(values, dtype=float)[:, 0, 1:] for name, values in record.items()}
    turned = rotation_matrix(record["orientation"])
    left = record["position"][:, 0] + 0.25 * turned[:, 0, :, 1]
    gaps = [
        record["position"][:, 0] - 0.25 * turned[:, 0, :, 1],
        record["position"][:, 1] - 0.5 * turned[:, 1, :, 0] - left,
        record["position"][:, 1] + 0.5 * turned[:, 1, :, 0] - record["position"][:, 2] - 0.25 * turned[:, 2, :, 1],
        record["position"][:, 2] - 0.25 * turned[:, 2, :, 1] - (1.0, 0, 0),
    ]
    gate("largest gap [m]", np.linalg.norm(gaps, axis=-1), 1e-5)
    gate("out of plane [m]", record["position"][..., 2], 1e-5)
    leaves = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    order = ("position", "orientation", "velocity", "angular_velocity")
    energy = invariants(leaves, *(record[name] for name in order))[0] + 9.81 * record["position"][..., 1].sum(1)
    gate("energy gained / swing energy", max(0.0, (energy - energy[0]).max()) / (2 * 9.81 * 0.5), 0.02)
    assert np.abs(record["angular_velocity"]).max() > 3.0, "the loop does not swing"
