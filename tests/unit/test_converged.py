"""The converged solver against independent float64 checks: residuals of the laws, NNLS, finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

from mathota_jax import Flag, Options, batching, step
from mathota_jax.solver import converged, pgs
from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.table import Constraint, make_tables
from tests.scenes import box_stack, slab_on_plane, stack, undamped

BODIES, CONTACTS = 4, 14


def random_problem(seed, *, friction, mass_ratio=1.0):
    """Contacts at random points of a few bodies, each with the ground or with the next body, in NumPy.

    Returns the Jacobian (contact, 3, 6 bodies), the inverse masses (6 bodies) and the free velocity.
    """
    draw = np.random.default_rng(seed)
    jacobian = np.zeros((CONTACTS, 3, 6 * BODIES))
    for contact in range(CONTACTS):
        body = contact % BODIES
        normal, first = np.linalg.qr(draw.normal(size=(3, 3)))[0][:2]
        normal = normal if normal[1] > 0 else -normal
        first = first - normal * (first @ normal)
        frame = np.stack([normal, first, np.cross(normal, first)])
        sides = [(body, 1.0)] if contact < BODIES or body == 0 else [(body, 1.0), (body - 1, -1.0)]
        for owner, sign in sides:
            arm = draw.uniform(-0.2, 0.2, 3)
            jacobian[contact, :, 6 * owner : 6 * owner + 3] = sign * frame
            jacobian[contact, :, 6 * owner + 3 : 6 * owner + 6] = sign * np.cross(arm, frame)
    mass = mass_ratio ** np.linspace(0.0, 1.0, BODIES)
    inverse_mass = np.repeat(np.stack([1 / mass, 60 / mass], 1), 3, axis=1).reshape(-1)
    free = np.tile([0.0, -1.0, 0.0, 0.0, 0.0, 0.0], BODIES) + draw.normal(size=6 * BODIES)
    return jacobian if friction else jacobian[:, :1], inverse_mass, free


def rows_of(jacobian, inverse_mass, friction):
    """The same as rows of the engine, of one world."""
    constraints = []
    for contact in range(CONTACTS):
        used = np.flatnonzero(np.abs(jacobian[contact]).reshape(-1, BODIES, 6).sum((0, 2)))
        constraints.append(Constraint(tuple(int(block) for block in used[::-1]), (contact,)))
    rows = []
    for table in make_tables(constraints, BODIES, together=True):
        slots = np.maximum(table.order, 0)
        shape = (table.turn_count, table.column_count)

        def arrange(values, shape=shape, table=table):  # (turn * column, row, ...) to (turn, row, ..., column, 1)
            values = np.where((table.order >= 0).reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)
            return jnp.asarray(np.moveaxis(values.reshape(*shape, *values.shape[1:]), 1, -1)[..., None])

        sides, responses = [], []
        for side in table.blocks:
            blocks = np.minimum(np.asarray(side).reshape(-1), BODIES - 1)
            picked = jacobian[slots].reshape(len(slots), -1, BODIES, 6)[np.arange(len(slots)), :, blocks]
            sides.append(arrange(picked))
            responses.append(arrange(picked * inverse_mass.reshape(BODIES, 6)[blocks][:, None]))
        effective = 1 / np.einsum("krd,d,krd->kr", jacobian, inverse_mass, jacobian)[slots]
        if friction is None:
            mass = arrange(effective)
            law = Bounded(mass, jnp.zeros_like(mass), jnp.zeros_like(mass), jnp.full_like(mass, jnp.inf))
        else:
            mass = arrange(effective)
            tangent = jnp.minimum(mass[:, 1], mass[:, 2]) / 2
            law = Cone(mass[:, 0], tangent, jnp.full_like(tangent, friction), jnp.ones_like(tangent))
        bias = jnp.zeros((table.turn_count, jacobian.shape[1], table.column_count, 1))
        rows.append(Rows(Dense(tuple(sides), tuple(responses)), bias, law, table))
    return tuple(rows)


def solved(problems, friction=None):
    """Impulses (world, contact, row), velocity (world, 6 bodies) and flags by the converged solver, as float64 NumPy."""
    each = [rows_of(jacobian, inverse_mass, friction) for jacobian, inverse_mass, _ in problems]
    rows = jax.tree.map(lambda *parts: jnp.concatenate(parts, -1), *each)
    start = tuple(jnp.zeros_like(group.bias) for group in rows)
    free = jnp.asarray(np.stack([free.reshape(BODIES, 6).T for *_, free in problems], -1))
    velocity, impulses, failed = jax.jit(converged.solve)(rows, free, start)
    found = np.zeros((len(problems), *problems[0][0].shape[:2]))
    for group, impulse in zip(rows, impulses, strict=True):
        values = np.moveaxis(np.asarray(impulse, float), (3, 0, 2), (0, 1, 2)).reshape(
            len(problems), -1, found.shape[-1]
        )
        real = group.table.order >= 0
        found[:, group.table.order[real]] = values[:, real]
    return found, np.asarray(velocity, float).T.reshape(len(problems), -1), np.asarray(failed)


def test_frictionless_contacts_are_those_of_nnls(precision, gate):
    """The velocity is the metric projection on the admissible ones (Gauss' principle), here by active sets (SciPy)."""
    problems = [random_problem(seed, friction=False) for seed in range(100)]
    impulses, velocity, failed = solved(problems)
    assert not failed.any()
    assert (impulses >= 0).all()
    limit = {"float32": 1e-4, "float64": 1e-7}[str(precision)]
    errors = []
    for (jacobian, inverse_mass, free), found in zip(problems, velocity, strict=True):
        root = np.sqrt(inverse_mass)
        truth = free + inverse_mass * (jacobian[:, 0].T @ nnls((jacobian[:, 0] * root).T, -free / root)[0])
        errors.append((found - truth) / np.abs(truth).max())
    gate("velocity - truth, over the largest", errors, limit)


@pytest.mark.parametrize("mass_ratio", [1.0, 1e4])
def test_contact_laws_hold(precision, mass_ratio, gate):
    """The four residuals of a rigid contact (Le Lidec et al., "Contact models in robotics", 2024) are 0.

    In many problems, since a search that wanders loses momentum in some. Velocities are beside the largest one that the free
    motion could give a contact.
    """
    friction = 0.5
    problems = [random_problem(seed, friction=True, mass_ratio=mass_ratio) for seed in range(200)]
    found, velocities, failed = solved(problems, friction)
    gate("share of worlds flagged", failed.mean(), 0.0 if mass_ratio == 1.0 else 0.01)
    limit = {"float32": 2e-3, "float64": 1e-6}[str(precision)]
    residuals = [
        residuals_of(problem, impulses, velocity, friction, np.finfo(precision).eps)
        for problem, impulses, velocity, flag in zip(problems, found, velocities, failed, strict=True)
        if not flag
    ]
    for name in residuals[0]:
        gate(name, [each[name] for each in residuals], 1e-6 if name == "outside the cone" else limit)
    assert (np.abs(found).max((1, 2)) > 0.1).all()


def residuals_of(problem, impulses, velocity, friction, eps):
    """How far an answer is from the laws, by name."""
    jacobian, inverse_mass, free = problem
    size, scale = np.abs(impulses).max(), (np.abs(jacobian) @ np.abs(free)).max()
    speed = jacobian @ velocity / scale
    normal, tangential = impulses[:, 0], np.linalg.norm(impulses[:, 1:], axis=-1)
    # The velocity is solved for itself; of the impulses two units in the last place show in what they add up to.
    momentum = velocity - free - inverse_mass * np.einsum("krd,kr->d", jacobian, impulses)
    sums = inverse_mass * np.einsum("krd,kr->d", np.abs(jacobian), np.abs(impulses))
    power = friction * normal * np.linalg.norm(speed[:, 1:], axis=-1) + (impulses[:, 1:] * speed[:, 1:]).sum(-1)
    return {
        "momentum, beyond the last places of the impulses": np.maximum(0, np.abs(momentum) - 2 * eps * sums).max()
        / scale,
        "approach": np.maximum(0, -speed[:, 0]).max(),
        "complementarity": np.abs(normal * speed[:, 0]).max() / size,
        "outside the cone": np.maximum(0, tangential - friction * normal).max() / size,
        "dissipation gap": np.abs(power).max() / size,
    }


@pytest.mark.slow
def test_worlds_do_not_touch_each_other(float64, gate):
    """Worlds that need different numbers of iterations give what each gives alone."""
    model, state = box_stack(2, options=Options(dt=1 / 60, solver="converged"))
    states = [
        dataclasses.replace(state, velocity=state.velocity.at[2].set(jnp.array([0.3 * k, -k, 0.1]))) for k in range(3)
    ]
    together = jax.vmap(step, (None, 0))(model, stack(states))
    for world, alone in enumerate(states):
        gate("velocity [m/s]", together.velocity[world] - step(model, alone).velocity, 1e-8)


def forget_traces():
    """For constants that tests replace."""
    jax.clear_caches()
    batching._traced.cache_clear()


def test_a_solve_that_ends_at_its_limit_is_flagged(float64, monkeypatch):
    model, state = box_stack(2, options=Options(dt=1 / 60, solver="converged", position_iterations=0))
    state = dataclasses.replace(state, velocity=state.velocity.at[2].set(jnp.array([1.0, -3.0, 0.0])))
    monkeypatch.setattr(converged, "LIMIT", 1)
    forget_traces()
    flagged = step(model, state)
    monkeypatch.undo()
    forget_traces()
    assert int(flagged.flags) == Flag.SOLVER_NOT_CONVERGED
    assert int(step(model, state).flags) == 0


def moved(model, state, push, friction):
    """End velocity of a slab that lies on its four corners: redundant rows."""
    model = dataclasses.replace(model, friction=jnp.full_like(model.friction, friction))
    return step(model, dataclasses.replace(state, applied_force=state.applied_force.at[1].set(push))).velocity[1]


STICKING_AND_SLIDING = pytest.mark.parametrize("push", [(1.0, 0.5, 0.3), (6.0, 0.5, 2.0)])


def slab():
    return slab_on_plane(friction=0.4, options=undamped(dt=1 / 60, solver="converged"))


@pytest.mark.slow
@STICKING_AND_SLIDING
def test_derivatives_against_finite_differences(float64, push, gate):
    """Reverse mode of the velocity, whose impulses are not unique."""
    model, state = slab()
    push = jnp.asarray(push)
    run = jax.jit(moved)
    by_push, by_friction = jax.jacrev(moved, (2, 3))(model, state, push, 0.4)
    h = 1e-4
    for axis in range(3):
        change = h * jnp.eye(3)[axis]
        truth = (run(model, state, push + change, 0.4) - run(model, state, push - change, 0.4)) / (2 * h)
        gate(f"dv/dF{axis}", by_push[:, axis] - truth, 1e-7)
    truth = (run(model, state, push, 0.4 + h) - run(model, state, push, 0.4 - h)) / (2 * h)
    gate("dv/dmu", by_friction - truth, 1e-6)
    assert (np.abs(truth).max() > 1e-2) == (float(push[0]) > 3)


@pytest.mark.slow
@STICKING_AND_SLIDING
def test_both_modes_agree(float64, push, gate):
    arguments = (*slab(), jnp.asarray(push), 0.4)
    forward, reverse = (mode(moved, (2, 3))(*arguments) for mode in (jax.jacfwd, jax.jacrev))
    for by, first, second in zip(("push", "friction"), forward, reverse, strict=True):
        gate(f"by {by}, forward - reverse", first - second, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("friction", (None, 0.5))
def test_derivative_agrees_with_that_of_the_sweeps(float64, friction, gate):
    """Where the sweeps converge as well, both differentiate the same fixed point."""
    jacobian, inverse_mass, free = random_problem(3, friction=friction is not None)
    rows = rows_of(jacobian, inverse_mass, friction)
    start = tuple(jnp.zeros_like(group.bias) for group in rows)
    packed = jnp.asarray(free.reshape(BODIES, 6).T[..., None])
    direction = jnp.asarray(np.random.default_rng(0).normal(size=packed.shape))

    def by_sweeps(velocity):
        return pgs.solve(20000, 20000, False, rows, velocity, start)[0]

    def directly(velocity):
        return converged.solve(rows, velocity, start)[0]

    (value, slope), (value_direct, slope_direct) = (
        jax.jit(lambda v, f=f: jax.jvp(f, (v,), (direction,)))(packed) for f in (by_sweeps, directly)
    )
    gate("velocity [m/s]", value_direct - value, 1e-7)
    gate("derivative", slope_direct - slope, 1e-5)
