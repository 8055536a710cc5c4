"""Ridges of a heightfield against a convex body: the best separating direction on the arc of a ridge's normals."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.closest import clamp
from mathota_jax.collision.convex.support import SUPPORT
from mathota_jax.collision.height_grid import Edges, Window, edges
from mathota_jax.collision.heightfield_walls import Wall
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle, settle_code
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot, normalize, where

BISECTIONS = 16
"""Halvings of the arc; a Newton step makes the direction exact."""
CONVEX = 1e-5
"""Sine of the bend from which an edge is a ridge."""
BEYOND = 0.05
"""The arc is searched beyond its ends by this share: a body that lies on one slope and juts out over the ridge has its
best direction exactly at the end."""
OVER = 0.5
"""Sine of the slope from which what is level with the border, and about to come over it, meets it."""
LARGEST_CORRECTION = 1e-2
"""The Newton step [rad] is held to this; only where the body's corner touches the ridge itself is it without bound."""


class Ridges(NamedTuple):
    """Contacts of ridges, components (edge, pair, world); see `heightfield.Candidates`. The separation is the core's.

    `at_border` says which edges are those of a wall.
    """

    ground: Vec3
    up: Vec3
    separation: Array
    number: Array
    valid: Array
    at_border: Array


class _Extreme(NamedTuple):
    """Direction on the arc where the parting is best, and the pieces of the body that are extreme on either side.

    `overlaps` says where the body is in the ground there.
    """

    up: Vec3
    piece_minus: Array
    piece_plus: Array
    interior: Array
    overlaps: Array


def ridge_contacts(kind: str, a: dict[str, Any], rotation: Mat3, window: Window, size: Array, wall: Wall) -> Ridges:
    """Contacts with all edges of the window that are ridges, for bodies of that size [m] with that wall next to them.

    The parting ``g(up) = min over the body of up . (x - ridge)`` has the derivative ``(along x up) . (x - ridge)``; at
    its maximum on the arc either one piece of the body is straight over the ridge or two pieces tie. That condition
    determines the direction differentiably; the derivative of the parting does not depend on it (envelope theorem).

    Where the body is in the ground, `up` is scaled to height 1 instead of length 1: ``-g`` is then the height of the ridge
    over the body's underside, and the condition is that a piece is straight under the ridge. Both are quasi-concave on
    the arc, and so is their union, as their signs agree.
    """
    edge = edges(window, size)
    found = _search(kind, *lax.stop_gradient((a, rotation, edge)), wall.beside)
    # The bisection's direction is made exact first: a step from an inexact one has inexact derivatives.
    exact, *_ = _step(kind, *lax.stop_gradient((a, rotation, edge)), found)
    up, across, one, other = _step(kind, a, rotation, edge, found._replace(up=lax.stop_gradient(exact)))
    same = found.piece_minus == found.piece_plus
    along = normalize(edge.span)
    change = _toward_plus(along, across, found.overlaps)
    first, second = dot(change, one), dot(change, other)
    share = jnp.where(same, 0.0, clamp(safe_divide(first, first - second), 0.0, 1.0))
    body = one + (other - one) * share
    separation = dot(up, body)
    ground = edge.start + body - up * separation
    # Of a body in the ground the place is straight above it.
    way, body = lax.stop_gradient((edge.span._replace(y=jnp.where(found.overlaps, 0.0, edge.span.y)), body))
    run = dot(way, body) / dot(way, way)
    valid = (run >= -CONVEX) & (run <= 1.0 + CONVEX)
    at_border = _is_border(edge)
    valid &= looks_up(lax.stop_gradient(up), at_border, wall.level) | (edge.upright & ~wall.level)
    valid = settle((valid & found.interior).astype(run.dtype)) > 0.5
    return Ridges(ground, up, separation, edge.number, valid, at_border)


def looks_up(direction: Vec3, at_border: Array, level: Array) -> Array:
    """Whether a contact with an edge or a peak may have a direction.

    It looks out of the ground above or, at the border, sideways; a body that is level with the border would stumble there
    over what it is about to slide over.
    """
    return direction.y > jnp.where(at_border, jnp.where(level, OVER, -BEYOND), 0.0)


def _is_border(edge: Edges) -> Array:
    """Whether the ground ends in a wall there; it has no height on that side."""
    return (edge.minus.y == 0) | (edge.plus.y == 0)


def _toward_plus(along: Vec3, across: Vec3, overlaps: Array) -> Vec3:
    """How the direction changes along the arc: turned, or in the ground moved at one height."""
    return where(overlaps, cross(along, Vec3(0.0, 1.0, 0.0)), across)


def _step(kind: str, a: dict[str, Any], rotation: Mat3, edge: Edges, found: _Extreme) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """One Newton step of the direction.

    Returns:
        The direction, the one across it and the ridge, and the points of the two pieces from the start of the edge on.
    """
    along = normalize(edge.span)
    flat = normalize(found.up - along * dot(along, found.up))
    side = cross(along, flat)
    same = found.piece_minus == found.piece_plus

    def turned(angle: Array) -> tuple[Vec3, Vec3, Vec3, Vec3]:
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        up, across = flat * cosine + side * sine, side * cosine - flat * sine
        local = rotation.apply_transposed(-up)
        one, other = (rotation.apply(SUPPORT[kind].point(a, p, local)) for p in (found.piece_minus, found.piece_plus))
        return up, across, one - edge.start, other - edge.start

    def condition(angle: Array) -> Array:
        up, across, one, other = turned(angle)
        return jnp.where(same, dot(_toward_plus(along, across, found.overlaps), one), dot(up, one - other))

    zero = jnp.zeros_like(along.x + found.up.x)
    value, rate = jax.jvp(condition, (zero,), (jnp.ones_like(zero),))
    angle = -safe_divide(value, lax.stop_gradient(rate))
    return turned(clamp(angle, -LARGEST_CORRECTION, LARGEST_CORRECTION))


def _search(kind: str, a: dict[str, Any], rotation: Mat3, edge: Edges, beside: Array) -> _Extreme:
    along = normalize(edge.span)
    arc = edge.plus - edge.minus

    def evaluate(share: Array, *by_height: Array | bool) -> tuple[Array, ...]:
        """Piece of the body and whether the parting grows toward the plus side, as one settled number each.

        The latter for each choice of where it goes by heights if the body is in the ground.
        """
        up = normalize(edge.minus + arc * share)
        local = rotation.apply_transposed(-up)
        code = SUPPORT[kind].code(a, local)
        point = rotation.apply(SUPPORT[kind].point(a, code, local)) - edge.start
        across, overlaps = cross(along, up), dot(up, point) < 0
        rates = [dot(_toward_plus(along, across, overlaps & chosen), point) for chosen in by_height]
        return code, *(settle_code((rate > 0).astype(share.dtype)) for rate in rates)

    zero = jnp.zeros_like(along.x)
    pieces, turning, rising = evaluate(jnp.stack([zero - BEYOND, zero, zero + 1.0, zero + 1.0 + BEYOND]), False, True)
    # Beside a wall there is no height: what is beside the field, or has a way out there, does without.
    by_height = ~_is_border(edge) | (~beside & ~((turning[0] == 1) & (turning[3] == 0)))
    by_height &= ~edge.upright
    grows = jnp.where(by_height, rising, turning)
    # Within the arc first: of a body that overlaps, the parting may grow again beyond the ends.
    within = (grows[1] == 1) & (grows[2] == 0)
    low, high = jnp.where(within, 0.0, -BEYOND) + zero, jnp.where(within, 1.0, 1.0 + BEYOND) + zero
    piece_minus, piece_plus = jnp.where(within, pieces[1], pieces[0]), jnp.where(within, pieces[2], pieces[3])
    convex = dot(cross(edge.minus, edge.plus), along) > CONVEX
    interior = edge.exists & convex & (within | ((grows[0] == 1) & (grows[3] == 0)))

    def halve(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, piece_minus, piece_plus = state
        middle = 0.5 * (low + high)
        code, grows = evaluate(middle, by_height)
        up = grows == 1
        return (
            jnp.where(up, middle, low),
            jnp.where(up, high, middle),
            jnp.where(up, code, piece_minus),
            jnp.where(up, piece_plus, code),
        )

    shape = jnp.broadcast_shapes(low.shape, piece_minus.shape)
    state = tuple(jnp.broadcast_to(x, shape) for x in (low, high, piece_minus, piece_plus))
    low, high, piece_minus, piece_plus = lax.fori_loop(0, BISECTIONS, halve, state)
    up = normalize(where(interior, edge.minus + arc * (0.5 * (low + high)), edge.minus))
    point = rotation.apply(SUPPORT[kind].point(a, piece_minus, rotation.apply_transposed(-up))) - edge.start
    overlaps = settle(((dot(up, point) < 0) & by_height).astype(point.x.dtype)) > 0.5
    return _Extreme(up, piece_minus, piece_plus, interior, overlaps)
