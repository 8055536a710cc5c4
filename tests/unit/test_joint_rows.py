"""The rows of every joint against automatic differentiation of what they constrain, and their number."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Distance, Fixed, Hinge, SceneBuilder, Slider, step
from mathota_jax.bodies import unpack
from mathota_jax.constraints.joint_layout import joint_groups, joint_row_count
from mathota_jax.constraints.joint_rows import joint_rows
from mathota_jax.constraints.joints import JOINTS
from mathota_jax.constraints.joints.rows import ELASTIC, HOLD, SERVO, STOP

WORLDS = 32
ANCHOR, AXIS = (0.3, 0.2, -0.1), (1.0, 2.0, -0.5)
SCALAR = {"friction": 0.1, "stiffness": 3.0, "damping": 0.2, "armature": 0.5}
# Of each kind: every row that it can have, in one or more joints.
EVERY_ROW = {
    "hinge": [Hinge(0, 1, ANCHOR, AXIS, limits=(-1, 1), **SCALAR), Hinge(0, 1, ANCHOR, AXIS, limits=(0.5, 0.5))],
    "slider": [Slider(0, 1, ANCHOR, AXIS, limits=(-1, 1), **SCALAR)],
    "ball_and_socket": [BallAndSocket(0, 1, ANCHOR, AXIS, swing=1.0, twist=(-1, 1), damping=0.1, friction=0.1)],
    "fixed": [Fixed(0, 1), Fixed(0, 1, ANCHOR)],
    "distance": [
        Distance(0, 1, ANCHOR),
        Distance(0, 1, ANCHOR, (0.1, 0.9, 0.2), lengths=(0.1, 2.0), **SCALAR),
    ],
}
# Free relative rotations. Where the joint forbids one, its Jacobian is that of poses without it (see `orientation_rows`).
FREE_ROTATION = {"hinge": "axis", "slider": None, "fixed": None, "ball_and_socket": "any", "distance": "any"}


def two_bodies(joint, motors=()):
    builder = SceneBuilder()
    builder.add_body(Box((0.1, 0.2, 0.3)), mass=1.0, position=(0.1, -0.2, 0.3), orientation=(1, 0.2, -0.4, 0.3))
    builder.add_body(Box((0.1, 0.1, 0.2)), mass=2.0, position=(0.5, 0.4, -0.2), orientation=(0.7, -0.2, 0.4, 0.1))
    handle = builder.add_joint(joint)
    for kind in motors:
        builder.add_motor(handle, kind=kind, **({"stiffness": 1.0} if kind == "position" else {}))
    return builder.build()


def hamilton(p, q):
    pw, px, py, pz = (p[:, k] for k in range(4))
    qw, qx, qy, qz = (q[:, k] for k in range(4))
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=1,
    )


def random_worlds(joint, kind, seed):
    """Model and state with the worlds last, at random poses and velocities."""
    motors = ("position",) if getattr(joint, "stiffness", 0.0) else ()
    model, state = jax.tree.map(lambda leaf: leaf[..., None], two_bodies(joint, motors))
    random = np.random.default_rng(seed)

    def normal(*shape):
        return jnp.asarray(random.normal(size=shape), state.position.dtype)

    turn = normal(2, 4, WORLDS)
    turn = turn / jnp.linalg.norm(turn, axis=1, keepdims=True)
    if FREE_ROTATION[kind] != "any":
        half = 0.45 * math.pi * jnp.tanh(normal(1, 1, WORLDS)) * (FREE_ROTATION[kind] == "axis")
        axis = jnp.asarray(AXIS, half.dtype)[None, :, None] / np.linalg.norm(AXIS)
        about_axis = jnp.concatenate([jnp.cos(half), axis * jnp.sin(half)], axis=1)
        turn = jnp.concatenate([turn[:1], hamilton(turn[:1], about_axis)])
    return model, dataclasses.replace(
        state,
        position=normal(2, 3, WORLDS),
        orientation=hamilton(turn, jnp.broadcast_to(state.orientation, turn.shape)),
        velocity=normal(2, 3, WORLDS),
        angular_velocity=normal(2, 3, WORLDS),
    )


CASES = [(kind, number) for kind in JOINTS for number in range(len(EVERY_ROW[kind]))]


@pytest.mark.parametrize(("kind", "number"), CASES, ids=lambda value: str(value))
def test_jacobian_is_the_derivative_of_the_constraint(precision, kind, number, gate):
    model, state = random_worlds(EVERY_ROW[kind][number], kind, seed=number)

    def errors(position, orientation):
        moved = dataclasses.replace(state, position=position, orientation=orientation)
        return joint_rows(model, unpack(moved)).error

    spin = jnp.concatenate([jnp.zeros_like(state.position[:, :1]), state.angular_velocity], axis=1)
    tangents = (state.velocity, 0.5 * hamilton(spin, state.orientation))
    _, rate = jax.jvp(errors, (state.position, state.orientation), tangents)
    rows = joint_rows(model, unpack(state))
    constrains = np.isin(rows.laws, [HOLD, STOP, ELASTIC, SERVO])
    assert constrains.any()
    size = 1 + np.abs(np.asarray(rate)[constrains])
    off = np.sort(np.abs(np.asarray(rows.rate - rate)[constrains]) / size, axis=1)
    # Near half a turn of swing the twist has no derivative: two worlds of 32 may come close.
    limits = {"float64": (1e-14, 1e-11), "float32": (1e-5, 1e-3)}[str(precision)]
    gate("Jacobian times velocity - derivative, relative, median", np.median(off, axis=1), limits[0])
    gate("Jacobian times velocity - derivative, relative, but for two worlds", off[:, :-2], limits[1])


@pytest.mark.parametrize("kind", JOINTS)
def test_rows_of_a_kind_count_what_it_forbids(kind):
    """3 + 3 motions, less those that are free (guide 9.3)."""
    free = {"ball_and_socket": 3, "hinge": 1, "slider": 1, "fixed": 0, "distance": 5}
    joint = next(joint for joint in EVERY_ROW[kind] if kind != "distance" or joint.lengths is None)
    plain = type(joint)(*(getattr(joint, name) for name in ("parent", "child", "anchor")), *_axis_of(joint))
    model, _ = two_bodies(plain)
    assert joint_row_count(model.scene) == 6 - free[kind]


def _axis_of(joint):
    return (AXIS,) if isinstance(joint, Hinge | Slider) else ()


@pytest.mark.parametrize(
    ("options", "motors", "more"),
    [
        ({"limits": (-1, 1)}, (), 2),
        ({"limits": (-1, math.inf)}, (), 1),
        ({"limits": (-math.inf, 1)}, (), 1),
        ({"limits": (0.2, 0.2)}, (), 1),
        ({"damping": 0.1}, (), 1),
        ({"friction": 0.1}, (), 1),
        ({"stiffness": 0.1}, (), 1),
        ({"armature": 0.1}, (), 1),
        ({"stiffness": 0.1, "damping": 0.1, "armature": 0.1}, (), 1),
        ({}, ("torque",), 0),
        ({}, ("velocity",), 1),
        ({}, ("position",), 1),
        ({}, ("velocity", "velocity", "position"), 3),
    ],
)
def test_an_absent_feature_costs_no_row(options, motors, more):
    rows = [
        joint_row_count(two_bodies(Hinge(0, 1, ANCHOR, AXIS, **o), m)[0].scene)
        for o, m in (({}, ()), (options, motors))
    ]
    assert rows[1] - rows[0] == more


@pytest.mark.parametrize(
    ("lengths", "rows"), [(None, 1), (0.8, 1), ((0.8, 0.8), 1), ((0.0, 0.8), 1), ((0.2, 0.8), 2), ((0.2, math.inf), 1)]
)
def test_rows_of_a_distance_joint(lengths, rows):
    assert joint_row_count(two_bodies(Distance(0, 1, ANCHOR, lengths=lengths))[0].scene) == rows


def test_a_joint_without_rows_is_no_constraint():
    model, state = two_bodies(Distance(0, 1, ANCHOR, lengths=(0.0, math.inf)), motors=("torque",))
    assert joint_row_count(model.scene) == 0
    moved = step(model, state, jnp.ones(1))
    # The force of 1 N pushes the anchors apart; the whole moves on under gravity alone.
    total = np.asarray(model.mass) @ np.asarray(moved.velocity - state.velocity)
    np.testing.assert_allclose(total, 3.0 * np.asarray([0, -9.8, 0]) / 60, rtol=1e-3, atol=1e-6)
    assert np.abs(np.asarray(moved.velocity)[:, 0]).min() > 1e-3


def test_slots_are_numbered_by_group_row_and_joint():
    builder = SceneBuilder()
    for place in range(4):
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(place, 0, 0))
    for child, options in ((1, {}), (2, {"damping": 1.0}), (3, {})):
        builder.add_joint(Hinge(0, child, (child, 0, 0), (0, 0, 1), **options))
    model, state = builder.build()
    groups = joint_groups(model.scene)
    assert [(group.joints, group.first_slot, group.row_count) for group in groups] == [((0, 2), 0, 5), ((1,), 10, 6)]
    assert groups[0].slots(3) == slice(6, 8)
    assert state.joint_force.shape == (16,)
