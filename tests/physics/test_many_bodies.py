"""Scenes whose contacts come from the broadphase: the same physics as with a slot for every pair."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Options, Plane, Polyhedron, SceneBuilder, Sphere, contact_forces, contacts, step
from mathota_jax.state import Flag
from tests.scenes import GRAVITY, advance, advance_worlds, invariants, repeat, stack

RADIUS = 0.1


def heap(
    count, shape=None, spacing=2.05, height=1.02, seed=0, friction=0.5, restitution=0.0, gravity=GRAVITY, **options
):
    """Body 0: the plane y = 0. The others: a jittered cubic lattice of `shape`, lying on it."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(count ** (1 / 3)))
    builder = SceneBuilder(gravity=(0.0, -gravity, 0.0))
    surface = {"friction": friction, "restitution": restitution}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    for index in range(count):
        place = spacing * np.array(np.unravel_index(index, (side, side, side)), float)[[0, 2, 1]]
        place += 0.02 * rng.normal(size=3)
        place[1] = max(place[1], 0.0) + height
        builder.add_body(shape or Sphere(RADIUS), mass=1.0, position=RADIUS * place, **surface)
    return builder.build(Options(**{"dt": 1 / 240, "linear_damping": 0.0, "angular_damping": 0.0, **options}))


def touching(model, state):
    """{(body A, body B): separations} of the contacts that overlap or nearly do."""
    found = jax.tree.map(np.asarray, jax.jit(contacts)(model, state))
    near = found.active & (found.separation < 1e-3)
    pairs = {}
    body_a, body_b = (np.broadcast_to(body, near.shape) for body in (found.body_a, found.body_b))
    for a, b, separation in zip(body_a[near], body_b[near], found.separation[near], strict=True):
        pairs.setdefault((int(a), int(b)), []).append(float(separation))
    return {pair: sorted(separations) for pair, separations in pairs.items()}


CONVERGED = {"velocity_iterations": 400, "position_iterations": 0, "gradient_iterations": 800}
SHAPES = {"spheres": Sphere(RADIUS), "boxes": Box((RADIUS, RADIUS, RADIUS))}


@functools.cache
def settled(method, shape):
    """The heap of eight after 80 steps, in which it falls together and bounces off the ground."""
    model, state = heap(8, SHAPES[shape], restitution=0.0, broadphase=method, **CONVERGED)
    return model, advance(model, state, 80)


@pytest.mark.parametrize("method", ["grid", pytest.param("all_pairs", marks=pytest.mark.slow)])
def test_same_trajectory_as_with_a_slot_for_every_pair(method, float64, gate):
    """Both solve the same equations to convergence; they differ in the order of the rows only."""
    own_model, own = settled("none", "spheres")
    model, state = settled(method, "spheres")
    assert own_model.scene.broadphase is None
    assert model.scene.broadphase is not None
    assert model.scene.pair_groups == own_model.scene.pair_groups[:1]  # the plane against the spheres
    assert touching(model, state).keys() == touching(own_model, own).keys()
    assert len(touching(model, state)) > 8
    gate("position [m]", state.position - own.position, 1e-8)
    gate("velocity [m/s]", state.velocity - own.velocity, 1e-6)
    gate("angular velocity [rad/s]", state.angular_velocity - own.angular_velocity, 1e-5)
    assert not int(state.flags)


def test_same_contacts_of_boxes(float64, gate):
    """Manifolds of four points, at the poses of one and the same state."""
    own_model, own = settled("none", "boxes")
    model, fresh = heap(8, SHAPES["boxes"], broadphase="sort_and_sweep", **CONVERGED)
    state = dataclasses.replace(own, contact_force=fresh.contact_force, contact_feature=fresh.contact_feature)
    state = dataclasses.replace(state, contact_pair=fresh.contact_pair)
    expected, found = touching(own_model, own), touching(model, state)
    assert expected.keys() == found.keys()
    assert max(len(separations) for separations in expected.values()) == 4
    for pair, separations in expected.items():
        np.testing.assert_allclose(found[pair], separations, atol=1e-12)


@functools.cache
def in_a_corner(method):
    """Seven boxes pressed into the corner of a floor, a wall and a leaning wall, after 40 steps."""
    builder = SceneBuilder(gravity=(-4.0, -GRAVITY, -3.0))
    builder.add_body(Plane((0, 1, 0)), static=True)
    builder.add_body(Plane((1, 0, 0), -0.13), static=True)
    builder.add_body(Plane((0, 0.3, 1), -0.085), static=True)
    rng = np.random.default_rng(4)
    for index in range(7):
        place = 0.22 * np.array([index % 2, index // 4, index // 2 % 2]) + 0.01 * rng.normal(size=3) + [0, 0.12, 0]
        builder.add_body(Box((0.1, 0.09, 0.08)), mass=1.0, position=place)
    options = {"dt": 1 / 240, "linear_damping": 0.0, "angular_damping": 0.0, **CONVERGED}
    model, state = builder.build(Options(broadphase=method, **options))
    return model, advance(model, state, 40)


@pytest.mark.slow
def test_pairs_with_many_planes_are_listed(float64, gate):
    """A box with slots for twelve points on planes touches few of them: close planes only, and the same motion."""
    own_model, own = in_a_corner("none")
    model, state = in_a_corner("auto")
    assert own_model.scene.broadphase is None
    assert not model.scene.pair_groups
    assert [group.kind_a for group in model.scene.compact_groups] == ["plane", "box"]
    assert touching(model, state).keys() == touching(own_model, own).keys()
    assert {a for a, _ in touching(model, state)} >= {0, 1, 2}
    gate("position [m]", state.position - own.position, 1e-7)
    gate("velocity [m/s]", state.velocity - own.velocity, 1e-5)
    assert not int(state.flags)


def hulls_and_others(method):
    """Polyhedra of different corners and faces on the ground, with a ball, pressed together."""
    rng = np.random.default_rng(6)
    points = rng.normal(size=(9, 3))
    hulls = [
        Polyhedron(0.12 * points / np.linalg.norm(points, axis=1, keepdims=True)),
        Polyhedron(0.2 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])),
        Polyhedron([[x, y, z] for x in (-0.1, 0.1) for y in (-0.08, 0.08) for z in (-0.09, 0.09)]),
    ]
    shapes = [*hulls, Sphere(0.1), hulls[2], hulls[0], hulls[0]]
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Plane((0, 1, 0)), static=True)
    for index, shape in enumerate(shapes):
        place = 0.19 * np.array([index % 2, index // 4, index // 2 % 2]) + [0, 0.1, 0]
        builder.add_body(shape, mass=1.0, position=place + 0.003 * rng.normal(size=3))
    return builder.build(Options(dt=1 / 240, broadphase=method, linear_damping=0.0, angular_damping=0.0, **CONVERGED))


@pytest.mark.slow
def test_same_contacts_of_polyhedra(float64):
    """Which polyhedra a place holds is known in the step only: the contacts are the same."""
    own_model, own = hulls_and_others("none")
    model, state = hulls_and_others("all_pairs")
    assert [group.kind_a for group in model.scene.compact_groups] == ["sphere", "polyhedron"]
    expected, found = touching(own_model, own), touching(model, state)
    assert len(expected) > 5
    assert expected.keys() == found.keys()
    for pair, separations in expected.items():
        np.testing.assert_allclose(found[pair], separations, atol=1e-12)


@pytest.mark.slow
def test_same_derivatives_of_polyhedra(float64, gate):
    """Of a step with the same pairs, by all corners."""
    model, state = hulls_and_others("all_pairs")
    own_model, own = hulls_and_others("none")
    weight = jnp.asarray(np.random.default_rng(0).normal(size=state.position.shape))

    def outcome(shapes, model, state):
        state = step(dataclasses.replace(model, shapes=shapes), state)
        return jnp.sum((state.position + state.velocity) * weight)

    @jax.jit
    def slope(model, state):
        along = jax.tree.map(jnp.zeros_like, model.shapes)
        along["polyhedron"]["vertices"] = jnp.asarray(np.random.default_rng(1).normal(size=(6, 9, 3)))
        return jax.jvp(lambda shapes: outcome(shapes, model, state), (model.shapes,), (along,))

    (value, change), (own_value, own_change) = slope(model, state), slope(own_model, own)
    assert abs(float(own_change)) > 0.1
    gate("value, relative", value / own_value - 1, 1e-6)
    gate("by vertices, relative", change / own_change - 1, 1e-4)


def test_worlds_may_share_what_the_last_step_found():
    """A batch over the positions alone: the pairs and forces of the last step are one for all worlds."""
    model, state = heap(3, broadphase="all_pairs")
    lift = jnp.array([0.0, 0.05, 0.1], state.position.dtype)

    def lifted(by):
        return step(model, dataclasses.replace(state, position=state.position.at[1:, 1].add(by)))

    together = jax.jit(jax.vmap(lifted))(lift)
    alone = stack([jax.jit(lifted)(by) for by in lift])
    np.testing.assert_allclose(together.position, alone.position, atol=1e-6)
    np.testing.assert_allclose(together.velocity, alone.velocity, atol=1e-6)


@pytest.mark.slow
def test_same_gradient_as_with_a_slot_for_every_pair(float64, gate):
    """Through a broadphase, a colouring and a solver with traced indices, in reverse mode and in forward mode."""

    def loss(velocity, friction, model, state):
        model = dataclasses.replace(model, friction=friction)
        state = dataclasses.replace(state, velocity=velocity)
        for _ in range(2):
            state = step(model, state)
        return jnp.sum(state.position * jnp.arange(state.position.size).reshape(state.position.shape))

    gradients = []
    for method in ("none", "all_pairs"):
        model, state = settled(method, "spheres")
        pushed = state.velocity.at[1:].add(jnp.array([0.3, -0.1, 0.2]))
        gradients.append(jax.jit(jax.grad(loss, (0, 1)))(pushed, model.friction, model, state))
    direction = jnp.asarray(np.random.default_rng(0).normal(size=pushed.shape))
    _, slope = jax.jit(lambda v, d: jax.jvp(lambda v: loss(v, model.friction, model, state), (v,), (d,)))(
        pushed, direction
    )
    scale = float(jnp.abs(gradients[0][0]).max())
    gate("by velocity, relative", (gradients[1][0] - gradients[0][0]) / scale, 1e-5)
    gate("by friction, relative", (gradients[1][1] - gradients[0][1]) / scale, 1e-5)
    gate("forward against reverse, relative", (slope - jnp.sum(gradients[1][0] * direction)) / scale, 1e-8)
    assert np.any(np.asarray(gradients[1][1]))


@pytest.mark.slow
@pytest.mark.parametrize("count", [64, 200])
def test_cloud_conserves_momentum_and_does_not_gain_energy(count, precision, gate):
    """No gravity, no ground in reach, spheres thrown at each other: several hundred collisions."""
    model, state = heap(count, gravity=0.0, height=1000.0, restitution=0.5)
    rng = np.random.default_rng(1)
    center = np.asarray(state.position)[1:].mean(0)
    inward = 8.0 * (center - np.asarray(state.position)[1:]) + rng.normal(size=(count, 3))
    state = dataclasses.replace(state, velocity=state.velocity.at[1:].set(inward))
    final = advance(model, state, 120)
    assert model.scene.broadphase is not None
    assert not int(final.flags)
    masses = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    before, after = (
        invariants(
            masses, s.position[1:] - jnp.asarray(center), s.orientation[1:], s.velocity[1:], s.angular_velocity[1:]
        )
        for s in (state, final)
    )
    eps = np.finfo(precision).eps
    size = np.abs(np.asarray(state.velocity)).sum()
    gate("linear momentum / sum of |m v|", (after[1] - before[1]) / size, 50 * eps)
    gate("energy after / before", after[0] / before[0], 1.0)
    assert after[0] < 0.8 * before[0]


def bin_of(count, **options):
    """`count` spheres above a box floor between four static boxes, and no plane."""
    rng = np.random.default_rng(2)
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    half = 0.55
    builder.add_body(Box((half, 0.1, half)), static=True, position=(0.0, -0.1, 0.0))
    for x, z in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        size = (0.1, 1.0, half + 0.2) if x else (half + 0.2, 1.0, 0.1)
        builder.add_body(Box(size), static=True, position=((half + 0.1) * x, 0.9, (half + 0.1) * z))
    for index in range(count):
        place = np.array(np.unravel_index(index, (count // 16 + 1, 4, 4)), float)[[1, 0, 2]] - [1.5, -0.5, 1.5]
        builder.add_body(Sphere(RADIUS), mass=1.0, position=0.24 * place + 0.01 * rng.normal(size=3))
    return builder.build(Options(**{"dt": 1 / 240, **options}))


@pytest.mark.slow
def test_bin_of_spheres_comes_to_rest(gate):
    """64 spheres against static boxes (one moving body a pair) and each other, float32, default iterations."""
    model, state = bin_of(64)
    assert {group.side_count for group in model.scene.compact_groups} == {1, 2}
    final = advance(model, state, 720)
    found = contacts(model, final)
    position = np.asarray(final.position)[5:]
    assert not int(final.flags)
    gate("overlap / radius", jnp.max(jnp.where(found.active, -found.separation, 0.0)) / RADIUS, 0.05)
    gate("height of the heap [m]", position[:, 1].max(), 1.1)
    assert np.all(position[:, 1] > 0.9 * RADIUS)
    assert np.all(np.abs(position[:, [0, 2]]) < 0.55 - 0.9 * RADIUS)
    # Newton's second law for the whole heap: the floor and the walls carry what does not accelerate.
    force = np.asarray(contact_forces(model, final))
    before = advance(model, state, 719)
    acceleration = (np.asarray(final.velocity) - np.asarray(before.velocity))[5:].sum(0) * 240
    one_sided = model.scene.compact_groups[0].slot_count
    on_heap = -force[:one_sided].sum(0)  # body B is the static box
    gate("vertical force balance / weight", (on_heap[1] - 64 * GRAVITY - acceleration[1]) / (64 * GRAVITY), 0.02)


@pytest.mark.slow
def test_worlds_are_independent(gate):
    """Piles that differ in each world, one of them not a number: the others are as if alone."""
    models, states = zip(*(heap(27, seed=seed) for seed in range(4)), strict=True)
    batch = stack(states)
    poisoned = dataclasses.replace(batch, position=batch.position.at[2, 5, 0].set(jnp.nan))
    clean = advance_worlds(repeat(models[0], 4), batch, 30)
    mixed = advance_worlds(repeat(models[0], 4), poisoned, 30)
    healthy = np.arange(4) != 2
    for name in ("position", "velocity", "contact_force", "contact_pair"):
        np.testing.assert_array_equal(
            np.asarray(getattr(clean, name))[healthy], np.asarray(getattr(mixed, name))[healthy]
        )
    np.testing.assert_array_equal(np.asarray(mixed.flags) & int(Flag.NON_FINITE) != 0, ~healthy)
    for world in (0, 3):
        alone = advance(models[0], states[world], 30)
        gate("against a world alone [m]", clean.position[world] - alone.position, 1e-4)


def test_overflow_is_flagged_and_keeps_the_deepest(float64):
    """Three pairs overlap, two have room: the shallowest passes through."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    for index, depth in enumerate((0.02, 0.001, 0.01)):
        for side in (0.0, 2 * RADIUS - depth):
            builder.add_body(Sphere(RADIUS), mass=1.0, position=(side, 2.0 * index, 0.0))
    results = {}
    for capacity in (2, 3):
        model, state = builder.build(Options(broadphase="all_pairs", pair_capacity=capacity))
        final = advance(model, state, 1)
        moved = np.abs(np.asarray(final.position) - np.asarray(state.position)).max(1).reshape(3, 2).max(1) > 0
        results[capacity] = int(final.flags), moved.tolist()
    assert results == {2: (int(Flag.CONTACT_OVERFLOW), [True, False, True]), 3: (0, [True, True, True])}


@pytest.mark.slow
def test_hub_with_many_neighbours(gate):
    """A sphere ten times larger than its 60 neighbours, all pressed on it: more turns than one word of colours."""
    rng = np.random.default_rng(0)
    direction = np.stack([np.cos(t := np.pi * (1 + 5**0.5) * np.arange(60)), np.sin(t)], axis=1)
    cosine = 1 - (2 * np.arange(60) + 1) / 60
    direction = np.concatenate([direction * np.sqrt(1 - cosine**2)[:, None], cosine[:, None]], axis=1)
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Sphere(1.0), mass=1e3)
    for unit in direction:
        builder.add_body(Sphere(RADIUS), mass=1.0, position=1.1 * unit, velocity=-unit + 0.1 * rng.normal(size=3))
    model, state = builder.build(Options(dt=1 / 240, velocity_iterations=20))
    final = advance(model, state, 10)
    assert not int(final.flags)
    assert int((final.contact_pair >= 0).sum()) >= 60
    distance = np.linalg.norm(np.asarray(final.position)[1:] - np.asarray(final.position)[0], axis=1)
    gate("overlap / radius", np.maximum(1.1 - distance, 0) / RADIUS, 0.02)


@pytest.mark.slow
def test_kinds_share_a_broadphase(gate):
    """Spheres, capsules and boxes, jointed bodies left out: three kinds, six groups, each with its own places."""
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Plane((0, 1, 0)), static=True)
    for index in range(27):
        shape = (Sphere(0.1), Capsule(0.07, 0.05), Box((0.08, 0.1, 0.09)))[index % 3]
        place = 0.26 * np.array(np.unravel_index(index, (3, 3, 3)), float) + [0.0, 0.13, 0.0]
        builder.add_body(shape, density=1000.0, position=place)
    model, state = builder.build(Options(dt=1 / 240))
    assert len(model.scene.compact_groups) == 6
    final = advance(model, state, 240)
    found = contacts(model, final)
    assert not int(final.flags)
    gate("overlap [m]", jnp.max(jnp.where(found.active, -found.separation, 0.0)), 0.01)
    assert float(final.position[1:, 1].min()) > 0.05


def test_small_scenes_have_no_broadphase():
    for count, has_one in ((6, False), (7, True), (27, True)):
        model, state = heap(count)
        assert (model.scene.broadphase is not None) == has_one, count
        assert (state.contact_pair is not None) == has_one
    assert heap(24, continuous=True)[0].scene.broadphase is None  # fast bodies are followed from slot to slot


def test_slots_do_not_grow_with_the_square_of_the_bodies():
    slots = [heap(count)[0].scene.slot_count for count in (64, 512)]
    assert slots[1] < 9 * slots[0]
