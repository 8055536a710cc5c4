"""Pictures of a scene by a small ray caster in JAX: no window, no OpenGL, any backend.

One primary and one shadow ray a pixel, intersections with every shape (`ray_shapes`), Lambert shading with an ambient part,
a chequered ground and a sky gradient. All per-pixel quantities are separate component arrays of shape ``(ray,)``, which
XLA fuses into a few vectorised loops.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_envs.camera import Camera, default_camera, validated
from mathota_envs.ray_shapes import RAY_SHAPES, Placed
from mathota_envs.scene_description import (
    GROUND,
    GROUND_COLOUR,
    body_colours,
    by_component,
    grid_cell,
)
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.geometry.hull import padded_faces
from mathota_jax.spatial.quaternion import Quaternion, multiply, to_matrix
from mathota_jax.spatial.vector import Vec3, cross, dot, normalize, tangent_basis, where

HORIZON_COLOUR = (0.80, 0.86, 0.91)
ZENITH_COLOUR = (0.36, 0.55, 0.78)
LIGHT_TILT = (0.45, 0.55)
"""Direction to the light along right and front (see `camera.view_basis`), relative to its part along up."""


class _Shape(NamedTuple):
    """Static identity of a shape, hashable: with the image size it selects the compiled program."""

    kind: str
    body: int
    index: int


class _Group(NamedTuple):
    """All shapes of one kind: every leaf of `placed` and `colour` (linear) has shape ``(count,)``."""

    kind: str
    count: int
    placed: Placed
    colour: Vec3


class _Surface(NamedTuple):
    """What the primary rays hit; every entry of shape ``(ray,)``."""

    distance: Array
    normal: Vec3
    colour: Vec3
    haze: Array


def render_rgb(model: Any, state: Any, width: int = 480, height: int = 360, camera: Camera | None = None) -> np.ndarray:
    """Picture of one state.

    Args:
        model: Scene to draw: ``scene.shapes``, ``shapes`` and ``gravity`` (which points down; it may be zero).
        state: ``position (body, 3)`` [m] and ``orientation (body, 4)``; a body that is not finite is not drawn.
        width: Columns of pixels.
        height: Rows of pixels.
        camera: Viewpoint; without one all bodies are framed (see `default_camera`, also for films).

    Returns:
        Image ``(height, width, 3)``, uint8, sRGB, first row at the top.

    Raises:
        ValueError: The size is not positive, the camera is not valid or a shape cannot be drawn.
    """
    for name, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
            raise ValueError(f"{name} must be a positive whole number of pixels, got {size!r}")
    width, height = int(width), int(height)
    camera = default_camera(model, state, width / height) if camera is None else validated(camera)
    return np.asarray(render(model, state, camera, width, height))


def render(model: Any, state: Any, camera: Camera, width: int, height: int) -> Array:
    """Picture of one state as a pure function, for `jax.jit` and, over states, models or cameras, `jax.vmap`.

    Args:
        model: As for `render_rgb`.
        state: As for `render_rgb`.
        camera: Viewpoint; not validated, since its values may be traced.
        width: Columns of pixels, static.
        height: Rows of pixels, static.

    Returns:
        Image ``(height, width, 3)``, uint8, sRGB, first row at the top. Not differentiable (it is quantised).

    Raises:
        ValueError: A shape is of a kind that cannot be drawn.
    """
    shapes = tuple(_Shape(shape.kind, int(shape.body), int(shape.index)) for shape in model.scene.shapes)
    for shape in shapes:
        if shape.kind not in RAY_SHAPES:
            raise ValueError(
                f"shape kind {shape.kind!r} of body {shape.body} cannot be drawn: "
                f"known kinds are {', '.join(sorted(RAY_SHAPES))}"
            )
    sizes = {kind: dict(model.shapes[kind]) for kind in RAY_SHAPES if any(shape.kind == kind for shape in shapes)}
    arrays = (sizes, model.gravity, state.position, state.orientation, camera)
    sizes, *others = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), arrays)
    if "polyhedron" in sizes:
        sizes["polyhedron"]["faces"] = jnp.asarray(padded_faces(model.scene.faces))
    return _render(shapes, sizes, *others, width=width, height=height)


@partial(jax.jit, static_argnames=("shapes", "width", "height"))
def _render(
    shapes: tuple[_Shape, ...],
    sizes: dict[str, dict[str, Array]],
    gravity: Array,
    position: Array,
    orientation: Array,
    camera: Camera,
    width: int,
    height: int,
) -> Array:
    groups = _groups(shapes, sizes, position, orientation)
    up = _up(gravity, groups)
    light = _light(up)
    eye = _vector(camera.position)
    ray, pixel_angle = _primary_rays(camera, width, height)
    sky = _sky(dot(ray, up))
    surface = _first_hit(groups, eye, ray, pixel_angle, jnp.linalg.norm(camera.target - camera.position))
    point = eye + ray * surface.distance
    # Lifted by less than a pixel, so that a surface does not shadow itself through round-off.
    start = point + surface.normal * (2e-4 * surface.distance)
    lambert = jnp.maximum(dot(surface.normal, light), 0.0)
    lit = jnp.where(_shadowed(groups, start, light), 0.0, lambert)
    ambient = 0.36 + 0.12 * dot(surface.normal, up)
    shaded = surface.colour * (ambient + 0.72 * lit)
    hit = jnp.isfinite(surface.distance)
    seen = where(hit, shaded + (sky - shaded) * surface.haze, sky)
    return _quantised(seen).reshape(height, width, 4)[..., :3]


def _vector(array: Array) -> Vec3:
    return Vec3(array[0], array[1], array[2])


def _linear(colour: Vec3) -> Vec3:
    """Light intensities of a display colour, with the display's curve taken as a square (see `_quantised`)."""
    return colour.map(lambda component: component * component)


def _groups(
    shapes: tuple[_Shape, ...], sizes: dict[str, dict[str, Array]], position: Array, orientation: Array
) -> list[_Group]:
    colours = body_colours(shapes)
    groups = []
    for kind in sizes:
        members = [shape for shape in shapes if shape.kind == kind]
        rows = jnp.array([shape.index for shape in members])
        bodies = jnp.array([shape.body for shape in members])
        size = {name: values[rows] for name, values in sizes[kind].items()}
        center, turn = Vec3(*position[bodies].T), Quaternion(*orientation[bodies].T)
        if "local_position" in size:
            center = center + to_matrix(turn).apply(Vec3(*size.pop("local_position").T))
        if "local_orientation" in size:
            turn = multiply(turn, Quaternion(*size.pop("local_orientation").T))
        placed = Placed(by_component(size), center, to_matrix(turn))
        tint = [GROUND_COLOUR if kind in GROUND else colours[shape.body] for shape in members]
        groups.append(_Group(kind, len(members), placed, _linear(Vec3(*jnp.array(tint).T))))
    return groups


def _over(group: _Group, update: Callable[[Any, Placed, Vec3], Any], initial: Any) -> Any:
    """Folds `update` over the shapes of a group; a loop, since unrolled XLA's work grows faster than their number."""

    def turn(index: Array, value: Any) -> Any:
        return update(value, *jax.tree.map(lambda leaf: leaf[index], (group.placed, group.colour)))

    return jax.lax.fori_loop(0, group.count, turn, initial)


def _up(gravity: Array, groups: list[_Group]) -> Vec3:
    """Direction against gravity; without gravity the first plane's normal, without a plane the Y axis."""
    normals = [group.placed.size["normal"].map(lambda c: c[0]) for group in groups if group.kind == "plane"]
    fallback = normals[0] if normals else Vec3(*jnp.array([0.0, 1.0, 0.0]))
    down = _vector(gravity)
    return normalize(where(dot(down, down) > 0, -down, fallback))


def _light(up: Vec3) -> Vec3:
    """Unit direction to the light: from above, to the right and before the default viewer."""
    one, zero = jnp.ones_like(up.x), jnp.zeros_like(up.x)
    reference = where(jnp.abs(up.x) < 0.9, Vec3(one, zero, zero), Vec3(zero, one, zero))
    right = normalize(reference - up * dot(reference, up))
    return normalize(up + right * LIGHT_TILT[0] + cross(right, up) * LIGHT_TILT[1])


def _primary_rays(camera: Camera, width: int, height: int) -> tuple[Vec3, Array]:
    """Unit directions through the pixel centres, row by row from the top, and the angle [rad] of a pixel."""
    forward = normalize(_vector(camera.target - camera.position))
    right = normalize(cross(forward, _vector(camera.up)))
    above = cross(right, forward)
    pixel = 2.0 * jnp.tan(0.5 * camera.vertical_field_of_view) / height
    across = jnp.tile((jnp.arange(width) - 0.5 * (width - 1)) * pixel, height)
    along = jnp.repeat((0.5 * (height - 1) - jnp.arange(height)) * pixel, width)
    direction = forward + right * across + above * along
    return direction * (1.0 / jnp.sqrt(1.0 + across * across + along * along)), pixel


def _sky(rise: Array) -> Vec3:
    """Colour of the sky by the sine of the elevation; below the horizon it stays the horizon's."""
    blend = jnp.sqrt(jnp.clip(rise, 0.0, 1.0))
    horizon, zenith = _linear(Vec3(*HORIZON_COLOUR)), _linear(Vec3(*ZENITH_COLOUR))
    return Vec3(*(low + (high - low) * blend for low, high in zip(horizon, zenith, strict=True)))


def _first_hit(groups: list[_Group], eye: Vec3, ray: Vec3, pixel_angle: Array, view_distance: Array) -> _Surface:
    radii = [jax.vmap(partial(bounding_radius, g.kind))(g.placed.size) for g in groups if g.kind != "plane"]
    cell = grid_cell(jnp.concatenate(radii) if radii else jnp.zeros(0))
    nothing = jnp.zeros_like(ray.x)
    nearest = _Surface(nothing + jnp.inf, Vec3(nothing, nothing, nothing), Vec3(nothing, nothing, nothing), nothing)
    for group in groups:
        kind, shape = group.kind, RAY_SHAPES[group.kind]

        def update(nearest: _Surface, placed: Placed, colour: Vec3, kind: str = kind, shape: Any = shape) -> _Surface:
            distance, normal = shape.meet(eye, ray, placed)
            closer = distance < nearest.distance
            point = eye + ray * distance
            haze = nothing
            if kind in GROUND:
                footprint = distance * pixel_angle / jnp.maximum(-dot(normal, ray), 1e-6)
                axes = tangent_basis(placed.size["normal"]) if kind == "plane" else _level_axes(placed)
                colour = colour * _chequer(point, axes, cell, footprint)
            if kind == "plane":
                haze = 1.0 - 1.0 / (1.0 + (distance / (12.0 * view_distance)) ** 2)
            elif shape.patterned:
                colour = colour * _octants(point, placed)
            return _Surface(
                jnp.where(closer, distance, nearest.distance),
                where(closer, normal, nearest.normal),
                where(closer, colour, nearest.colour),
                jnp.where(closer, haze, nearest.haze),
            )

        nearest = _over(group, update, nearest)
    return nearest


def _octants(point: Vec3, placed: Placed) -> Array:
    """Brightness of the eight octants of a round shape in turns light and dark, so that its rotation shows."""
    local = placed.rotation.apply_transposed(point - placed.position)
    return jnp.where(local.x * local.y * local.z > 0, 1.0, 0.6)


def _level_axes(placed: Placed) -> tuple[Vec3, Vec3]:
    """Axes of a heightfield's grid."""
    return placed.rotation.column_x, placed.rotation.column_z


def _chequer(point: Vec3, axes: tuple[Vec3, Vec3], cell: Array, footprint: Array) -> Array:
    """Brightness of the squares along two axes; fades to their mean where a pixel is as large as a square."""
    first, second = axes
    parity = jnp.floor(dot(point, first) / cell) + jnp.floor(dot(point, second) / cell)
    contrast = jnp.clip(1.5 - 1.5 * footprint / cell, 0.0, 1.0)
    return 0.85 + 0.15 * contrast * jnp.where(jnp.mod(parity, 2.0) < 0.5, 1.0, -1.0)


def _shadowed(groups: list[_Group], start: Vec3, light: Vec3) -> Array:
    """Whether a bounded shape hides the light. Planes cast none: an endless wall would darken the whole scene."""
    blocked = jnp.zeros(start.x.shape, bool)
    for group in groups:
        if group.kind != "plane":
            meet = RAY_SHAPES[group.kind].meet

            def update(blocked: Array, placed: Placed, _: Vec3, meet: Any = meet) -> Array:
                return blocked | (meet(start, light, placed)[0] < jnp.inf)

            blocked = _over(group, update, blocked)
    return blocked


def _quantised(colour: Vec3) -> Array:
    """Display bytes ``(ray, 4)``, the last one zero.

    Packed into one word a pixel, because XLA on a CPU would compute the whole picture again for each array that is
    stacked into the last axis.
    """
    red, green, blue = colour.map(lambda c: (jnp.sqrt(jnp.clip(c, 0.0, 1.0)) * 255.0 + 0.5).astype(jnp.uint32))
    return jax.lax.bitcast_convert_type(red | (green << 8) | (blue << 16), jnp.uint8)
