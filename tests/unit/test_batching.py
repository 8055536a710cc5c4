"""`jax.vmap(step)` and every derivative of it equal a Python loop over unbatched calls."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, Plane, SceneBuilder, Sphere, contacts, joint_gaps, residuals, rollout, step
from tests.marks import slow_but
from tests.scenes import slab_on_plane, sphere_on_plane, stack, undamped

WORLDS, STEPS = 3, 3


def scene():
    """A ball that slides and bounces a little, and a motorised arm: contact, friction, restitution, joint, action.

    The arm touches nothing: else its joint is held while contacts are solved, which is three times the program.
    """
    builder = SceneBuilder()
    ground = builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.3, restitution=0.4)
    builder.add_body(
        Sphere(0.1), mass=1.0, position=(0, 0.105, 0), velocity=(2.0, -1.0, 0.3), friction=0.3, restitution=0.4
    )
    arm = builder.add_body(Sphere(0.1), mass=0.5, position=(3.0, 1.0, 0.0), collides=False)
    hinge = builder.add_joint(Hinge(parent=ground, child=arm, anchor=(3.2, 1.0, 0.0), axis=(0, 0, 1), damping=0.1))
    builder.add_motor(hinge, kind="torque", limit=5.0)
    return builder.build(undamped(dt=1 / 60, velocity_iterations=100, gradient_iterations=200))


def apply(parameters):
    """Model, state and action of one world from a vector: speed, friction, mass, action."""
    model, state = scene()
    model = dataclasses.replace(
        model,
        friction=jnp.full_like(model.friction, parameters[1]),
        mass=model.mass.at[1].set(parameters[2]),
    )
    return model, dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(parameters[0])), parameters[3:]


def outcome(parameters):
    """(position, velocity, spin, arm) after three steps, as one vector."""
    model, state, action = apply(parameters)
    final, _ = rollout(model, state, jnp.broadcast_to(action, (STEPS, 1)))
    return jnp.concatenate([final.position[1], final.velocity[1], final.angular_velocity[1], final.velocity[2]])


def cost(parameters):
    return jnp.sum(jnp.sin(outcome(parameters)))


def parameters():
    rng = np.random.default_rng(5)
    return jnp.asarray(rng.uniform([1.5, 0.2, 0.8, -1.0], [2.5, 0.4, 1.2, 1.0], size=(WORLDS, 4)))


def loop(function, batch):
    compiled = jax.jit(function)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *[compiled(one) for one in batch])


def finite_differences(function, batch, width=1e-6):
    """Central differences of unbatched calls: (world, output..., parameter)."""
    compiled = jax.jit(function)
    directions = width * np.eye(batch.shape[1])
    return np.stack(
        [
            np.stack([(compiled(one + d) - compiled(one - d)) / (2 * width) for d in directions], axis=-1)
            for one in batch
        ]
    )


def diagonal(blocks):
    """(world, output, world, parameter) -> (world, output, parameter); the rest must vanish."""
    blocks = np.asarray(blocks)
    for first in range(WORLDS):
        for second in range(WORLDS):
            assert first == second or not np.any(blocks[first, :, second])
    return np.stack([blocks[world, :, world] for world in range(WORLDS)])


@pytest.mark.slow
def test_derivatives_against_finite_differences(float64):
    """The one truth for all derivatives: differences of unbatched calls, away from any kink."""
    batch = parameters()
    np.testing.assert_allclose(jacobian_of_each(), finite_differences(outcome, batch), rtol=2e-6, atol=2e-7)
    assert np.abs(finite_differences(outcome, batch)).max() > 0.1


FIRST_ORDER = {
    "vmap(jacfwd)": (lambda: jax.vmap(jax.jacfwd(outcome)), np.asarray),
    "vmap(jacrev)": (lambda: jax.vmap(jax.jacrev(outcome)), np.asarray),
    "jacfwd(vmap)": (lambda: jax.jacfwd(jax.vmap(outcome)), diagonal),
    "jacrev(vmap)": (lambda: jax.jacrev(jax.vmap(outcome)), diagonal),
}


@functools.cache
def jacobian_of_each():
    return loop(jax.jacfwd(outcome), parameters())


@functools.cache
def gradient_of_each():
    return loop(jax.grad(cost), parameters())


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(("vmap(jacfwd)",), FIRST_ORDER))
def test_jacobians(float64, name):
    transform, arrange = FIRST_ORDER[name]
    measured = arrange(jax.jit(transform())(parameters()))
    np.testing.assert_allclose(measured, jacobian_of_each(), rtol=1e-9, atol=1e-10)


GRADIENTS = {
    "vmap(grad)": lambda: jax.vmap(jax.grad(cost)),
    "grad(vmap)": lambda: jax.grad(lambda batch: jnp.sum(jax.vmap(cost)(batch))),
    "vmap(grad(checkpoint))": lambda: jax.vmap(jax.grad(jax.checkpoint(cost))),
    "grad(scan(vmap))": lambda: jax.grad(lambda batch: jnp.sum(jnp.sin(scan_of_vmap(batch)))),
    "vmap(vmap(grad))": lambda: lambda batch: jax.vmap(jax.vmap(jax.grad(cost)))(batch[None])[0],
}


def scan_of_vmap(batch):
    models, states, actions = jax.vmap(apply)(batch)
    final, _ = jax.lax.scan(lambda s, _: (jax.vmap(step)(models, s, actions), None), states, None, length=STEPS)
    leaves = (final.position[:, 1], final.velocity[:, 1], final.angular_velocity[:, 1], final.velocity[:, 2])
    return jnp.concatenate(leaves, axis=-1)


@pytest.mark.parametrize("name", slow_but(("vmap(grad(checkpoint))",), GRADIENTS))
def test_gradients(float64, name):
    measured = jax.jit(GRADIENTS[name]())(parameters())
    np.testing.assert_allclose(measured, gradient_of_each(), rtol=1e-9, atol=1e-10)


@pytest.mark.slow
def test_hessian(float64):
    batch = parameters()
    measured = np.asarray(jax.jit(jax.vmap(jax.hessian(cost)))(batch))
    truth = finite_differences(jax.grad(cost), batch)
    np.testing.assert_allclose(measured, truth, rtol=1e-4, atol=1e-5 * np.abs(truth).max())


VALUES = {
    "vmap": lambda: jax.vmap(outcome),
    "vmap(vmap)": lambda: lambda batch: jax.vmap(jax.vmap(outcome))(batch[None])[0],
    "vmap(checkpoint)": lambda: jax.vmap(jax.checkpoint(outcome)),
    "scan(vmap)": lambda: scan_of_vmap,
    "vmap(jvp)": lambda: lambda batch: jax.vmap(lambda p: jax.jvp(outcome, (p,), (p,))[0])(batch),
}


@pytest.mark.parametrize("name", VALUES)
def test_values(float64, name):
    batch = parameters()
    measured = jax.jit(VALUES[name]())(batch)
    np.testing.assert_allclose(measured, loop(outcome, batch), rtol=1e-11, atol=1e-12)


def worlds():
    pairs = [apply(one) for one in parameters()]
    return [[pair[index] for pair in pairs] for index in range(3)]


def assert_states_equal(measured, truth):
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(measured), jax.tree.leaves(truth), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize(
    ("mapped", "jit"),
    [
        pytest.param(mapped, jit, id=f"{mapped}-{name}", marks=() if jit or mapped == "all" else pytest.mark.slow)
        for name, jit in (("eager", False), ("jit", True))
        for mapped in ("all", "model shared", "action shared", "state shared", "no action")
    ],
)
def test_shared_arguments(float64, mapped, jit):
    """Any of model, state and action may be shared by the worlds."""
    models, states, actions = worlds()
    shared = {"model shared": 0, "state shared": 1, "action shared": 2}.get(mapped)
    lists = [models, states, actions]
    axes = [0, 0, 0]
    if shared is not None:
        lists[shared] = [lists[shared][0]] * WORLDS
        axes[shared] = None
    if mapped == "no action":
        lists, axes = lists[:2], axes[:2]
    batch = [items[0] if axis is None else stack(items) for items, axis in zip(lists, axes, strict=True)]
    mapped_step = jax.vmap(step, in_axes=tuple(axes))
    measured = (jax.jit(mapped_step) if jit else mapped_step)(*batch)
    truth = stack([step(*one) for one in zip(*lists, strict=True)])
    assert_states_equal(measured, truth)


def test_one_mapped_leaf_of_the_model(float64):
    """`in_axes` may name a single leaf, the others being shared."""
    models, states, actions = worlds()
    frictions = jnp.stack([model.friction for model in models])
    base = models[0]
    axes = dataclasses.replace(jax.tree.map(lambda _: None, base), friction=0)
    batched = dataclasses.replace(base, friction=frictions)
    measured = jax.vmap(step, in_axes=(axes, 0, 0))(batched, stack(states), stack(actions))
    truth = [
        step(dataclasses.replace(base, friction=f), s, a) for f, s, a in zip(frictions, states, actions, strict=True)
    ]
    assert_states_equal(measured, stack(truth))


LEAVES_ALONE = ("friction", "restitution", "mass", "shapes", "size", "joint_anchor_child", "joint_damping", "gravity")


@pytest.mark.parametrize("name", slow_but(("friction", "shapes"), LEAVES_ALONE))
@pytest.mark.parametrize("function", [step, joint_gaps, residuals])
def test_one_leaf_alone_is_mapped(name, function):
    """The state was given once, and was looked at for how many worlds there are."""
    model, state = arm_and_box()
    factors = jnp.asarray([0.9, 1.0, 1.2])

    def outcome(factor):
        leaf = jax.tree.map(lambda x: x * factor, getattr(model, name))
        return function(dataclasses.replace(model, **{name: leaf}), state)

    shapes = jax.eval_shape(jax.vmap(outcome), factors)
    alone = jax.eval_shape(outcome, factors[0])
    assert jax.tree.map(lambda x: x.shape[1:], shapes) == jax.tree.map(lambda x: x.shape, alone)


def arm_and_box():
    builder = SceneBuilder()
    surface = {"friction": 0.4, "restitution": 0.5}
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, **surface)
    first, second = (
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(0.25 * k, 0.1, 0), velocity=(1, 0, 0), **surface)
        for k in range(2)
    )
    builder.add_joint(Hinge(parent=first, child=second, anchor=(0.125, 0.1, 0), axis=(0, 1, 0), damping=0.1))
    return builder.build()


def test_slides_by_friction_alone():
    """Only the friction is mapped, all else is given once: each world is that of its friction."""
    model, state = slab_on_plane()
    state = dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(1.0))

    def slid(friction):
        changed = dataclasses.replace(model, friction=jnp.full_like(model.friction, friction))
        return rollout(changed, state, 20)[0].velocity[1, 0]

    frictions = jnp.asarray([0.05, 0.1, 0.2])
    seconds = 20 * float(model.dt)
    np.testing.assert_allclose(jax.vmap(slid)(frictions), 1.0 - frictions * 9.81 * seconds, atol=1e-4)
    slopes = jax.vmap(jax.grad(slid))(frictions)
    np.testing.assert_allclose(slopes, -9.81 * seconds, rtol=1e-3)


@pytest.mark.parametrize("solver", ["pgs", "soft_step"])
def test_a_time_step_of_each_world_from_one_state(solver):
    """What the state remembers of the last step has one world there, and what the step made of it has as many as steps."""
    model, state = sphere_on_plane(height=0.05, options=undamped(solver=solver))
    steps = jnp.asarray([1 / 240, 1 / 60, 1 / 30])

    def fallen(dt, state=state):
        return step(dataclasses.replace(model, dt=dt), step(dataclasses.replace(model, dt=dt), state))

    mapped = jax.jit(jax.vmap(fallen))(steps)
    for world, dt in enumerate(steps):
        alone = jax.jit(fallen)(dt)
        np.testing.assert_allclose(mapped.position[world], alone.position, atol=1e-6)
        np.testing.assert_allclose(mapped.velocity[world], alone.velocity, atol=1e-6)


def test_a_number_as_time_step_inside_of_a_loop():
    """JAX hands constants of loops to the rule of a map as numbers, not as arrays."""
    model, state = sphere_on_plane(height=0.05, options=undamped())
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * WORLDS), state)

    def looped(state):
        return jax.lax.fori_loop(0, 2, lambda _, now: step(dataclasses.replace(model, dt=0.01), now), state)

    expected = step(dataclasses.replace(model, dt=jnp.float32(0.01)), state)
    expected = step(dataclasses.replace(model, dt=jnp.float32(0.01)), expected)
    found = jax.jit(jax.vmap(looped))(states)
    np.testing.assert_allclose(found.position[0], expected.position, atol=1e-6)


def test_worlds_along_another_axis(float64):
    models, states, actions = worlds()
    truth = stack([step(*one) for one in zip(models, states, actions, strict=True)])
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), (stack(models), stack(states), stack(actions)))
    measured = jax.vmap(step, in_axes=-1, out_axes=-1)(*last)
    assert_states_equal(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), measured), truth)


def test_nested_maps_over_models_and_states(float64):
    """Every model with every state: two mapped axes that belong to different arguments."""
    models, states, actions = worlds()
    inner = jax.vmap(step, in_axes=(None, 0, None))
    measured = jax.jit(jax.vmap(inner, in_axes=(0, None, None)))(stack(models), stack(states), actions[0])
    truth = stack([stack([step(model, state, actions[0]) for state in states]) for model in models])
    assert_states_equal(measured, truth)


def test_rollout_inside_and_outside_the_map(float64):
    models, states, actions = worlds()
    sequences = [jnp.broadcast_to(action, (STEPS, 1)) for action in actions]
    final, trajectory = jax.jit(jax.vmap(rollout))(stack(models), stack(states), stack(sequences))
    truth = [rollout(*one) for one in zip(models, states, sequences, strict=True)]
    assert_states_equal(final, stack([one[0] for one in truth]))
    assert_states_equal(trajectory, stack([one[1] for one in truth]))
    stepped = states[0]
    for _ in range(STEPS):
        stepped = step(models[0], stepped, actions[0])
    assert_states_equal(truth[0][0], stepped)
    assert_states_equal(jax.tree.map(lambda leaf: leaf[-1], truth[0][1]), stepped)


def test_batch_of_one_and_bitwise_repeatability(precision):
    models, states, actions = worlds()
    one = jax.jit(jax.vmap(step))(stack(models[:1]), stack(states[:1]), stack(actions[:1]))
    again = jax.jit(jax.vmap(step))(stack(models[:1]), stack(states[:1]), stack(actions[:1]))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


def test_no_worlds_at_all():
    """An empty batch, as a mask that selects nothing leaves it."""
    model, state = scene()
    none = jax.tree.map(lambda leaf: leaf[None][:0], state)
    advance = jax.vmap(step, in_axes=(None, 0, 0))
    final = advance(model, none, jnp.zeros((0, 1)))
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), final) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), none
    )
    mass = jax.grad(lambda mass: advance(dataclasses.replace(model, mass=mass), none, jnp.zeros((0, 1))).position.sum())
    np.testing.assert_array_equal(mass(model.mass), jnp.zeros(3))
    grid = jax.tree.map(lambda leaf: jnp.zeros((3, 0, *leaf.shape), leaf.dtype), state)
    assert jax.vmap(advance, in_axes=(None, 0, None))(model, grid, jnp.zeros((0, 1))).position.shape == (3, 0, 3, 3)


def test_an_output_that_all_worlds_share_has_no_derivative():
    """The normal of a plane depends on nothing that a ball does."""
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0, 0.1, 0))
    model, state = builder.build()

    def normal(position):
        return contacts(model, dataclasses.replace(state, position=position)).normal

    assert not jax.jacrev(normal)(state.position).any()


def test_debugging_of_nans_names_them():
    """`jax_debug_nans` runs a program again without `jit`, which must not end in this very program."""
    model, state = scene()
    states = stack([dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(speed)) for speed in (1.0, 3e38)])
    actions = jnp.zeros((2, 1))
    with jax.debug_nans(True):
        advance = jax.vmap(step, in_axes=(None, 0, 0))
        good = jax.tree.map(lambda leaf: leaf[:1], states)
        assert np.isfinite(np.asarray(advance(model, good, actions[:1]).position)).all()
        with pytest.raises(FloatingPointError, match="nan"):
            advance(model, states, actions)
        with pytest.raises(FloatingPointError, match="nan"):
            jax.grad(lambda states: advance(model, states, actions).position.sum(), allow_int=True)(states)
