"""What can be fitted: named quantities of bodies, joints, motors and the whole scene, read from and written to a model."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mathota_jax.geometry.mass import mass_properties
from mathota_jax.model import Model
from mathota_jax.spatial.safe import safe_sqrt
from mathota_jax.state import State

World = tuple[Model, State]


class Quantity(NamedTuple):
    """One kind of parameter.

    Attributes:
        owner: "body", "joint", "motor" or "scene": what the index in brackets names.
        unit: for reports.
        lower, upper: open bounds that physics sets.
        transform: the default between these bounds: "identity", "log", "softplus", "logit" or "moments".
        read: (model, state, index) -> value.
        write: (model, state, index, value) -> changed model and state; JAX, differentiable.
        missing: (model, index) -> why the quantity can not be fitted in this scene, or None.
        initial: whether it is part of the initial state, not of the model.
    """

    owner: str
    unit: str
    lower: float
    upper: float
    transform: str
    read: Callable[[Model, State, int], Any]
    write: Callable[[Model, State, int, Any], World]
    missing: Callable[[Model, int], str | None] = lambda model, index: None
    initial: bool = False


def _with(model: Model, state: State, **leaves: Any) -> World:
    return dataclasses.replace(model, **leaves), state


# Bodies --------------------------------------------------------------------------------------------------------------


def _surface(leaf: str) -> Quantity:
    """Friction or restitution of a body."""
    upper, transform = (1.0, "logit") if leaf == "restitution" else (math.inf, "softplus")

    def missing(model: Model, index: int) -> str | None:
        if getattr(model.scene, leaf):
            return None
        return f"the scene was built without {leaf}, so that it has no effect; build it with a positive {leaf} in some pair"

    return Quantity(
        "body",
        "",
        0.0,
        upper,
        transform,
        lambda model, state, index: getattr(model, leaf)[index],
        lambda model, state, index, value: _with(model, state, **{leaf: getattr(model, leaf).at[index].set(value)}),
        missing,
    )


def _static(model: Model, index: int) -> str | None:
    return "the body is static" if model.scene.static[index] else None


def _write_mass(model: Model, state: State, index: int, value: Any) -> World:
    """The inertia follows: the distribution of the mass stays as it is."""
    ratio = value / model.mass[index]
    return _with(model, state, mass=model.mass.at[index].set(value), inertia=model.inertia.at[index].multiply(ratio))


EQUAL = "all moving bodies were built with three equal moments of inertia, which the engine relies on"


def _unequal_moments(model: Model, index: int) -> str | None:
    if model.scene.all_spherical:
        return f"{EQUAL}; fit inertia_scale instead"
    return _static(model, index)


LENGTHS = ("radius", "half_extents", "half_height", "vertices", "local_position")
"""Parameters of shapes that grow with the size of a body."""


def _write_size(model: Model, state: State, index: int, value: Any) -> World:
    """All lengths of the shapes of a body times a factor; at a given mass the inertia grows with its square."""
    shapes = {kind: dict(parameters) for kind, parameters in model.shapes.items()}
    for entry in model.scene.shapes:
        if entry.body == index:
            for name in LENGTHS:
                if name in shapes[entry.kind]:
                    shapes[entry.kind][name] = shapes[entry.kind][name].at[entry.index].multiply(value)
    return _with(
        model,
        state,
        shapes=shapes,
        size=model.size.at[index].multiply(value),
        inertia=model.inertia.at[index].multiply(value**2),
    )


def _no_size(model: Model, index: int) -> str | None:
    kinds = {entry.kind for entry in model.scene.shapes if entry.body == index}
    infinite = sorted(kinds & {"plane", "heightfield"})
    return f"a {infinite[0]} has no size" if infinite else None


def _dimension(name: str) -> Quantity:
    """A size parameter of the only shape of a body; the inertia at the given mass follows."""

    def entry(model: Model, index: int) -> Any:
        entries = [entry for entry in model.scene.shapes if entry.body == index]
        return entries[0] if len(entries) == 1 and name in model.shapes[entries[0].kind] else None

    def missing(model: Model, index: int) -> str | None:
        found = entry(model, index)
        if not found:
            return f"the body is not one shape with a {name}; fit size instead"
        if found.kind != "sphere" and not model.scene.static[index] and model.scene.all_spherical:
            return f"{EQUAL}; build this one with sides that differ a little, or fit size instead"
        return None

    def read(model: Model, state: State, index: int) -> Any:
        found = entry(model, index)
        return model.shapes[found.kind][name][found.index]

    def write(model: Model, state: State, index: int, value: Any) -> World:
        kind, _, row = entry(model, index)
        before = {key: leaf[row] for key, leaf in model.shapes[kind].items()}
        changed = {**model.shapes[kind], name: model.shapes[kind][name].at[row].set(value)}
        after = {key: leaf[row] for key, leaf in changed.items()}
        old, new = mass_properties(kind, before), mass_properties(kind, after)
        ratio = jnp.diag(new.unit_inertia) / jnp.diag(old.unit_inertia)
        length = jnp.cbrt(new.volume / old.volume)
        return _with(
            model,
            state,
            shapes={**model.shapes, kind: changed},
            size=model.size.at[index].multiply(length),
            inertia=model.inertia.at[index].multiply(ratio),
        )

    return Quantity("body", "m", 0.0, math.inf, "log", read, write, missing)


def _initial(leaf: str, unit: str) -> Quantity:
    return Quantity(
        "body",
        unit,
        -math.inf,
        math.inf,
        "identity",
        lambda model, state, index: getattr(state, leaf)[index],
        lambda model, state, index, value: (
            model,
            dataclasses.replace(state, **{leaf: getattr(state, leaf).at[index].set(value)}),
        ),
        _static,
        initial=True,
    )


# Joints, motors, scene -----------------------------------------------------------------------------------------------


def _entry(owner: str, leaf: str, unit: str, lower: float, transform: str) -> Quantity:
    """One entry of a leaf of joints or motors."""

    def missing(model: Model, index: int) -> str | None:
        features = model.scene.joints[index].features if leaf in FEATURES else ()
        if leaf in FEATURES and not set(FEATURES[leaf]) & set(features):
            return f"the joint was built without it (its features: {', '.join(features) or 'none'})"
        return None

    return Quantity(
        owner,
        unit,
        lower,
        math.inf,
        transform,
        lambda model, state, index: getattr(model, leaf)[index],
        lambda model, state, index, value: _with(model, state, **{leaf: getattr(model, leaf).at[index].set(value)}),
        missing,
    )


FEATURES = {
    "joint_damping": ("damping", "spring"),
    "joint_friction": ("friction",),
    "joint_stiffness": ("spring",),
    "joint_rest": ("spring",),
    "joint_armature": ("spring",),
    "joint_swing": ("swing",),
}
"""Features of a joint without which a leaf has no effect."""


def _read_gravity(model: Model, state: State, index: int) -> Any:
    return np.linalg.norm(np.asarray(model.gravity, float))


def _write_gravity(model: Model, state: State, index: int, value: Any) -> World:
    return _with(model, state, gravity=model.gravity * (value / safe_sqrt(model.gravity @ model.gravity)))


def _weightless(model: Model, index: int) -> str | None:
    return None if np.any(np.asarray(model.gravity)) else "the scene has no gravity and so no direction of it"


def _one(model: Model, state: State, index: int) -> float:
    """Factors start from 1."""
    return 1.0


QUANTITIES: dict[str, Quantity] = {
    # The order is that of writing: what sets the inertia itself comes after what scales it.
    "mass": Quantity("body", "kg", 0.0, math.inf, "log", lambda m, s, i: m.mass[i], _write_mass, _static),
    "radius": _dimension("radius"),
    "half_extents": _dimension("half_extents"),
    "half_height": _dimension("half_height"),
    "size": Quantity("body", "", 0.0, math.inf, "log", _one, _write_size, _no_size),
    "inertia": Quantity(
        "body",
        "kg m²",
        0.0,
        math.inf,
        "moments",
        lambda m, s, i: m.inertia[i],
        lambda m, s, i, value: _with(m, s, inertia=m.inertia.at[i].set(value)),
        _unequal_moments,
    ),
    "inertia_scale": Quantity(
        "body",
        "",
        0.0,
        math.inf,
        "log",
        _one,
        lambda m, s, i, value: _with(m, s, inertia=m.inertia.at[i].multiply(value)),
        _static,
    ),
    "friction": _surface("friction"),
    "restitution": _surface("restitution"),
    "gravity": Quantity("scene", "m/s²", 0.0, math.inf, "log", _read_gravity, _write_gravity, _weightless),
    "joint_damping": _entry("joint", "joint_damping", "N m s/rad or N s/m", 0.0, "softplus"),
    "joint_friction": _entry("joint", "joint_friction", "N m or N", 0.0, "softplus"),
    "joint_stiffness": _entry("joint", "joint_stiffness", "N m/rad or N/m", 0.0, "log"),
    "joint_rest": _entry("joint", "joint_rest", "rad or m", -math.inf, "identity"),
    "joint_armature": _entry("joint", "joint_armature", "kg m² or kg", 0.0, "softplus"),
    "joint_swing": _entry("joint", "joint_swing", "rad", 0.0, "log"),
    "motor_gear": _entry("motor", "motor_gear", "", -math.inf, "identity"),
    "motor_stiffness": _entry("motor", "motor_stiffness", "N m/rad or N/m", 0.0, "log"),
    "motor_damping": _entry("motor", "motor_damping", "N m s/rad or N s/m", 0.0, "softplus"),
    "position": _initial("position", "m"),
    "velocity": _initial("velocity", "m/s"),
    "angular_velocity": _initial("angular_velocity", "rad/s"),
}
"""Every quantity by its name. A factor ("size", "inertia_scale") multiplies what the model was built with."""
