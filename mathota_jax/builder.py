"""`SceneBuilder`: the only imperative code. It validates everything before anything is compiled."""

from __future__ import annotations

import dataclasses
import itertools
import math
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.cautions import cautions
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.collision.plan import plan_broadphase
from mathota_jax.constraints.joint_layout import joint_row_count
from mathota_jax.constraints.mechanism_layout import takes_small_steps
from mathota_jax.constraints.warm_start import matches_by_distance
from mathota_jax.declarations import UNTURNED, Body, boolean, look_up, look_up_all, mass_properties, number
from mathota_jax.geometry import SHAPES, Compound, Shape
from mathota_jax.geometry.validation import finite_vector, unit_quaternion
from mathota_jax.joint_declarations import Joint, Motor, declare_joint, declare_motor, kind_of
from mathota_jax.model import Model
from mathota_jax.options import Options
from mathota_jax.pair_filter import Filter, Ignored, make_filter
from mathota_jax.rotation import rotate
from mathota_jax.scene import JointEntry, MotorEntry, PairGroup, Scene, ShapeEntry
from mathota_jax.shape_table import ShapeTable, heightfield_window, shape_table
from mathota_jax.state import EndForces, Sleep, State


class SceneBuilder:
    """Collects bodies, joints and motors, and builds a model and its initial state.

    Args:
      gravity: (3,) acceleration [m/s^2], world frame. Nothing in the engine assumes an up axis.

    Raises:
      ValueError: any argument of any method that has the wrong shape, sign or range or is not finite; the message names
        the body and the argument.
    """

    def __init__(self, gravity: Any = (0.0, -9.8, 0.0)) -> None:
        self._gravity = finite_vector("SceneBuilder.gravity", gravity)
        self._bodies: list[Body] = []
        self._joints: list[Joint] = []
        self._motors: list[Motor] = []
        self._ignored: list[Ignored] = []

    def add_body(
        self,
        shape: Shape | Compound,
        *,
        mass: float | None = None,
        density: float | None = None,
        position: Any = (0.0, 0.0, 0.0),
        orientation: Any = (1.0, 0.0, 0.0, 0.0),
        velocity: Any = (0.0, 0.0, 0.0),
        angular_velocity: Any = (0.0, 0.0, 0.0),
        restitution: float = 0.0,
        friction: float = 0.5,
        static: bool = False,
        collides: bool = True,
        name: str | None = None,
    ) -> int:
        """Adds a rigid body and returns its handle.

        Args:
          shape: collision shape, which also gives the volume, the centre of mass and the inertia.
          mass: [kg]; exactly one of `mass` and `density` for a body that moves, neither for a static one.
          density: [kg/m^3].
          position: (3,) of the origin of the body frame, in which the shape is given [m], world frame. `State.position`
            is the centre of mass, ``position + R center_of_mass``; the two agree for all but polyhedra and compounds.
          orientation: (4,) quaternion (w, x, y, z), world from body; normalised here.
          velocity: (3,) of the centre of mass [m/s].
          angular_velocity: (3,) [rad/s], world frame.
          restitution: Newton coefficient in [0, 1]; a pair uses the smaller of its two.
          friction: Coulomb coefficient, at least 0; a pair uses the geometric mean of its two.
          static: the body never moves. Planes and heightfields are static always and must say so.
          collides: False leaves the body out of every contact; `ignore_collisions` out of those with some bodies.
          name: unique name; "body0", "body1", ... by default.

        Returns:
          Handle: the index of the body in every per-body array.
        """
        name = self._new_name(name, "body", [body.name for body in self._bodies])
        label = f"body '{name}'"
        if not isinstance(shape, (*SHAPES.values(), Compound)):
            known = ", ".join(cls.__name__ for cls in (*SHAPES.values(), Compound))
            raise ValueError(f"{label}: shape must be one of {known}, got {shape!r}")
        static = boolean(f"{label}: static", static)
        motion = [
            finite_vector(f"{label}: {key}", value)
            for key, value in (("velocity", velocity), ("angular_velocity", angular_velocity))
        ]
        infinite = isinstance(shape, Shape) and shape.static_only
        if infinite and not static:
            raise ValueError(f"{label}: a {type(shape).__name__} has no mass and can not move; pass static=True")
        if static and any(np.any(value) for value in motion):
            raise ValueError(f"{label}: a static body can not have a velocity")
        mass_value, inertia, frame = (
            (1.0, np.ones(3), UNTURNED) if static else mass_properties(label, shape, mass, density)
        )
        if static and (mass is not None or density is not None):
            raise ValueError(f"{label}: a static body takes neither mass nor density")
        place = finite_vector(f"{label}: position", position)
        turn = unit_quaternion(f"{label}: orientation", orientation)
        center = np.zeros(3) if infinite else shape.center_of_mass()
        self._bodies.append(
            Body(
                name=name,
                shape=shape,
                static=static,
                collides=boolean(f"{label}: collides", collides),
                mass=mass_value,
                inertia=inertia,
                inertia_frame=frame,
                center=center,
                position=place + rotate(turn, center),
                orientation=turn,
                velocity=motion[0],
                angular_velocity=motion[1],
                friction=number(f"{label}: friction", friction, 0.0, math.inf),
                restitution=number(f"{label}: restitution", restitution, 0.0, 1.0),
            )
        )
        return len(self._bodies) - 1

    def add_joint(self, joint: Any, name: str | None = None) -> int:
        """Adds a joint at the present poses of its bodies and returns its handle.

        Args:
          joint: a joint declaration such as `Hinge`; anchors and axis in the world frame.
          name: unique name; "joint0", "joint1", ... by default.
        """
        name = self._new_name(name, "joint", [joint.name for joint in self._joints])
        label = f"joint '{name}'"
        kind = kind_of(label, joint)
        parent, child = (self.body(getattr(joint, side), f"{label}: {side}") for side in ("parent", "child"))
        if parent == child:
            raise ValueError(f"{label}: parent and child are the same body '{self._bodies[parent].name}'")
        if self._bodies[parent].static and self._bodies[child].static:
            raise ValueError(f"{label}: parent and child are both static; at least one must move")
        self._joints.append(declare_joint(name, kind, joint, parent, child, self._bodies))
        return len(self._joints) - 1

    def add_motor(
        self,
        joint: int | str,
        kind: str = "torque",
        limit: float = 1.0,
        gear: float = 1.0,
        *,
        cap: float | None = None,
        stiffness: float = 0.0,
        damping: float = 0.0,
    ) -> int:
        """Drives the coordinate of a joint and returns the index of its entry in the action vector.

        The command is the action, clipped to `limit`, times `gear`. "torque": it is the torque [N m] of a hinge or the
        force [N] of a slider or distance joint. "velocity": it is the rate that the motor keeps with a torque of at most
        `cap`, as far as the stops of the joint leave room. "position": it is the coordinate c to which the motor pulls like
        a spring and damper, with the torque ``stiffness (c - coordinate) - damping rate`` clipped to `cap`; implicit, so
        that any stiffness is stable.

        Args:
          joint: handle or name of the joint, which must have a single free coordinate.
          kind: "torque", "velocity" or "position".
          limit: largest absolute action; larger actions are clipped.
          gear: command per unit of action.
          cap: largest torque [N m] or force [N] of a velocity or position motor; None for no bound.
          stiffness: of a position motor [N m/rad] or [N/m], positive.
          damping: of a position motor [N m s/rad] or [N s/m].
        """
        index = self.joint(joint, "add_motor: joint")
        declared = self._joints[index]
        given = {"limit": limit, "gear": gear, "cap": cap, "stiffness": stiffness, "damping": damping}
        self._motors.append(declare_motor(f"motor on joint '{declared.name}'", declared, index, kind, given))
        return len(self._motors) - 1

    def ignore_collisions(self, bodies: Any, others: Any = None) -> None:
        """Declares that bodies pass through each other, such as the links of a robot.

        What ignores each other costs nothing: such pairs are absent from the program, or never listed by the broadphase.
        Bodies that a joint connects ignore each other anyway.

        Args:
          bodies: handle or name of a body, or a sequence of them.
          others: the same; no body of `bodies` collides with any of these. None: no two of `bodies` collide.
        """
        names = [body.name for body in self._bodies]
        first = frozenset(look_up_all("ignore_collisions: bodies", bodies, names, "body"))
        second = first if others is None else frozenset(look_up_all("ignore_collisions: others", others, names, "body"))
        if len(first | second) < 2:
            raise ValueError(f"ignore_collisions: at least two bodies are needed, got {bodies!r} and {others!r}")
        self._ignored.append((first, second))

    def body(self, body: int | str, label: str = "body") -> int:
        """Handle of a body given by handle or name."""
        return look_up(label, body, [entry.name for entry in self._bodies], "body")

    def joint(self, joint: int | str, label: str = "joint") -> int:
        """Handle of a joint given by handle or name."""
        return look_up(label, joint, [entry.name for entry in self._joints], "joint")

    def build(self, options: Options | None = None) -> tuple[Model, State]:
        """Makes the model and its initial state, in JAX's default float precision.

        Raises:
          ValueError: no body, or a pair of shapes that can not collide (the message names both bodies).

        Warns:
          UserWarning: contacts of a robot are swept in turn with its joints, so that it may sink into the ground.
        """
        options = Options() if options is None else options
        if not isinstance(options, Options):
            raise ValueError(f"build: options must be an Options, got {options!r}")
        if not self._bodies:
            raise ValueError("build: the scene has no body; call add_body first")
        table = shape_table(self._bodies)
        scene = self._scene(table, options)
        model = self._model(scene, table, options.dt)
        for caution in cautions(model):
            warnings.warn(caution, stacklevel=2)
        return model, self._state(scene)

    def _scene(self, table: ShapeTable, options: Options) -> Scene:
        bodies = self._bodies
        joined = {(min(joint.parent, joint.child), max(joint.parent, joint.child)) for joint in self._joints}
        ignored = make_filter(len(bodies), self._ignored)
        broadphase = plan_broadphase(
            table.entries,
            [body.static for body in bodies],
            [body.collides for body in bodies],
            [body.shape.bounding_radius() for body in bodies],
            sorted(joined),
            ignored,
            options,
        )
        if broadphase and options.continuous:
            raise ValueError(
                'build: Options.continuous follows pairs that have contact slots of their own; pass broadphase="none"'
            )
        groups = self._pair_groups(table, frozenset(broadphase.shapes) if broadphase else frozenset(), ignored)
        pairs = [pair for group in groups for pair in zip(group.bodies_a, group.bodies_b, strict=True)]
        if broadphase:
            # Any two that take part may meet: it is enough that one moving body and another one have the property.
            taking_part = sorted({table.entries[k].body for k in broadphase.shapes})
            for surface in ("friction", "restitution"):
                able = [body for body in taking_part if getattr(bodies[body], surface) > 0]
                pairs += list(itertools.pairwise(able))[:1]
        return Scene(
            static=tuple(body.static for body in bodies),
            spherical=tuple(bool(np.ptp(body.inertia) == 0) for body in bodies),
            shapes=table.entries,
            faces=table.faces,
            pair_groups=groups,
            joints=tuple(
                JointEntry(joint.kind, joint.parent, joint.child, (*joint.features, *self._motor_rows(index)))
                for index, joint in enumerate(self._joints)
            ),
            motors=tuple(MotorEntry(motor.joint, motor.kind) for motor in self._motors),
            friction=any(bodies[a].friction * bodies[b].friction > 0 for a, b in pairs),
            restitution=any(min(bodies[a].restitution, bodies[b].restitution) > 0 for a, b in pairs),
            # dt is a leaf of the model: scenes that differ in it alone share a compilation.
            options=dataclasses.replace(options, dt=Options.dt),
            body_names=tuple(body.name for body in bodies),
            joint_names=tuple(joint.name for joint in self._joints),
            broadphase=broadphase,
        )

    def _model(self, scene: Scene, table: ShapeTable, dt: float) -> Model:
        bodies, joints = self._bodies, self._joints
        turned = any(np.any(body.inertia_frame != UNTURNED) for body in bodies)
        return Model(
            dt=_floats(dt),
            gravity=_floats(self._gravity),
            mass=_floats([body.mass for body in bodies]),
            inertia=_floats([body.inertia for body in bodies]),
            inertia_frame=_floats([body.inertia_frame for body in bodies]) if turned else None,
            # An infinite body never is the smaller one of a pair.
            size=_floats([body.shape.inradius() if math.isfinite(body.shape.inradius()) else 1.0 for body in bodies]),
            friction=_floats([body.friction for body in bodies]),
            restitution=_floats([body.restitution for body in bodies]),
            shapes={
                kind: {key: _floats(values) for key, values in named.items()}
                for kind, named in table.parameters.items()
            },
            joint_anchor_parent=_floats([joint.anchor_parent for joint in joints], (0, 3)),
            joint_anchor_child=_floats([joint.anchor_child for joint in joints], (0, 3)),
            joint_frame_parent=_floats([joint.frame_parent for joint in joints], (0, 4)),
            joint_frame_child=_floats([joint.frame_child for joint in joints], (0, 4)),
            joint_limits=_floats([joint.limits for joint in joints], (0, 2)),
            **{
                f"joint_{name}": _floats([getattr(joint, name) for joint in joints])
                for name in ("swing", "damping", "friction", "stiffness", "rest", "armature")
            },
            **{
                f"motor_{name}": _floats([getattr(motor, name) for motor in self._motors])
                for name in ("limit", "gear", "cap", "stiffness", "damping")
            },
            scene=scene,
        )

    def _motor_rows(self, joint: int) -> list[str]:
        """Motors of a joint that are rows of it."""
        return [motor.kind for motor in self._motors if motor.joint == joint and motor.kind != "torque"]

    def _state(self, scene: Scene) -> State:
        bodies = self._bodies
        position = _floats([body.position for body in bodies])
        orientation = _floats([body.orientation for body in bodies])
        contact_force, joint_force = _floats(np.zeros((scene.slot_count, 3))), _floats(np.zeros(joint_row_count(scene)))
        return State(
            position=position,
            orientation=orientation,
            velocity=_floats([body.velocity for body in bodies]),
            angular_velocity=_floats([body.angular_velocity for body in bodies]),
            applied_force=_floats(np.zeros((len(bodies), 3))),
            applied_torque=_floats(np.zeros((len(bodies), 3))),
            contact_force=contact_force,
            contact_feature=jnp.full(scene.slot_count, -1, jnp.int32),
            joint_force=joint_force,
            flags=jnp.zeros((), jnp.int32),
            contact_pair=jnp.full(scene.place_count, -1, jnp.int32) if scene.broadphase else None,
            contact_offset=jnp.zeros_like(contact_force) if matches_by_distance(scene) else None,
            sleep=Sleep(
                time=_floats(np.zeros(len(bodies))),
                asleep=jnp.zeros(len(bodies), bool),
                pose=jnp.concatenate([position, orientation], axis=1),
            )
            if scene.options.sleep
            else None,
            end_forces=EndForces(
                contact_force=jnp.copy(contact_force),
                joint_force=jnp.copy(joint_force),
                time=_floats(scene.options.dt / scene.options.substep_count),
            )
            if takes_small_steps(scene)
            else None,
        )

    def _pair_groups(self, table: ShapeTable, planned: frozenset[int], ignored: Filter) -> tuple[PairGroup, ...]:
        """Admissible pairs: not both static, not joined, not ignored, both colliding, not both `planned` (broadphase)."""
        joined = {frozenset((joint.parent, joint.child)) for joint in self._joints}
        order = list(SHAPES)
        members: dict[tuple[str, str], list[tuple[ShapeEntry, ShapeEntry]]] = {}
        others = [entry for k, entry in enumerate(table.entries) if k not in planned]
        pairs = itertools.combinations(table.entries, 2)
        if planned:
            found = [table.entries[k] for k in sorted(planned)]
            pairs = itertools.chain(itertools.combinations(others, 2), itertools.product(others, found))
        for first, second in pairs:
            one, two = self._bodies[first.body], self._bodies[second.body]
            if (one.static and two.static) or not (one.collides and two.collides):
                continue
            if first.body == second.body or frozenset((first.body, second.body)) in joined:
                continue
            if ignored.ignores(first.body, second.body):
                continue
            a, b = sorted((first, second), key=lambda entry: order.index(entry.kind))
            if (a.kind, b.kind) not in PAIRS:
                raise ValueError(
                    f"build: bodies '{self._bodies[a.body].name}' ({a.kind}) and '{self._bodies[b.body].name}' "
                    f"({b.kind}) can not collide with each other; pass collides=False for one of them, or name both in "
                    "ignore_collisions"
                )
            members.setdefault((a.kind, b.kind), []).append((a, b))
        return tuple(
            PairGroup(
                kind_a,
                kind_b,
                PAIRS[kind_a, kind_b].point_count,
                tuple(a.index for a, _ in pairs),
                tuple(b.index for _, b in pairs),
                tuple(a.body for a, _ in pairs),
                tuple(b.body for _, b in pairs),
                heightfield_window(table, pairs) if kind_b == "heightfield" else None,
            )
            for (kind_a, kind_b), pairs in sorted(
                members.items(), key=lambda item: (order.index(item[0][0]), order.index(item[0][1]))
            )
        )

    @staticmethod
    def _new_name(name: str | None, prefix: str, taken: list[str]) -> str:
        if name is None:
            return next(f"{prefix}{k}" for k in itertools.count(len(taken)) if f"{prefix}{k}" not in taken)
        if not isinstance(name, str) or not name:
            raise ValueError(f"name of a {prefix} must be a non-empty string, got {name!r}")
        if name in taken:
            raise ValueError(f"{prefix} name '{name}' is taken; choose another")
        return name


def _floats(values: Any, empty_shape: tuple[int, ...] | None = None) -> Array:
    array = np.asarray(values, np.float64)
    if array.size == 0 and empty_shape is not None:
        array = array.reshape(empty_shape)
    return jnp.asarray(array, jnp.result_type(float))
