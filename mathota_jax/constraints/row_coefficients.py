"""Numbers that the laws of joint rows need, in slot order."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.constraints.joint_layout import JointGroup, joint_groups
from mathota_jax.constraints.joint_rows import stack_rows
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take

Coefficients = dict[str, Array]
"""By name, (slot, world); a name that no row needs is absent: "damping", "stiffness", "target", "cap", "armature"."""


def row_coefficients(model: Model, action: Array) -> Coefficients:
    """Coefficients of all joint rows; `action` (motor, world) sets the targets of the motors."""
    rows: list[Coefficients] = []
    counts: list[int] = []
    for group in joint_groups(model.scene):
        found = _group_coefficients(model, group, action)
        rows += found
        counts += [len(group.joints)] * len(found)
    zero = jnp.zeros((1, 1), model.dt.dtype)
    names = sorted({name for row in rows for name in row})
    return {name: stack_rows([row.get(name, zero) for row in rows], counts) for name in names}


def motor_command(model: Model, action: Array) -> Array:
    """Action clipped to the limits and multiplied by the gears, (motor, world)."""
    return jnp.clip(action, -model.motor_limit, model.motor_limit) * model.motor_gear


def _group_coefficients(model: Model, group: JointGroup, action: Array) -> list[Coefficients]:
    kind, scene = group.kind, model.scene
    rows: list[Coefficients] = [{} for _ in range(kind.fixed_row_count)]

    def of_joints(**leaves: Array) -> Coefficients:
        return {name: take(leaf, group.joints) for name, leaf in leaves.items()}

    armature = of_joints(armature=model.joint_armature) if "spring" in group.features else {}
    for place, feature in enumerate(group.features):
        if feature == "damping":
            rows += [of_joints(damping=model.joint_damping)] * kind.free_count
        elif feature == "friction":
            rows += [of_joints(cap=model.joint_friction)] * kind.free_count
        elif feature == "spring":
            spring = of_joints(stiffness=model.joint_stiffness, target=model.joint_rest, damping=model.joint_damping)
            rows.append({**spring, **armature})
        elif feature in ("velocity", "position"):
            motors = group.motors(scene, place)
            values = {"target": motor_command(model, action), "cap": model.motor_cap}
            if feature == "position":
                values |= {"stiffness": model.motor_stiffness, "damping": model.motor_damping}
            chosen = {name: take(value, motors) for name, value in values.items()}
            rows.append({**chosen, **(armature if feature == "position" else {})})
        else:
            rows.append({})
    return rows
