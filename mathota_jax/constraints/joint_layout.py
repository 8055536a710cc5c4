"""Which joint rows a scene has and how they are numbered."""

from __future__ import annotations

import collections
from typing import NamedTuple

import numpy as np

from mathota_jax.constraints.joints import JOINTS
from mathota_jax.constraints.joints.kind import JointKind
from mathota_jax.scene import Scene
from mathota_jax.solver.table import Constraint, Table, make_tables


class JointGroup(NamedTuple):
    """Joints with the same rows; `first_slot` is the first of their slots, numbered row by row, joint by joint."""

    kind_name: str
    features: tuple[str, ...]
    joints: tuple[int, ...]
    first_slot: int

    @property
    def kind(self) -> JointKind:
        """What the joints have in common."""
        return JOINTS[self.kind_name]

    @property
    def row_count(self) -> int:
        """Rows of each joint."""
        return self.kind.row_count(self.features)

    def slots(self, row: int) -> slice:
        """Slots of one row of all joints."""
        start = self.first_slot + row * len(self.joints)
        return slice(start, start + len(self.joints))

    def members(self, scene: Scene, side: str) -> list[int]:
        """Bodies on one side of the joints."""
        return [getattr(scene.joints[joint], side) for joint in self.joints]

    def motors(self, scene: Scene, place: int) -> list[int]:
        """For each joint, the motor behind the feature at a place among the features."""
        kind = self.features[place]
        earlier = self.features[:place].count(kind)
        return [
            [motor for motor, entry in enumerate(scene.motors) if (entry.joint, entry.kind) == (joint, kind)][earlier]
            for joint in self.joints
        ]


def joint_groups(scene: Scene) -> list[JointGroup]:
    """Groups in order of first appearance."""
    members: dict[tuple[str, tuple[str, ...]], list[int]] = {}
    for joint, entry in enumerate(scene.joints):
        members.setdefault((entry.kind, entry.features), []).append(joint)
    groups, start = [], 0
    for (kind, features), joints in members.items():
        groups.append(JointGroup(kind, features, tuple(joints), start))
        start += groups[-1].row_count * len(joints)
    return groups


def joint_row_count(scene: Scene) -> int:
    """Number of joint rows of a scene."""
    return sum(group.row_count * len(group.joints) for group in joint_groups(scene))


def solves_together(scene: Scene) -> bool:
    """Whether all rows of a scene are solved together, to round-off, instead of by sweeps.

    Also where steps are split at their impacts and there are joints: sweeps carry an impact one joint a sweep, and the
    forces of a step with an impact are no start for those of the next. Of a double pendulum that strikes the ground they
    left out up to 0.4 of the change of its velocities.
    """
    return scene.options.solver == "converged" or (scene.splits_at_impacts and joint_row_count(scene) > 0)


def most_joints_of_a_body(scene: Scene) -> np.ndarray:
    """(joint,) how many joints that of its moving bodies has which has most."""
    ends = [(joint.parent, joint.child) for joint in scene.joints]
    counts = collections.Counter(body for end in ends for body in end if not scene.static[body])
    return np.array([max(counts[body] for body in end) for end in ends])


def joint_tables(scene: Scene) -> tuple[Table, ...]:
    """Order in which the solver visits the joint rows."""
    block_of = {body: block for block, body in enumerate(scene.dynamic_bodies)}
    constraints = []
    for group in joint_groups(scene):
        for place, joint in enumerate(group.joints):
            entry = scene.joints[joint]
            blocks = tuple(block_of[body] for body in (entry.parent, entry.child) if body in block_of)
            slots = tuple(group.slots(row).start + place for row in range(group.row_count))
            if slots:
                constraints.append(Constraint(blocks, slots))
    return make_tables(constraints, len(block_of), together=False)


def child_moves(scene: Scene) -> np.ndarray:
    """(slot,) whether the child of the joint of each row moves."""
    return np.concatenate(
        [
            np.tile([not scene.static[child] for child in group.members(scene, "child")], group.row_count)
            for group in joint_groups(scene)
        ]
    )
