"""Free flight is the exact parabola and a free sphere spins exactly, at every time step."""

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Options, SceneBuilder, Sphere
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance,
    angle_between,
    axis_angle,
    body_on_plane,
    quaternion_product,
    undamped,
    with_dt,
)

DTS = [0.1, 1 / 60, 1 / 240, 1e-3]
ROUND_OFF = {"float32": 5e-5, "float64": 1e-11}


def lone_sphere(options, gravity=DOWN, **body):
    builder = SceneBuilder(gravity=gravity)
    builder.add_body(Sphere(0.1), mass=2.0, **body)
    return builder.build(options)


@pytest.mark.parametrize("dt", DTS)
@pytest.mark.parametrize("scene", ["sphere alone", "box above a plane"])
def test_flight_is_the_exact_parabola(precision, scene, dt, gate):
    start, velocity = np.array([1.0, 2.0, -1.0]), np.array([3.0, 4.0, -2.0])
    body = {"position": start, "velocity": velocity}
    if scene == "sphere alone":
        model, state = lone_sphere(undamped(), **body)
    else:
        model, state = body_on_plane(Box((0.1, 0.2, 0.3)), **body)
    count = round(0.7 / dt)
    time = count * dt
    final = advance(with_dt(model, dt), state, count)
    fall = np.array([0.0, -GRAVITY, 0.0])
    gate(
        "position [m]", final.position[-1] - (start + velocity * time + 0.5 * fall * time**2), ROUND_OFF[str(precision)]
    )
    gate("velocity [m/s]", final.velocity[-1] - (velocity + fall * time), ROUND_OFF[str(precision)])
    assert int(final.flags) == 0


@pytest.mark.parametrize("dt", DTS)
def test_free_sphere_turns_by_exactly_omega_t(precision, dt, gate):
    omega = np.array([1.0, 2.0, -3.0])
    start = axis_angle((1.0, -1.0, 0.5), 0.7)
    model, state = lone_sphere(undamped(), orientation=start, angular_velocity=omega)
    count = round(2.0 / dt)
    final = advance(with_dt(model, dt), state, count)
    truth = quaternion_product(axis_angle(omega, np.linalg.norm(omega) * count * dt), start)
    gate(
        "orientation [rad]",
        angle_between(final.orientation[0], truth),
        {"float32": 3e-4, "float64": 1e-10}[str(precision)],
    )
    gate("angular velocity [rad/s]", final.angular_velocity[0] - omega, ROUND_OFF[str(precision)])
    gate(
        "quaternion norm",
        jnp.linalg.norm(final.orientation[0]) - 1,
        {"float32": 1e-6, "float64": 1e-14}[str(precision)],
    )


def test_damping_decays_at_its_rate(float64, gate):
    options = Options(dt=1 / 240, linear_damping=0.5, angular_damping=0.8)
    model, state = lone_sphere(options, gravity=(0, 0, 0), velocity=(3.0, 0.0, 0.0), angular_velocity=(0.0, 2.0, 0.0))
    final = advance(model, state, 480)
    gate("linear rate / truth - 1", -np.log(final.velocity[0, 0] / 3.0) / (0.5 * 2.0) - 1, 0.01)
    gate("angular rate / truth - 1", -np.log(final.angular_velocity[0, 1] / 2.0) / (0.8 * 2.0) - 1, 0.01)


def test_zero_gravity_is_allowed_and_keeps_the_velocity(precision):
    model, state = lone_sphere(undamped(), gravity=(0, 0, 0), velocity=(1.0, 2.0, 3.0))
    final = advance(model, state, 60)
    np.testing.assert_array_equal(np.asarray(final.velocity[0]), [1.0, 2.0, 3.0])


@pytest.mark.parametrize("rate", [1.0, 5.0])
def test_thin_rod_turns_at_its_rate(precision, rate, gate):
    """Moments 5000:1 across the rod: its momentum over the smallest moment is no bound of how fast it turns."""
    builder = SceneBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_body(Box((0.5, 0.005, 0.005)), mass=1.0, angular_velocity=(0.0, 0.0, rate))
    model, state = builder.build(undamped(dt=1 / 60))
    end = advance(model, state, 60)
    gate("angle after 1 s [rad]", angle_between(end.orientation[0], axis_angle((0, 0, 1), rate)), 2e-5)
