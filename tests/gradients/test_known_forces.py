"""Derivatives take the solved forces of a step from its result; they equal those of a step that solves again."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, Options, Plane, SceneBuilder, Sphere, step
from mathota_jax.batching import Shortcut, batch_last
from mathota_jax.step import step_worlds_last
from tests.marks import slow_but
from tests.scenes import box_stack, slab_on_plane, with_dt


def hinged_balls():
    """Two balls on a plane, one of them on a hinge."""
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.5)
    parent = builder.add_body(Sphere(0.1), mass=1.0, position=(0, 0.1, 0), velocity=(1.0, 0, 0.2), friction=0.5)
    child = builder.add_body(Sphere(0.1), mass=0.3, position=(0.3, 0.1, 0), friction=0.5)
    builder.add_joint(Hinge(parent=parent, child=child, anchor=(0.15, 0.1, 0), axis=(0, 0, 1)))
    return builder.build()


def pushed_slab():
    model, state = slab_on_plane(velocity=(2.0, 0, 0.5))
    return with_dt(model, 1 / 240), state


def swinging_chain(**features):
    """Three links, the last of which turns fast; with `features` of the joints, its mechanism is not alone."""
    builder = SceneBuilder()
    parent = builder.add_body(Sphere(0.01), static=True)
    for index in range(3):
        child = builder.add_body(
            Box((0.1, 0.02, 0.03)),
            mass=0.2 + 0.1 * index,
            position=(0.1 + 0.2 * index, 0, 0),
            angular_velocity=(0, 0, float(index)),
            velocity=(0, 0.1 * index, 0),
            collides=False,
        )
        joint = Hinge(parent=parent, child=child, anchor=(0.2 * index, 0, 0), axis=(0, 0.6, 0.8), **features)
        builder.add_joint(joint)
        parent = child
    return builder.build()


SCENES = {
    "chain": swinging_chain,
    "damped chain": lambda: swinging_chain(damping=0.01, limits=(-0.01, 1.0)),
    "slab": pushed_slab,
    "stack": lambda: box_stack(2),
    "hinge": hinged_balls,
    "converged": lambda: box_stack(1, options=Options(solver="converged")),
    "listed pairs": lambda: box_stack(2, options=Options(broadphase="all_pairs")),
}


@pytest.mark.parametrize("name", slow_but({"slab"}, SCENES))
def test_derivatives_are_those_of_a_step_that_solves_again(float64, name):
    """Both after a few steps, when the solver starts from impulses that are nearly right."""
    model, state = SCENES[name]()
    state = dataclasses.replace(state, velocity=state.velocity.at[-1, 2].add(0.3))
    state = jax.lax.fori_loop(0, 3, lambda _, state: step(model, state), state)
    action = jnp.zeros(len(model.scene.motors))

    def solve_again(model, state):
        model, state, worlds = jax.tree.map(lambda x: x[..., None], (model, state, action))
        return jax.tree.map(lambda x: x[..., 0], step_worlds_last(model, state, worlds))

    def cost(advance, velocity, friction):
        changed = dataclasses.replace(model, friction=friction)
        new = advance(changed, dataclasses.replace(state, velocity=velocity))
        return (new.velocity * jnp.arange(1.0, 4.0)).sum() + (new.position**2).sum() + new.angular_velocity.sum()

    known, again = (
        jax.jit(jax.grad(lambda v, f, advance=advance: cost(advance, v, f), argnums=(0, 1)))(
            state.velocity, model.friction
        )
        for advance in (step, solve_again)
    )
    for measured, truth in zip(known, again, strict=True):
        np.testing.assert_allclose(measured, truth, rtol=1e-8, atol=1e-10 * np.abs(truth).max())
    assert np.abs(known[0]).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chain", "damped chain"])
def test_forward_mode_in_worlds_that_share_the_motion(float64, name):
    """Directions, and worlds that differ in their flags alone, share what the mechanism's solver found."""
    model, state = SCENES[name]()

    def cost(velocity, flags):
        new = step(model, dataclasses.replace(state, velocity=velocity, flags=flags))
        return (new.velocity * jnp.arange(1.0, 4.0)).sum() + (new.position**2).sum() + new.angular_velocity.sum()

    flags = jnp.zeros(2, state.flags.dtype)
    forward = jax.jit(jax.vmap(jax.jacfwd(cost), (None, 0)))(state.velocity, flags)
    truth = jax.jit(jax.grad(cost))(state.velocity, flags[0])
    np.testing.assert_allclose(forward, np.stack([truth] * 2), rtol=1e-8, atol=1e-10 * np.abs(truth).max())


@pytest.mark.slow
def test_second_derivatives_through_a_joint(float64):
    """The Hessian is symmetric, and equals central differences of the gradient: what is known still depends on the state."""
    builder = SceneBuilder()
    pivot = builder.add_body(Sphere(0.01), static=True)
    rod = builder.add_body(Box((0.1, 0.02, 0.03)), mass=0.3, position=(0.1, 0, 0), collides=False)
    builder.add_joint(Hinge(parent=pivot, child=rod, anchor=(0, 0, 0), axis=(0, 0.6, 0.8)))
    model, state = builder.build()

    def cost(spin):
        new = step(model, dataclasses.replace(state, angular_velocity=state.angular_velocity.at[rod].set(spin)))
        return (
            100 * (new.position[rod] ** 3).sum()
            + (new.velocity[rod] ** 2).sum()
            + (new.angular_velocity[rod] ** 3).sum()
        )

    gradient, spin, change = jax.grad(cost), jnp.asarray([0.1, 0.8, 1.0]), 1e-5
    points = jnp.concatenate([spin + change * jnp.eye(3), spin - change * jnp.eye(3)])
    around = jax.jit(jax.vmap(gradient))(points)
    truth = (around[:3] - around[3:]) / (2 * change)
    hessian = jax.jit(jax.jacfwd(gradient))(spin)
    np.testing.assert_allclose(hessian, truth, atol=1e-8 * np.abs(truth).max())
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(truth).max())


@jax.custom_jvp
def known_exponential(known, x):
    return known


@known_exponential.defjvp
def _known_exponential_jvp(primals, tangents):
    value = known_exponential(*primals)
    return value, value * tangents[1]


def test_a_shortcut_replaces_the_second_evaluation():
    """``exp`` is evaluated once in value and gradient; derivatives of any order are right."""
    shortcut = Shortcut(keep=lambda value, x: value, function=known_exponential)
    exponential = batch_last(jnp.exp, shortcut)
    x = jnp.asarray([0.3, -1.2])
    program = jax.jit(jax.vmap(jax.value_and_grad(exponential))).lower(x).as_text()
    assert program.count("exponential") == 1
    for order in (exponential, jax.grad(exponential), jax.grad(jax.grad(exponential)), jax.jacfwd(exponential)):
        np.testing.assert_allclose(jax.vmap(order)(x), np.exp(x), rtol=1e-6)
        np.testing.assert_allclose(order(x[0]), np.exp(x[0]), rtol=1e-6)
