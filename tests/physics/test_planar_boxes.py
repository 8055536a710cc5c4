"""Boxes turned about one axis only, where axes of edges are axes of faces: nothing may tip out of the plane."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Options, SceneBuilder
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import advance_worlds, repeat

WORLDS = 64


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_cube_that_falls_on_a_slope_stays_in_its_plane(precision, gate):
    """One corner of a face in place of the face made a fifth of the worlds spin, by up to 9 rad/s."""
    builder = SceneBuilder()
    slope = builder.add_body(Box((1.0, 0.1, 1.0)), static=True, friction=0.5)
    cube = builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(0, 0.5, 0), friction=0.5)
    model, state = builder.build(Options(dt=1 / 240))
    draw = np.random.default_rng(0)
    tilt = draw.uniform(-0.4, 0.4, WORLDS)
    angles = np.stack([tilt, tilt + draw.uniform(-0.3, 0.3, WORLDS)], 1)
    zero = np.zeros_like(angles)
    turned = jnp.asarray(np.stack([np.cos(angles / 2), zero, zero, np.sin(angles / 2)], -1), precision)
    states = repeat(state, WORLDS)
    states = dataclasses.replace(states, orientation=states.orientation.at[:, [slope, cube]].set(turned))
    final = advance_worlds(repeat(model, WORLDS), states, 120)
    gate("rate out of the plane [rad/s]", final.angular_velocity[:, cube, :2], 1e-3)
    gate("sideways [m]", final.position[:, cube, 2], 1e-4)
    assert (np.asarray(final.position[:, cube, 1]) < 0.45).all()
