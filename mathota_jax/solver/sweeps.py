"""Sweeps over rows, turn by turn, in which a law finds new impulses from the errors that it sees.

A sweep is unrolled over few turns, where slicing with a traced index was measured to cost 3x, and a scan over many.

Of a contact with friction the normals answer first, and the tangents to what the normals have left. A push along the normals
of a box on its face turns it as a pull along its tangents does: if both answer to the same errors the same turn is corrected
twice. Measured for a cube with the steps of `pgs`: such a sweep multiplies what is left by 1.24, this one by 0.59.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import visits
from mathota_jax.solver.laws import Cone, Law
from mathota_jax.solver.row_matrix import sum_over_points
from mathota_jax.solver.rows import UNROLLED_TURNS, Rows, gather, receive, visited
from mathota_jax.solver.table import Table, TracedTable
from mathota_jax.spatial import counter
from mathota_jax.spatial.by_platform import by_platform
from mathota_jax.spatial.settle import store


class Update(NamedTuple):
    """How a turn finds its new impulses (row, column, world).

    Attributes:
      at_once: of rows without friction, from their coefficients, biases, impulses and errors.
      first: of the normals of contacts with friction, from coefficients and biases, the impulses of all their rows, and the
        errors of the normals.
      others: of their tangents, likewise, from the new impulses of the normals and the errors that these leave, too.
      begin: impulses to start from, and what is to be remembered until then, from coefficients and what is held of the turn.
      end: what is held from then on, and what is added up over all turns (sum, column, world), from coefficients, biases,
        what was to be remembered, and the impulses before and after. Those sums are components of the velocity behind those
        of which the matrix knows; None for none.
      sums: their number.
    """

    at_once: Callable[[Any, Array, Array, Array], Array]
    first: Callable[[Any, Array, Array, Array], Array]
    others: Callable[[Any, Array, Array, Array, Array], Array]
    begin: Callable[[Any, Any], tuple[Array, Any]] = lambda _, held: (held, None)
    end: Callable[[Any, Array, Any, Array, Array], tuple[Any, Array | None]] = lambda _, __, ___, ____, new: (new, None)
    sums: int = 0


def of_law(
    prepare: Callable[[Any, Array], Any] = lambda law, _: law, law_of: Callable[[Any], Any] = lambda law: law
) -> Update:
    """That of laws, the coefficients or in them (`law_of`); `prepare` gives those of normals, from their biases."""
    return Update(
        lambda law, bias, impulse, error: prepare(law, bias).update(impulse, error),
        lambda law, bias, impulse, error: prepare(law, bias).push(impulse[:1], error),
        lambda law, _, impulse, normal, error: jnp.stack(law_of(law).hold(normal[0], tuple(impulse[1:]), tuple(error))),
    )


def run(
    iterations: int,
    rows: tuple[Rows, ...],
    update: Callable[[Array | int], Update],
    coefficients: tuple[object, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Any, ...],
) -> tuple[Array, tuple[Any, ...]]:
    """A number of sweeps, for use inside of custom derivatives.

    Args:
      iterations: that number.
      rows: groups of rows, swept in this order.
      update: of each sweep, from its number. It looks at each column by itself.
      coefficients: what the update gets of each group, with a leading turn axis.
      biases: of each group (turn, row, column, world).
      velocity: (component, block, world) with the impulses, the sums of the update behind it.
      impulses: of each group (turn, row, column, world); a pytree of such arrays where the update begins with one.

    Returns:
      The velocity and the impulses after the sweeps.
    """
    args = (rows, coefficients, biases, velocity, impulses)
    one_by_one = functools.partial(by_turns, iterations, update)
    in_one_kernel = functools.partial(_in_one_kernel, iterations, update)
    return by_platform(one_by_one, in_one_kernel, (velocity, impulses), *args)


def by_turns(
    iterations: int,
    update: Callable[[Array | int], Update],
    rows: tuple[Rows, ...],
    coefficients: tuple[object, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Any, ...],
) -> tuple[Array, tuple[Any, ...]]:
    """`run` turn by turn, on any device. Its derivative is that of every update."""

    def sweep(number: Array | int, carry: tuple[Array, tuple[Any, ...]]) -> tuple[Array, tuple[Any, ...]]:
        return once(rows, update(number), coefficients, biases, *carry)

    start = (velocity, impulses)
    return sweep(0, start) if iterations == 1 else lax.fori_loop(0, iterations, sweep, start)


def _in_one_kernel(
    iterations: int,
    update: Callable[[Array | int], Update],
    rows: tuple[Rows, ...],
    coefficients: tuple[object, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Any, ...],
) -> tuple[Array, tuple[Any, ...]]:
    """`run` on a GPU. What is held of a group is one array there."""

    def answer_of(group: Rows, like: Any) -> visits.Answer:
        def answer(number: Array, moving: list[Array], values: tuple, impulse: Array) -> tuple[list[Array], Array]:
            held = (*values, _apart(impulse, like, 0))
            moving = [of_side[: velocity.shape[0] - update(number).sums] for of_side in moving]
            changes, new = _answer(group.law, update(number), impulse.shape[1], moving, held)
            return changes, _together(new, 0)

        return answer

    groups = tuple(
        visited(group, (group.matrix, bias, coefficient))
        for group, bias, coefficient in zip(rows, biases, coefficients, strict=True)
    )
    answers = [answer_of(group, impulse) for group, impulse in zip(rows, impulses, strict=True)]
    velocity, found = visits.run(iterations, answers, groups, velocity, tuple(_together(x, 1) for x in impulses))
    return velocity, tuple(_apart(x, like, 1) for x, like in zip(found, impulses, strict=True))


def _together(held: Any, axis: int) -> Array:
    """The arrays of a pytree behind one another along the axis of the rows."""
    return jnp.concatenate(jax.tree.leaves(held), axis=axis)


def _apart(array: Array, like: Any, axis: int) -> Any:
    """The reverse; `like` has the rows on its axis 1."""
    leaves, structure = jax.tree.flatten(like)
    return jax.tree.unflatten(structure, lax.split(array, [leaf.shape[1] for leaf in leaves], axis))


def once(
    rows: tuple[Rows, ...],
    update: Update,
    coefficients: tuple[object, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
) -> tuple[Array, tuple[Array, ...]]:
    """One pass over all groups."""
    new = []
    for group, coefficient, bias, impulse in zip(rows, coefficients, biases, impulses, strict=True):
        velocity, impulse = _sweep(group, update, coefficient, bias, velocity, impulse)
        new.append(impulse)
    return velocity, tuple(new)


def _sweep(
    group: Rows, update: Update, coefficients: object, bias: Array, velocity: Array, impulse: Any
) -> tuple[Array, Any]:
    """One pass over the turns of a group."""
    table: Table | TracedTable = group.table
    fixed = (group.matrix, bias, coefficients)
    if isinstance(table, TracedTable):
        return _sweep_places(group, update, fixed, velocity, impulse)
    scanned = (*fixed, impulse)
    if table.turn_count <= UNROLLED_TURNS:
        new = []
        for turn in range(table.turn_count):
            blocks = tuple(side[turn] for side in table.blocks)
            receivers = table.receivers[turn]
            at_turn = jax.tree.map(lambda x, turn=turn: x[turn], scanned)
            velocity, at_turn = _turn(group.law, update, table.together, velocity, blocks, receivers, at_turn)
            new.append(at_turn)
        return velocity, jax.tree.map(lambda *turns: jnp.stack(turns), *new)

    def body(velocity: Array, at_turn: tuple) -> tuple[Array, Array]:
        blocks, receivers, values = at_turn
        return _turn(group.law, update, table.together, velocity, blocks, receivers, values)

    indices = tuple(jnp.asarray(side, jnp.int32) for side in table.blocks)
    return lax.scan(body, velocity, (indices, jnp.asarray(table.receivers), scanned))


def _sweep_places(group: Rows, update: Update, fixed: tuple, velocity: Array, impulse: Array) -> tuple[Array, Array]:
    """One pass over those turns of a traced table that hold a constraint."""
    places = group.places
    assert places is not None

    def body(_: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        turn, velocity, impulse = carry
        blocks, values = counter.row((places.blocks, (*fixed, impulse)), turn)
        *values, old = values
        # The old impulse is stored: read again after its place is overwritten, all of them would be copied every turn.
        old = jax.tree.map(lambda x: store(x, x), old)
        velocity, new = _turn(group.law, update, group.table.together, velocity, blocks, blocks, (*values, old))
        impulse = jax.tree.map(lambda all_turns, own: counter.put(all_turns, own, turn), impulse, new)
        return counter.following(turn), velocity, impulse

    turns = group.table.turn_count if places.turns is None else places.turns
    return lax.fori_loop(0, turns, body, (counter.start(), velocity, impulse))[1:]


def _turn(
    law: Law, update: Update, together: int, velocity: Array, blocks: tuple, receivers: object, values: tuple
) -> tuple[Array, Array]:
    """Solves the rows of one turn side by side."""
    components = velocity.shape[0] - update.sums
    moving = [gather(velocity[:components], side, together) for side in blocks]
    changes, new = _answer(law, update, together, moving, values)
    return receive(velocity, receivers, changes), new


def _answer(law: Law, update: Update, together: int, moving: list[Array], values: tuple) -> tuple[list[Array], Array]:
    """How the velocity (component, constraint, world) of each side changes, and the new impulses of a turn."""
    matrix, bias, coefficients, held = values
    impulse, remembered = update.begin(coefficients, held)
    # Errors and impulses are stored: what is not is computed again by all that reads it, of the later turns, too.
    if isinstance(law, Cone):
        first, others = matrix.first_row(), matrix.other_rows()
        normal = store(update.first(coefficients, bias, impulse, bias[:1] + first.rates(moving)), first.like)
        pushed = first.changes_once(normal - impulse[:1], together)
        moving = [store(old + part, old) for old, part in zip(moving, pushed, strict=True)]
        error = store(bias[1:] + others.rates(moving), others.like)
        tangents = store(update.others(coefficients, bias, impulse, normal, error), others.like)
        new = jnp.concatenate([normal, tangents])
        changes = [a + b for a, b in zip(pushed, others.changes(tangents - impulse[1:], together), strict=True)]
    else:
        error = store(bias + matrix.rates(moving), matrix.like)
        new = store(update.at_once(coefficients, bias, impulse, error), matrix.like)
        changes = matrix.changes(new - impulse, together)
    held, sums = update.end(coefficients, bias, remembered, impulse, new)
    return changes if sums is None else _with_sums(changes, sum_over_points(sums, together)), held


def _with_sums(changes: list[Array], sums: Array) -> list[Array]:
    """The changes (component, constraint, world) with sums behind them, which one side receives."""
    first, *others = (jnp.broadcast_to(change, (*change.shape[:-1], sums.shape[-1])) for change in changes)
    nothing = jnp.zeros_like(sums)
    return [jnp.concatenate([first, sums]), *(jnp.concatenate([change, nothing]) for change in others)]
