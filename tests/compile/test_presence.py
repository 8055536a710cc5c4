"""A scene pays only for what it has: absent features leave no trace in the program (benchmark M1).

Two independent kinds of evidence. Size: the number of operations of the lowered program. Influence: a parameter whose
value may be NaN without any effect cannot be part of the program.
"""

import collections
import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, Plane, SceneBuilder, Slider, Sphere, contacts, step
from tests.scenes import box_stack, slab_on_plane, sphere_on_plane, undamped


def operations(function, *arguments):
    """Multiset of the StableHLO operations of the lowered program."""
    text = jax.jit(function).lower(*arguments).as_text()
    return collections.Counter(re.findall(r"(?:stablehlo|chlo)\.([a-z_]+)", text))


def size(function, *arguments):
    ignored = {"constant", "reshape", "broadcast_in_dim", "slice", "concatenate", "convert", "transpose", "return"}
    return sum(count for name, count in operations(function, *arguments).items() if name not in ignored)


def free_sphere(**_):
    builder = SceneBuilder()
    builder.add_body(Sphere(0.1), mass=1.0)
    return builder.build(undamped())


def spheres(friction=0.0, restitution=0.0):
    builder = SceneBuilder()
    surface = {"friction": friction, "restitution": restitution}
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, **surface)
    for index in range(2):
        builder.add_body(Sphere(0.1), mass=1.0, position=(0.15 * index, 0.1, 0.0), **surface)
    return builder.build(undamped())


def boxes(joint=None, limits=None, damping=0.0, motor=False):
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    for index in range(2):
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(index, 0.1, 0.0))
    post = builder.add_body(Sphere(0.02), static=True, position=(9.0, 9.0, 0.0))
    if joint:
        kind = "torque" if joint is Hinge else "force"
        handle = builder.add_joint(
            joint(parent=post, child=2, anchor=(1.5, 0.1, 0), axis=(0, 0, 1), limits=limits, damping=damping)
        )
        if motor:
            builder.add_motor(handle, kind=kind)
    return builder.build(undamped())


LADDER = {
    "S0 free body": free_sphere,
    "S1 frictionless spheres": spheres,
    "S2 friction": lambda: spheres(friction=0.5),
    "S3 restitution": lambda: spheres(friction=0.5, restitution=0.5),
    "S4 boxes": boxes,
    "S5 hinge": lambda: boxes(Hinge),
    "S6 limits": lambda: boxes(Hinge, limits=(-1, 1)),
}


def test_program_grows_with_the_scene():
    sizes = {name: size(step, *build()) for name, build in LADDER.items()}
    values = list(sizes.values())
    assert values[0] < values[1] < values[2] <= values[3] < values[4] < values[5] < values[6], sizes


@pytest.mark.slow
def test_gradient_program_grows_with_the_scene():
    """What is absent from the step is absent from its derivative."""

    def loss(model, state):
        return jnp.sum(step(model, state).position)

    gradient = jax.grad(loss, argnums=(0, 1), allow_int=True)
    sizes = {name: size(gradient, *build()) for name, build in list(LADDER.items())[:5]}
    values = list(sizes.values())
    assert values[0] < values[1] < values[2] <= values[3] < values[4], sizes


@pytest.mark.parametrize(
    ("smaller", "larger"),
    [
        ({"joint": Hinge}, {"joint": Hinge, "limits": (-1, 1)}),
        ({"joint": Slider}, {"joint": Slider, "limits": (-1, 1)}),
        ({"joint": Hinge}, {"joint": Hinge, "damping": 0.1}),
        ({"joint": Hinge}, {"joint": Hinge, "motor": True}),
    ],
)
def test_parts_of_a_joint_are_absent_unless_asked_for(smaller, larger):
    sizes = []
    for arguments in (smaller, larger):
        model, state = boxes(**arguments)
        action = jnp.zeros(1) if arguments.get("motor") else None
        sizes.append(size(step, model, state, action))
    assert sizes[0] < sizes[1]


def test_free_body_has_no_collision_and_no_solver():
    assert "while" not in operations(step, *free_sphere())
    assert jax.tree.leaves(contacts(*free_sphere()))[0].shape[0] == 0


def same_bits(first, second):
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("leaf", ["friction", "restitution"])
def test_absent_surface_property_has_no_influence(leaf):
    model, state = spheres()
    poisoned = dataclasses.replace(model, **{leaf: jnp.full_like(getattr(model, leaf), jnp.nan)})
    same_bits(step(model, state), step(poisoned, state))


def test_unused_parameters_have_zero_gradient_however_bad():
    model, state = spheres()
    poisoned = dataclasses.replace(model, friction=jnp.full_like(model.friction, jnp.nan))
    gradient = jax.grad(lambda m: jnp.sum(step(m, state).position))(poisoned)
    assert not np.any(np.asarray(gradient.friction))
    assert np.all(np.isfinite(np.asarray(gradient.mass)))


def test_collision_of_spheres_uses_no_orientation():
    """No quaternion algebra: an orientation of NaN does not show, and no product of its size is in the program."""
    model, state = spheres(friction=0.5)
    poisoned = dataclasses.replace(state, orientation=jnp.full_like(state.orientation, jnp.nan))
    same_bits(contacts(model, state), contacts(model, poisoned))
    names = set(operations(contacts, model, state))
    assert not names & {"sine", "cosine", "tan", "atan2", "dot_general", "while", "case", "if"}, names
    box_model, box_state = boxes()
    assert size(contacts, model, state) < 0.2 * size(contacts, box_model, box_state)


def test_orientation_shows_in_the_collision_of_boxes():
    """The counter-test of the one above: it can fail."""
    model, state = boxes()
    poisoned = dataclasses.replace(state, orientation=jnp.full_like(state.orientation, jnp.nan))
    assert not np.all(np.isfinite(np.asarray(contacts(model, poisoned).separation)))


def test_frictionless_scene_has_no_tangent_rows():
    """Pushed along the plane with all else equal, the frictionless program holds fewer operations of every kind."""
    without, with_friction = (operations(step, *spheres(friction=mu)) for mu in (0.0, 0.5))
    for name in ("multiply", "add", "divide", "select"):
        assert without[name] <= with_friction[name], name
    assert without["multiply"] < 0.8 * with_friction["multiply"]


def test_jointless_scene_has_no_joint_data_and_ignores_it():
    model, state = boxes()
    for field in dataclasses.fields(model):
        if field.name.startswith(("joint", "motor")):
            assert getattr(model, field.name).size == 0, field.name
    for field in dataclasses.fields(state):
        if field.name.startswith("joint"):
            assert getattr(state, field.name).size == 0, field.name


def test_contact_slots_come_from_admissible_pairs():
    """Static-static and jointed pairs have no slot."""
    plain = contacts(*boxes()).separation.shape[0]
    builder = SceneBuilder()
    for index in range(3):
        builder.add_body(Box((0.1, 0.1, 0.1)), static=True, position=(index, 0, 0))
    builder.add_body(Sphere(0.1), mass=1.0, position=(0, 5, 0))
    assert contacts(*builder.build(undamped())).separation.shape[0] == 3
    assert plain == 2 * 4 + 4 + 2  # two boxes on the plane, with one another, and with the small static sphere


def counted(function):
    """The function behind jit, and a list that grows by one with every trace of it."""
    traces = []

    def traced(*arguments):
        traces.append(None)
        return function(*arguments)

    return jax.jit(traced), traces


def test_equal_scenes_compile_once():
    compiled, traces = counted(step)
    for _ in range(3):
        compiled(*slab_on_plane())
    assert len(traces) == 1
    compiled(*sphere_on_plane())
    assert len(traces) == 2
    assert slab_on_plane()[0].scene == slab_on_plane()[0].scene
    assert hash(slab_on_plane()[0].scene) == hash(slab_on_plane()[0].scene)
    assert slab_on_plane()[0].scene != sphere_on_plane()[0].scene


@pytest.mark.parametrize(
    "change",
    [
        {"friction": 0.3},
        {"mass": 3.0},
        {"gravity": (0, -1.6, 0)},
        {"position": (0, 0.3, 0), "velocity": (1, 0, 0)},
        {"options": undamped(dt=1 / 500)},
    ],
    ids=lambda change: ", ".join(change),
)
def test_scenes_that_differ_in_numbers_only_share_the_program(change):
    compiled, traces = counted(step)
    compiled(*slab_on_plane())
    compiled(*slab_on_plane(**change))
    assert len(traces) == 1


def test_traced_parameters_never_recompile():
    compiled, traces = counted(step)
    model, state = boxes(Hinge, limits=(-1, 1), damping=0.1, motor=True)
    compiled(model, state, jnp.zeros(1))
    for path, leaf in jax.tree_util.tree_leaves_with_path(model):
        changed = jax.tree_util.tree_map_with_path(lambda p, x, path=path: 1.01 * x if p == path else x, model)
        compiled(changed, state, jnp.ones(1))
        assert len(traces) == 1, f"changing {jax.tree_util.keystr(path)} {leaf.shape} traced again"


def test_size_of_a_shape_is_traced():
    compiled, traces = counted(step)
    for radius in (0.1, 0.2):
        builder = SceneBuilder()
        builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
        builder.add_body(Sphere(radius), mass=1.0, position=(0, 1, 0))
        compiled(*builder.build(undamped()))
    assert len(traces) == 1


def test_nothing_long_is_worked_out_element_by_element():
    """A kernel that joins arrays branches for each element and runs side by side for no two worlds: it has to be short."""
    builder = SceneBuilder()
    builder.add_body(Box((0.1, 0.2, 0.3)), mass=1.0)
    model, state = builder.build(undamped())
    worlds = jax.tree.map(lambda x: jnp.broadcast_to(x, (64, *x.shape)), state)
    program = jax.jit(jax.vmap(step, in_axes=(None, 0))).lower(model, worlds).compile().as_text()
    joining = [
        kernel for kernel in program.split("\n\n") if "fused_computation" in kernel and " concatenate(" in kernel
    ]
    assert joining
    assert max(kernel.count("\n") for kernel in joining) < 100  # 276 where the angular velocity was not stored first


def test_a_gradient_sums_nothing_by_the_library():
    """The transpose of an ordinary broadcast is a reduction, which took a seventh of the time of a stack's gradient."""
    model, state = box_stack(2, options=undamped())

    def loss(velocity):
        return jnp.sum(step(model, dataclasses.replace(state, velocity=velocity)).position)

    velocity = jnp.zeros((16, *state.velocity.shape))
    text = jax.jit(jax.vmap(jax.grad(loss))).lower(velocity).as_text()
    found = re.findall(r"applies stablehlo\.add across dimensions = \[([\d, ]+)\] : \(tensor<([\dx]+)xf32>", text)
    sums = [
        (axes, shape) for axes, shape in found if any(shape.split("x")[int(axis)] != "1" for axis in axes.split(","))
    ]
    assert found, "the form of the program has changed"
    assert not sums
