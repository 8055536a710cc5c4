"""Impacts that go through joints (`Options.impact_events`), against the generalized coordinates of the mechanism."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, Plane, SceneBuilder, Slider, Sphere, energy, joint_gaps, step
from tests.scenes import DOWN, GRAVITY, record_worlds, repeat, stack, undamped

LENGTH, RADIUS, HALF = 0.7, 0.1, (0.05, 0.3, 0.1)
ROD, TIP = 1.5, 0.6
WORLDS, DT = 16, 1e-6
ACROSS = np.array([0.0, 0.0, 1.0])


def along(angle):
    return np.array([np.sin(angle), -np.cos(angle), 0.0])


def double_pendulum(solver, dt=DT, gap=None, friction=0.0, restitution=0.6):
    """A rod and a ball on hinges that hang; in each world the ball meets the ground after half a step, or is `gap` above.

    Returns:
      Model, states, and for each world the rates of both hinges before, the Jacobian of the ball's velocity by them, and the
      matrix of inertia.
    """
    builder = SceneBuilder(gravity=DOWN)
    surface = {"friction": friction, "restitution": restitution}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    post = builder.add_body(Sphere(0.01), static=True, position=(0, 2, 0), collides=False)
    rod = builder.add_body(Box(HALF), mass=ROD, position=(0, 2 - LENGTH / 2, 0), collides=False)
    tip = builder.add_body(Sphere(RADIUS), mass=TIP, position=(0, 2 - 2 * LENGTH, 0), **surface)
    builder.add_joint(Hinge(post, rod, (0, 2, 0), ACROSS))
    builder.add_joint(Hinge(rod, tip, (0, 2 - LENGTH, 0), ACROSS))
    model, hanging = builder.build(undamped(dt=dt, solver=solver, impact_events=3))
    rng, states, truths = np.random.default_rng(0), [], []
    central = ROD * (HALF[0] ** 2 + HALF[1] ** 2) / 3, TIP * RADIUS**2 * 2 / 5
    while len(states) < WORLDS:
        angles, rates = rng.uniform(-1, 1, 2), rng.normal(size=2) * 2
        first, second = LENGTH * along(angles[0]), LENGTH * along(angles[1])
        of_rod = np.stack([np.cross(ACROSS, first / 2), np.zeros(3)], 1)
        of_tip = np.stack([np.cross(ACROSS, first), np.cross(ACROSS, second)], 1)
        if of_tip[1] @ rates > 0:
            rates = -rates
        speed = of_tip[1] @ rates
        if speed > -0.3:
            continue
        height = RADIUS + (-0.5 * speed * dt if gap is None else gap)
        pivot = np.array([0, height, 0]) - first - second
        turn = np.stack([np.cos(angles / 2), 0 * angles, 0 * angles, np.sin(angles / 2)], 1)
        leaves = {
            "position": [[0, 0, 0], pivot, pivot + first / 2, pivot + first + second],
            "orientation": [[1, 0, 0, 0], [1, 0, 0, 0], *turn],
            "velocity": [[0, 0, 0], [0, 0, 0], of_rod @ rates, of_tip @ rates],
            "angular_velocity": [[0, 0, 0], [0, 0, 0], *(rate * ACROSS for rate in rates)],
        }
        arrays = {name: jnp.asarray(value, hanging.position.dtype) for name, value in leaves.items()}
        states.append(dataclasses.replace(hanging, **arrays))
        inertia = ROD * of_rod.T @ of_rod + TIP * of_tip.T @ of_tip + np.diag(central)
        truths.append((rates, of_tip, inertia))
    return model, stack(states), truths


def struck(rates, of_tip, inertia, friction, restitution):
    """Rates after an impact with Newton's restitution and Coulomb's friction."""
    normal, tangent = of_tip[1], of_tip[0] + [0.0, RADIUS]  # where the ball touches
    inverse, target = np.linalg.inv(inertia), -restitution * (normal @ rates)

    def with_impulse(jacobian, impulse):
        return rates + inverse @ jacobian.T @ impulse

    both = np.stack([normal, tangent])
    sticking = np.linalg.solve(both @ inverse @ both.T, [target, 0.0] - both @ rates)
    if abs(sticking[1]) <= friction * sticking[0]:
        return with_impulse(both, sticking)
    for sign in (-1.0, 1.0):
        slides = normal + sign * friction * tangent
        impulse = (target - normal @ rates) / (normal @ inverse @ slides)
        after = with_impulse(slides[None], np.array([impulse]))
        if sign * (tangent @ after) <= 0:
            return after
    raise AssertionError("neither sticks nor slides")


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["pgs", "converged"])
def test_a_double_pendulum_strikes_the_ground_with_friction(float64, solver, gate):
    """Both hinges take part at once. Where the laws of Newton and Coulomb together gain energy, less is given back."""
    model, states, truths = double_pendulum(solver, friction=0.3)
    after = jax.jit(jax.vmap(lambda state: step(model, step(model, state))))(states)
    assert not np.asarray(after.flags).any()
    found = np.asarray(after.angular_velocity)[:, 2:, 2]
    others = 0
    for rates, (before, of_tip, inertia) in zip(found, truths, strict=True):
        expected = struck(before, of_tip, inertia, 0.3, 0.6)
        energies = [0.5 * v @ inertia @ v for v in (before, expected, rates)]
        gate("energy gained", max(0.0, energies[2] / energies[0] - 1), 1e-4)
        if energies[1] < energies[0]:
            others += 1
            gate("error of the rates / their change", (rates - expected) / np.abs(expected - before).max(), 1e-4)
    assert others >= 10


def test_an_impact_through_joints_and_its_derivatives(float64, gate):
    """The rates after it, by the restitution and by the rates before. Sweeps left out up to 0.4 of the change."""
    model, states, truths = double_pendulum("pgs")

    def rates_after(restitution, change, state, of_tip, rod):
        spins = state.angular_velocity.at[2:, 2].add(change)
        velocity = state.velocity.at[2].add(rod @ change).at[3].add(of_tip @ change)
        changed = dataclasses.replace(model, restitution=jnp.full(4, restitution))
        moving = dataclasses.replace(state, angular_velocity=spins, velocity=velocity)
        rates = step(changed, moving).angular_velocity[2:, 2]
        return rates, rates

    of_rod = np.stack([np.stack([t[1][:, 0] / 2, np.zeros(3)], 1) for t in truths])
    of_tip = np.stack([t[1] for t in truths])
    slopes = jax.vmap(jax.jacfwd(rates_after, (0, 1), has_aux=True), (None, None, 0, 0, 0))
    (by_restitution, by_rates), after = jax.jit(slopes)(0.6, np.zeros(2), states, of_tip, of_rod)
    for world, (rates, jacobian, inertia) in enumerate(truths):
        normal = jacobian[1]
        push = np.linalg.solve(inertia, normal) / (normal @ np.linalg.solve(inertia, normal))
        change = -push * (normal @ rates)
        gate("rates", (after[world] - rates - 1.6 * change) / np.abs(change).max(), 1e-4)
        gate("by restitution", (by_restitution[world] - change) / np.abs(change).max(), 1e-4)
        gate("by the rates before", by_rates[world] - (np.eye(2) - 1.6 * np.outer(push, normal)), 1e-3)


@pytest.mark.slow
def test_energy_of_elastic_bounces(float64, gate):
    """Half a second at 1/240 s. Sweeps lost up to 0.98 of the energy in the first impact, or gained 0.015 of it."""
    model, states, _ = double_pendulum("pgs", dt=1 / 240, gap=0.05, restitution=1.0)
    start = np.asarray(jax.vmap(energy, (None, 0))(model, states), float)

    def observe(model, state):
        return {"energy": energy(model, state), "gap": joint_gaps(model, state).translation, "flags": state.flags}

    _, record = record_worlds(repeat(model, WORLDS), states, 120, observe)
    assert not np.asarray(record["flags"]).any()
    gate("energy / that of a fall by a metre", (np.asarray(record["energy"]) - start) / ((ROD + TIP) * GRAVITY), 0.01)
    gate("joint gap [m]", record["gap"], 1e-3)


CAPPED = {"motor_cap": 1e-9}
CARRIAGES = {
    "free": (1.0, CAPPED),
    "with a rotor": (4.0, CAPPED | {"joint_armature": 3.0}),
    "with a rotor and a spring": (4.0, CAPPED | {"joint_armature": 3.0, "joint_stiffness": 1e4}),
    "held by a motor": (np.inf, {}),
    "held by a motor as far as it can": (1.0, {"motor_cap": 100.0}),
    "at its stop": (np.inf, CAPPED | {"joint_limits": (-1.0, 0.0)}),
    "near its stop": (1.0, CAPPED | {"joint_limits": (-1.0, 1e-3)}),
}
"""The mass that takes part in an impact; leaves of the model. A bounded force does nothing in no time."""


@pytest.mark.slow
def test_carriages_that_are_struck(float64, gate):
    """Of 1 kg, by a ball of 1 kg at 2 m/s: rotors count, motors without a cap hold, and so do stops that are reached.

    Rotors and motors were ignored. Stops a way off held, against the rebound: impulses of 1e11 N s.
    """
    builder = SceneBuilder(gravity=(0, 0, 0))
    post = builder.add_body(Sphere(0.01), static=True, position=(0, 9, 0), collides=False)
    carriage = builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, restitution=0.5)
    place = (-0.15 - 2e-6, 0, 0)
    ball = builder.add_body(Sphere(0.05), mass=1.0, position=place, velocity=(2.0, 0, 0), restitution=0.5)
    features = {"armature": 1e-9, "stiffness": 1e-9, "limits": (-1.0, 1.0)}
    rail = builder.add_joint(Slider(post, carriage, (0, 0, 0), (1, 0, 0), **features))
    builder.add_motor(rail, kind="velocity")
    # In longer steps springs, motors and stops act after the impact, too.
    model, state = builder.build(undamped(dt=2e-6, impact_events=1))

    def changed(leaves):
        return dataclasses.replace(
            model, **{name: jnp.asarray(value, jnp.float64)[None] for name, value in leaves.items()}
        )

    models = stack([changed(leaves) for _, leaves in CARRIAGES.values()])
    after = jax.jit(jax.vmap(step, (0, None)))(models, state)
    assert not np.asarray(after.flags).any()
    for world, (name, (mass, _)) in enumerate(CARRIAGES.items()):
        common = 2.0 / (1.0 + mass)
        truth = [common * 1.5, common * 1.5 - 1.0]  # they part at half of the 2 m/s
        gate(f"{name}: velocities", np.asarray(after.velocity)[world, [carriage, ball], 0] - truth, 1e-3)
        gate(f"{name}: others", np.asarray(after.velocity)[world, [carriage, ball], 1:], 1e-9)
