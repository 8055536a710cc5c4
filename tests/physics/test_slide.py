"""Stopping distance, heading and isotropy of Coulomb friction (benchmark A9)."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from tests.scenes import GRAVITY, advance_worlds, axis_angle, per_body, repeat, slab_on_plane, with_dt

SPEED = 2.0
DIRECTIONS = (0.0, 11.25, 22.5, 33.75, 45.0)
FRICTIONS = (0.2, 0.4, 0.7)
YAWS = (0.0, 45.0)
GRID = list(itertools.product(FRICTIONS, YAWS, DIRECTIONS))


def yaw_of(orientation):
    orientation = np.asarray(orientation, dtype=float)
    return 2 * np.arctan2(orientation[..., 2], orientation[..., 0])


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240, 1e-3])
def test_sliding_box_stops_where_coulomb_says(precision, dt, gate):
    friction, yaw, direction = (np.array(column) for column in zip(*GRID, strict=True))
    heading = np.radians(direction)
    model, state = slab_on_plane()
    models = with_dt(repeat(model, len(GRID)), dt)
    models = dataclasses.replace(models, friction=per_body(friction, models.friction))
    states = repeat(state, len(GRID))
    turned = np.stack([axis_angle((0, 1, 0), angle) for angle in np.radians(yaw)])
    states = dataclasses.replace(states, orientation=states.orientation.at[:, 1].set(jnp.asarray(turned)))

    settled = advance_worlds(models, states, round(0.5 / dt))
    gate("creep while settling [m]", (settled.position - states.position)[:, 1, ::2], 1e-4)
    push = SPEED * np.stack([np.cos(heading), np.zeros_like(heading), np.sin(heading)], axis=-1)
    pushed = dataclasses.replace(settled, velocity=settled.velocity.at[:, 1].set(jnp.asarray(push)))
    stopped = advance_worlds(models, pushed, round(1.2 / dt))  # the slowest stops after 1.02 s
    rested = advance_worlds(models, stopped, round(5.0 / dt))

    path = np.asarray(stopped.position[:, 1] - settled.position[:, 1], dtype=float)
    distance = np.hypot(path[:, 0], path[:, 2])
    gate("distance / truth - 1", distance / (SPEED**2 / (2 * friction * GRAVITY)) - 1, 0.01)
    gate("heading error [deg]", np.degrees(np.arctan2(path[:, 2], path[:, 0]) - heading), 0.1)
    gate("yaw error [deg]", np.degrees(yaw_of(stopped.orientation[:, 1])) - yaw, 0.1)
    by_direction = distance.reshape(len(FRICTIONS), len(YAWS), len(DIRECTIONS))
    gate("isotropy max / min - 1", by_direction.max(axis=-1) / by_direction.min(axis=-1) - 1, 0.01)
    gate("creep over 5 s [m]", rested.position[:, 1] - stopped.position[:, 1], 1e-4)
    gate("speed at rest [m/s]", rested.velocity[:, 1], 1e-3)
    assert not np.any(np.asarray(rested.flags))
