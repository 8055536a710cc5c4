"""Times of impact against closed forms and dense samples, with their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Heightfield, Plane, Sphere, time_of_impact
from tests.marks import slow_but
from tests.poses import STILL, at, turned


def test_two_balls_meet(precision, gate):
    """Gap 9 less, speed 10: 0.9 s (the case of the parry library)."""
    found = time_of_impact(
        Sphere(0.5), at(0, 0, 0), (np.array([10.0, 0, 0]), np.ones(3)), Sphere(0.5), at(10, 0, 0), STILL, 2.0
    )
    limit = 1e-12 if precision == "float64" else 1e-6
    assert found.hit
    gate("time", found.time - 0.9, limit)
    gate("gap", found.distance.separation, 20 * limit)


def test_first_and_second_derivatives_of_balls_that_meet_askew(float64, gate):
    """The lesser root of ``|p + v t| = 1`` in closed form; and the normal there, which is ``p + v t``."""

    def searched(x):
        found = time_of_impact(
            Sphere(0.6), at(0, 0, 0), STILL, Sphere(0.4), (x[:3], at(0, 0, 0)[1]), (x[3:], np.zeros(3)), 3.0
        )
        return jnp.concatenate([found.time[None], found.distance.normal])

    def known(x):
        p, v = x[:3], x[3:]
        a, b, c = v @ v, p @ v, p @ p - 1.0
        time = (-b - jnp.sqrt(b * b - a * c)) / a
        return jnp.concatenate([time[None], p + v * time])

    x = jnp.array([2.0, 0.3, -0.2, -1.5, 0.1, 0.3])
    gate("value", searched(x) - known(x), 1e-12)
    gate("forward mode", jax.jacfwd(searched)(x) - jax.jacfwd(known)(x), 1e-9)
    gate("reverse mode", jax.jacrev(searched)(x) - jax.jacrev(known)(x), 1e-9)
    gate("second derivatives", jax.hessian(searched)(x) - jax.hessian(known)(x), 1e-8)


def test_rod_swings_onto_a_plane(float64, gate):
    """The end of a turning rod, L sin(omega t) below its centre, reaches the plane below: rotation alone closes the gap."""
    length, radius, height, rate = 1.0, 0.05, 0.5, 2.0
    lying = turned((0, 0, 1), np.pi / 2)  # the rod's axis along -x

    def time(height, rate):
        return time_of_impact(
            Plane((0, 1, 0)), at(0, 0, 0), STILL,
            Capsule(radius, length), (jnp.array([0.0, height, 0.0]), lying), (np.zeros(3), jnp.array([0, 0, rate])), 3.0,
        ).time  # fmt: skip

    truth = np.arcsin((height - radius) / length) / rate
    value, (by_height, by_rate) = jax.value_and_grad(time, argnums=(0, 1))(height, rate)
    gate("time", value - truth, 1e-9)
    gate("d time / d height", by_height - 1.0 / (rate * np.sqrt(length**2 - (height - radius) ** 2)), 1e-7)
    gate("d time / d rate", by_rate + truth / rate, 1e-7)


def test_no_impact_within_the_duration(float64):
    for velocity, duration in (((1.0, 0, 0), 1.0), ((-1.0, 0, 0), 5.0), ((0, 1.0, 0), 9.0)):
        found = time_of_impact(
            Sphere(0.5),
            at(0, 0, 0),
            (np.array(velocity), np.zeros(3)),
            Box((0.5, 0.5, 0.5)),
            at(4, 0, 0),
            STILL,
            duration,
        )
        assert not found.hit and found.time == duration


def test_touching_from_the_start():
    found = time_of_impact(Sphere(1.0), at(0, 0, 0), STILL, Sphere(1.0), at(1, 0, 0), STILL, 1.0)
    assert found.hit and found.time == 0.0


def test_a_bullet_never_passes_through_a_thin_plate(float64, gate):
    rng = np.random.default_rng(0)
    speeds = rng.uniform(100, 1000, 64)
    spins = rng.normal(size=(64, 3)) * 50

    def impact(speed, spin):
        motion = (jnp.array([1.0, 0.0, 0.0]) * speed, spin)
        return time_of_impact(
            Box((0.01, 0.005, 0.005)), at(-5, 0, 0), motion, Box((0.001, 2, 2)), at(0, 0, 0), STILL, 1.0
        )

    found = jax.vmap(impact)(speeds, spins)
    assert found.hit.all()
    gate("time * speed against the reach of the bullet [m]", np.abs(found.time * speeds - 4.99), 0.01)
    gate("gap", found.distance.separation, 1e-5)


STICK = Box((1.0, 0.05, 0.05))


def gap_of_stick(angle, height):
    """Of a stick turned about z and a ball of radius 0.1 above its middle: a point and a rectangle, in closed form."""
    x, y = height * np.sin(angle), height * np.cos(angle)
    return np.hypot(np.maximum(np.abs(x) - 1.0, 0.0), np.maximum(np.abs(y) - 0.05, 0.0)) - 0.1


@pytest.mark.parametrize(("rate", "height", "fall", "duration"), [
    (5.0, 1.5, 0.5, 2.0), (10.0, 1.5, 0.5, 2.0), (20.0, 1.5, 0.5, 2.0), (50.0, 1.5, 0.5, 2.0), (100.0, 3.0, 1.0, 3.0),
])  # fmt: skip
def test_a_ball_falls_into_a_spinning_stick(precision, gate, rate, height, fall, duration):
    """The first root of the gap by dense sampling and bisection."""
    times = np.linspace(0.0, duration, 2_000_001)
    first = np.argmax(gap_of_stick(rate * times, height - fall * times) <= 0)
    low, high = times[first - 1], times[first]
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if gap_of_stick(rate * middle, height - fall * middle) <= 0 else (middle, high)
    ball = at(0, height, 0), (np.array([0, -fall, 0]), np.zeros(3))
    found = time_of_impact(STICK, at(0, 0, 0), (np.zeros(3), np.array([0, 0, rate])), Sphere(0.1), *ball, duration)
    assert found.hit and found.distance.converged
    gate("time", found.time - high, 1e-9 if precision == "float64" else 2e-5)
    gate("gap", found.distance.separation, 1e-10 if precision == "float64" else 2e-5)


def test_shapes_that_spin_out_of_reach_of_each_other(precision):
    """A ball 0.0985 m beyond the reach of a stick; a stick that leaves a plane."""
    spin = np.zeros(3), np.array([0, 0, 20.0])
    beside = time_of_impact(STICK, at(0, 0, 0), spin, Sphere(0.1), at(0, 1.2, 0), STILL, 10.0)
    leaving = np.array([0, 0.5, 0]), np.array([0, 0, 30.0])
    above = time_of_impact(Plane((0, 1, 0)), at(0, 0, 0), STILL, STICK, at(0, 2, 0), leaving, 20.0)
    for found, duration in ((beside, 10.0), (above, 20.0)):
        assert not found.hit and found.time == duration and found.distance.converged


@pytest.mark.parametrize("height", slow_but((0.35,), (0.301, 0.35, 0.5, 1.31)))
def test_a_ball_that_flies_along_the_ground_meets_a_slope(float64, gate, height):
    """Ground 0 up to x = 0.5, from there a slope of two up to 1: the ball of radius 0.3 touches it at a distance of 0.3."""
    heights = np.zeros((21, 21))
    heights[12:14] = 1.0
    normal = np.array([-2.0, 1.0]) / np.sqrt(5.0)
    moving = np.array([1.0, 0, 0]), np.zeros(3)
    field = Heightfield(heights, cell_size=0.5)
    found = time_of_impact(field, at(0, 0, 0), STILL, Sphere(0.3), at(-3, height, 0), moving, 20.0)
    assert found.hit == (height < 1.3)
    gate("time", found.time - (3.5 + (0.3 - normal[1] * height) / normal[0] if height < 1.3 else 20.0), 1e-12)


def test_bad_motion():
    with pytest.raises(ValueError, match="motion_b must be"):
        time_of_impact(Sphere(1), at(0, 0, 0), STILL, Sphere(1), at(3, 0, 0), (np.zeros(3),), 1.0)


@pytest.mark.parametrize("shape", [Sphere(0.5), Box((0.5, 0.5, 0.5)), Heightfield(np.zeros((3, 3)), 1.0)])
def test_what_is_not_finite_is_no_answer(shape):
    """No hit, no time, and a word that nothing was found; the second motion is a real one."""
    spin = np.zeros((5, 3))
    velocity = np.array([[0, np.nan, 0], [0, -1.0, 0], [0, np.inf, 0], [np.inf, 0, 0], [0, np.nan, np.nan]])
    spin[4] = np.nan

    def search(velocity, spin):
        return time_of_impact(shape, at(0, 0, 0), STILL, Box((0.5, 0.5, 0.5)), at(0, 3, 0), (velocity, spin), 10.0)

    found = jax.jit(jax.vmap(search))(velocity, spin)
    real = np.arange(5) == 1
    np.testing.assert_array_equal(found.hit, real)
    np.testing.assert_array_equal(found.distance.converged, real)
    np.testing.assert_array_equal(np.isnan(found.time), ~real)


def test_a_negative_duration():
    with pytest.raises(ValueError, match="duration must be at least 0 s"):
        time_of_impact(Sphere(1), at(0, 0, 0), STILL, Sphere(1), at(3, 0, 0), STILL, -1.0)
