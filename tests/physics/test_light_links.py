"""Light links between heavy ones: the impulses of their joints are large and all but cancel each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, SceneBuilder, Slider, Sphere, rollout
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import undamped

LENGTH, LOAD, STEPS, DT = 0.5, 12.0, 240, 1 / 240
CARRIAGES = np.array([1e-1, 1e-3, 3e-5])


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_heavy_pendulum_on_a_light_carriage(precision, gate):
    """The centre of mass moves straight on, and so do its derivatives; the load keeps its distance.

    Carriages of 1 g and less turned faster and faster in float32 where they can not turn at all, by what round-off left of
    the impulses, until nothing was finite.
    """
    builder = SceneBuilder()
    rail = builder.add_body(Sphere(0.1), static=True, position=(0, 3, 0), collides=False)
    carriage = builder.add_body(Box((0.01, 0.01, 0.01)), mass=1.0, position=(0, 2, 0), collides=False)
    load = builder.add_body(Sphere(0.05), mass=LOAD, position=(0, 2 - LENGTH, 0), collides=False)
    builder.add_joint(Slider(rail, carriage, anchor=(0, 2, 0), axis=(1, 0, 0)))
    builder.add_joint(Hinge(carriage, load, anchor=(0, 2, 0), axis=(0, 0, 1)))
    model, state = builder.build(undamped(dt=DT))

    def end(mass, speed, spin, gravity):
        of_carriage = dataclasses.replace(
            model,
            mass=model.mass.at[carriage].set(mass),
            inertia=model.inertia.at[carriage].mul(mass),
            gravity=model.gravity.at[1].set(gravity),
        )
        velocity = state.velocity.at[carriage, 0].set(speed).at[load, 0].set(speed + LENGTH * spin)
        start = dataclasses.replace(
            state, velocity=velocity, angular_velocity=state.angular_velocity.at[load, 2].set(spin)
        )
        final = rollout(of_carriage, start, STEPS)[0]
        places = final.position[jnp.array([carriage, load]), :2]
        share = jnp.array([mass, LOAD]) / (mass + LOAD)
        centre = share @ places[:, 0]
        return centre, (centre, places, final.flags)

    by = (1, 2, 3)
    motion = (1.0, 2.0, -9.81)
    time, size = STEPS * DT, {"float32": 2e-5, "float64": 1e-12}[str(precision)]
    share = LOAD / (CARRIAGES + LOAD)
    zero = np.zeros_like(share)
    truth = np.stack([zero + time, LENGTH * share * time, zero])
    for mode in (jax.jacfwd, jax.jacrev):
        derivatives = jax.jit(jax.vmap(lambda mass, mode=mode: mode(end, by, has_aux=True)(mass, *motion)))
        found, (centre, places, flags) = derivatives(jnp.asarray(CARRIAGES, precision))
        assert not flags.any()
        gate("centre of mass", centre - time * (motion[0] + LENGTH * share * motion[1]), size)
        gate("on the rail", places[:, 0, 1] - 2.0, size)
        gate("length", np.linalg.norm(places[:, 1] - places[:, 0], axis=1) - LENGTH, size)
        gate("derivatives by speed, spin and gravity", np.stack(found) - truth, size)
