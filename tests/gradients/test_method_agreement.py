"""Implicit, unrolled and difference derivatives agree (benchmark C14); memory does not grow with the sweeps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Options, Sphere, rollout, step
from mathota_jax.solver import pgs, sweeps
from tests.scenes import body_on_plane, box_stack, slab_on_plane, undamped
from tests.unit.test_converged import BODIES, random_problem, rows_of


@pytest.mark.slow
@pytest.mark.parametrize("friction", [None, 0.5])
def test_unrolled_sweeps_have_the_implicit_derivative(float64, friction, gate):
    """Differentiated sweep by sweep, and as the fixed point: as close as the sweeps have converged."""
    jacobian, inverse_mass, free = random_problem(3, friction=friction is not None)
    rows = rows_of(jacobian, inverse_mass, friction)
    start = tuple(jnp.zeros_like(group.bias) for group in rows)
    packed = jnp.asarray(free.reshape(BODIES, 6).T[..., None])
    direction = jnp.asarray(np.random.default_rng(0).normal(size=packed.shape))
    laws, biases = (tuple(getattr(group, name) for group in rows) for name in ("law", "bias"))

    def unrolled(count):
        def run(velocity):
            return sweeps.by_turns(count, lambda _: sweeps.of_law(), rows, laws, biases, velocity, start)[0]

        return run

    def implicit(velocity):
        return pgs.solve(4000, 4000, False, rows, velocity, start)[0]

    (_, truth), (_, few), (_, many) = (
        jax.jit(lambda v, f=f: jax.jvp(f, (v,), (direction,)))(packed) for f in (implicit, unrolled(10), unrolled(4000))
    )
    gate("4000 sweeps: unrolled - implicit", many - truth, 1e-9)
    assert np.abs(few - truth).max() > 1e-6  # 10 sweeps are not enough: the comparison can fail


@jax.jit
def pushed(model, state, push):
    """Velocities after a step by a push [N] along x at the middle of the slab, and their derivatives by those before."""

    def after(velocity, angular_velocity):
        moving = dataclasses.replace(
            state,
            velocity=state.velocity.at[1].set(velocity),
            angular_velocity=state.angular_velocity.at[1].set(angular_velocity),
            applied_force=state.applied_force.at[1, 0].set(push),
        )
        new = step(model, moving)
        return jnp.concatenate([new.velocity[1], new.angular_velocity[1]]), new

    return jax.jacfwd(after, argnums=(0, 1), has_aux=True)(state.velocity[1], state.angular_velocity[1])


@pytest.mark.slow
def test_few_sweeps_behind_a_derivative_are_enough(float64, gate):
    """As many linear sweeps as scenes of many bodies have, and the limit of many more, against the dense system of the
    default, where a slab sticks and where it slips.
    """
    (few, _), (many, _), (model, state) = (
        slab_on_plane(friction=0.4, options=undamped(dt=1 / 240, gradient_iterations=sweeps))
        for sweeps in (15, 300, None)
    )
    for push in (2.0, 12.0):
        current = state
        for _ in range(4):
            _, current = pushed(model, current, push)
        found, limit, truth = (np.concatenate(pushed(which, current, push)[0], 1) for which in (few, many, model))
        gate(f"push {push}: slopes by few sweeps", found - truth, 1e-3)
        gate(f"push {push}: slopes by many sweeps", limit - truth, 1e-9)


def test_memory_does_not_grow_with_the_sweeps():
    def memory(sweeps):
        options = undamped(velocity_iterations=sweeps)
        model, state = body_on_plane(Sphere(0.1), position=(0.0, 0.1, 0.0), options=options)
        gradient = jax.jit(jax.grad(lambda s: rollout(model, s, 100)[0].position[1, 1], allow_int=True))
        return gradient.lower(state).compile().memory_analysis().temp_size_in_bytes

    assert memory(40) <= 1.05 * memory(10)


@pytest.mark.slow  # the converged solver of five boxes, with derivatives, compiles for a minute
def test_a_pushed_stack(float64, gate):
    """Benchmark B3 with five boxes, the top one pushed: reverse mode of the converged solve against its differences."""
    options = Options(dt=1 / 60, solver="converged", linear_damping=0.0, angular_damping=0.0)
    model, state = box_stack(5, options=options, friction=0.5)
    state = jax.jit(lambda m, s: rollout(m, s, 30)[0])(model, state)

    def end(push, friction):
        changed = dataclasses.replace(model, friction=jnp.full_like(model.friction, friction))
        pushed = dataclasses.replace(state, applied_force=state.applied_force.at[5].set(push))
        return jnp.concatenate([step(changed, pushed).velocity[level] for level in (1, 3, 5)])

    run = jax.jit(end)
    for push in ([1.0, 0.0, 0.5], [8.0, -1.0, 2.0]):
        push, friction, h = jnp.array(push), 0.5, 1e-4
        by_push, by_friction = jax.jit(jax.jacrev(end, (0, 1)))(push, friction)
        for axis in range(3):
            change = h * jnp.eye(3)[axis]
            truth = (run(push + change, friction) - run(push - change, friction)) / (2 * h)
            gate(f"push {push[0]}: dv/dF{axis}", by_push[:, axis] - truth, 1e-5)
        truth = (run(push, friction + h) - run(push, friction - h)) / (2 * h)
        gate(f"push {push[0]}: dv/dmu", by_friction - truth, 1e-5)
