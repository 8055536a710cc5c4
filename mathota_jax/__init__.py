"""mathota_jax: a differentiable rigid-body contact engine in JAX. This module is the whole public API."""

from mathota_jax.builder import SceneBuilder
from mathota_jax.collision.raycast import Raycast, raycast
from mathota_jax.constraints.joints.ball_and_socket import BallAndSocket
from mathota_jax.constraints.joints.distance import Distance
from mathota_jax.constraints.joints.fixed import Fixed
from mathota_jax.constraints.joints.hinge import Hinge
from mathota_jax.constraints.joints.slider import Slider
from mathota_jax.description import describe
from mathota_jax.diagnostics import (
    Contacts,
    angular_momentum,
    contact_forces,
    contacts,
    energy,
    joint_forces,
    joint_position,
    joint_velocity,
    momentum,
)
from mathota_jax.dynamics.sleep import is_asleep, wake
from mathota_jax.geometry import Box, Capsule, Compound, Cone, Cylinder, Heightfield, Plane, Polyhedron, Sphere
from mathota_jax.model import Model
from mathota_jax.options import Options
from mathota_jax.queries import (
    ClosestPoints,
    ContactManifold,
    Geometry,
    Impact,
    closest_points,
    manifold,
    signed_distance,
    time_of_impact,
)
from mathota_jax.residuals import JointGaps, Residuals, joint_gaps, penetration, residuals
from mathota_jax.scene import Scene
from mathota_jax.state import EndForces, Flag, Sleep, State, apply_force
from mathota_jax.step import rollout, step
from mathota_jax.time_stepping import Frame, advance, interpolate, substep

__version__ = "0.1.0"

__all__ = [
    "BallAndSocket",
    "Box",
    "Capsule",
    "ClosestPoints",
    "Compound",
    "Cone",
    "ContactManifold",
    "Contacts",
    "Cylinder",
    "Distance",
    "EndForces",
    "Fixed",
    "Flag",
    "Frame",
    "Geometry",
    "Heightfield",
    "Hinge",
    "Impact",
    "JointGaps",
    "Model",
    "Options",
    "Plane",
    "Polyhedron",
    "Raycast",
    "Residuals",
    "Scene",
    "SceneBuilder",
    "Sleep",
    "Slider",
    "Sphere",
    "State",
    "advance",
    "angular_momentum",
    "apply_force",
    "closest_points",
    "contact_forces",
    "contacts",
    "describe",
    "energy",
    "interpolate",
    "is_asleep",
    "joint_forces",
    "joint_gaps",
    "joint_position",
    "joint_velocity",
    "manifold",
    "momentum",
    "penetration",
    "raycast",
    "residuals",
    "rollout",
    "signed_distance",
    "step",
    "substep",
    "time_of_impact",
    "wake",
]
