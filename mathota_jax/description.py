"""`describe`: what a scene compiles to, in words, so that nothing in a program is a surprise."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterable

from mathota_jax import measured
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.constraints.contact import contact_tables
from mathota_jax.constraints.contact_room import rows_of_a_point
from mathota_jax.constraints.joint_layout import joint_row_count, joint_tables
from mathota_jax.constraints.mechanism_layout import (
    bounded_slots,
    contact_places,
    layout,
    takes_contacts,
    takes_small_steps,
)
from mathota_jax.constraints.warm_start import matches_by_distance
from mathota_jax.model import Model
from mathota_jax.scene import Scene

FLOATS_OF_A_BODY = 3 + 4 + 3 + 3 + 3 + 3
"""Pose, velocities, applied force and torque in a `State`."""


def describe(model: Model) -> str:
    """What the step of a scene consists of, and what it does without.

    Bodies, groups of pairs with the method that tests them, contact slots, rows and turns of a sweep of the solver,
    joints, features, broadphase with its capacities, memory of a state, expected CPU time of a step, and all settings.

    Args:
      model: any model of the scene; nothing is computed.

    Returns:
      Several lines of text, ``name: value`` each.

    Raises:
      ValueError: `model` is not a model.
    """
    if not isinstance(model, Model):
        raise ValueError(f"describe: expected a Model, got {type(model).__name__}")
    scene = model.scene
    sections = [_bodies(scene), _pairs(scene), _rows(scene), _joints(scene), _features(scene)]
    sections += [[f"memory of a state: {_state_bytes(model)} bytes a world"], _cost(scene), _settings(model)]
    return "\n".join(line for section in sections for line in section)


def _bodies(scene: Scene) -> list[str]:
    moving = len(scene.dynamic_bodies)
    return [
        f"bodies: {scene.body_count} ({moving} moving, {scene.body_count - moving} static)",
        f"shapes: {_counted(entry.kind for entry in scene.shapes)}",
    ]


def _pairs(scene: Scene) -> list[str]:
    lines = []
    for group in scene.pair_groups:
        method = PAIRS[group.kind_a, group.kind_b].method
        lines.append(
            f"pairs with slots of their own, {group.kind_a}-{group.kind_b}: {len(group.bodies_a)} of up to "
            f"{group.point_count} points, {method}"
        )
    if scene.broadphase is None:
        return [*lines, "broadphase: none"]
    lines.append(
        f"broadphase: {scene.broadphase.method} of {len(scene.broadphase.shapes)} shapes, up to "
        f"{scene.broadphase.capacity} close pairs"
    )
    for group in scene.compact_groups:
        method = PAIRS[group.kind_a, group.kind_b].method
        partner = "moving" if group.side_count == 2 else "static"
        lines.append(
            f"close pairs, {group.kind_a}-{group.kind_b} with a {partner} body: up to {group.place_count} of up to "
            f"{group.point_count} points, {method}"
        )
    return lines


def _rows(scene: Scene) -> list[str]:
    tables = (*contact_tables(scene), *joint_tables(scene)) if scene.joints else contact_tables(scene)
    turns = sum(table.turn_count for table in tables)
    most = sum(tier.turn_count for group in scene.compact_groups for tier in group.tiers)
    rows = scene.slot_count * rows_of_a_point(scene)
    touching = ""
    room = contact_places(scene)
    if room is not None and room.count:
        which = "all" if room.for_all else "those of close pairs"
        touching = f" ({which} in up to {room.count} places of {room.points} points at a time)"
    return [
        f"contact slots: {scene.slot_count}",
        f"rows: {rows} of contacts{touching}, {joint_row_count(scene)} of joints",
        f"turns of a sweep: {turns}" + (f", and up to {most} of close pairs" if most else ""),
    ]


def _joints(scene: Scene) -> list[str]:
    joints = _counted(entry.kind for entry in scene.joints)
    features = _counted(feature for entry in scene.joints for feature in entry.features)
    lines = [f"joints: {joints}{f' (rows of their own: {features})' if features else ''}" if joints else "joints: none"]
    return [*lines, f"motors: {_counted(entry.kind for entry in scene.motors) or 'none'}"]


def _features(scene: Scene) -> list[str]:
    options = scene.options
    features = {
        "contacts": scene.slot_count > 0,
        "friction": scene.friction and scene.slot_count > 0,
        "restitution": scene.restitution and scene.slot_count > 0,
        "steps split at impacts": scene.splits_at_impacts,
        "joints": bool(scene.joints),
        "exact joints": layout(scene) is not None,
        "contacts with the joints held": takes_contacts(scene),
        "gyroscopic torque": not scene.all_spherical,
        "linear damping": options.linear_damping > 0,
        "angular damping": options.angular_damping > 0,
        "warm start": options.warm_start,
        "position correction": options.position_iterations > 0,
        "continuous collision": options.continuous,
        "sleep": options.sleep,
    }
    return [
        f"present: {', '.join(name for name, there in features.items() if there) or 'nothing'}",
        f"absent: {', '.join(name for name, there in features.items() if not there) or 'nothing'}",
    ]


def _state_bytes(model: Model) -> int:
    """Bytes of a `State` of one world."""
    scene = model.scene
    number = model.dt.dtype.itemsize
    forces = 3 * scene.slot_count + joint_row_count(scene)
    end_forces = forces + 1 if takes_small_steps(scene) else 0
    contact_offset = 3 * scene.slot_count if matches_by_distance(scene) else 0
    floats = scene.body_count * FLOATS_OF_A_BODY + forces + end_forces + contact_offset
    integers = scene.slot_count + 1 + scene.place_count
    sleep = scene.body_count * (8 * number + 1) if scene.options.sleep else 0
    return floats * number + integers * 4 + sleep


def scene_sizes(scene: Scene) -> tuple[int, ...]:
    """Moving bodies, contact slots and joints: what the cost of a step is taken to be linear in."""
    return len(scene.dynamic_bodies), scene.slot_count, len(scene.joints)


def _cost(scene: Scene) -> list[str]:
    """Expected cost, for the measured solvers; between and beyond the measured numbers of sweeps by a straight line."""
    options, sizes = scene.options, scene_sizes(scene)
    setting = options.solver
    cost = measured.expected_cost(setting, sizes)
    # Of rows that are solved with the joints held, the cost grows otherwise; no measured scene has any.
    held = bool(bounded_slots(scene)) or takes_contacts(scene)
    if cost is None or held or scene.splits_at_impacts or options.substeps or options.sleep or options.continuous:
        return ["expected cost: not measured for these settings"]
    seconds, factor = cost
    if setting == "pgs":
        more = measured.expected_cost("pgs, 30 sweeps", sizes)
        if more is not None:
            seconds = max(seconds + (more.seconds - seconds) * (options.velocity_iterations - 10) / 20, 0.25 * seconds)
            factor = max(factor, more.factor)
    return [
        f"expected cost: {1e6 * seconds:.2g} CPU-microseconds a step and world of a large batch on the processor of the "
        f"work-precision report, whose scenes it meets within a factor of {factor:.1f}"
    ]


def _settings(model: Model) -> list[str]:
    options = dataclasses.asdict(model.scene.options)
    options["dt"] = float(model.dt) if model.dt.ndim == 0 else "differs between worlds"
    values = (
        f"{name}={value:.6g}" if isinstance(value, float) else f"{name}={value}" for name, value in options.items()
    )
    return [f"settings: {', '.join(values)}"]


def _counted(kinds: Iterable[str]) -> str:
    counts = collections.Counter(kinds)
    return ", ".join(f"{count} {kind}" for kind, count in counts.items())
