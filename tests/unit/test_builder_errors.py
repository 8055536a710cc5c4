"""Every bad input is one clear `ValueError` that names the thing and the argument."""

import math
import re

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import (
    BallAndSocket,
    Box,
    Capsule,
    Distance,
    Fixed,
    Hinge,
    Options,
    Plane,
    SceneBuilder,
    Slider,
    Sphere,
    apply_force,
    rollout,
    step,
)

NAN, INFINITY = math.nan, math.inf


def add(shape=None, **arguments):
    SceneBuilder().add_body(shape or Sphere(0.1), **{"mass": 1.0, "name": "crate", **arguments})


def bodies():
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, name="ground")
    builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(0, 1, 0), name="door")
    return builder


def join(kind=Hinge, **arguments):
    bodies().add_joint(kind(**{"parent": 0, "child": 1, "anchor": (0, 1, 0), "axis": (0, 0, 1), **arguments}))


def motor(joint=None, **arguments):
    builder = bodies()
    hinge = builder.add_joint(Hinge(parent=0, child=1, anchor=(0, 1, 0), axis=(0, 0, 1)), name="latch")
    builder.add_motor(hinge if joint is None else joint, **arguments)


def link(kind, **arguments):
    builder = bodies()
    return builder, builder.add_joint(kind(**{"parent": 0, "child": 1, "anchor": (0, 2, 0), **arguments}), name="tie")


def drive(joint_kind, joint, **arguments):
    builder, handle = link(joint_kind, **joint)
    builder.add_motor(handle, **arguments)


def built(motors=1):
    builder = bodies()
    hinge = builder.add_joint(Hinge(parent=0, child=1, anchor=(0, 1, 0), axis=(0, 0, 1)))
    for _ in range(motors):
        builder.add_motor(hinge)
    return builder.build(Options())


def repeated_name():
    builder = bodies()
    builder.add_body(Sphere(0.1), mass=1.0, name="door")


def repeated_joint_name():
    builder = bodies()
    for _ in range(2):
        builder.add_joint(Hinge(parent=0, child=1, anchor=(0, 1, 0), axis=(0, 0, 1)), name="latch")


def join_static():
    builder = bodies()
    wall = builder.add_body(Box((0.1, 0.1, 0.1)), static=True)
    builder.add_joint(Hinge(parent=0, child=wall, anchor=(0, 1, 0), axis=(0, 0, 1)))


BAD = {
    # shapes
    "sphere, negative radius": (lambda: Sphere(-0.1), ["Sphere", "radius"]),
    "sphere, zero radius": (lambda: Sphere(0.0), ["Sphere", "radius"]),
    "sphere, NaN radius": (lambda: Sphere(NAN), ["Sphere", "radius"]),
    "sphere, infinite radius": (lambda: Sphere(INFINITY), ["Sphere", "radius"]),
    "sphere, vector radius": (lambda: Sphere((0.1, 0.2)), ["Sphere", "radius"]),
    "box, two extents": (lambda: Box((0.1, 0.1)), ["Box", "half_extents"]),
    "box, zero extent": (lambda: Box((0.1, 0.0, 0.1)), ["Box", "half_extents"]),
    "box, negative extent": (lambda: Box((0.1, -0.1, 0.1)), ["Box", "half_extents"]),
    "box, NaN extent": (lambda: Box((0.1, NAN, 0.1)), ["Box", "half_extents"]),
    "capsule, negative radius": (lambda: Capsule(-0.1, 0.2), ["Capsule", "radius"]),
    "capsule, negative half height": (lambda: Capsule(0.1, -0.2), ["Capsule", "half_height"]),
    "capsule, NaN half height": (lambda: Capsule(0.1, NAN), ["Capsule", "half_height"]),
    "plane, zero normal": (lambda: Plane(normal=(0, 0, 0), offset=0.0), ["Plane", "normal"]),
    "plane, two components": (lambda: Plane(normal=(0, 1), offset=0.0), ["Plane", "normal"]),
    "plane, NaN normal": (lambda: Plane(normal=(0, NAN, 0), offset=0.0), ["Plane", "normal"]),
    "plane, NaN offset": (lambda: Plane(normal=(0, 1, 0), offset=NAN), ["Plane", "offset"]),
    # scene
    "gravity, two components": (lambda: SceneBuilder(gravity=(0, -9.8)), ["gravity"]),
    "gravity, NaN": (lambda: SceneBuilder(gravity=(0, NAN, 0)), ["gravity"]),
    "nothing to simulate": (lambda: SceneBuilder().build(Options()), ["body|bodies"]),
    "options of another kind": (lambda: bodies().build({"dt": 0.01}), ["options|Options"]),
    # bodies
    "shape of another kind": (lambda: add("cube"), ["crate", "shape"]),
    "mass, negative": (lambda: add(mass=-1.0), ["crate", "mass"]),
    "mass, zero": (lambda: add(mass=0.0), ["crate", "mass"]),
    "mass, NaN": (lambda: add(mass=NAN), ["crate", "mass"]),
    "mass, infinite": (lambda: add(mass=INFINITY), ["crate", "mass"]),
    "mass, vector": (lambda: add(mass=(1.0, 2.0)), ["crate", "mass"]),
    "mass, text": (lambda: add(mass="heavy"), ["crate", "mass"]),
    "density, negative": (lambda: add(mass=None, density=-1.0), ["crate", "density"]),
    "density, NaN": (lambda: add(mass=None, density=NAN), ["crate", "density"]),
    "mass and density": (lambda: add(density=1.0), ["crate", "mass", "density"]),
    "moving body without mass": (lambda: add(mass=None), ["crate", "mass", "density"]),
    "plane that is not static": (lambda: add(Plane(normal=(0, 1, 0), offset=0.0)), ["crate", "static"]),
    "position, two components": (lambda: add(position=(0, 0)), ["crate", "position"]),
    "position, NaN": (lambda: add(position=(0, NAN, 0)), ["crate", "position"]),
    "position, text": (lambda: add(position="here"), ["crate", "position"]),
    "orientation, three components": (lambda: add(orientation=(1, 0, 0)), ["crate", "orientation"]),
    "orientation, zero": (lambda: add(orientation=(0, 0, 0, 0)), ["crate", "orientation"]),
    "orientation, NaN": (lambda: add(orientation=(NAN, 0, 0, 1)), ["crate", "orientation"]),
    "velocity, scalar": (lambda: add(velocity=1.0), ["crate", "velocity"]),
    "velocity, infinite": (lambda: add(velocity=(INFINITY, 0, 0)), ["crate", "velocity"]),
    "angular velocity, four components": (lambda: add(angular_velocity=(0, 0, 0, 1)), ["crate", "angular_velocity"]),
    "angular velocity, NaN": (lambda: add(angular_velocity=(0, NAN, 0)), ["crate", "angular_velocity"]),
    "restitution above 1": (lambda: add(restitution=1.1), ["crate", "restitution"]),
    "restitution below 0": (lambda: add(restitution=-0.1), ["crate", "restitution"]),
    "restitution, NaN": (lambda: add(restitution=NAN), ["crate", "restitution"]),
    "friction below 0": (lambda: add(friction=-0.1), ["crate", "friction"]),
    "friction, NaN": (lambda: add(friction=NAN), ["crate", "friction"]),
    "friction, infinite": (lambda: add(friction=INFINITY), ["crate", "friction"]),
    "body name used twice": (repeated_name, ["door", "name"]),
    # joints
    "parent out of range": (lambda: join(parent=7), ["parent", "7"]),
    "parent negative": (lambda: join(parent=-1), ["parent", "-1"]),
    "parent of an unknown name": (lambda: join(parent="wall"), ["parent", "wall", "ground|door"]),
    "child out of range": (lambda: join(child=7), ["child", "7"]),
    "child of an unknown name": (lambda: join(Slider, child="wall"), ["child", "wall"]),
    "parent is child": (lambda: join(parent=1), ["parent", "child"]),
    "two static bodies": (join_static, ["static"]),
    "axis, zero": (lambda: join(axis=(0, 0, 0)), ["axis"]),
    "axis, two components": (lambda: join(Slider, axis=(0, 1)), ["axis"]),
    "axis, NaN": (lambda: join(axis=(0, 0, NAN)), ["axis"]),
    "anchor, NaN": (lambda: join(anchor=(NAN, 0, 0)), ["anchor"]),
    "anchor, scalar": (lambda: join(anchor=1.0), ["anchor"]),
    "limits reversed": (lambda: join(limits=(1.0, -1.0)), ["limit"]),
    "limits, one": (lambda: join(limits=(1.0,)), ["limits"]),
    "limits, NaN": (lambda: join(Slider, limits=(NAN, 1.0)), ["limits"]),
    "damping, negative": (lambda: join(damping=-0.1), ["damping"]),
    "damping, NaN": (lambda: join(Slider, damping=NAN), ["damping"]),
    "joint of another kind": (lambda: bodies().add_joint("hinge"), ["joint"]),
    "joint name used twice": (repeated_joint_name, ["latch", "name"]),
    "friction of a joint, negative": (lambda: join(friction=-0.1), ["joint0", "friction"]),
    "friction of a joint, NaN": (lambda: link(BallAndSocket, friction=NAN), ["tie", "friction"]),
    "stiffness, negative": (lambda: join(stiffness=-0.1), ["joint0", "stiffness"]),
    "stiffness, infinite": (lambda: link(Distance, lengths=(0, 2), stiffness=INFINITY), ["tie", "stiffness"]),
    "rest, NaN": (lambda: join(stiffness=1.0, rest=NAN), ["rest"]),
    "rest of a spring, text": (lambda: link(Distance, lengths=(0, 2), rest="long"), ["tie", "rest"]),
    "armature, negative": (lambda: join(Slider, armature=-1.0), ["armature"]),
    "damping of a ball, negative": (lambda: link(BallAndSocket, damping=-1.0), ["tie", "damping"]),
    "limits beyond a turn": (lambda: join(limits=(-4.0, 1.0)), ["limits", "pi"]),
    "limits equal, with friction": (lambda: join(limits=(0.5, 0.5), friction=1.0), ["friction", "limits"]),
    "swing, negative": (lambda: link(BallAndSocket, axis=(0, 1, 0), swing=-0.1), ["tie", "swing"]),
    "swing beyond half a turn": (lambda: link(BallAndSocket, axis=(0, 1, 0), swing=3.2), ["tie", "swing"]),
    "swing without axis": (lambda: link(BallAndSocket, swing=0.5), ["tie", "swing", "axis"]),
    "twist without axis": (lambda: link(BallAndSocket, twist=(-1, 1)), ["tie", "twist", "axis"]),
    "twist reversed": (lambda: link(BallAndSocket, axis=(0, 1, 0), twist=(1, -1)), ["tie", "twist", "swap"]),
    "axis of a ball, zero": (lambda: link(BallAndSocket, axis=(0, 0, 0), swing=0.5), ["tie", "axis"]),
    "anchor of a ball, two points": (lambda: link(BallAndSocket, anchor=((0, 1, 0), (0, 2, 0))), ["tie", "anchor"]),
    "anchor of a ball, none": (lambda: link(BallAndSocket, anchor=None), ["tie", "anchor"]),
    "anchor of a weld, NaN": (lambda: link(Fixed, anchor=(0, NAN, 0)), ["tie", "anchor"]),
    "anchor of a rod, none": (lambda: link(Distance, anchor=None), ["tie", "anchor"]),
    "child anchor of a rod, two components": (lambda: link(Distance, child_anchor=(0, 1)), ["tie", "child_anchor"]),
    "rod between equal points": (lambda: link(Distance, anchor=(0, 1, 0)), ["tie", "length", "BallAndSocket"]),
    "lengths reversed": (lambda: link(Distance, lengths=(2.0, 1.0)), ["tie", "lengths", "swap"]),
    "lengths negative": (lambda: link(Distance, lengths=(-1.0, 1.0)), ["tie", "lengths", "negative"]),
    "length zero": (lambda: link(Distance, lengths=0.0), ["tie", "length"]),
    "length NaN": (lambda: link(Distance, lengths=NAN), ["tie", "lengths"]),
    "rod with a spring": (lambda: link(Distance, stiffness=1.0), ["tie", "stiffness", "limits"]),
    # motors
    "motor on a ball": (lambda: drive(BallAndSocket, {}), ["tie", "BallAndSocket", "driven"]),
    "motor on a weld": (lambda: drive(Fixed, {}), ["tie", "Fixed", "driven"]),
    "motor on a rod": (lambda: drive(Distance, {}), ["tie", "Distance", "driven"]),
    "cap, negative": (lambda: motor(kind="velocity", cap=-1.0), ["cap"]),
    "cap, zero": (lambda: motor(kind="velocity", cap=0.0), ["cap"]),
    "cap, NaN": (lambda: motor(kind="position", stiffness=1.0, cap=NAN), ["cap"]),
    "cap of a torque motor": (lambda: motor(cap=1.0), ["cap", "velocity", "position"]),
    "position motor without stiffness": (lambda: motor(kind="position"), ["stiffness"]),
    "stiffness of a motor, negative": (lambda: motor(kind="position", stiffness=-1.0), ["stiffness"]),
    "damping of a motor, negative": (lambda: motor(kind="position", stiffness=1.0, damping=-1.0), ["damping"]),
    "stiffness of a torque motor": (lambda: motor(stiffness=1.0), ["stiffness", "position"]),
    "damping of a velocity motor": (lambda: motor(kind="velocity", damping=1.0), ["damping", "position"]),
    "joint out of range": (lambda: motor(joint=5), ["joint", "5"]),
    "joint of an unknown name": (lambda: motor(joint="knee"), ["joint", "knee"]),
    "kind unknown": (lambda: motor(kind="steam"), ["kind", "steam", "torque"]),
    "limit, zero": (lambda: motor(limit=0.0), ["limit"]),
    "limit, negative": (lambda: motor(limit=-1.0), ["limit"]),
    "limit, NaN": (lambda: motor(limit=NAN), ["limit"]),
    "gear, NaN": (lambda: motor(gear=NAN), ["gear"]),
    # options
    "dt, zero": (lambda: Options(dt=0.0), ["dt"]),
    "dt, negative": (lambda: Options(dt=-0.1), ["dt"]),
    "dt, NaN": (lambda: Options(dt=NAN), ["dt"]),
    "velocity iterations, zero": (lambda: Options(velocity_iterations=0), ["velocity_iterations"]),
    "velocity iterations, fraction": (lambda: Options(velocity_iterations=1.5), ["velocity_iterations"]),
    "position iterations, negative": (lambda: Options(position_iterations=-1), ["position_iterations"]),
    "linear damping, negative": (lambda: Options(linear_damping=-0.1), ["linear_damping"]),
    "angular damping, NaN": (lambda: Options(angular_damping=NAN), ["angular_damping"]),
    "slop, negative": (lambda: Options(slop=-0.1), ["slop"]),
    "position percent above 1": (lambda: Options(position_percent=1.5), ["position_percent"]),
    "baumgarte, negative": (lambda: Options(baumgarte=-0.1), ["baumgarte"]),
    "warm start, text": (lambda: Options(warm_start="yes"), ["warm_start"]),
    # running
    "action of the wrong size": (lambda: step(*built(), jnp.zeros(3)), ["action", "1", "3"]),
    "action, scalar": (lambda: step(*built(), jnp.zeros(())), ["action"]),
    "action without motors": (lambda: step(*built(0), jnp.zeros(1)), ["action", "motor"]),
    "actions of the wrong size": (lambda: rollout(*built(), jnp.zeros((5, 3))), ["action", "1", "3"]),
    "step count, negative": (lambda: rollout(*built(), -1), ["step|actions"]),
    "force on an unknown body": (lambda: apply_force(built()[1], 9, jnp.zeros(3)), ["body", "9"]),
    "force, two components": (lambda: apply_force(built()[1], 1, jnp.zeros(2)), ["force", "3"]),
    "point, two components": (lambda: apply_force(built()[1], 1, jnp.zeros(3), jnp.zeros(2)), ["point", "3"]),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_named(name):
    action, words = BAD[name]
    with pytest.raises(ValueError) as caught:
        action()
    message = str(caught.value)
    for word in words:
        assert re.search(word, message), f"{word!r} is missing from {message!r}"
    assert len(message.splitlines()) <= 3


def test_unnamed_body_is_named_by_its_number():
    builder = bodies()
    with pytest.raises(ValueError, match=r"2.*mass|mass.*2"):
        builder.add_body(Sphere(0.1), mass=-1.0)


def test_names_work_as_handles():
    builder = bodies()
    builder.add_joint(Hinge(parent="ground", child="door", anchor=(0, 1, 0), axis=(0, 0, 1)), name="latch")
    builder.add_motor("latch")
    model, state = builder.build(Options())
    step(model, state, jnp.zeros(1))


def test_good_input_of_every_numeric_kind_is_accepted():
    builder = SceneBuilder(gravity=np.array([0.0, -9.8, 0.0]))
    builder.add_body(Sphere(np.float32(0.1)), mass=1, position=[0, 1, 0], orientation=np.array([2.0, 0, 0, 0]))
    builder.add_body(Box(np.array([0.1, 0.2, 0.3])), density=np.float64(500.0), position=jnp.array([2.0, 1.0, 0.0]))
    _, state = builder.build(Options(dt=np.float64(0.01)))
    assert state.orientation.shape == (2, 4)
    assert abs(float(jnp.linalg.norm(state.orientation[0])) - 1.0) < 1e-6
