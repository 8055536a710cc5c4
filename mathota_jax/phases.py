"""The phases of a step (guide 11.1), in the order in which `step` and `impact_splitting` call them."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import (
    Bodies,
    Inertia,
    merge,
    momentum,
    moving,
    moving_inertia,
    of_all_bodies,
    unpack_blocks,
    vector,
)
from mathota_jax.constraints import (
    contact,
    graph,
    joint,
    joint_layout,
    joint_rows,
    loops,
    mechanism,
    mechanism_contacts,
    mechanism_correction,
    mechanism_links,
    mechanism_rows,
    mechanism_sweeps,
    motor,
    rebound_limit,
)
from mathota_jax.constraints.carried import resting
from mathota_jax.constraints.mechanism_layout import (
    bounded_slots,
    covers,
    covers_with_bounds,
    layout,
    takes_small_steps,
)
from mathota_jax.constraints.problem import Problem
from mathota_jax.dynamics import events, sleep
from mathota_jax.dynamics.free_motion import drift, free_velocity
from mathota_jax.dynamics.integrate import displace
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.solver import converged, pgs, soft_step
from mathota_jax.solver.rows import Rows, add_impulses
from mathota_jax.spatial.indexing import in_every_world, put, take
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, settle, store_cotangents
from mathota_jax.spatial.vector import Vec3, dot, norm, where
from mathota_jax.state import State


def external(model: Model, state: State, bodies: Bodies, action: Array) -> tuple[Vec3, Vec3]:
    """Phase 1: forces and torques on the moving bodies, gravity excepted."""
    force, torque = vector(state.applied_force), vector(state.applied_torque)
    if motor.exert_torque(model.scene):
        motor_force, motor_torque = motor.motor_forces(model, bodies, action)
        force, torque = force + motor_force, torque + motor_torque
    return take((force, torque), model.scene.dynamic_bodies)


def acting_inertia(model: Model, blocks: Bodies, inertia: Inertia) -> tuple[Inertia, Bodies | None]:
    """Inertia with which bodies respond to impulses, and where they do so if it is not where the step starts.

    Joints act at the middle of the step, see `drift`; all else at its start.
    """
    if not joint_layout.joint_row_count(model.scene) or inertia.rotation is None or takes_small_steps(model.scene):
        return inertia, None
    return compute_once(drift(store_cotangents(blocks), inertia, 0.5 * model.dt), blocks.position.x)


def free_velocities(
    model: Model, blocks: Bodies, inertia: Inertia, halfway: Bodies | None, force: Vec3, torque: Vec3
) -> tuple[tuple[Vec3, Vec3], float | Array]:
    """Phase 4: velocities at the end of the step without constraints; also the decay of the angular momentum."""
    options, dt = model.scene.options, model.dt
    carried = None if halfway is None else halfway.angular_velocity
    linear, angular = free_velocity(blocks, inertia, carried, gravity(model), force, torque, dt)
    if options.linear_damping:
        linear = linear * jnp.maximum(1.0 - options.linear_damping * dt, 0.0)
    if not options.angular_damping:
        return (linear, angular), 1.0
    decay = jnp.maximum(1.0 - options.angular_damping * dt, 0.0)
    return (linear, angular * decay), decay


def gravity(model: Model) -> Vec3:
    """Components (1, world) [m/s^2]."""
    return Vec3(*(model.gravity[axis][None] for axis in range(3)))


def let_rest(model: Model, problem: Problem, last: tuple[Array, ...], step: Array) -> Problem:
    """The problem without rebounds of contacts that carry a load, told by impulses of the last step, which took `step`."""
    fall = norm(gravity(model)) * step
    return problem.with_contacts(resting(problem.contact_rows, last[len(problem.joint_rows) :], fall))


class SolvedRows(NamedTuple):
    """Solution of the velocity constraints.

    Attributes:
      velocity: (component, block, world).
      impulses: of all groups (turn, row, column, world).
      failed: 1 for each world (world,) that was not solved; None from "pgs".
      held: solution for mechanisms where there is nothing else.
      uncut: impulses with the full rebounds; None where none is ever cut.
    """

    velocity: Array
    impulses: tuple[Array, ...]
    failed: Array | None = None
    held: mechanism.Solution | None = None
    uncut: tuple[Array, ...] | None = None


def solve_rows(
    scene: Scene,
    problem: Problem,
    inertia: Inertia,
    velocity: Array,
    start: tuple[Array, ...],
    change: Array | None = None,
    known: bool = False,
    held: mechanism.Solution | None = None,
) -> SolvedRows:
    """Phase 5: velocity constraints.

    Args:
      scene: static scene.
      problem: the constraints.
      inertia: with which the bodies respond.
      velocity: (component, block, world) without them.
      start: impulses to start from.
      change: what these do to the velocity, where that is known.
      known: whether they solve the constraints, but for rebounds that have to be cut.
      held: what mechanisms alone are held with, where that is known.
    """
    rows = problem.rows
    worlds = max([velocity.shape[-1], *(group.bias.shape[-1] for group in rows)])
    velocity = jnp.broadcast_to(velocity, (*velocity.shape[:-1], worlds))
    if covers(scene):
        assert problem.held is not None
        nothing = tuple(jnp.zeros_like(impulse) for impulse in start)
        solved, impulses, held = mechanism.hold(problem.held, problem.joint_rows, velocity, nothing, held)
        return SolvedRows(solved, impulses, held=held)
    if scene.rebounds_may_gain:
        start = in_every_world(start, worlds)
    with_joints = velocity if problem.with_joints is None else problem.with_joints
    begin = _Begin(velocity, with_joints, start, change, inertia)
    solved, impulses, failed = _solve_all(scene, problem, begin, known)
    if not scene.rebounds_may_gain:
        return SolvedRows(solved, impulses, failed)

    def with_contacts(contacts: list[contact.ContactRows]) -> tuple[Array, tuple[Array, ...]]:
        return _solve_all(scene, problem.with_contacts(contacts), begin, known=False)[:2]

    cut = rebound_limit.limit(with_contacts, problem.contact_rows, begin.with_joints, solved, impulses)
    return SolvedRows(*cut, failed, uncut=impulses)


class _Begin(NamedTuple):
    """What the solvers begin with.

    Attributes:
      velocity: (component, block, world) without constraints.
      with_joints: the same where mechanisms hold.
      impulses: of all groups.
      change: what these do to the velocity, where that is known.
      inertia: with which the bodies respond.
    """

    velocity: Array
    with_joints: Array
    impulses: tuple[Array, ...]
    change: Array | None
    inertia: Inertia


def _solve_all(
    scene: Scene, problem: Problem, begin: _Begin, known: bool
) -> tuple[Array, tuple[Array, ...], Array | None]:
    """`solve_rows` where there are other rows than those of mechanisms."""
    if problem.held is None:
        return _sweep(scene, problem.rows, begin.velocity, begin.impulses, known, begin.change, begin.inertia)
    if problem.reduced is not None:
        return *_solve_reduced(scene, problem, problem.reduced, problem.held, begin), None
    return _solve_mechanisms(scene, problem, problem.held, begin.velocity, begin.impulses)


def _solve_mechanisms(
    scene: Scene, problem: Problem, held: mechanism_links.Links, velocity: Array, start: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...], Array | None]:
    """The same where there are mechanisms: what they hold, holds exactly in the end."""
    rows = problem.rows

    def hold(velocity: Array, impulses: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        return mechanism.hold(held, problem.joint_rows, velocity, impulses)[:2]

    responses = None if scene.options.solver == "converged" else problem.responses
    bounded = () if responses is None else bounded_slots(scene)
    failed, joint_count = None, len(problem.joint_rows)
    if responses is not None and covers_with_bounds(scene):
        start, impulses = lax.stop_gradient(start), tuple(jnp.zeros_like(impulse) for impulse in start)
    else:
        _, start = lax.stop_gradient(hold(add_impulses(rows, velocity, start), start))
        velocity, impulses, failed = _sweep(scene, rows, velocity, start, known=False)
        start = impulses
    velocity, impulses = hold(velocity, impulses)
    if responses is None:
        return velocity, impulses, failed
    sweeps = scene.options.velocity_iterations
    joints, others = impulses[:joint_count], impulses[joint_count:]
    assert problem.joints is not None
    moved, change = mechanism_rows.solve(
        responses, problem.joint_rows, bounded, problem.joints, sweeps, velocity, joints, start[:joint_count]
    )
    # What the joints take for it; the velocity is known better.
    joints = tuple(old + more for old, more in zip(joints, change, strict=True))
    _, joints = hold(add_impulses(problem.joint_rows, velocity, change), joints)
    return moved, (*joints, *others), failed


def _solve_reduced(
    scene: Scene,
    problem: Problem,
    reduced: mechanism_contacts.Reduced,
    held: mechanism_links.Links,
    begin: _Begin,
) -> tuple[Array, tuple[Array, ...]]:
    """The same where contacts, too, act on mechanisms as wholes."""
    first = lax.stop_gradient(mechanism_contacts.to_reduced(scene, problem.joint_rows, reduced, begin.impulses))
    rates = reduced.rates(begin.with_joints)
    assert problem.joints is not None
    contacts = reduced.contacts([group.rows for group in problem.contact_rows])
    found = mechanism_sweeps.solve(scene, problem.joints, contacts, reduced, rates, first)
    impulses = mechanism_contacts.from_reduced(scene, problem.joint_rows, reduced, found)
    # What the joints take for it; the velocity is known better than their large impulses on light links would have it.
    moved = begin.with_joints + reduced.change(mechanism_contacts.in_order(found))
    pushed = add_impulses(problem.rows, begin.velocity, impulses)
    return moved, mechanism.hold(held, problem.joint_rows, pushed, impulses)[1]


def _sweep(
    scene: Scene,
    rows: tuple[Rows, ...],
    velocity: Array,
    start: tuple[Array, ...],
    known: bool,
    change: Array | None = None,
    inertia: Inertia | None = None,
) -> tuple[Array, tuple[Array, ...], Array | None]:
    """All rows by the solver of the scene."""
    if joint_layout.solves_together(scene):
        return converged.solve(rows, velocity, start)
    iterations = scene.options.velocity_iterations
    sweeps = 0 if known else iterations
    gradient = _gradient_iterations(scene, rows, iterations)
    conjugate = scene.options.conjugate and not scene.restitution and inertia is not None
    masses = lax.stop_gradient(jax.tree_util.Partial(momentum, inertia)) if conjugate else None
    return *pgs.solve(sweeps, gradient, _on_facets(scene), rows, velocity, start, change, masses), None


def _on_facets(scene: Scene) -> bool:
    """Whether contacts of one body may have normals that differ by a small angle: derivatives need the solution then.

    Such contacts exchange their impulses at a rate of the square of that angle a sweep. While both still press though only
    one would in the end, the derivative at the impulses found is that of a body wedged between the two: a ball that rolls
    over bumps of 4 % of a cell had derivatives of 48 by its own velocity (0.3 in truth) in one step of fifteen, and after
    twenty steps 1000 times the truth.
    """
    return any("heightfield" in (group.kind_a, group.kind_b) for group in (*scene.pair_groups, *scene.compact_groups))


def _gradient_iterations(scene: Scene, rows: tuple[Rows, ...], iterations: int) -> int:
    return pgs.gradient_sweeps(rows, iterations, scene.options.gradient_iterations)


def small_steps(
    model: Model, problem: Problem, blocks: Bodies, free: Array, start: tuple[Array, ...]
) -> tuple[Array, Array, tuple[Array, ...], tuple[Array, ...]]:
    """Phases 5 to 7 in small steps: velocities, displacements by the impulses; impulses of the whole step and of its end."""
    scene, options, rows = model.scene, model.scene.options, problem.rows
    begin = contact.pack_motion(scene, blocks.velocity, blocks.angular_velocity)
    worlds = max([begin.shape[-1], free.shape[-1], *(group.bias.shape[-1] for group in rows)])
    begin, free = (jnp.broadcast_to(velocity, (*velocity.shape[:-1], worlds)) for velocity in (begin, free))
    count = options.substep_count
    start = tuple(impulse / count for impulse in start)
    rebound_sweeps = options.velocity_iterations if scene.restitution and problem.contact_rows else 0
    damping = (options.linear_damping, options.angular_damping)
    added, gained, (total, last) = soft_step.solve(
        count, rebound_sweeps, rows, problem.errors, begin, free, start, model.dt, damping
    )
    return free + added, gained, total, last


def correct_positions(
    model: Model, problem: Problem, bodies: Bodies, inertia: Inertia, moved: Bodies, displacement: tuple[Vec3, Vec3]
) -> Bodies:
    """Phase 7: sequential position correction (guide 10.2) by pseudo-impulses with the full effective mass."""
    scene = model.scene
    options = scene.options
    if not options.position_iterations or not problem.rows or covers(scene):
        return moved
    packed = contact.pack_motion(scene, *displacement)
    rows: list[Rows] = []
    back = None
    if problem.joints is not None:
        error = loops.correctable(model, joint_rows.joint_rows(model, merge(scene, bodies, moved)).error)
        bounded = () if problem.responses is None else bounded_slots(scene)
        if problem.responses is not None and mechanism_rows.has_stops(bounded, problem.joints):
            back = mechanism_rows.leave_stops(
                problem.responses, problem.joint_rows, bounded, problem.joints, error, options.velocity_iterations
            )
        if problem.responses is not None and covers_with_bounds(scene):
            # What holds is closed at the end of the step.
            return moved if back is None else displace(moved, inertia, back)
        if problem.reduced is not None:
            shift = _leave_contacts(scene, problem, problem.reduced, packed)
            return displace(moved, inertia, shift if back is None else shift + back)
        rows += [
            joint.position_rows(scene, group.table, problem.joints, error, inertia, bounded)
            if how is None
            else joint.decoupled_position_rows(scene, group, how, problem.joints, error)
            for group, how in zip(problem.joint_rows, problem.of_joint_rows, strict=True)
        ]
    for group in problem.contact_rows:
        rows.append(contact.position_rows(group, packed, options.position_percent))
    start = tuple(jnp.zeros_like(group.bias) for group in rows)
    worlds = max(group.bias.shape[-1] for group in rows)
    zero = jnp.zeros((*packed.shape[:-1], worlds), packed.dtype)
    iterations = options.position_iterations
    if joint_layout.solves_together(scene):
        correction = converged.solve(tuple(rows), zero, start)[0]
    elif problem.joints is None:
        gradient = _gradient_iterations(scene, tuple(rows), iterations)
        correction, _ = pgs.solve(iterations, gradient, _on_facets(scene), tuple(rows), zero, start, zero)
    else:
        # Joints that pull on each other are not where they should be after so few sweeps.
        found = pgs.from_rest(iterations, tuple(rows), zero)
        correction = add_impulses(tuple(rows), zero, pgs.as_swept(iterations, tuple(rows), zero, found))
    return displace(moved, inertia, correction if back is None else correction + back)


def _leave_contacts(scene: Scene, problem: Problem, reduced: mechanism_contacts.Reduced, displacement: Array) -> Array:
    """Displacement (component, block, world) out of what overlaps, of mechanisms as wholes."""
    percent, iterations = scene.options.position_percent, scene.options.position_iterations
    contacts = [contact.position_rows(group, displacement, percent) for group in problem.contact_rows]
    rows, still, chosen = mechanism_contacts.normal_rows(reduced, contacts)
    found = pgs.from_rest(iterations, rows, still)

    def change(impulses: tuple[Array, ...]) -> Array:
        of_chosen = mechanism_contacts.in_order(impulses)
        return reduced.change(put(of_chosen, chosen, reduced.delassus.count))

    # What the matrix changes at these impulses: it has no derivative of its own.
    left = take(reduced.rates(change(found)), chosen)
    rows = mechanism_contacts.with_errors(rows, left - lax.stop_gradient(left))
    return change(pgs.as_swept(iterations, rows, still, found))


def close_joints(
    model: Model, bodies: Bodies, moved: Bodies, known: mechanism.Solution | None = None
) -> tuple[Bodies, mechanism.Solution]:
    """Mechanisms at the end of the step: their joints closed, and velocities along which they stay closed.

    The second is a projection in the metric of the kinetic energy, and so never adds any. Also the solutions of all rounds,
    which may be `known`.
    """
    scene = model.scene

    def close(moved: Bodies, of_round: tuple) -> tuple[Bodies, mechanism.Solution]:
        is_last, known = of_round
        inertia = moving_inertia(scene, model, moved.orientation)
        joints = joint_rows.joint_rows(model, merge(scene, bodies, moved))
        weights = jax.tree.map(
            lambda a, b: jnp.where(is_last, a, b), inertia, mechanism_correction.correction_weights(inertia)
        )
        yielding = loops.yielding(model, joints.error)
        if yielding is not None:
            yielding = jnp.where(is_last, 0.0, yielding)
        links = mechanism_links.links(scene, joints, moved.position, weights, yielding)
        velocity = contact.pack_motion(scene, moved.velocity, moved.angular_velocity)
        excess, errors = mechanism_links.rates(links, velocity), mechanism_links.of_slots(links, joints.error)
        closing = (
            errors if yielding is None else mechanism_links.of_slots(links, loops.correctable(model, joints.error))
        )
        wanted = jax.tree.map(lambda rate, error: -jnp.where(is_last, rate, error), excess, closing)
        found = mechanism.solve(links, wanted, known)
        change = found.change(links)
        linear, angular = unpack_blocks(jnp.where(is_last, velocity + change, velocity))
        assert angular is not None
        moved = moved._replace(velocity=linear, angular_velocity=angular)
        if not rounds:
            return moved, found
        shift = jnp.where(is_last, mechanism.closing_shift(links, errors), mechanism_correction.bounded(change))
        return displace(moved, inertia, shift), found

    rounds = mechanism.rounds(scene)
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((moved, model, known)))
    moved = in_every_world(moved, worlds)
    if known is not None:
        # Nothing is left to be found that it would be cheaper to store than to compute again.
        close = jax.checkpoint(close, prevent_cse=False)
    closed, solutions = lax.scan(close, moved, (jnp.arange(rounds + 1) == rounds, known))
    found = layout(scene)
    if found is not None and found.closings:
        inertia = moving_inertia(scene, model, closed.orientation)
        closed = mechanism_correction.without_gain(found, inertia, gravity(model), moved, closed)
    return closed, solutions


def stop_at_impacts(
    model: Model, bodies: Bodies, inertia: Inertia, moved: Bodies, displacement: tuple[Vec3, Vec3], force: Vec3
) -> Bodies:
    """Fast bodies stop at the first touch on their way (guide 10.4), mechanisms as a whole.

    `force` is the external one on the moving bodies, without gravity.
    """
    scene = model.scene
    motion = events.Motion(bodies.position, bodies.orientation, *(of_all_bodies(scene, part) for part in displacement))
    trees = ()
    if (found := layout(scene)) is not None:
        trees = tuple(tuple(scene.dynamic_bodies[found.blocks[link]] for link in tree) for tree in found.trees)
    stopped = moving(scene, events.stop_at_impacts(model, motion, merge(scene, bodies, moved), trees))
    lost = moved.position - stopped.position
    acceleration = gravity(model) + force * inertia.inverse_mass
    stopped = stopped._replace(velocity=_speed_before(moved.velocity, acceleration, lost))
    return stopped if inertia.rotation is None else _keep_spin(inertia, moved, stopped)


def _speed_before(velocity: Vec3, acceleration: Vec3, way: Vec3) -> Vec3:
    """Velocities before a constant acceleration acted along a way, ``u^2 = v^2 - 2 a s`` along it.

    A ball that stops short of the ground has not fallen the rest: with the speed of the end of the step it would gain that
    energy at each bounce.
    """
    squared, along = dot(acceleration, acceleration), dot(velocity, acceleration)
    before = safe_sqrt(jnp.maximum(along * along - 2.0 * squared * dot(way, acceleration), 0.0))
    before = jnp.where(dot(way, way) > 0, jnp.where(along < 0, -before, before), along)
    return velocity + acceleration * safe_divide(before - along, squared)


def _keep_spin(inertia: Inertia, moved: Bodies, stopped: Bodies) -> Bodies:
    """Angular velocities that go with the orientation in which a body stopped: of its angular momentum, or less.

    At the end of the step the momentum may have been about an axis of a larger moment: the same about that of a smaller one
    would be more energy.
    """
    momentum = inertia.at(moved.orientation).apply(moved.angular_velocity)
    spin = inertia.at(stopped.orientation).solve(momentum)
    before, after = dot(moved.angular_velocity, momentum), dot(spin, momentum)
    gains = settle(jnp.where(after > before, 1.0, 0.0)) > 0.5
    scale = safe_sqrt(jnp.where(gains, safe_divide(before, after), 1.0))
    turned = functools.reduce(
        jnp.logical_or, (a != b for a, b in zip(moved.orientation, stopped.orientation, strict=True))
    )
    return stopped._replace(angular_velocity=where(turned, spin * scale, moved.angular_velocity))


def let_sleep(model: Model, old: State, new: State, action: Array, problem: Problem) -> State:
    """Phase 8: islands fall asleep and wake (guide 3.4 and 12.2)."""
    edges = graph.body_graph(model, old, new, problem.contacts, problem.close)
    new, sleepers = sleep.let_sleep(model, old, new, action, edges)
    return dataclasses.replace(new, **graph.keep_forces(model, old, new, problem.close, sleepers))
