"""Frames of fixed steps, sub-steps, interpolation, and time steps of zero or worse (guide 11.2 and 12.3)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from mathota_jax import Flag, Options, advance, apply_force, interpolate, step, substep
from tests.marks import QUICK_AND_SLOW_PRECISION, QUICK_IN_FLOAT64
from tests.scenes import GRAVITY, box_stack, slab_on_plane, sphere_on_plane, undamped, with_dt

DT = 1 / 64  # a power of two: sums of steps are exact


def falling(**changes):
    return sphere_on_plane(height=50.0, options=undamped(dt=DT), **changes)


@pytest.mark.parametrize("frame", [0.3 * DT, DT, 1.7 * DT, 2.999 * DT])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_frames_add_up_to_the_time_that_passed(precision, frame, gate):
    model, state = falling()
    accumulator, total, calls = 0.0, 0, 40
    run = jax.jit(advance)
    for _ in range(calls):
        found = run(model, state, accumulator, frame)
        state, accumulator = found.state, found.accumulator
        total += int(found.step_count)
        assert 0 <= float(found.alpha) < 1 and float(found.dropped) == 0
        assert float(found.alpha) == pytest.approx(float(accumulator) / DT, abs=1e-5)
    assert total == int(calls * frame / DT + 1e-3)
    gate("time at hand and in steps - time passed [s]", total * DT + float(accumulator) - calls * frame, 1e-5)
    gate("velocity / truth", float(state.velocity[1, 1]) / (-GRAVITY * total * DT) - 1, 1e-5)


def test_a_frame_of_one_step_is_one_step_however_it_rounds():
    """1/60 s as the difference of clock readings is never exactly 1/60 s."""
    model, state = with_dt(falling()[0], 1 / 60), falling()[1]
    run, accumulator = jax.jit(advance), 0.0
    clock = np.arange(200) / 60
    for elapsed in np.diff(clock):
        found = run(model, state, accumulator, elapsed)
        accumulator = found.accumulator
        assert int(found.step_count) == 1


def test_a_pause_after_a_frame_that_fell_short_by_a_rounding_takes_no_step_back():
    """The time left over is then a little less than nothing."""
    model, state = with_dt(falling()[0], 1 / 60), falling()[1]
    run = jax.jit(advance)
    found = run(model, state, 0.0, jnp.nextafter(jnp.float32(51 / 60), jnp.float32(0)))
    assert int(found.step_count) == 8 and float(found.accumulator) <= 0
    paused = run(model, found.state, found.accumulator, 0.0)
    assert int(paused.step_count) == 0 and float(paused.alpha) == 0 and int(paused.state.flags) == 0
    assert float(paused.accumulator) == float(found.accumulator)


@pytest.mark.parametrize("accumulator", [-0.5, np.nan, np.inf])
def test_time_left_over_that_no_frame_leaves_is_flagged(accumulator):
    model, state = falling()
    found = jax.jit(advance)(model, state, accumulator, 1.5 * DT)
    assert int(found.state.flags) == int(Flag.INVALID_TIME_STEP)
    assert int(found.step_count) == 1 and float(found.accumulator) == pytest.approx(0.5 * DT)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_frame_equals_its_steps(precision):
    model, state = slab_on_plane(velocity=(1.0, 0.0, 0.5), options=undamped(dt=DT))
    expected = state
    for _ in range(3):
        before, expected = expected, jax.jit(step)(model, expected)
    found = jax.jit(advance)(model, state, 0.25 * DT, 3.5 * DT)
    for name in ("position", "orientation", "velocity", "contact_force"):
        np.testing.assert_allclose(getattr(found.state, name), getattr(expected, name), atol=1e-6)
        np.testing.assert_allclose(getattr(found.previous, name), getattr(before, name), atol=1e-6)
    assert float(found.alpha) == pytest.approx(0.75)


def test_too_much_time_is_dropped_and_reported():
    model, state = falling()
    found = advance(model, state, 0.5 * DT, 10 * DT, max_steps=4)
    assert int(found.step_count) == 4
    assert float(found.dropped) == pytest.approx(6 * DT)
    assert float(found.accumulator) == pytest.approx(0.5 * DT)


def test_forces_wait_for_a_step():
    model, state = falling()
    pushed = apply_force(state, 1, jnp.array([1.0, 0.0, 0.0]))
    idle = advance(model, pushed, 0.0, 0.5 * DT)
    assert int(idle.step_count) == 0
    np.testing.assert_array_equal(idle.state.applied_force, pushed.applied_force)
    np.testing.assert_array_equal(idle.previous.position, idle.state.position)
    moved = advance(model, idle.state, idle.accumulator, 2.5 * DT)
    assert int(moved.step_count) == 3
    np.testing.assert_allclose(moved.state.velocity[1, 0], DT, rtol=1e-5)


@pytest.mark.parametrize("elapsed", [-0.1, np.nan, np.inf])
def test_bad_elapsed_time_is_flagged_and_does_nothing(elapsed):
    model, state = falling()
    found = advance(model, state, 0.25 * DT, elapsed)
    assert int(found.state.flags) == Flag.INVALID_TIME_STEP and int(found.step_count) == 0
    assert float(found.accumulator) == 0.25 * DT
    np.testing.assert_array_equal(found.state.position, state.position)


def test_worlds_take_their_own_numbers_of_steps():
    model, state = falling()
    frames = jnp.array([0.5, 1.5, 20.5]) * DT
    found = jax.vmap(lambda elapsed: advance(model, state, 0.0, elapsed, max_steps=5))(frames)
    assert found.step_count.tolist() == [0, 1, 5]
    np.testing.assert_allclose(found.state.velocity[:, 1, 1], -GRAVITY * DT * np.array([0, 1, 5]), rtol=1e-5)


def test_frames_are_differentiable(float64):
    model, state = falling()
    slope = jax.grad(
        lambda v: advance(model, dataclasses.replace(state, velocity=v), 0.0, 3.2 * DT).state.position[1, 0]
    )(state.velocity)
    np.testing.assert_allclose(slope[1], [3 * DT, 0, 0], rtol=1e-12)


def test_substeps_are_steps_of_a_fraction(precision, gate):
    """An applied force gives the impulse of one step, whatever the number of parts."""
    model, state = falling(velocity=(1.0, 0.0, 0.0))
    pushed = apply_force(state, 1, jnp.array([0.0, 0.0, 6.0]))
    whole, parts = step(model, pushed), substep(model, pushed, count=4)
    for name in ("position", "velocity"):
        gate(name, np.asarray(getattr(parts, name)) - np.asarray(getattr(whole, name)), 1e-5)
    assert not np.any(parts.applied_force)


def test_substeps_solve_an_impact_at_its_own_time(float64, gate):
    """A ball with e = 0 and v = -1 at height 0.6 v dt stops in the third of four parts, at the plane."""
    model, state = sphere_on_plane(height=0.6 * DT, gravity=(0, 0, 0), velocity=(0, -1.0, 0), options=undamped(dt=DT))
    final = substep(model, state, count=4)
    gate("height [m]", float(final.position[1, 1]) - 0.1, 1e-9)
    gate("velocity [m/s]", float(final.velocity[1, 1]), 1e-9)


@pytest.mark.parametrize("alpha", [0.0, 0.25, 0.5, 1.0, 1.5])
def test_interpolation_against_scipy(precision, alpha, gate):
    _, state = box_stack(20)
    rng = np.random.default_rng(4)
    turns = Rotation.random(21, random_state=1)
    small = Rotation.from_rotvec(rng.normal(size=(21, 3)) * np.logspace(-9, 0.3, 21)[:, None])
    quaternions = [np.roll(r.as_quat(), 1, axis=-1) for r in (turns, small * turns)]
    quaternions[1] *= rng.choice([-1.0, 1.0], (21, 1))  # q and -q are one rotation
    places = rng.normal(size=(2, 21, 3))
    states = [
        dataclasses.replace(state, position=jnp.asarray(p), orientation=jnp.asarray(q))
        for p, q in zip(places, quaternions, strict=True)
    ]
    found = interpolate(*states, alpha)
    truth = Rotation.from_rotvec(alpha * (small).as_rotvec()) * turns
    if 0 <= alpha <= 1:
        k = 20
        slerp = Slerp([0, 1], Rotation.from_quat([turns[k].as_quat(), (small * turns)[k].as_quat()]))
        assert (slerp(alpha).inv() * truth[k]).magnitude() < 1e-6
    measured = Rotation.from_quat(np.roll(np.asarray(found.orientation, dtype=float), -1, axis=-1))
    limit = {"float32": 2e-6, "float64": 1e-12}[str(precision)]
    gate("angle to the truth [rad]", (measured.inv() * truth).magnitude(), limit)
    gate("position", np.asarray(found.position, float) - ((1 - alpha) * places[0] + alpha * places[1]), limit)
    np.testing.assert_array_equal(found.velocity, states[1].velocity)


def test_interpolation_has_finite_gradients_where_nothing_moved(float64):
    _, state = slab_on_plane()

    def loss(orientation, alpha):
        return jnp.sum(interpolate(state, dataclasses.replace(state, orientation=orientation), alpha).orientation ** 3)

    gradient = jax.grad(loss, (0, 1))(state.orientation, 0.3)
    assert all(np.isfinite(part).all() for part in gradient)


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(slab_on_plane, id="slab"),
        pytest.param(lambda **k: box_stack(2, **k), id="stack"),
    ],
)
def test_zero_time_step_changes_nothing(precision, scene):
    """Not a bit, applied forces included: no time has passed in which they could have acted."""
    model, state = scene(options=Options())
    state = apply_force(jax.jit(step)(model, state), 1, jnp.array([1.0, 2.0, 3.0]))
    after = step(with_dt(model, 0.0), state)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(state), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))
    slope = jax.grad(lambda m: jnp.sum(step(m, state).position), allow_int=True)(with_dt(model, 0.0))
    assert all(not np.any(np.asarray(leaf)) for leaf in jax.tree.leaves(slope) if leaf.dtype == precision)


@pytest.mark.parametrize("dt", [-1 / 60, np.nan, np.inf, -np.inf])
def test_bad_time_step_is_flagged_and_changes_nothing(precision, dt):
    model, state = slab_on_plane(velocity=(1.0, 0.0, 0.0))
    after = step(with_dt(model, dt), state)
    assert int(after.flags) == Flag.INVALID_TIME_STEP
    for name in ("position", "orientation", "velocity", "contact_force", "applied_force"):
        np.testing.assert_array_equal(getattr(after, name), getattr(state, name))


def test_bad_time_step_of_one_world_leaves_the_others_alone():
    model, state = slab_on_plane(velocity=(1.0, 0.0, 0.0))
    models = jax.vmap(lambda dt: with_dt(model, dt))(jnp.array([1 / 60, jnp.nan, 0.0]))
    final = jax.vmap(step, (0, None))(models, state)
    assert final.flags.tolist() == [0, int(Flag.INVALID_TIME_STEP), 0]
    np.testing.assert_allclose(final.position[0], step(with_dt(model, 1 / 60), state).position, atol=1e-6)


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf, "fast"])
def test_bad_time_step_is_refused_when_built(dt):
    with pytest.raises(ValueError, match="dt"):
        Options(dt=dt)


def test_bad_arguments_are_refused():
    model, state = falling()
    for count in (0, -1, 2.5, True):
        with pytest.raises(ValueError, match="substep: count"):
            substep(model, state, count=count)
        with pytest.raises(ValueError, match="advance: max_steps"):
            advance(model, state, 0.0, DT, max_steps=count)
    with pytest.raises(ValueError, match="advance: elapsed"):
        advance(model, state, 0.0, jnp.zeros(2))
    with pytest.raises(ValueError, match="advance: accumulator"):
        advance(model, state, jnp.zeros(2), DT)
    with pytest.raises(ValueError, match="interpolate"):
        interpolate(state, box_stack(3)[1], 0.5)
