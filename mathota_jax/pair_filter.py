"""Which bodies ignore each other: by classes of bodies, of which a scene has few, however many bodies it has."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

Ignored = tuple[frozenset[int], frozenset[int]]
"""Two sets of bodies: none of the first collides with any of the second."""


@dataclasses.dataclass(frozen=True)
class Filter:
    """What never collides although it could; static.

    Attributes:
      classes: class of each body; empty if no body ignores another.
      ignored: pairs of classes (the smaller first, or a class twice) whose bodies do not collide.
    """

    classes: tuple[int, ...] = ()
    ignored: tuple[tuple[int, int], ...] = ()

    def ignores(self, first: int, second: int) -> bool:
        """Whether two bodies do not collide."""
        return bool(self.ignored) and self.ignores_classes(self.classes[first], self.classes[second])

    def ignores_classes(self, first: int, second: int) -> bool:
        """Whether the bodies of two classes do not collide."""
        return bool(self.ignored) and bool(self.table[first, second])

    @functools.cached_property
    def table(self) -> np.ndarray:
        """(class, class) whether their bodies do not collide."""
        count = max(self.classes) + 1
        found = np.zeros((count, count), bool)
        for a, b in self.ignored:
            found[a, b] = found[b, a] = True
        return found


NOTHING_IGNORED = Filter()


def make_filter(body_count: int, ignored: Sequence[Ignored]) -> Filter:
    """The filter of all declarations. Bodies that these do not tell apart are one class."""
    if not ignored:
        return NOTHING_IGNORED
    roles = [tuple((body in first, body in second) for first, second in ignored) for body in range(body_count)]
    kinds = list(dict.fromkeys(roles))
    number = {role: k for k, role in enumerate(kinds)}
    pairs = [
        (a, b)
        for a, one in enumerate(kinds)
        for b, other in enumerate(kinds[a:], a)
        if any((x[0] and y[1]) or (x[1] and y[0]) for x, y in zip(one, other, strict=True))
    ]
    return Filter(tuple(number[role] for role in roles), tuple(pairs))
