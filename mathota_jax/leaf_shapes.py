"""Whether the leaves of a model and a state fit its scene, where a user has replaced some: clear errors."""

from __future__ import annotations

import numbers
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.state import State

BODY, JOINT, MOTOR = "body", "joint", "motor"
MODEL: dict[str, tuple] = {
    "dt": (),
    "gravity": (3,),
    "mass": (BODY,),
    "inertia": (BODY, 3),
    "inertia_frame": (BODY, 4),
    "size": (BODY,),
    "friction": (BODY,),
    "restitution": (BODY,),
    "joint_anchor_parent": (JOINT, 3),
    "joint_anchor_child": (JOINT, 3),
    "joint_frame_parent": (JOINT, 4),
    "joint_frame_child": (JOINT, 4),
    "joint_limits": (JOINT, 2),
    "joint_swing": (JOINT,),
    "joint_damping": (JOINT,),
    "joint_friction": (JOINT,),
    "joint_stiffness": (JOINT,),
    "joint_rest": (JOINT,),
    "joint_armature": (JOINT,),
    "motor_limit": (MOTOR,),
    "motor_gear": (MOTOR,),
    "motor_cap": (MOTOR,),
    "motor_stiffness": (MOTOR,),
    "motor_damping": (MOTOR,),
}
STATE: dict[str, tuple] = {
    "position": (BODY, 3),
    "orientation": (BODY, 4),
    "velocity": (BODY, 3),
    "angular_velocity": (BODY, 3),
    "applied_force": (BODY, 3),
    "applied_torque": (BODY, 3),
}
"""Shapes by the counts of the scene; a leaf that is None is absent."""


def check_leaves(label: str, model: Model, state: State) -> None:
    """Checks kinds, shapes and types; what the solver remembers is left to those who read it.

    Raises:
      ValueError: one of them does not fit, or model and state are not what they should be.
    """
    if not isinstance(model, Model) or not isinstance(state, State):
        kinds = f"{type(model).__name__} and {type(state).__name__}"
        raise ValueError(f"{label}: expected a Model and a State, in this order, got {kinds}")
    precisions: dict[str, str] = {}
    for owner, value, shapes in (("state", state, STATE), ("model", model, MODEL)):
        for name, shape in shapes.items():
            precision = _check(label, f"{owner}.{name}", getattr(value, name), shape, model.scene)
            if precision is not None:
                precisions.setdefault(precision, f"{owner}.{name}")
    if len(precisions) > 1:
        found = ", ".join(f"{name} is {precision}" for precision, name in precisions.items())
        raise ValueError(
            f"{label}: model and state must have one precision, but {found}; build both in it, or convert their "
            "floating-point leaves (jax_enable_x64 makes new arrays float64)"
        )
    kinds = [entry.kind for entry in model.scene.shapes]
    for kind, parameters in model.shapes.items():
        for name, leaf in parameters.items():
            if np.shape(leaf)[:1] != (kinds.count(kind),):
                raise ValueError(
                    f"{label}: model.shapes['{kind}']['{name}'] must have an entry for each {kind} of the scene, "
                    f"{kinds.count(kind)}, got shape {np.shape(leaf)}"
                )


def check_actions(label: str, model: Model, state: State, actions: Array | int) -> Array:
    """(step, motor) actions in the precision of the state, also for a number of steps without effort.

    Raises:
      ValueError: a negative number of steps, or one that is traced, or actions of the wrong shape.
    """
    motor_count = len(model.scene.motors)
    if isinstance(actions, numbers.Integral):
        if isinstance(actions, bool) or actions < 0:
            raise ValueError(f"{label}: the number of steps must be an integer of at least 0, got {actions}")
        return jnp.zeros((int(actions), motor_count), state.position.dtype)
    if isinstance(actions, Tracer) and actions.ndim == 0:
        raise ValueError(
            f"{label}: the number of steps must be known at compilation: jax.jit({label}, static_argnums=2), or a Python "
            "integer inside of your own jitted function"
        )
    try:
        actions = jnp.asarray(actions, state.position.dtype)
    except (TypeError, ValueError) as error:
        wanted = f"an array of shape (steps, {motor_count}) or a whole number of steps"
        raise ValueError(f"{label}: actions must be {wanted}, got a {type(actions).__name__}") from error
    if actions.ndim != 2 or actions.shape[1] != motor_count:
        raise ValueError(f"{label}: actions must have shape (steps, {motor_count}), got {actions.shape}")
    return actions


def _check(label: str, name: str, leaf: Any, symbolic: tuple, scene: Scene) -> str | None:
    """The precision of a leaf; None where it takes that of the others."""
    if leaf is None:
        return None
    if isinstance(leaf, list | tuple):
        raise ValueError(f"{label}: {name} must be an array, got a {type(leaf).__name__}")
    counts = {BODY: scene.body_count, JOINT: len(scene.joints), MOTOR: len(scene.motors)}
    shape = tuple(counts.get(length, length) for length in symbolic)
    if np.shape(leaf) != shape:
        hint = "; use jax.vmap for several worlds" if np.ndim(leaf) > len(shape) else ""
        raise ValueError(f"{label}: {name} must have shape {shape} for this model, got {np.shape(leaf)}{hint}")
    number = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
    if number.kind in "biu":
        raise ValueError(f"{label}: {name} must be floating point, got {number}")
    if isinstance(leaf, float) or getattr(leaf, "weak_type", False):
        return None
    return str(jax.dtypes.canonicalize_dtype(number))
