"""`Model` and `State` are plain pytrees; forces accumulate and clear; nothing assumes an up axis."""

import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Hinge, Options, Plane, SceneBuilder, Sphere, apply_force, rollout, step
from tests.scenes import (
    advance,
    axis_angle,
    quaternion_product,
    rotation_matrix,
    slab_on_plane,
    sphere_on_plane,
    undamped,
)


def free_box(**body):
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Box((0.1, 0.2, 0.3)), mass=2.0, **body)
    return builder.build(undamped(dt=0.01))


@pytest.mark.parametrize("solver", ["pgs", "soft_step", "converged"])
def test_no_two_leaves_share_a_buffer(solver):
    """Or the first state could not be donated (`jax.jit(step, donate_argnums=1)`)."""
    _, state = slab_on_plane(options=undamped(solver=solver, sleep=True))
    leaves = [leaf for leaf in jax.tree.leaves(state) if leaf.size]
    assert len({leaf.unsafe_buffer_pointer() for leaf in leaves}) == len(leaves)


def test_shapes_and_types(precision):
    model, state = slab_on_plane()
    shapes = {"position": (2, 3), "orientation": (2, 4), "velocity": (2, 3), "angular_velocity": (2, 3), "flags": ()}
    for name, shape in shapes.items():
        assert getattr(state, name).shape == shape
    assert jnp.issubdtype(state.flags.dtype, jnp.integer)
    assert state.position.dtype == jnp.dtype(precision)
    assert model.dt.shape == () and model.gravity.shape == (3,)
    for name, shape in {"mass": (2,), "inertia": (2, 3), "friction": (2,), "restitution": (2,)}.items():
        assert getattr(model, name).shape == shape
    for leaf in jax.tree.leaves(model):
        assert leaf.dtype == jnp.dtype(precision), "every leaf of the model is a float and differentiable"


def test_step_keeps_structure_shapes_and_types(precision):
    model, state = slab_on_plane()
    following = step(model, state)
    assert jax.tree.structure(following) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(following), jax.tree.leaves(state), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype


def test_step_does_not_change_its_input():
    model, state = sphere_on_plane(height=0.5)
    before = copy.deepcopy(jax.tree.map(np.asarray, state))
    step(model, state)
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(a, b)


def test_replace_and_immutability():
    _, state = sphere_on_plane(height=0.5)
    moved = dataclasses.replace(state, velocity=state.velocity.at[1].set(jnp.array([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(moved.velocity[1], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(state.velocity[1], [0.0, 0.0, 0.0])
    with pytest.raises(dataclasses.FrozenInstanceError):
        state.velocity = moved.velocity


def test_pytrees_survive_flatten_pickle_and_map():
    model, state = slab_on_plane()
    for tree in (model, state):
        leaves, structure = jax.tree.flatten(tree)
        again = jax.tree.unflatten(structure, leaves)
        assert jax.tree.structure(again) == structure
        loaded = pickle.loads(pickle.dumps(tree))
        assert jax.tree.structure(loaded) == structure
        for a, b in zip(jax.tree.leaves(loaded), leaves, strict=True):
            np.testing.assert_array_equal(a, b)
    doubled = jax.tree.map(lambda leaf: 2 * leaf, model)
    assert doubled.scene == model.scene and float(doubled.mass[1]) == 2 * float(model.mass[1])


def test_names_shapes_and_frame_of_the_scene():
    """The renderer's view: which shape belongs to which body, with its size."""
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 2, 0), offset=1.0), static=True)
    builder.add_body(Box((0.1, 0.2, 0.3)), mass=1.0, position=(0, 2, 0))
    builder.add_body(Sphere(0.4), mass=1.0, position=(2, 2, 0))
    builder.add_body(Capsule(0.1, 0.25), mass=1.0, position=(4, 2, 0))
    model, _ = builder.build(Options())
    found = {(entry.kind, entry.body): entry.index for entry in model.scene.shapes}
    assert set(found) == {("plane", 0), ("box", 1), ("sphere", 2), ("capsule", 3)}
    np.testing.assert_allclose(model.shapes["box"]["half_extents"][found["box", 1]], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(model.shapes["sphere"]["radius"][found["sphere", 2]], 0.4, rtol=1e-6)
    np.testing.assert_allclose(model.shapes["capsule"]["half_height"][found["capsule", 3]], 0.25, rtol=1e-6)
    np.testing.assert_allclose(model.shapes["plane"]["normal"][found["plane", 0]], [0, 1, 0], rtol=1e-6)
    hash(model.scene)


def test_density_gives_mass_and_inertia(precision, gate):
    builder = SceneBuilder()
    builder.add_body(Box((0.1, 0.2, 0.3)), density=500.0)
    builder.add_body(Sphere(0.2), density=1000.0, position=(2, 0, 0))
    model, _ = builder.build(Options())
    box_mass, ball_mass = 500 * 8 * 0.1 * 0.2 * 0.3, 1000 * 4 / 3 * np.pi * 0.2**3
    gate("mass / truth - 1", np.asarray(model.mass) / [box_mass, ball_mass] - 1, 1e-6)
    gate("sphere inertia / truth - 1", np.asarray(model.inertia[1]) / (0.4 * ball_mass * 0.04) - 1, 1e-6)
    truth = np.sort(box_mass / 3 * np.array([0.13, 0.10, 0.05]))
    gate("box inertia / truth - 1", np.sort(model.inertia[0]) / truth - 1, 1e-6)


def test_applied_force_accumulates_acts_once_and_clears(precision, gate):
    model, state = free_box()
    pushed = apply_force(state, 0, jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3))
    pushed = apply_force(pushed, 0, jnp.array([2.0, 4.0, 0.0]), jnp.zeros(3))
    first = step(model, pushed)
    gate("velocity after the push [m/s]", first.velocity[0] - jnp.array([0.015, 0.02, 0.0]), 1e-8)
    second = step(model, first)
    gate("velocity one step later [m/s]", second.velocity[0] - first.velocity[0], 1e-9)
    np.testing.assert_array_equal(state.velocity, np.zeros((1, 3)))


def test_force_off_centre_turns_the_body(precision, gate):
    """r x F about each axis: the angular velocity after one short step is I^-1 (r x F) dt."""
    center, inertia = np.array([1.0, 2.0, 3.0]), 2.0 / 3 * np.array([0.13, 0.10, 0.05])
    model, state = free_box(position=center)
    force, lever = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.3])
    final = step(model, apply_force(state, 0, jnp.asarray(force), jnp.asarray(center + lever)))
    gate("angular velocity / truth", final.angular_velocity[0] - np.cross(lever, force) / inertia * 0.01, 1e-5)
    gate("velocity [m/s]", final.velocity[0] - force / 2.0 * 0.01, 1e-7)
    at_center = step(model, apply_force(state, 0, jnp.asarray(force), jnp.asarray(center)))
    gate("angular velocity of a central push", at_center.angular_velocity[0], 1e-7)


def test_constant_applied_force_gives_the_parabola(float64, gate):
    model, state = free_box()

    def body(current, _):
        return step(model, apply_force(current, 0, jnp.array([3.0, 0.0, 0.0]), current.position[0])), None

    final, _ = jax.jit(lambda s: jax.lax.scan(body, s, None, length=100))(state)
    gate("position [m]", final.position[0, 0] - 0.5 * 1.5 * 1.0, 1e-10)


def test_static_bodies_never_move():
    model, state = slab_on_plane(velocity=(1.0, -3.0, 0.0))
    final = advance(model, apply_force(state, 0, jnp.array([9.0, 9.0, 9.0]), jnp.array([1.0, 0.0, 0.0])), 30)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        np.testing.assert_array_equal(getattr(final, name)[0], getattr(state, name)[0])


def test_same_inputs_give_the_same_bits():
    model, state = slab_on_plane(velocity=(1.0, 0.0, 0.5))
    first, second = advance(model, state, 50), advance(model, state, 50)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


def test_rollout_counts_and_records():
    model, state = sphere_on_plane(height=0.5)
    final, trajectory = rollout(model, state, 7)
    assert trajectory.position.shape == (7, 2, 3) and trajectory.flags.shape == (7,)
    np.testing.assert_array_equal(trajectory.position[-1], final.position)
    np.testing.assert_array_equal(trajectory.position[0], step(model, state).position)
    same, empty = rollout(model, state, 0)
    np.testing.assert_array_equal(same.position, state.position)
    assert empty.position.shape == (0, 2, 3)


TURNS = {
    "Z up": axis_angle((1, 0, 0), np.pi / 2),
    "X up": axis_angle((0, 0, 1), -np.pi / 2),
    "oblique": axis_angle((1.0, 2.0, -0.5), 1.1),
}


def turned_scene(turn):
    """A ball, a box and a capsule thrown on the ground, and a hinged arm, all turned as a whole by `turn`."""
    rotation = rotation_matrix(turn)

    def place(vector):
        return rotation @ np.asarray(vector, dtype=float)

    builder = SceneBuilder(gravity=place((0.0, -9.81, 0.0)))
    ground = builder.add_body(Plane(normal=place((0, 1, 0)), offset=0.0), static=True, restitution=0.3)
    for index, shape in enumerate((Sphere(0.1), Box((0.1, 0.15, 0.2)), Capsule(0.1, 0.15))):
        own = axis_angle((1.0, 0.3 * index, 0.5), 0.4 + index)
        builder.add_body(
            shape,
            mass=1.0,
            position=place((index * 0.8, 0.4, 0.0)),
            orientation=quaternion_product(turn, own),
            velocity=place((1.0, -1.0, 0.3 * index)),
            angular_velocity=place((0.5, 1.0, -2.0)),
            restitution=0.3,
        )
    arm = builder.add_body(Box((0.2, 0.03, 0.03)), mass=0.5, position=place((-2.0, 2.0, 0.0)), orientation=turn)
    builder.add_joint(Hinge(parent=ground, child=arm, anchor=place((-2.2, 2.0, 0.0)), axis=place((0, 0, 1))))
    return builder.build(undamped(dt=1 / 240, velocity_iterations=100))


@pytest.mark.parametrize("name", TURNS)
def test_nothing_assumes_an_up_axis(float64, name, gate):
    """Turning the whole scene, gravity included, turns the result. Short enough that no bounce amplifies round-off."""
    rotation = rotation_matrix(TURNS[name])
    upright = advance(*turned_scene(np.array([1.0, 0.0, 0.0, 0.0])), 100)
    turned = advance(*turned_scene(TURNS[name]), 100)
    for leaf in ("position", "velocity", "angular_velocity"):
        gate(leaf, (np.asarray(getattr(turned, leaf)) - np.asarray(getattr(upright, leaf)) @ rotation.T)[1:], 1e-6)
    difference = rotation_matrix(turned.orientation) - rotation @ rotation_matrix(upright.orientation)
    gate("orientation", difference[1:], 1e-6)
    assert float(np.abs(np.asarray(upright.velocity)[1:4, 1]).max()) < 3.0  # they did reach the ground and were stopped


def replaced(owner, name, value):
    model, state = slab_on_plane()
    if owner == "model":
        return dataclasses.replace(model, **{name: value}), state
    return model, dataclasses.replace(state, **{name: value})


@pytest.mark.parametrize(("owner", "name", "value", "message"), [
    ("model", "mass", jnp.ones(3), r"model\.mass must have shape \(2,\) for this model, got \(3,\)"),
    ("model", "friction", 0.5, r"model\.friction must have shape \(2,\) for this model, got \(\)"),
    ("model", "gravity", jnp.zeros(2), r"model\.gravity must have shape \(3,\)"),
    ("state", "orientation", jnp.ones((2, 3)), r"state\.orientation must have shape \(2, 4\)"),
    ("state", "velocity", jnp.ones((5, 2, 3)), r"state\.velocity must have shape \(2, 3\) .* use jax\.vmap"),
    ("state", "position", jnp.ones((2, 3), int), r"state\.position must be floating point, got int"),
])  # fmt: skip
def test_leaves_that_do_not_fit_are_named(owner, name, value, message):
    for function in (step, lambda *arguments: rollout(*arguments, 2)):
        with pytest.raises(ValueError, match=message):
            function(*replaced(owner, name, value))


def test_model_and_state_in_the_wrong_order():
    model, state = slab_on_plane()
    with pytest.raises(ValueError, match="expected a Model and a State, in this order, got State and Model"):
        step(state, model)


def test_forces_on_a_batch_or_on_no_body_are_refused():
    _, state = slab_on_plane()
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), state)
    with pytest.raises(ValueError, match=r"apply_force: state\.position must have shape .* use jax\.vmap"):
        apply_force(batch, 1, jnp.ones(3))
    for body in ("slab", 1.0, 2, -1):
        with pytest.raises(ValueError, match="apply_force: body must lie between 0 and 1"):
            apply_force(state, body, jnp.ones(3))


def test_a_traced_handle():
    _, state = slab_on_plane()
    pushed = jax.vmap(lambda body: apply_force(state, body, jnp.ones(3)).applied_force)(jnp.arange(2))
    np.testing.assert_array_equal(pushed, np.eye(2)[:, :, None] * np.ones(3))
