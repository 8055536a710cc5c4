"""Mass properties as functions of the sizes, for derivatives: the formulas from which the builder makes the model."""

from __future__ import annotations

from typing import Any

from mathota_jax.geometry import SHAPES
from mathota_jax.geometry.inertia import MassProperties, combine


def mass_properties(kind: str, parameters: dict[str, Any]) -> MassProperties:
    """Volume, centre of mass and unit inertia of one shape.

    Args:
        kind: Key of `SHAPES` of a solid, such as "box".
        parameters: Sizes by name, in natural shapes, as in ``model.shapes[kind]`` (one row of it); a polyhedron also has
            "faces", the static attribute of `Polyhedron`.

    Returns:
        Mass properties in the shape's own frame; arrays of JAX or NumPy as the sizes are. Differentiable in the sizes.

    Raises:
        ValueError: the kind is unknown, or infinite.
    """
    if kind not in SHAPES:
        raise ValueError(f"mass_properties: no shape is of kind {kind!r}; known: {', '.join(SHAPES)}")
    return SHAPES[kind].mass_of(parameters)


__all__ = ["MassProperties", "combine", "mass_properties"]
