"""Numbers that the laws of joint rows need, in slot order."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.constraints.joint_layout import JointGroup, joint_groups
from mathota_jax.constraints.joint_rows import JointRows, stack_rows
from mathota_jax.constraints.row_laws import rate_to_stop
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take

RETURN = 0.1
"""Share of what a joint is beyond its stop that a motor takes back in a step. Measured: with all of it two motors on one
arm, whose rates a few sweeps leave unsettled, swing by 1 rad/s for ever; with none they hold the arm beyond a soft stop."""

Coefficients = dict[str, Array]
"""By name, (slot, world); a name that no row needs is absent: "damping", "stiffness", "target", "cap", "armature"."""


def row_coefficients(model: Model, action: Array, joints: JointRows) -> Coefficients:
    """Coefficients of all joint rows.

    Args:
      model: parameters.
      action: (motor, world) sets the targets of the motors.
      joints: rows at the start of the step.
    """
    rows: list[Coefficients] = []
    counts: list[int] = []
    for group in joint_groups(model.scene):
        found = _group_coefficients(model, group, action, joints)
        rows += found
        counts += [len(group.joints)] * len(found)
    zero = jnp.zeros((1, 1), model.dt.dtype)
    names = sorted({name for row in rows for name in row})
    return {name: stack_rows([row.get(name, zero) for row in rows], counts) for name in names}


def motor_command(model: Model, action: Array) -> Array:
    """Action clipped to the limits and multiplied by the gears, (motor, world)."""
    return jnp.clip(action, -model.motor_limit, model.motor_limit) * model.motor_gear


def _group_coefficients(model: Model, group: JointGroup, action: Array, joints: JointRows) -> list[Coefficients]:
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
            if feature == "velocity":
                chosen["target"] = _within_stops(chosen["target"], group, joints, model.dt)
            rows.append({**chosen, **(armature if feature == "position" else {})})
        else:
            rows.append({})
    return rows


def _within_stops(rate: Array, group: JointGroup, joints: JointRows, dt: Array) -> Array:
    """The rates (joint, world) told to motors, as far as the stops of their joints leave room in the step.

    Else a motor without a cap and a stop ask for what can not be: their impulses grow against each other from step to step,
    and what is left of the one or the other moves the joint. Nobody else feels which of the two holds the joint.
    """
    for feature, outwards in (("lower", -1.0), ("upper", 1.0)):
        if feature not in group.features:
            continue
        slots = group.slots(group.kind.row_count(group.features[: group.features.index(feature)]))
        room, opening = joints.error[slots], joints.rate[slots]
        # The stop holds on average over the step; small steps hold at every moment.
        most = jnp.minimum(room / dt, rate_to_stop(room, opening, dt))
        back = jnp.maximum(RETURN * room / dt, -jnp.abs(rate))
        rate = outwards * jnp.minimum(outwards * rate, jnp.where(room > 0, most, back))
    return rate
