"""What `SceneBuilder.build` warns of: scenes that step, but not as one may expect."""

from __future__ import annotations

import numpy as np

from mathota_jax.constraints.joint_layout import most_joints_of_a_body
from mathota_jax.constraints.joints import JOINTS
from mathota_jax.constraints.mechanism_layout import links_with_swept_contacts, takes_small_steps
from mathota_jax.model import Model
from mathota_jax.rotation import rotate, rotate_back

STIFFEST = 2.0
"""Largest stiffness of a spring or servo, times the square of a substep over the inertia of the lighter body (about its own
centre), that small steps follow where joints share bodies. Measured on arms of links of 1 kg and 0.4 m, 1/60 s in four
substeps: with 2.6 (1000 N m/rad) three links still move at 0.002 rad/s after 4 s and six at 0.8, with 26 three at 60."""


def cautions(model: Model) -> list[str]:
    """Messages on a model with its values as built."""
    return [*_swept_contacts(model), *_stiff_drives(model)]


def _swept_contacts(model: Model) -> list[str]:
    links = links_with_swept_contacts(model.scene)
    if links is None:
        return []
    return [
        f"build: the contacts of '{links[0]}' to '{links[-1]}', {len(links)} bodies with joints, are swept in turn "
        "with their joints: too many may touch at a time to be solved with the joints held, or there are joints "
        "that are left to the sweeps. What stands on light feet will sink. Leave pairs out "
        "(SceneBuilder.ignore_collisions), allow fewer to touch at a time (Options.touching_capacity), or pass "
        'solver="converged"; exact_joints=False if this is what you want'
    ]


def _stiff_drives(model: Model) -> list[str]:
    scene = model.scene
    if not scene.joints or not takes_small_steps(scene):
        return []
    stiffness = np.array(model.joint_stiffness, float)
    for motor, entry in enumerate(scene.motors):
        if entry.kind == "position":
            stiffness[entry.joint] += float(model.motor_stiffness[motor])
    substep = float(model.dt) / scene.options.substep_count
    swept_in_turn = (stiffness > 0) & (most_joints_of_a_body(scene) > 1)
    stiff = [
        scene.joint_names[joint]
        for joint in map(int, np.flatnonzero(swept_in_turn))
        if stiffness[joint] * substep**2 > STIFFEST * _smallest_inertia(model, joint)
    ]
    if not stiff:
        return []
    return [
        f"build: the spring or servo of '{stiff[0]}' ({len(stiff)} such joints) is too stiff for small steps of "
        f"{substep:.3g} s, in which joints that share bodies are swept one after the other: it may feed the scene with "
        'energy without bound. Pass solver="pgs" or "converged", or take smaller ones (Options.substeps)'
    ]


def _smallest_inertia(model: Model, joint: int) -> float:
    """Of the moving bodies of a joint about its axis [kg m^2], or mass [kg] if it slides."""
    entry = model.scene.joints[joint]
    coordinate = JOINTS[entry.kind].coordinate
    turns = coordinate is not None and coordinate.angular
    sides = ((entry.parent, model.joint_frame_parent[joint]), (entry.child, model.joint_frame_child[joint]))
    return min(
        _inertia_about(model, body, rotate(np.asarray(frame, float), np.array([1.0, 0.0, 0.0])))
        if turns
        else float(model.mass[body])
        for body, frame in sides
        if not model.scene.static[body]
    )


def _inertia_about(model: Model, body: int, axis: np.ndarray) -> float:
    """About an axis (3,) of its frame through its centre of mass."""
    if model.inertia_frame is not None:
        axis = rotate_back(np.asarray(model.inertia_frame[body], float), axis)
    return float(np.asarray(model.inertia[body], float) @ axis**2)
