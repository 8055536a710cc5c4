"""What every broadphase method takes and gives: which pairs may collide, and the list of pairs found."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.collision.broadphase.volumes import Bounds, overlaps, plane_overlaps
from mathota_jax.pair_filter import NOTHING_IGNORED, Filter
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.running_sum import running_sum
from mathota_jax.spatial.settle import settle, store

LARGEST_SHAPE_COUNT = 46_340
"""Pairs are numbered ``first * count + second`` in int32."""


@dataclasses.dataclass(frozen=True)
class Admissible:
    """Which pairs of shapes may collide at all; static.

    Attributes:
      bodies: body of each shape; shapes of one body never collide.
      static: for each shape, whether its body never moves; static shapes never collide with each other.
      excluded: pairs of bodies (smaller handle first) that never collide, such as those that a joint connects.
      filter: which others ignore each other.
    """

    bodies: tuple[int, ...]
    static: tuple[bool, ...]
    excluded: tuple[tuple[int, int], ...] = ()
    filter: Filter = NOTHING_IGNORED

    def __post_init__(self) -> None:
        if len(self.bodies) > LARGEST_SHAPE_COUNT:
            raise ValueError(f"at most {LARGEST_SHAPE_COUNT} shapes, got {len(self.bodies)}")

    @property
    def shape_count(self) -> int:
        """Number of shapes."""
        return len(self.bodies)

    @functools.cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """All admissible pairs in order, the smaller shape first."""
        first, second = np.triu_indices(self.shape_count, 1)
        bodies, static = np.asarray(self.bodies), np.asarray(self.static)
        kept = (bodies[first] != bodies[second]) & ~(static[first] & static[second])
        if self.excluded:
            kept &= ~np.isin(self._body_key(bodies[first], bodies[second], np), self._excluded_keys)
        if self.filter.ignored:
            classes = self._classes
            kept &= ~self.filter.table[classes[first], classes[second]]
        return first[kept].astype(np.int32), second[kept].astype(np.int32)

    def test(self, first: Array, second: Array) -> Array:
        """Whether pairs of shapes, given by index, are admissible."""
        bodies, static = np.asarray(self.bodies, np.int32), np.asarray(self.static)
        kept = first != second
        if len(set(self.bodies)) < self.shape_count:
            kept &= jnp.asarray(bodies)[first] != jnp.asarray(bodies)[second]
        if static.sum() > 1:
            kept &= ~(jnp.asarray(static)[first] & jnp.asarray(static)[second])
        if self.excluded:
            key = self._body_key(jnp.asarray(bodies)[first], jnp.asarray(bodies)[second], jnp)
            known = jnp.asarray(self._excluded_keys)
            place = jnp.searchsorted(known, key.reshape(-1)).reshape(key.shape)
            kept &= known[jnp.minimum(place, len(self._excluded_keys) - 1)] != key
        if self.filter.ignored:
            classes = jnp.asarray(self._classes)
            kept &= ~jnp.asarray(self.filter.table)[classes[first], classes[second]]
        return kept

    @functools.cached_property
    def _classes(self) -> np.ndarray:
        return np.asarray(self.filter.classes, np.int32)[np.asarray(self.bodies)]

    @functools.cached_property
    def _excluded_keys(self) -> np.ndarray:
        pairs = np.asarray(self.excluded)
        return np.unique(self._body_key(pairs[:, 0], pairs[:, 1], np)).astype(np.int32)

    def _body_key(self, a: Any, b: Any, module: Any) -> Any:
        count = max(self.bodies) + 1
        return module.minimum(a, b) * count + module.maximum(a, b)


class PairList(NamedTuple):
    """Candidate pairs of one broadphase pass, each unordered pair once, ascending by (first, second).

    Attributes:
      first, second: ``(place, world)`` int32 shapes, the smaller index first; padding holds shapes 0 and 1.
      count: ``(world,)`` int32 pairs found, also those that did not fit.
      overflow: ``(world,)`` whether pairs did not fit; then the list keeps those whose boxes overlap deepest.
      invalid: ``(world,)`` whether bounds were not finite; such shapes are in no pair.
    """

    first: Array
    second: Array
    count: Array
    overflow: Array
    invalid: Array

    @property
    def active(self) -> Array:
        """``(place, world)`` whether the place holds a pair."""
        return jnp.arange(self.first.shape[0], dtype=jnp.int32)[:, None] < self.count


Visit = Callable[..., tuple]
"""``visit(carry, first, second, kept) -> carry`` for one chunk ``(pair, world)`` of possibly overlapping pairs.

With a further argument, how deep they overlap [m], the pairs are taken to be admissible.
"""

Enumerate = Callable[[Visit, tuple], tuple]
"""``enumerate(visit, carry) -> carry``: shows all possibly overlapping pairs, each once, to `visit`."""


def collect(
    enumerators: Sequence[Enumerate], bounds: Bounds, bad: Array, admissible: Admissible, capacity: int, ordered: bool
) -> PairList:
    """The pairs that the enumerators show, tested, in a list of fixed capacity.

    Args:
      enumerators: together show each pair at most once, and every pair whose boxes overlap; no planes.
      bounds, bad: from `stored_bounds` or `finite_bounds`. Pairs of planes, if there are any, are found here.
      admissible: which pairs may collide.
      capacity: places of the list.
      ordered: whether the enumerators show pairs in ascending order already.
    """
    worlds, count = bounds.radius.shape[-1], admissible.shape_count
    if bounds.planes is not None:
        enumerators = [_of_planes(bounds, bad, admissible), *enumerators]
    empty = jnp.iinfo(jnp.int32).max

    def hits(first: Array, second: Array, kept: Array, depth: Array | None) -> tuple[Array, Array, Array]:
        low, high = jnp.minimum(first, second), jnp.maximum(first, second)
        if depth is None:
            touch, depth = overlaps(bounds, low, high)
            kept = kept & touch & admissible.test(low, high)
        return settle(jnp.where(kept, 1.0, 0.0)) > 0, low * count + high, depth

    def append(limit: tuple[Array, Array]) -> Callable:
        def visit(carry: tuple, first: Array, second: Array, kept: Array, known: Array | None = None) -> tuple:
            keys, found, total = carry
            hit, key, depth = hits(first, second, kept, known)
            shallowness = _shallowness(depth)
            listed = hit & ((shallowness < limit[0]) | ((shallowness == limit[0]) & (key <= limit[1])))
            place = found + running_sum(listed.astype(jnp.int32)) - 1
            place = jnp.where(listed, place, capacity)
            keys = keys.at[place, jnp.arange(worlds)].set(jnp.broadcast_to(key, place.shape), mode="drop")
            found = found + listed.sum(0, dtype=jnp.int32)
            return keys, found, total + hit.sum(0, dtype=jnp.int32)

        return visit

    def fill(limit: tuple[Array, Array]) -> tuple[Array, Array]:
        carry = (jnp.full((capacity, worlds), empty, jnp.int32), *(jnp.zeros(worlds, jnp.int32),) * 2)
        for enumerate_pairs in enumerators:
            carry = enumerate_pairs(append(limit), carry)
        return carry[0], carry[2]

    no_limit = jnp.full(worlds, empty, jnp.int32)
    keys, total = fill((no_limit, no_limit))
    if capacity < count * (count - 1) // 2:
        keys = jax.lax.cond(
            (total > capacity).any(),
            lambda _: fill(_deepest(enumerators, hits, capacity, worlds, _digit_bits(count)))[0],
            lambda keys: keys,
            keys,
        )
    if not ordered:
        keys = jnp.sort(keys, axis=0)
    used = keys != empty
    first = jnp.where(used, keys // count, 0)
    second = jnp.where(used, keys - (keys // count) * count, min(1, count - 1))
    return PairList(first, second, total, total > capacity, _invalid(bounds, bad))


def _of_planes(bounds: Bounds, bad: Array, admissible: Admissible) -> Enumerate:
    """Enumerates the pairs of a plane and a shape that reaches below it, in ascending order."""
    first, second = (side[admissible.pairs[0] < bounds.plane_count] for side in admissible.pairs)
    depth = plane_overlaps(bounds)
    depth = take(depth.reshape(-1, depth.shape[-1]), first * admissible.shape_count + second)
    depth = store(depth, depth)
    kept = (depth >= 0) & ~take(bad, second)

    def enumerate_pairs(visit: Visit, carry: tuple) -> tuple:
        one, two = (jnp.broadcast_to(jnp.asarray(side)[:, None], depth.shape) for side in (first, second))
        return visit(carry, one, two, kept, depth)

    return enumerate_pairs


def _invalid(bounds: Bounds, bad: Array) -> Array:
    """(world,) whether numbers are not finite, those apart that planes have in place of bounds."""
    invalid = take(bad, range(bounds.plane_count, len(bad))).any(0)
    if bounds.planes is None:
        return invalid
    return functools.reduce(
        jnp.logical_or, [~jnp.isfinite(x).all(0) for x in (*bounds.planes.normal, bounds.planes.offset)], invalid
    )


def _shallowness(depth: Array) -> Array:
    """Order-preserving int32 code of a depth >= 0, the deepest first (bits of a float32 ascend with its value)."""
    deepest = jnp.finfo(jnp.float32).max
    depth = jnp.clip(depth, 0.0, deepest).astype(jnp.float32) + 0.0  # no negative zero
    code = jax.lax.bitcast_convert_type(settle(depth), jnp.int32)
    return jnp.iinfo(jnp.int32).max - code


CODE_BITS = 31
"""Of a non-negative int32."""


def _digit_bits(count: int) -> int:
    """Bits of a digit for which the selection among the pairs of `count` shapes takes the fewest operations.

    Each digit costs a visit of all pairs and running sums of the histogram, by doubling.
    """
    pair_count = count * (count - 1) // 2
    return min(range(3, 12), key=lambda bits: -(-CODE_BITS // bits) * (pair_count + (bits + 2) * 2**bits))


def _deepest(
    enumerators: Sequence[Enumerate], hits: Callable, capacity: int, worlds: int, digit_bits: int
) -> tuple[Array, Array]:
    """Largest (shallowness, key) among the `capacity` smallest, by radix selection: a histogram for each digit.

    Ties in depth go to the smaller key, so that every method keeps the same pairs.
    """
    bin_count, digits = 1 << digit_bits, -(-CODE_BITS // digit_bits)

    def select_digit(turn: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Appends one digit: those of the shallowness first, then those of the key among equally deep pairs."""
        limit, key_limit, room = state
        ties = turn >= digits
        shift = digit_bits * (digits - 1 - turn % digits)
        prefix = jnp.where(ties, key_limit, limit)

        def visit(histogram: tuple, first: Array, second: Array, kept: Array, known: Array | None = None) -> tuple:
            hit, key, depth = hits(first, second, kept, known)
            shallowness = _shallowness(depth)
            code = jnp.where(ties, key, shallowness)
            hit = hit & (~ties | (shallowness == limit)) & ((code >> shift >> digit_bits) == prefix)
            digit = jnp.where(hit, (code >> shift) & (bin_count - 1), bin_count)
            return (histogram[0].at[digit, jnp.arange(worlds)].add(1, mode="drop"),)

        histogram = (jnp.zeros((bin_count, worlds), jnp.int32),)
        for enumerate_pairs in enumerators:
            histogram = enumerate_pairs(visit, histogram)
        counts = running_sum(histogram[0])
        # The digit in which the last place falls; what has a smaller digit is kept whole. The last digit if all fit.
        digit = jnp.minimum((counts < room).sum(0, dtype=jnp.int32), bin_count - 1)
        before = jnp.where(jnp.arange(bin_count)[:, None] < digit, histogram[0], 0).sum(0, dtype=jnp.int32)
        prefix = (prefix << digit_bits) + digit
        return jnp.where(ties, limit, prefix), jnp.where(ties, prefix, key_limit), room - before

    zero = jnp.zeros(worlds, jnp.int32)
    room = jnp.full(worlds, capacity, jnp.int32)
    limit, key_limit, _ = jax.lax.fori_loop(0, 2 * digits, select_digit, (zero, zero, room))
    return limit, key_limit
