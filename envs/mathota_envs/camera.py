"""Pinhole camera, its validation and the default view of a scene."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mathota_envs.scene_description import bounding_sphere, scene_description

DEFAULT_FIELD_OF_VIEW = math.radians(40.0)
ELEVATION = math.radians(20.0)


class Camera(NamedTuple):
    """Pinhole camera; a pytree, so cameras can be batched and differentiated like any other argument.

    Attributes:
        position: Pinhole in world coordinates [m], ``(3,)``.
        target: Point seen at the centre of the image [m], ``(3,)``.
        up: Direction shown upwards, any length, not along the view, ``(3,)``.
        vertical_field_of_view: Angle between the top and bottom edges [rad], between 0 and pi.
    """

    position: Any
    target: Any
    up: Any
    vertical_field_of_view: Any = DEFAULT_FIELD_OF_VIEW


def validated(camera: Camera) -> Camera:
    """Camera as float64 NumPy arrays.

    Raises:
        ValueError: A part has the wrong shape, is not finite or leaves the view undefined.
    """
    if not isinstance(camera, Camera):
        raise ValueError(f"camera must be a Camera(position, target, up, ...), got {type(camera).__name__}")
    vectors = {}
    for name in ("position", "target", "up"):
        try:
            vector = np.asarray(getattr(camera, name), dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"camera.{name} must be three numbers: {error}") from error
        if vector.shape != (3,) or not np.isfinite(vector).all():
            raise ValueError(f"camera.{name} must be three finite numbers, got {getattr(camera, name)!r}")
        vectors[name] = vector
    forward = vectors["target"] - vectors["position"]
    distance, up_length = np.linalg.norm(forward), np.linalg.norm(vectors["up"])
    if distance == 0:
        raise ValueError("camera.target must differ from camera.position")
    if up_length == 0:
        raise ValueError("camera.up must not be zero")
    if np.linalg.norm(np.cross(forward, vectors["up"])) <= 1e-6 * distance * up_length:
        raise ValueError("camera.up must not be parallel to the line from camera.position to camera.target")
    field_of_view = np.asarray(camera.vertical_field_of_view)
    if field_of_view.shape != () or not np.issubdtype(field_of_view.dtype, np.number):
        raise ValueError(f"camera.vertical_field_of_view must be one angle, got {camera.vertical_field_of_view!r}")
    if not 0 < field_of_view < math.pi:
        raise ValueError(
            f"camera.vertical_field_of_view must be between 0 and pi radians, got {camera.vertical_field_of_view!r}"
        )
    return Camera(**vectors, vertical_field_of_view=float(field_of_view))


def view_basis(model: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World directions that a viewer calls right, up and front (towards the viewer), each ``(3,)``, unit, right-handed.

    Up is against gravity; without gravity it is the normal of the first plane, without a plane the Y axis.
    """
    up = -np.asarray(model.gravity, dtype=float)
    if not np.linalg.norm(up) > 0:
        planes = [shape for shape in scene_description(model) if shape["kind"] == "plane"]
        up = np.array(planes[0]["normal"] if planes else (0.0, 1.0, 0.0))
    up = up / np.linalg.norm(up)
    along_x = np.array([1.0, 0.0, 0.0])
    right = along_x if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = right - up * (right @ up)
    right = right / np.linalg.norm(right)
    return right, up, np.cross(right, up)


def viewing_direction(model: Any, centre: np.ndarray, distance: float) -> np.ndarray:
    """Unit direction from `centre` to the viewer: slightly raised, from the first side that no plane hides.

    Args:
        model: The scene; its planes are seen from their outer side only.
        centre: Point looked at [m], ``(3,)``.
        distance: Distance of the viewer [m].
    """
    right, up, front = view_basis(model)
    planes = [shape for shape in scene_description(model) if shape["kind"] == "plane"]

    def direction(azimuth: float) -> np.ndarray:
        level = math.sin(azimuth) * right + math.cos(azimuth) * front
        return math.cos(ELEVATION) * level + math.sin(ELEVATION) * up

    def hidden(candidate: np.ndarray) -> int:
        viewer = centre + distance * candidate
        return sum(float(np.dot(plane["normal"], viewer)) <= plane["offset"] for plane in planes)

    # A small turn off the axis shows two sides of a box; the others are tried from front to back.
    azimuths = [math.radians(turn) for turn in (25, -25, 70, -70, 115, -115, 160, -160)]
    return min((direction(azimuth) for azimuth in azimuths), key=hidden)


def default_camera(model: Any, state: Any, aspect: float = 1.0) -> Camera:
    """Camera that shows all moving-sized bodies of a state, with gravity pointing down.

    The view follows from the given state alone: to film an episode call this once, on its first state.

    Args:
        model: Needs ``scene.shapes``, ``shapes`` and ``gravity``.
        state: Needs ``position (body, 3)`` [m]; non-finite bodies are ignored.
        aspect: Width over height of the image.

    Returns:
        A `Camera` at the distance at which the bounding sphere of the bodies fills the smaller side of the image.
    """
    centre, radius = bounding_sphere(scene_description(model), np.asarray(state.position))
    half_angle = math.atan(math.tan(0.5 * DEFAULT_FIELD_OF_VIEW) * min(1.0, aspect))
    distance = radius / math.sin(half_angle)
    position = centre + distance * viewing_direction(model, centre, distance)
    return Camera(position, centre, view_basis(model)[1], DEFAULT_FIELD_OF_VIEW)
