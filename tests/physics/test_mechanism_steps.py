"""Trees of joints with what changes between steps, and between worlds: the time step, sleep, fast motion, one bad world."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import (
    BallAndSocket,
    Box,
    Distance,
    Fixed,
    Flag,
    Hinge,
    SceneBuilder,
    Sphere,
    apply_force,
    energy,
    is_asleep,
    joint_gaps,
    momentum,
    step,
    substep,
)
from mathota_jax import advance as advance_frame
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.physics.test_chain import TIPS, chain
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance,
    advance_worlds,
    record_worlds,
    repeat,
    rotation_matrix,
    undamped,
    with_dt,
)

LINKS = 10
ACROSS = (0, 0, 1)


def tip(state):
    """End of the last link of `chain`."""
    along = rotation_matrix(state.orientation)[-1, :, 0]
    return np.asarray(state.position, float)[-1] + 0.5 / LINKS * along


def check_swing(gate, model, state):
    """Ten links after 0.5 s (benchmark A5)."""
    gate("gap / link", np.asarray(joint_gaps(model, state).translation) * LINKS, 1e-9)
    gate("tip at 0.5 s [m]", tip(state)[:2] - TIPS[LINKS][0], 1e-2)
    gate("energy / that of the swing", float(energy(model, state)) / 4.905, 2e-3)


@pytest.mark.slow
def test_time_step_may_change(float64, gate):
    """At 1/480 s and 1/240 s by turns: the motion and energy of the chain, and no gap."""
    model, state = chain(LINKS, dt=1 / 240)

    @jax.jit
    def cycle(_, state):
        fine, coarse = with_dt(model, 1 / 480), with_dt(model, 1 / 240)
        return step(coarse, step(fine, step(fine, state)))

    check_swing(gate, model, jax.lax.fori_loop(0, 60, cycle, state))


@pytest.mark.slow
def test_frames_and_substeps(float64, gate):
    """Frames of 1/50 s from steps of 1/240 s, and of 1/60 s from four sub-steps each."""
    model, state = chain(LINKS, dt=1 / 240)
    frame = jax.jit(advance_frame)
    left, current, steps = 0.0, state, 0
    for _ in range(25):
        found = frame(model, current, left, 1 / 50)
        current, left, steps = found.state, found.accumulator, steps + int(found.step_count)
    assert steps == 120
    check_swing(gate, model, current)
    coarse = with_dt(model, 1 / 60)
    check_swing(gate, model, jax.lax.fori_loop(0, 30, lambda _, s: substep(coarse, s), state))


@pytest.mark.slow
def test_a_broken_world_leaves_the_others_alone(precision):
    """One chain of four has a position, another a velocity that is NaN or infinite."""
    model, state = chain(4, dt=1 / 240)
    good = repeat(state, 4)
    bad = dataclasses.replace(
        good,
        position=good.position.at[1, 2, 0].set(jnp.nan),
        velocity=good.velocity.at[3, 4, 1].set(jnp.inf),
    )
    models = repeat(model, 4)
    clean, dirty = (advance_worlds(models, states, 30) for states in (good, bad))
    assert np.asarray(dirty.flags & Flag.NON_FINITE).astype(bool).tolist() == [False, True, False, True]
    for name in ("position", "orientation", "velocity", "angular_velocity", "joint_force"):
        np.testing.assert_array_equal(getattr(dirty, name)[::2], getattr(clean, name)[::2], err_msg=name)

    def loss(states):
        return jax.vmap(step)(models, states).position[::2].sum()

    slope = jax.jit(jax.grad(loss, allow_int=True))(bad)
    assert np.isfinite(slope.velocity[::2]).all() and np.any(slope.velocity[::2])


# Sleep ---------------------------------------------------------------------------------------------------------------


def sleepy(**changes):
    return undamped(**{"dt": 1 / 60, "sleep": True, **changes})


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_chain_at_rest_sleeps_and_wakes_whole(precision, gate):
    """Four links hang still. Asleep they do not move a bit; a push of the lowest wakes them all, in the same step."""
    builder = SceneBuilder(gravity=DOWN)
    last = builder.add_body(Sphere(0.02), static=True, collides=False)
    for k in range(4):
        body = builder.add_body(Box((0.02, 0.1, 0.03)), mass=0.5, position=(0, -0.1 - 0.2 * k, 0), collides=False)
        builder.add_joint(Hinge(last, body, (0, -0.2 * k, 0), ACROSS, friction=0.01))
        last = body
    model, state = builder.build(sleepy())
    rested = advance(model, state, 60)
    assert np.asarray(is_asleep(model, rested)).tolist() == [False, True, True, True, True]
    gate("moved while falling asleep [m]", np.asarray(rested.position - state.position), 1e-6)
    later = advance(model, rested, 500)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(rested), jax.tree.leaves(later), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))
    # The reaction of the top hinge outlives the sleep: it carries four links.
    pushed = jax.jit(step)(model, apply_force(later, body, jnp.array([5.0, 0.0, 0.0])))
    assert not np.asarray(is_asleep(model, pushed)).any()
    assert float(pushed.velocity[4, 0]) > 0.05
    gate("gap / link", np.asarray(joint_gaps(model, pushed).translation) / 0.2, 1e-5)
    again = advance(model, pushed, 1800)
    assert np.asarray(is_asleep(model, again)).sum() in (0, 4), "the chain sleeps and wakes as one"


@pytest.mark.slow
def test_a_ball_wakes_a_free_chain(precision, gate):
    """Three links adrift sleep until an elastic ball hits the end of them: the momentum is that of the ball."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    for k in range(4):
        body = builder.add_body(Sphere(0.1), mass=1.0, position=(0.3 * k, 0, 0), friction=0.0)
        if k:
            builder.add_joint(BallAndSocket(body - 1, body, (0.3 * k - 0.15, 0, 0)))
    ball = builder.add_body(Sphere(0.1), mass=2.0, position=(0.9, -1.5, 0), velocity=(0, 1.0, 0), friction=0.0)
    model, state = builder.build(sleepy())
    _, record = record_worlds(
        repeat(model, 1), repeat(state, 1), 120,
        lambda model, state: {
            "asleep": is_asleep(model, state), "velocity": state.velocity, "momentum": momentum(model, state),
            "gap": joint_gaps(model, state).translation.max(),
        },
    )  # fmt: skip
    record = {name: np.asarray(values)[:, 0] for name, values in record.items()}
    hit = np.flatnonzero(np.abs(record["velocity"][:, 3]).max(-1) > 1e-3)[0]
    assert record["asleep"][hit - 1, :4].all() and not record["asleep"][hit, : ball + 1].any()
    gate("momentum - that of the ball [kg m/s]", record["momentum"] - [0.0, 2.0, 0.0], 1e-5)
    gate("gap / link", record["gap"] / 0.3, 1e-5)


# Fast bodies ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("speed", [30.0, 180.0])
def test_a_fast_chain_does_not_pass_a_wall(speed, gate):
    """Four balls in a row, jointed, fly at a wall as thick as they are, at up to 15 times that a step."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Box((0.1, 5.0, 5.0)), static=True)
    for k in range(4):
        place = (-2.0, 0.3 * k, 0.0)
        body = builder.add_body(Sphere(0.1), mass=1.0, position=place, velocity=(speed, 0, 0), collides=True)
        if k:
            builder.add_joint(BallAndSocket(body - 1, body, (-2.0, 0.3 * k - 0.15, 0)))
    model, state = builder.build(undamped(dt=1 / 60, continuous=True))
    # Aslant: the ends arrive at different times.
    turn = np.linspace(0.0, 0.6, 4)
    place = np.stack(
        [-2.0 - 0.3 * np.arange(4) * np.sin(turn[-1]), 0.3 * np.arange(4) * np.cos(turn[-1]), 0 * turn], -1
    )
    half = 0.5 * turn[-1]
    state = dataclasses.replace(
        state,
        position=state.position.at[1:].set(jnp.asarray(place, state.position.dtype)),
        orientation=state.orientation.at[1:].set(jnp.asarray([np.cos(half), 0, 0, np.sin(half)], state.position.dtype)),
    )
    _, record = record_worlds(
        repeat(model, 1), repeat(state, 1), 60,
        lambda model, state: {"x": state.position[1:, 0], "gap": joint_gaps(model, state).translation.max()},
    )  # fmt: skip
    gate("centre of a ball inside the wall [m]", np.maximum(np.asarray(record["x"]) + 0.1, 0.0), 0.0)
    gate("gap / link", np.asarray(record["gap"]) / 0.3, 1e-3)


# Closed loops --------------------------------------------------------------------------------------------------------


def bars(*joints, count=3, **options):
    """Bars of 1 m and 1 kg in a square, (body, body, corner, axis) for each hinge; body 0 is the ground."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Sphere(0.02), static=True, collides=False)
    places = [((0, 0.5, 0), (0.02, 0.5, 0.02)), ((0.5, 1, 0), (0.5, 0.02, 0.02)), ((1, 0.5, 0), (0.02, 0.5, 0.02))]
    for place, half in places[:count]:
        builder.add_body(Box(half), mass=1.0, position=place, collides=False)
    for joint in joints:
        builder.add_joint(joint)
    return builder.build(undamped(**{"dt": 1 / 240, **options}))


SQUARE = (
    Hinge(0, 1, (0, 0, 0), ACROSS),
    Hinge(1, 2, (0, 1, 0), ACROSS),
    Hinge(2, 3, (1, 1, 0), ACROSS),
    Hinge(3, 0, (1, 0, 0), ACROSS),
)
OVERCONSTRAINED = {
    "axes that cross": (*SQUARE[:3], Hinge(3, 0, (1, 0, 0), (0, 1, 0))),
    "hinge twice": (*SQUARE, Hinge(1, 2, (0, 1, 0), ACROSS)),
    "weld beside a hinge": (*SQUARE, Fixed(1, 2, (0, 1, 0))),
    "rod that can not reach": (*SQUARE, Distance(1, 3, anchor=(0, 1, 0), child_anchor=(1, 0, 0), lengths=3.0)),
}


@pytest.mark.parametrize("case", slow_but(("rod that can not reach",), OVERCONSTRAINED))
@pytest.mark.parametrize("precision", ["float32"], indirect=True)
def test_a_loop_with_too_many_joints_stays_finite(precision, case, gate):
    """Rows that say the same twice, or what can not be: nothing is NaN, and no energy comes from nothing.

    What can not be is flagged.
    """
    model, state = bars(*OVERCONSTRAINED[case])
    spin = state.angular_velocity.at[1, 2].set(-1.0)
    state = dataclasses.replace(state, angular_velocity=spin)
    _, record = record_worlds(
        repeat(model, 1), repeat(state, 1), 480,
        lambda model, state: {
            "energy": energy(model, state), "gap": joint_gaps(model, state).translation, "flags": state.flags,
        },
    )  # fmt: skip
    assert np.isfinite(record["energy"]).all()
    contradicts = case == "rod that can not reach"
    assert (np.asarray(record["flags"]) == (Flag.OPEN_LOOP if contradicts else 0)).all()
    rise = np.asarray(record["energy"], float) - float(energy(model, state))
    gate("energy gained / that of the fall", np.maximum(rise, 0.0) / (GRAVITY * 3 * 2.0), 0.02)
    if not contradicts:
        gate("gap [m]", np.asarray(record["gap"]), 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("sleep", [False, True])
def test_a_loop_beside_a_tree_leaves_it_exact(precision, sleep, gate):
    """A four-bar linkage and a chain of four in one scene."""
    builder = SceneBuilder(gravity=DOWN)
    ground = builder.add_body(Sphere(0.02), static=True, collides=False)
    places = [((0, 0.5, 0), (0.02, 0.5, 0.02)), ((0.5, 1, 0), (0.5, 0.02, 0.02)), ((1, 0.5, 0), (0.02, 0.5, 0.02))]
    for place, half in places:
        builder.add_body(Box(half), mass=1.0, position=place, collides=False)
    for joint in SQUARE:
        builder.add_joint(joint)
    last = ground
    for k in range(4):
        body = builder.add_body(Box((0.125, 0.02, 0.02)), mass=0.25, position=(3.125 + 0.25 * k, 0, 0), collides=False)
        builder.add_joint(Hinge(last, body, (3.0 + 0.25 * k, 0, 0), ACROSS))
        last = body
    model, state = builder.build(undamped(dt=1 / 240, sleep=sleep))
    state = dataclasses.replace(state, angular_velocity=state.angular_velocity.at[1, 2].set(-1.0))
    _, record = record_worlds(
        repeat(model, 1), repeat(state, 1), 480,
        lambda model, state: {"gap": joint_gaps(model, state).translation, "energy": energy(model, state)},
    )  # fmt: skip
    gap = np.asarray(record["gap"], float)[:, 0]
    gate("gap of the loop [m]", gap[:, :4], 1e-5)
    gate("gap of the chain / link", gap[:, 4:] / 0.25, 1e-5)
    rise = np.asarray(record["energy"], float) - float(energy(model, state))
    gate("energy gained / that of the fall", np.maximum(rise, 0.0) / (GRAVITY * 3 * 2.0), 0.02)
