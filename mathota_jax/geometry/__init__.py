"""Shapes: sizes, validation, mass properties and bounds. One file a shape; `SHAPES` is the registry."""

from mathota_jax.geometry.box import Box
from mathota_jax.geometry.capsule import Capsule
from mathota_jax.geometry.compound import Compound
from mathota_jax.geometry.cone import Cone
from mathota_jax.geometry.cylinder import Cylinder
from mathota_jax.geometry.heightfield import Heightfield
from mathota_jax.geometry.plane import Plane
from mathota_jax.geometry.polyhedron import Polyhedron
from mathota_jax.geometry.shape import Shape
from mathota_jax.geometry.sphere import Sphere

# The order of the kinds is the order of a pair: body A of a pair is the earlier kind.
SHAPES: dict[str, type[Shape]] = {
    shape.kind: shape for shape in (Plane, Sphere, Capsule, Box, Cylinder, Cone, Polyhedron, Heightfield)
}

__all__ = [
    "SHAPES",
    "Box",
    "Capsule",
    "Compound",
    "Cone",
    "Cylinder",
    "Heightfield",
    "Plane",
    "Polyhedron",
    "Shape",
    "Sphere",
]
