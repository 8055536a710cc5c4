"""Shapes: sizes, validation and mass properties. One file a shape; `SHAPES` is the registry."""

from typing import TypeAlias

from mathota_jax.geometry.box import Box
from mathota_jax.geometry.capsule import Capsule
from mathota_jax.geometry.plane import Plane
from mathota_jax.geometry.sphere import Sphere

Shape: TypeAlias = Plane | Sphere | Capsule | Box

# The order of the kinds is the order of a pair: body A of a pair is the earlier kind.
SHAPES: dict[str, type[Shape]] = {shape.kind: shape for shape in (Plane, Sphere, Capsule, Box)}

__all__ = ["SHAPES", "Box", "Capsule", "Plane", "Shape", "Sphere"]
