"""Islands at rest fall asleep, do not move a bit, and wake for whatever would move them (guide 3.4 and 12.2)."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, Plane, SceneBuilder, Sphere, apply_force, is_asleep, rollout, step, wake
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance,
    advance_worlds,
    axis_angle,
    box_stack,
    repeat,
    sphere_on_plane,
    stack,
    undamped,
)

DT = 1 / 60
POSE = ("position", "orientation")
MOTION = ("velocity", "angular_velocity")
FORCES = ("contact_force", "contact_feature", "joint_force")


run = jax.jit(rollout, static_argnums=2)


def sleepy(**changes):
    return undamped(**{"dt": DT, "sleep": True, **changes})


def two_stacks(options=None, ball=None):
    """Body 0: the plane; bodies 1, 2 and 3, 4: one ball exactly upon another; body 5: a ball that bounces for ever."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, restitution=1.0)
    for x in (0.0, 2.0):
        for level in range(2):
            builder.add_body(Sphere(0.1), mass=1.0, position=(x, 0.1 + 0.2 * level, 0.0))
    builder.add_body(Sphere(0.1), mass=1.0, restitution=1.0, **(ball or {"position": (-2.0, 1.0, 0.0)}))
    return builder.build(options or sleepy())


def asleep(seconds=1.5, **arguments):
    """`two_stacks` after both have fallen asleep; the ball bounces."""
    model, state = two_stacks(**arguments)
    state = advance(model, state, round(seconds / DT))
    assert np.asarray(is_asleep(model, state)).tolist() == [False, True, True, True, True, False]
    return model, state


def same_bits(first, second, names, bodies=slice(None)):
    for name in names:
        np.testing.assert_array_equal(getattr(first, name)[bodies], getattr(second, name)[bodies], err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("broadphase", ["none", "all_pairs"])
def test_stacks_beside_a_bouncing_ball_do_not_move_a_bit(broadphase):
    model, state = asleep(options=sleepy(broadphase=broadphase))
    bodies = slice(1, 5)
    _, record = run(model, state, 1000)
    for name in POSE:
        np.testing.assert_array_equal(
            getattr(record, name)[:, bodies], jnp.stack([getattr(state, name)[bodies]] * 1000)
        )
    for name in MOTION:
        assert not np.any(getattr(record, name)[:, bodies])
    assert np.asarray(record.sleep.asleep)[:, bodies].all() and not np.asarray(record.sleep.asleep)[:, 5].any()
    assert np.ptp(np.asarray(record.position)[:, 5, 1]) > 0.5, "the ball has to move for this test to mean something"
    # The impulses stay for the wake-up, in whatever order: the ball's contacts come and go.
    weight = np.asarray(record.contact_force, dtype=float)[:, :, 1].sum(-1)
    in_flight = np.asarray(record.position)[:, 5, 1] > 0.5
    np.testing.assert_array_equal(weight[in_flight], weight[in_flight][0])


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_world_asleep_does_not_change_a_bit(precision):
    model, state = box_stack(3, options=sleepy())
    state = advance(model, state, 120)
    assert np.asarray(is_asleep(model, state))[1:].all()
    later = advance(model, state, 1000)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(state), jax.tree.leaves(later), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))
    force = np.asarray(state.contact_force, dtype=float)
    assert force[:, 1].max() > 0.7 * GRAVITY, "the lowest box stands on four points with three weights"


@pytest.mark.slow
def test_the_whole_island_sleeps_at_once():
    model, state = two_stacks()
    _, record = run(model, state, 90)
    sleeps = np.asarray(record.sleep.asleep)
    np.testing.assert_array_equal(sleeps[:, 1], sleeps[:, 2])
    np.testing.assert_array_equal(sleeps[:, 3], sleeps[:, 4])
    first = np.argmax(sleeps[:, 1])
    assert first * DT >= 0.5 - 1.5 * DT, "not before the sleep time"
    assert first * DT < 1.0


def test_an_impact_passes_through_a_sleeping_body(gate):
    """Two equal elastic balls in free space: the one that sleeps takes the whole momentum, in the step of the impact."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    for x, speed in ((0.0, 1.0), (2.05, 0.0)):
        builder.add_body(
            Sphere(0.1), mass=1.0, position=(x, 0, 0), velocity=(speed, 0, 0), restitution=1.0, friction=0.0
        )
    model, state = builder.build(sleepy())
    _, record = run(model, state, 150)
    sleeps, speed = np.asarray(record.sleep.asleep), np.asarray(record.velocity, dtype=float)[:, :, 0]
    impact = np.flatnonzero(speed[:, 1])[0]
    assert sleeps[60, 1] and not sleeps[: impact + 1, 0].any()
    assert impact == int(1.85 / DT)  # the gap of 1.85 m closes within this step
    assert not sleeps[impact, 1]
    gate("momentum taken over in the step of the impact", speed[impact] - [0.0, 1.0], 1e-5)


def test_a_contact_wakes_the_island_and_no_other():
    model, state = asleep(ball={"position": (0.0, 20.0, 0.0)})
    _, record = run(model, state, 60)
    sleeps = np.asarray(record.sleep.asleep)
    woken = np.argmin(sleeps[:, 2])
    assert woken > 0 and not sleeps[woken, 1], "both boxes of the stack that is hit wake together"
    assert np.asarray(record.contact_force)[woken, :, 1].max() > 100.0, "in the step of the impact"
    assert sleeps[:, 3:5].all()
    np.testing.assert_array_equal(record.position[-1, 3:5], state.position[3:5])


@pytest.mark.slow
def test_a_force_wakes(gate):
    model, state = asleep()
    pushed = jax.jit(step)(model, apply_force(state, 2, jnp.array([0.0, 30.0, 0.0])))
    assert np.asarray(is_asleep(model, pushed)).tolist() == [False, False, False, True, True, False]
    gate("velocity of the body lifted", float(pushed.velocity[2, 1]) - (30.0 - GRAVITY) * DT, 1e-5)


def test_a_motor_wakes(gate):
    builder = SceneBuilder(gravity=(0, 0, 0))
    post = builder.add_body(Sphere(0.1), static=True)
    arm = builder.add_body(Box((0.5, 0.1, 0.1)), mass=1.0, position=(0.6, 0, 0))
    hinge = builder.add_joint(Hinge(parent=post, child=arm, anchor=(0, 0, 0), axis=(0, 0, 1)))
    builder.add_motor(hinge, limit=10.0)
    model, state = builder.build(sleepy())
    state = advance(model, state, 60, jnp.zeros(1))
    assert bool(is_asleep(model, state)[arm])
    driven = step(model, state, jnp.array([1.0]))
    assert not bool(is_asleep(model, driven)[arm])
    inertia = (0.5**2 + 0.1**2) / 3 + 0.6**2
    gate("angular velocity / truth - 1", float(driven.angular_velocity[arm, 2]) / (DT / inertia) - 1, 1e-4)


@pytest.mark.parametrize(
    "edit",
    [
        lambda s: dataclasses.replace(s, velocity=s.velocity.at[2, 0].set(1e-6)),
        lambda s: dataclasses.replace(s, angular_velocity=s.angular_velocity.at[2, 0].set(1e-6)),
        lambda s: dataclasses.replace(s, position=s.position.at[2, 0].add(1e-5)),
        lambda s: dataclasses.replace(s, orientation=s.orientation.at[2].multiply(-1.0)),
        lambda s: wake(s, 2),
    ],
    ids=["velocity", "angular velocity", "position", "orientation", "wake"],
)
def test_the_user_wakes(edit):
    model, state = asleep()
    sleeps = np.asarray(is_asleep(model, jax.jit(step)(model, edit(state))))
    assert not sleeps[1] and not sleeps[2]


def test_a_traced_handle_wakes_and_a_batch_is_refused():
    _, state = asleep()
    woken = jax.vmap(lambda body: wake(state, body).sleep.asleep)(jnp.array([1, 2]))
    np.testing.assert_array_equal(woken, np.asarray(state.sleep.asleep) & ~np.eye(6, dtype=bool)[[1, 2]])
    with pytest.raises(ValueError, match=r"wake: state\.position must have shape .* use jax\.vmap"):
        wake(repeat(state, 2), 1)
    with pytest.raises(ValueError, match="wake: body must lie between 0 and 5, got 6"):
        wake(state, 6)


@pytest.mark.parametrize("broadphase", ["none", "all_pairs"])
def test_what_loses_its_support_falls(broadphase):
    """The lower box is taken away, far from everything: what it touched before counts."""
    model, state = asleep(options=sleepy(broadphase=broadphase))
    gone = dataclasses.replace(state, position=state.position.at[1].set(jnp.array([50.0, 0.1, 0.0])))
    final = advance(model, gone, 10)
    assert np.asarray(final.position)[2, 1] < np.asarray(state.position)[2, 1] - 0.05
    assert np.asarray(is_asleep(model, final))[3:5].all()


def test_what_loses_a_static_support_falls():
    builder = SceneBuilder(gravity=DOWN)
    shelf = builder.add_body(Box((0.5, 0.1, 0.5)), static=True)
    box = builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(0, 0.2, 0))
    model, state = builder.build(sleepy())
    state = advance(model, state, 90)
    assert bool(is_asleep(model, state)[box])
    moved = dataclasses.replace(state, position=state.position.at[shelf, 0].add(5.0))
    assert np.asarray(advance(model, moved, 10).position)[box, 1] < 0.15


@pytest.mark.parametrize("gravity", [1e-3, 0.02, 0.1])
def test_a_ball_at_its_apex_does_not_sleep(gravity, gate):
    """In weak gravity the ball is slow for 2 x 0.05 / g = 100 s ... 0.1 s around its apex."""
    model, state = sphere_on_plane(height=2.0, gravity=(0, -gravity, 0), velocity=(0, 0.04, 0), options=sleepy())
    steps = round(min(1.6 * 0.04 / gravity, 30.0) / DT)
    final = advance(model, state, steps)
    t = steps * DT
    assert not np.asarray(is_asleep(model, final)).any()
    gate("velocity off the parabola [m/s]", float(final.velocity[1, 1]) - (0.04 - gravity * t), 1e-5)


def test_a_slow_pendulum_does_not_sleep_at_its_turning_point(gate):
    """A rod released from rest 0.4 rad off, in weak gravity: slow for 1.5 s, carried by its hinge for the most part."""
    gravity, half, angle = 0.1, 1.0, 0.4
    builder = SceneBuilder(gravity=(0, -gravity, 0))
    post = builder.add_body(Sphere(0.1), static=True)
    place = (half * np.sin(angle), -half * np.cos(angle), 0)
    rod = builder.add_body(Box((0.05, half, 0.05)), mass=1.0, position=place, orientation=axis_angle((0, 0, 1), angle))
    builder.add_joint(Hinge(parent=post, child=rod, anchor=(0, 0, 0), axis=(0, 0, 1)))
    model, state = builder.build(sleepy())
    _, record = run(model, state, 240)
    speed = np.linalg.norm(np.asarray(record.velocity)[:, rod], axis=-1)
    assert speed[round(1.2 / DT)] < 0.05 < speed[-1], "slow for longer than the sleep time, then fast"
    assert not np.asarray(record.sleep.asleep).any()


@pytest.mark.slow
def test_sleep_does_nothing_to_what_never_rests():
    """Neutral equals absent (benchmark M2): with thresholds that nothing meets, the trajectory is that without sleep."""
    never = sleepy(sleep_velocity=1e-30, sleep_angular_velocity=1e-30)
    finals = []
    for options in (undamped(dt=DT), never):
        model, state = two_stacks(options=options)
        finals.append(advance(model, state, 60))
    same_bits(*finals, (*POSE, *MOTION, *FORCES))


def test_sleep_is_absent_unless_asked_for():
    model, state = two_stacks(options=undamped(dt=DT))
    assert state.sleep is None and step(model, state).sleep is None
    assert not np.asarray(is_asleep(model, state)).any()
    assert wake(state, 1) is state
    # Thresholds are static: were they in the program, another value would be another program.
    programs = []
    for seconds in (0.5, 0.7):
        model, state = sphere_on_plane(options=undamped(dt=DT, sleep_time=seconds))
        programs.append(jax.jit(step).lower(model, state).as_text())
    assert programs[0] == programs[1]
    assert programs[0] != jax.jit(step).lower(*sphere_on_plane(options=sleepy())).as_text()


def test_worlds_sleep_on_their_own():
    """A batch of sleeping and waking worlds gives what each world gives alone."""
    model, state = asleep()
    quiet = dataclasses.replace(
        state, position=state.position.at[5, 1].set(0.1), velocity=state.velocity.at[5].set(0.0)
    )
    quiet = advance(model, quiet, 60)
    assert np.asarray(is_asleep(model, quiet))[1:].all()
    pushed = apply_force(quiet, 1, jnp.array([50.0, 0.0, 0.0]))
    worlds = [quiet, pushed, state]
    final = advance_worlds(repeat(model, 3), stack(worlds), 5)
    same_bits(quiet, jax.tree.map(lambda x: x[0], final), (*POSE, *MOTION, *FORCES))
    assert np.asarray(final.sleep.asleep)[:, 1].tolist() == [True, False, True]
    alone = advance(model, pushed, 5)
    np.testing.assert_allclose(final.position[1], alone.position, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("everything", [True, False], ids=["step skipped", "step computed"])
def test_gradient_passes_through_a_sleeping_body(float64, everything):
    """The identity for the pose and zero for the velocity; nothing is NaN."""
    if everything:
        model, state = two_stacks(ball={"position": (-2.0, 0.1, 0.0)})
        state = advance(model, state, 90)
    else:
        model, state = asleep()
    assert np.asarray(is_asleep(model, state))[1:].all() == everything
    assert np.asarray(is_asleep(model, state))[1:3].all()

    def after(position, velocity):
        return step(model, dataclasses.replace(state, position=position, velocity=velocity))

    by_position, by_velocity = jax.jacrev(lambda p, v: after(p, v).position[1:3], (0, 1))(
        state.position, state.velocity
    )
    identity = np.zeros(by_position.shape)
    for body in (0, 1):
        identity[body, :, body + 1] = np.eye(3)
    np.testing.assert_array_equal(by_position, identity)
    np.testing.assert_array_equal(by_velocity, np.zeros_like(by_velocity))
    speeds = jax.jacrev(lambda p, v: after(p, v).velocity[1:3], (0, 1))(state.position, state.velocity)
    assert all(not np.any(np.asarray(part)) for part in speeds)
    slope = jax.grad(lambda m: jnp.sum(rollout(m, state, 3)[0].position), allow_int=True)(model)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope) if leaf.dtype == float)


@pytest.mark.slow
def test_falling_asleep_and_waking_have_finite_gradients(float64):
    model, state = two_stacks()

    def loss(velocity):
        final, _ = rollout(model, dataclasses.replace(state, velocity=velocity), 90)
        return jnp.sum(final.position)

    assert np.isfinite(jax.jit(jax.grad(loss))(state.velocity)).all()


def test_a_sleeping_batch_costs_next_to_nothing(gate):
    """Three boxes in each of 64 worlds; 1.0 is the step of the same batch awake."""
    model, state = box_stack(3, options=sleepy())
    rested = advance(model, state, 200)
    assert np.asarray(is_asleep(model, rested))[1:].all()
    models = repeat(model, 64)
    times = {}
    for name, start in (("asleep", rested), ("awake", wake(rested, 1))):
        states = repeat(start, 64)
        advance_worlds(models, states, 20)
        taken = []
        for _ in range(15):  # each takes milliseconds: a busy machine disturbs a few in a row
            begin = time.process_time()
            jax.block_until_ready(advance_worlds(models, states, 20))
            taken.append(time.process_time() - begin)
        times[name] = min(taken)
    gate("time asleep / awake", times["asleep"] / times["awake"], 0.1)
