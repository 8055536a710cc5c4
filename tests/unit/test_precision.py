"""A model in float32 stays so where JAX allows float64, and one in float64 says what it needs where JAX does not."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mathota_jax as mj
from mathota_jax import Box, Capsule, Hinge, Options, Plane, SceneBuilder, Slider, Sphere, rollout, step
from mathota_jax.gradients import long_rollout, smoothed_step
from tests.marks import slow_but
from tests.scenes import box_stack

OPTIONS = {
    "default": {},
    "sleep": {"sleep": True},
    "continuous": {"continuous": True},
    "events": {"impact_events": 2},
    "soft_step": {"solver": "soft_step"},
    "converged": {"solver": "converged"},
    "grid": {"broadphase": "grid"},
    "conjugate": {"conjugate": True},
    "swept joints": {"exact_joints": False},
}


def scene(**options):
    """An arm on springs and motors, with a slider, above things that bounce and slide on a plane."""
    builder = SceneBuilder()
    restitution = 0.0 if options.get("conjugate") else 0.5
    ground = builder.add_body(Plane((0, 1, 0)), static=True, friction=0.5, restitution=restitution)
    for place, shape in enumerate((Sphere(0.1), Box((0.1, 0.1, 0.1)), Capsule(0.05, 0.1))):
        position = (0.3 * place, 0.2, 0)
        builder.add_body(shape, mass=1.0, position=position, friction=0.5, restitution=restitution)
    arm = builder.add_body(Box((0.1, 0.02, 0.02)), mass=0.5, position=(0.1, 1, 0))
    hand = builder.add_body(Sphere(0.02), mass=0.1, position=(0.3, 1, 0))
    features = {"stiffness": 5.0, "damping": 0.1, "friction": 0.01, "armature": 0.01, "limits": (-1.0, 1.0)}
    turn = builder.add_joint(Hinge(ground, arm, (0, 1, 0), (0, 0, 1), **features))
    push = builder.add_joint(Slider(arm, hand, (0.2, 1, 0), (1, 0, 0), limits=(-0.1, 0.1)))
    builder.add_motor(turn, kind="position", stiffness=3.0, damping=0.1, cap=2.0)
    builder.add_motor(push, kind="torque")
    return builder.build(Options(dt=1 / 240, **options))


def wide_leaves(tree):
    return [
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        if leaf.dtype in (jnp.float64, jnp.int64)
    ]


@pytest.mark.parametrize("name", slow_but(("default", "events", "soft_step", "converged"), OPTIONS))
def test_steps_in_float32_where_float64_is_allowed(name):
    model, state = scene(**OPTIONS[name])
    with jax.enable_x64(True):
        assert not wide_leaves(jax.eval_shape(step, model, state))
        assert not wide_leaves(jax.eval_shape(lambda model, state: rollout(model, state, 2), model, state))


FUNCTIONS = {
    **{
        name: getattr(mj, name)
        for name in (
            "energy", "momentum", "angular_momentum", "contacts", "contact_forces", "joint_forces", "joint_position",
            "joint_velocity", "joint_gaps", "penetration",
        )
    },
    "residuals": mj.residuals,
    "advance": lambda model, state: mj.advance(model, state, 0.0, 0.01).state,
    "substep": mj.substep,
    "interpolate": lambda model, state: mj.interpolate(state, step(model, state), 0.5),
    "smoothed_step": lambda model, state: smoothed_step(model, state, reach=0.1),
    "long_rollout": lambda model, state: long_rollout(model, state, 4),
    "apply_force": lambda model, state: mj.apply_force(state, 1, jnp.ones(3)),
    "raycast": lambda model, state: mj.raycast(model, state, *jnp.eye(2, 3, dtype=jnp.float32)),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_other_functions_of_a_state_too(name):
    model, state = scene()
    with jax.enable_x64(True):
        assert not wide_leaves(jax.eval_shape(FUNCTIONS[name], model, state))


def test_motion_and_derivatives_are_the_same_where_float64_is_allowed():
    model, state = box_stack(1)

    def way(speed):
        moving = dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(speed))
        return rollout(model, moving, 3)[0].position[1, 0]

    value_and_slope = jax.value_and_grad(way)
    found = jax.jit(value_and_slope)(np.float32(0.5))
    with jax.enable_x64(True):
        again = jax.jit(value_and_slope)(np.float32(0.5))
    assert [x.dtype for x in again] == [np.float32] * 2
    np.testing.assert_array_equal(found, again)


def test_float64_where_it_is_not_allowed():
    with jax.enable_x64(True):
        model, state = box_stack(1)
    for function in (step, functools.partial(rollout, actions=2), mj.energy):
        with pytest.raises(ValueError, match=r"float64 arrays were given .*jax_enable_x64"):
            function(model, state)
