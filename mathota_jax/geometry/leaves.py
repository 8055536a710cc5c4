"""`Geometry`: a shape whose sizes are traced leaves, so that a query can be differentiated by them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.geometry import SHAPES, Polyhedron, Shape
from mathota_jax.struct import pytree, static


@pytree
class Geometry:
    """One shape as a pytree.

    `Geometry.of(Sphere(0.5))` makes it, once, outside `jax.jit`. Its leaves may then be traced, mapped and differentiated:
    ``dataclasses.replace(geometry, parameters={"radius": radius})``.

    Attributes:
      parameters: sizes by name in natural shapes [m], e.g. "radius" (), "half_extents" (3,), "vertices" (vertex, 3).
      kind: key of `SHAPES`.
      faces: of a polyhedron, the vertex indices of each face, counter-clockwise seen from outside.
      window: of a heightfield, how many cells along each side are tested around the other shape. None: enough for its
        sizes, which then must not be traced.
    """

    parameters: dict[str, Array]
    kind: str = static()
    faces: tuple[tuple[int, ...], ...] | None = static(default=None)
    window: int | None = static(default=None)

    @classmethod
    def of(cls, shape: Any) -> Geometry:
        """The geometry of a shape (a geometry is returned as it is).

        Raises:
          ValueError: `shape` is neither a shape of one kind nor a geometry. A compound has several: query its parts.
        """
        if isinstance(shape, Geometry):
            return shape
        if not isinstance(shape, Shape):
            known = ", ".join(kind.__name__ for kind in SHAPES.values())
            raise ValueError(f"expected one of the shapes {known}, or a Geometry, got {shape!r}")
        with jax.ensure_compile_time_eval():  # known also inside of `jax.jit`
            parameters = {name: jnp.asarray(x, jnp.result_type(float)) for name, x in shape.parameters().items()}
        return cls(parameters, shape.kind, shape.faces if isinstance(shape, Polyhedron) else None)
