"""Scenes described by numbers, and compiled runners that every test shares.

The runners are module-level jitted functions: tests that use the same scene, batch size and precision share one
compilation. Time steps, gravity, friction, restitution and masses are traced, so a whole grid of them is one program.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from mathota_jax import Box, Capsule, Fixed, Hinge, Options, Plane, SceneBuilder, Sphere, contacts, step

GRAVITY = 9.81
DOWN = (0.0, -GRAVITY, 0.0)

HALVES_BY_PROPORTION = {
    "slab": (0.5, 0.05, 0.5),
    "brick": (0.5, 0.3, 0.8),
    "cube": (0.5, 0.5, 0.5),
    "tower": (0.5, 1.0, 0.5),
}
"""Half extents [m] of boxes whose contacts turn them in different ways."""


def undamped(**changes: Any) -> Options:
    """Options without the stabilising damping, which no closed form contains."""
    return Options(**{"linear_damping": 0.0, "angular_damping": 0.0, **changes})


# Runners -------------------------------------------------------------------------------------------------------------


@jax.jit
def advance(model: Any, state: Any, step_count: Any, action: Any = None) -> Any:
    """State of one world after `step_count` steps; the count is traced, so it never recompiles."""
    return jax.lax.fori_loop(0, step_count, lambda _, current: step(model, current, action), state)


@jax.jit
def advance_worlds(models: Any, states: Any, step_count: Any, actions: Any = None) -> Any:
    """The same for a batch of worlds whose every model leaf, state leaf and action is mapped."""
    return jax.lax.fori_loop(0, step_count, lambda _, current: jax.vmap(step)(models, current, actions), states)


@functools.partial(jax.jit, static_argnames=("step_count", "observe"))
def record_worlds(models: Any, states: Any, step_count: int, observe: Callable, actions: Any = None) -> tuple[Any, Any]:
    """Final states and `observe(model, state)` after every step; leading axes of the record: (step, world)."""

    def body(current: Any, _: None) -> tuple[Any, Any]:
        following = jax.vmap(step)(models, current, actions)
        return following, jax.vmap(observe)(models, following)

    return jax.lax.scan(body, states, None, length=step_count)


def motion(model: Any, state: Any) -> dict[str, Any]:
    """The whole motion of the bodies, for `record_worlds`."""
    return {
        "position": state.position,
        "orientation": state.orientation,
        "velocity": state.velocity,
        "angular_velocity": state.angular_velocity,
    }


def motion_and_penetration(model: Any, state: Any) -> dict[str, Any]:
    """`motion` and the deepest overlap of any active contact [m]."""
    found = contacts(model, state)
    depth = jnp.max(jnp.where(found.active, -found.separation, 0.0), initial=0.0)
    return {**motion(model, state), "penetration": depth}


# Batches -------------------------------------------------------------------------------------------------------------


def stack(trees: Sequence[Any]) -> Any:
    """One batch from worlds of the same scene: every leaf gets a leading world axis."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *trees)


def repeat(tree: Any, count: int) -> Any:
    """A batch of `count` equal worlds."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), tree)


def per_body(values: Any, like: Any) -> Any:
    """One value a world, (world,), spread over the bodies of the leaf `like`, (world, body)."""
    return jnp.broadcast_to(jnp.asarray(values, dtype=like.dtype)[:, None], like.shape)


def with_dt(tree: Any, dt: float) -> Any:
    """The model, or batch of models, with another time step [s]."""
    return dataclasses.replace(tree, dt=jnp.full_like(tree.dt, dt))


def tilted_gravity(angle_degrees: Any, magnitude: float = GRAVITY) -> np.ndarray:
    """Gravity as seen from a slope whose downhill direction is +X: (..., 3) [m/s^2]."""
    angle = np.radians(np.asarray(angle_degrees, dtype=float))
    return magnitude * np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(angle)], axis=-1)


# Scenes --------------------------------------------------------------------------------------------------------------


def body_on_plane(
    shape: Any,
    *,
    gravity: Sequence[float] = DOWN,
    friction: float = 0.5,
    restitution: float = 0.0,
    options: Options | None = None,
    **body: Any,
) -> tuple[Any, Any]:
    """Body 0: the plane y = 0. Body 1: `shape`, of mass 1 unless said otherwise."""
    builder = SceneBuilder(gravity=gravity)
    surface = {"friction": friction, "restitution": restitution}
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, **surface)
    builder.add_body(shape, **{"mass": 1.0, **surface, **body})
    return builder.build(options or undamped())


def slab_on_plane(**changes: Any) -> tuple[Any, Any]:
    """The 0.4 x 0.1 x 0.4 m slab of benchmarks A9 and A10, at rest on the plane."""
    return body_on_plane(Box((0.2, 0.05, 0.2)), **{"position": (0.0, 0.05, 0.0), **changes})


def sphere_on_plane(height: float = 0.0, **changes: Any) -> tuple[Any, Any]:
    """A sphere of radius 0.1 m whose lowest point is `height` above the plane."""
    return body_on_plane(Sphere(0.1), **{"position": (0.0, 0.1 + height, 0.0), **changes})


def box_stack(count: int = 10, half: float = 0.1, options: Options | None = None, **body: Any) -> tuple[Any, Any]:
    """Body 0: the plane. Bodies 1 to `count`: cubes stacked exactly touching, 1 kg each."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, **body)
    for level in range(count):
        builder.add_body(Box((half, half, half)), mass=1.0, position=(0.0, half * (2 * level + 1), 0.0), **body)
    return builder.build(options or Options(dt=1 / 240))


def quadruped(drive: str, options: Options, ignores_itself: bool = True, tiles: int = 0) -> tuple[Any, Any]:
    """A torso of 20 kg on four legs of 0.6 kg, on a plane or on a row of tiles; for `drive` see `add_driven_hinge`."""
    builder = SceneBuilder(gravity=DOWN)
    if tiles:
        for tile in range(tiles):
            place = (0.5 * (tile - tiles // 2), -0.5, 0)
            builder.add_body(Box((0.25, 0.5, 1.0)), static=True, position=place, friction=1.0)
    else:
        builder.add_body(Plane((0, 1, 0)), static=True, friction=1.0)
    links = [builder.add_body(Box((0.2, 0.05, 0.2)), mass=20.0, position=(0, 0.55, 0))]
    for x in (-0.2, 0.2):
        for z in (-0.2, 0.2):
            upper = builder.add_body(Capsule(0.02, 0.1), mass=0.5, position=(x, 0.385, z))
            lower = builder.add_body(Capsule(0.02, 0.115), mass=0.1, position=(x, 0.135, z))
            for parent, child, height in ((links[0], upper, 0.5), (upper, lower, 0.27)):
                add_driven_hinge(builder, drive, parent, child, (x, height, z))
            links += [upper, lower]
    if ignores_itself:
        builder.ignore_collisions(links)
    return builder.build(options)


def humanoid(options: Options) -> tuple[Any, Any]:
    """A body of 15 links and 52.4 kg upright on a plane, which may touch itself: 105 pairs beside the 15 with the plane.

    Limits and servos ("servo" of `stiffened`) on its 12 hinges, which are all about z; the hands are welded.
    """
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=1.0)
    across = axis_angle((1, 0, 0), np.pi / 2)
    pelvis = builder.add_body(Capsule(0.09, 0.08), mass=8.0, position=(0, 0.95, 0), orientation=across)
    chest = builder.add_body(Box((0.1, 0.17, 0.16)), mass=16.0, position=(0, 1.25, 0))
    head = builder.add_body(Sphere(0.1), mass=4.0, position=(0, 1.55, 0))
    hinges = [(pelvis, chest, (0, 1.06, 0)), (chest, head, (0, 1.44, 0))]
    for side in (-1.0, 1.0):
        z, w = 0.1 * side, 0.24 * side
        thigh = builder.add_body(Capsule(0.06, 0.13), mass=5.0, position=(0, 0.69, z))
        shin = builder.add_body(Capsule(0.045, 0.14), mass=3.0, position=(0, 0.28, z))
        foot = builder.add_body(Box((0.1, 0.03, 0.045)), mass=0.8, position=(0.03, 0.03, z))
        hinges += [(pelvis, thigh, (0, 0.88, z)), (thigh, shin, (0, 0.48, z)), (shin, foot, (0, 0.08, z))]
        upper = builder.add_body(Capsule(0.04, 0.1), mass=1.8, position=(0, 1.24, w))
        fore = builder.add_body(Capsule(0.035, 0.1), mass=1.2, position=(0, 0.96, w))
        hand = builder.add_body(Sphere(0.045), mass=0.4, position=(0, 0.8, w))
        hinges += [(chest, upper, (0, 1.38, w)), (upper, fore, (0, 1.1, w))]
        builder.add_joint(Fixed(fore, hand, (0, 0.85, w)))
    for parent, child, anchor in hinges:
        add_driven_hinge(builder, "servo", parent, child, anchor, limits=(-2.0, 2.0))
    return builder.build(options)


def add_driven_hinge(
    builder: SceneBuilder, drive: str, parent: int, child: int, anchor: Any, limits: Any = None
) -> None:
    """A hinge about z with a "spring" or a "servo" of 1 N m/rad and 1 N m s/rad."""
    gains = {"stiffness": 1.0, "damping": 1.0}
    spring = gains if drive == "spring" else {}
    hinge = Hinge(parent=parent, child=child, anchor=anchor, axis=(0, 0, 1), limits=limits, **spring)
    handle = builder.add_joint(hinge)
    if drive == "servo":
        builder.add_motor(handle, kind="position", limit=10.0, **gains)


def stiffened(model: Any, drive: str, stiffness: Any, damping: Any) -> Any:
    """The model with all its springs or servos (`drive`) of this stiffness and damping."""
    name = {"spring": "joint", "servo": "motor"}[drive]
    values = {f"{name}_stiffness": stiffness, f"{name}_damping": damping}
    return dataclasses.replace(
        model, **{key: jnp.full_like(getattr(model, key), value) for key, value in values.items()}
    )


# Truths --------------------------------------------------------------------------------------------------------------


def rotation_matrix(quaternion: Any) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (w, x, y, z), in NumPy."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def axis_angle(axis: Any, angle: float) -> np.ndarray:
    """Quaternion (w, x, y, z) of a turn by `angle` [rad] about `axis`."""
    unit = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * unit])


def quaternion_product(p: Any, q: Any) -> np.ndarray:
    """Hamilton product of two quaternions (w, x, y, z): first the turn `q`, then `p`."""
    pw, pv = p[0], np.asarray(p[1:], dtype=float)
    qw, qv = q[0], np.asarray(q[1:], dtype=float)
    return np.concatenate([[pw * qw - pv @ qv], pw * qv + qw * pv + np.cross(pv, qv)])


def angle_between(p: Any, q: Any) -> np.ndarray:
    """Angle [rad] of the turn between two unit quaternions (..., 4); exact for small angles as well."""
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    sign = np.where(np.sum(p * q, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return 4 * np.arcsin(np.clip(np.linalg.norm(p - sign * q, axis=-1) / 2, 0, 1))


def box_moments(half: Any) -> np.ndarray:
    """Principal moments of inertia (3,) of a box of 1 kg with these half extents [m]."""
    squares = np.square(half)
    return (squares.sum() - squares) / 3


def torque_free(moments: Any, spin: Any, seconds: float) -> np.ndarray:
    """Orientation and body angular velocity (7,) of a free body after some time, by Euler's equations and an eighth-order
    method; it starts upright with angular velocity `spin`."""

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        turn = 0.5 * quaternion_product(y[:4], np.concatenate([[0.0], y[4:]]))
        return np.concatenate([turn, -np.cross(y[4:], moments * y[4:]) / moments])

    start = np.concatenate([[1.0, 0.0, 0.0, 0.0], spin])
    return solve_ivp(rates, (0, seconds), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def invariants(
    model: Any, position: Any, orientation: Any, velocity: Any, angular_velocity: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kinetic energy (...), linear and angular momentum (..., 3) of the moving bodies, in NumPy float64.

    `model` is one world's; bodies of infinite or zero mass (the static ones) must not be passed in the arrays.
    """
    mass, inertia = (np.asarray(leaf, dtype=float) for leaf in (model["mass"], model["inertia"]))
    position, velocity, omega = (np.asarray(leaf, dtype=float) for leaf in (position, velocity, angular_velocity))
    rotation = rotation_matrix(orientation)
    body_omega = np.einsum("...ji,...j->...i", rotation, omega)
    spin = np.einsum("...ij,...j->...i", rotation, inertia * body_omega)
    kinetic = 0.5 * np.sum(mass * np.sum(velocity**2, -1) + np.sum(spin * omega, -1), axis=-1)
    linear = np.sum(mass[..., None] * velocity, axis=-2)
    angular = np.sum(np.cross(position, mass[..., None] * velocity) + spin, axis=-2)
    return kinetic, linear, angular
