"""Hard cases of the converged solver tier: mass ratios, tall stacks, creep, heavy chains, set-valued friction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Cone, Cylinder, Hinge, Options, Plane, SceneBuilder, Sphere, contacts, energy, step
from tests.gradients.test_stick_slip import COUNT, FACTORS, FRICTION, THRESHOLD, push_with_slopes
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance_worlds,
    box_stack,
    repeat,
    slab_on_plane,
    stack,
    tilted_gravity,
    undamped,
    with_dt,
)

SIDE = 0.2
RATIOS = {"float32": [1.0, 1e2, 1e3, 1e4, 1e5], "float64": [1.0, 1e2, 1e4, 1e6, 1e8]}


def converged(**changes):
    return undamped(**{"solver": "converged", **changes})


def two_cubes(ratio):
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.9)
    for level, mass in enumerate((1.0, ratio)):
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=mass, position=(0.0, 0.1 + 0.2 * level, 0.0), friction=0.9)
    return builder.build(converged(dt=1 / 60))


@pytest.mark.parametrize(
    ("precision", "dt"),
    [
        pytest.param("float32", 1e-3, marks=pytest.mark.slow),
        ("float32", 1 / 60),
        pytest.param("float64", 1e-3, marks=pytest.mark.slow),
        ("float64", 1 / 60),
    ],
    indirect=["precision"],
)
def test_heavy_cube_on_a_light_one(precision, dt, gate):
    """Benchmark B1: sink at most 1 % of the side, drift at most 1 mm, for mass ratios that defeat sweeps."""
    ratios = RATIOS[str(precision)]
    worlds = [two_cubes(ratio) for ratio in ratios]
    models, states = with_dt(stack([m for m, _ in worlds]), dt), stack([s for _, s in worlds])
    final = advance_worlds(models, states, round(2.0 / dt))
    moved = np.asarray(final.position - states.position, dtype=float)[:, 1:]
    gate("sink / side", moved[..., 1] / SIDE, 0.01)
    gate("drift [m]", moved[..., [0, 2]], 1e-3)
    assert not np.asarray(final.flags).any()


@pytest.mark.slow
def test_a_stack_of_ten_boxes_does_not_move(precision, gate):
    """Benchmark B3 at 60 Hz: a stack is an equilibrium; ten sweeps sink into the slop instead."""
    model, state = box_stack(10, half=0.5, options=Options(dt=1 / 60, solver="converged"), friction=0.6)
    final = advance_worlds(stack([model]), stack([state]), 600)
    limit = {"float32": 2e-3, "float64": 1e-4}[str(precision)]
    gate("any box in 10 s [m]", (final.position - state.position)[0, 1:], limit)
    assert not np.asarray(final.flags).any()


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_fast_ball_slides_and_then_rolls(precision, gate):
    """Friction is many times smaller than what moves: it must still be that of the law, and end where the ball rolls."""
    speeds, friction, radius, dt = np.array([0.5, 5.0, 50.0]), 0.2, 0.1, 1 / 240
    worlds = []
    for speed in speeds:
        builder = SceneBuilder(gravity=DOWN)
        builder.add_body(Plane((0, 1, 0)), static=True, friction=friction)
        builder.add_body(Sphere(radius), mass=1.0, position=(0, radius, 0), velocity=(speed, 0, 0), friction=friction)
        worlds.append(builder.build(converged(dt=dt)))
    models, states = stack([m for m, _ in worlds]), stack([s for _, s in worlds])
    steps = 20
    final = advance_worlds(models, states, steps)
    sliding = speeds[1:] - friction * GRAVITY * steps * dt
    gate("speed while it slides / closed form - 1", final.velocity[1:, 1, 0] / sliding - 1, 1e-5)
    final = advance_worlds(models, final, round(8.0 / dt))
    rolling = speeds / 1.4
    gate("rolling speed / closed form - 1", final.velocity[:, 1, 0] / rolling - 1, 1e-4)
    gate("spin / closed form - 1", -final.angular_velocity[:, 1, 2] * radius / rolling - 1, 1e-4)
    assert not np.asarray(final.flags).any()


@pytest.mark.slow
@pytest.mark.parametrize("count", [20, 40])
def test_tall_stacks_stand(float64, count, gate):
    model, state = box_stack(count, half=0.5, options=Options(dt=1 / 60, solver="converged"), friction=0.6)
    final = advance_worlds(stack([model]), stack([state]), 600)
    moved = np.asarray(final.position - state.position)[0, 1:]
    gate("top, sideways [m]", moved[-1, [0, 2]], 1e-2)
    gate("top, downwards / height", moved[-1, 1] / count, 5e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_sticking_slab_does_not_creep(precision, gate):
    """Benchmark A10: 0.1 mm in 3 s."""
    angles, friction = [3.0, 10.0, 20.0], 0.5
    worlds = [slab_on_plane(gravity=tilted_gravity(a), friction=friction, options=converged()) for a in angles]
    states = stack([s for _, s in worlds])
    final = advance_worlds(stack([m for m, _ in worlds]), states, 180)
    gate("creep in 3 s [m]", (final.position - states.position)[:, 1], 1e-4)


def chain(count, heavy):
    """Links of 1/count m and kg held level, the last with a ball at its end (benchmark A5, variant H)."""
    length = 1.0 / count
    builder = SceneBuilder(gravity=DOWN)
    previous = builder.add_body(Sphere(0.01), static=True)
    for link in range(count):
        half = length / 2
        body = builder.add_body(
            Box((half, 0.1 * half, 0.1 * half)), mass=length, position=(half + link * length, 0.0, 0.0), collides=False
        )
        builder.add_joint(Hinge(parent=previous, child=body, anchor=(link * length, 0, 0), axis=(0, 0, 1)))
        previous = body
    end = builder.add_body(Sphere(0.02), mass=heavy, position=(1.0, 0.0, 0.0), collides=False)
    builder.add_joint(Hinge(parent=previous, child=end, anchor=(1.0, 0, 0), axis=(0, 0, 1)))
    return builder.build(converged(dt=1 / 240))


@pytest.mark.slow
def test_a_chain_with_a_heavy_end_does_not_stretch(precision, gate):
    """Ten links with a thousand times their weight at the end: sweeps would need 4e4 of them (benchmark B7)."""
    count = 10
    model, state = chain(count, 100.0)
    states = stack([state])
    for _ in range(4):
        states = advance_worlds(stack([model]), states, 60)
        place = np.asarray(states.position, dtype=float)[0]
        spread = np.linalg.norm(np.diff(place[2 : count + 1], axis=0), axis=-1)
        # Neighbouring centres are never further apart than two half links.
        gate("stretch / link", np.maximum(0.0, spread * count - 1.0), 1e-2)
        gate("end beyond the length of the chain", max(0.0, np.linalg.norm(place[-1]) - 1.0), 1e-2)
    assert not np.asarray(states.flags).any()


@pytest.mark.slow
def test_slip_derivative_is_exact(precision, gate):
    """Benchmark C11: the sweeps miss dv/dF by 0.36 %."""
    model, state = slab_on_plane(friction=FRICTION, options=converged(dt=1 / COUNT))
    factors = np.array(FACTORS)
    force = jnp.asarray(factors) * THRESHOLD
    velocity, (by_force, by_friction) = push_with_slopes(force, jnp.asarray(FRICTION), model, state)
    sticks, slips = factors <= 0.99, factors >= 1.01
    gate("sticking: v [m/s]", velocity[sticks], 1e-4)
    gate("sticking: dv/dF [1/kg s]", by_force[sticks], 1e-3)
    gate("slipping: v - truth [m/s]", velocity[slips] - (force - THRESHOLD)[slips], 1e-3)
    gate("slipping: dv/dF - 1", by_force[slips] - 1.0, 1e-3)
    gate("slipping: dv/dmu / truth - 1", by_friction[slips] / -GRAVITY - 1.0, 1e-3)


@pytest.mark.slow
def test_scenes_with_a_broadphase(float64, gate):
    """Pairs found in each step lead to the same motion as pairs that have their own slots."""
    finals = []
    for broadphase in ("none", "all_pairs"):
        builder = SceneBuilder(gravity=DOWN)
        builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
        for ball in range(4):
            builder.add_body(Sphere(0.1), mass=1.0 + ball, position=(0.12 * ball, 0.1 + 0.16 * (ball % 2), 0.0))
        model, state = builder.build(converged(dt=1 / 60, broadphase=broadphase))
        run = jax.jit(lambda m, s: jax.lax.fori_loop(0, 20, lambda _, c: step(m, c), s))
        finals.append(run(model, dataclasses.replace(state)))
    gate("difference of the places [m]", finals[0].position - finals[1].position, 1e-6)
    assert float(jnp.abs(finals[0].velocity).max()) > 1e-2


@pytest.mark.slow
def test_boxes_that_could_rebound_come_to_rest(float64, gate):
    """At rest from the start with a high restitution, and dropped with a low one: they shook for ever, at up to 0.06 m/s."""

    def offset_stack(restitution, gap):
        builder = SceneBuilder(gravity=DOWN)
        surface = {"friction": 0.5, "restitution": restitution}
        builder.add_body(Plane((0, 1, 0), 0.0), static=True, **surface)
        for k in range(3):
            place = (0.05 * k, 0.15 + (0.3 + gap) * k + gap, 0.03 * k)
            builder.add_body(Box((0.2, 0.15, 0.25)), mass=1.0 + k, position=place, **surface)
        return builder.build(converged(dt=1 / 120))

    cases = [offset_stack(0.5, 0.0), offset_stack(0.1, 0.01)]
    models, states = (stack(list(parts)) for parts in zip(*cases, strict=True))
    later = advance_worlds(models, states, 120)
    gate("speed after a second [m/s]", later.velocity, 1e-7)
    gate("spin after a second [rad/s]", later.angular_velocity, 1e-7)
    gate("sideways [m]", (later.position - states.position)[:, 1:, ::2], 1e-6)
    gate("sunk [m]", later.position[:, 1:, 1] - jnp.asarray([0.15, 0.45, 0.75]), 1e-4)


SETTLING = {"cylinder": Cylinder(0.1, 0.2), "cone": Cone(0.1, 0.2), "box": Box((0.1, 0.2, 0.15))}


@pytest.mark.parametrize(
    ("name", "friction"),
    [
        ("cylinder", 0.5),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("cylinder", 4.0), ("cone", 0.5), ("cone", 4.0), ("box", 0.5))
        ),
    ],
)
def test_what_topples_and_settles_is_solved(float64, name, friction, gate):
    """In 32 directions. One step of 300 was flagged: points that stick may contradict each other a little."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=friction)
    builder.add_body(SETTLING[name], mass=1.5, friction=friction)
    model, state = builder.build(converged(dt=1 / 120))
    turns = np.random.default_rng(0).normal(size=(32, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)

    @jax.vmap
    def placed(turn):
        turned = dataclasses.replace(state, orientation=state.orientation.at[1].set(turn))
        lift = 1e-3 - contacts(model, turned).separation.min()
        return dataclasses.replace(turned, position=turned.position.at[1, 1].add(lift))

    starts = jax.jit(placed)(turns)
    final = advance_worlds(repeat(model, 32), starts, 240)
    assert not np.asarray(final.flags).any()
    before, after = (np.asarray(jax.vmap(energy, (None, 0))(model, s), float) for s in (starts, final))
    gate("energy gained [J]", np.maximum(after - before, 0.0), 1e-6)
    gate("speed of half of them [m/s]", np.median(np.abs(np.asarray(final.velocity)[:, 1]).max(1)), 1e-6)
