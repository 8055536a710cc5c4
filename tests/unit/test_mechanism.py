"""Trees of joints solved in linear time, against the dense matrix of their rows."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Distance, Fixed, Hinge, SceneBuilder, Slider, Sphere
from mathota_jax.bodies import moving, moving_inertia, pack_blocks, unpack
from mathota_jax.constraints import mechanism, mechanism_coordinates, mechanism_links
from mathota_jax.constraints.joint_rows import joint_rows
from mathota_jax.constraints.mechanism_layout import covers, layout
from tests.marks import slow_but
from tests.scenes import undamped

ANCHOR, AXIS = (0.3, 0.2, 0.1), (0.2, 0.5, 1.0)


def joined(kinds, parents, grounded, reverse=(), alone=0):
    """Boxes of unlike masses, body 1 on the ground or free; joint k leads to body k + 2 from `parents[k]`, `alone` more."""
    generator = np.random.default_rng(len(kinds))
    builder = SceneBuilder()
    ground = builder.add_body(Sphere(0.1), static=True, collides=False)
    for _ in range(len(kinds) + 1 + alone):
        half = tuple(generator.uniform(0.05, 0.5, 3))
        place = tuple(generator.normal(size=3))
        builder.add_body(Box(half), mass=10 ** generator.uniform(-1, 1), position=place, collides=False)
    if grounded:
        builder.add_joint(Hinge(ground, 1, ANCHOR, AXIS))
    for joint, (kind, parent) in enumerate(zip(kinds, parents, strict=True)):
        ends = (joint + 2, parent) if joint in reverse else (parent, joint + 2)
        builder.add_joint(kind(*ends, ANCHOR, AXIS) if kind in (Hinge, Slider) else kind(*ends, ANCHOR))
    return builder.build(undamped())


CASES = {
    "chain": joined([Hinge] * 4, [1, 2, 3, 4], True),
    "floating chain": joined([Hinge] * 3, [1, 2, 3], False),
    "all kinds": joined([BallAndSocket, Slider, Fixed, Distance, Hinge], [1, 2, 3, 4, 5], True),
    "branches": joined([Hinge, BallAndSocket, Hinge, Hinge, Slider, Hinge], [1, 1, 2, 2, 1, 4], False),
    "joints that call the link their parent": joined([Hinge, BallAndSocket, Slider], [1, 2, 2], True, (0, 2)),
    "beside two boxes": joined([Hinge, BallAndSocket], [1, 1], False, alone=2),
}


@pytest.mark.parametrize("case", slow_but(("all kinds", "branches"), CASES))
def test_impulses_are_those_of_the_dense_matrix(float64, case, gate):
    """At poses at which the joints are broken too, in two worlds."""
    model, state = jax.tree.map(lambda x: x.astype(jnp.result_type(float)) if x.dtype.kind == "f" else x, CASES[case])
    scene = model.scene
    generator = np.random.default_rng(5)
    broken = 0.1 * generator.normal(size=(2, *state.orientation.shape))
    turned = jnp.asarray(state.orientation + broken)
    turned = turned / jnp.linalg.norm(turned, axis=-1, keepdims=True)
    states = jax.tree.map(lambda x: jnp.stack([x, x], axis=-1), state)
    states = dataclasses.replace(states, orientation=jnp.moveaxis(turned, 0, -1))
    worlds_last = jax.tree.map(lambda x: x[..., None], model)
    bodies = unpack(states)
    joints = joint_rows(worlds_last, bodies)
    blocks = moving(scene, bodies)
    inertia = moving_inertia(scene, worlds_last, blocks.orientation)
    found = layout(scene)
    assert found is not None and covers(scene)
    links = mechanism_links.links(scene, joints, blocks.position, inertia)

    rows, count = joints.error.shape[0], len(scene.dynamic_bodies)
    wanted = generator.normal(size=(rows, 2))
    solution = mechanism.solve(links, mechanism_links.of_slots(links, jnp.asarray(wanted)))
    change = np.asarray(solution.change(links))
    force, torque = mechanism_links.forces_on_links(links, solution.impulses)
    by_impulses = pack_blocks(force * links.inertia.inverse_mass, links.inertia.solve(torque))
    by_impulses = mechanism_links.to_blocks(links.layout, by_impulses)
    gate("velocity by the impulses", change - by_impulses, 1e-9 * np.abs(change).max())
    solved = np.asarray(mechanism_links.to_slots(links.layout, solution.impulses, rows))
    ends = {}
    for link in found.links:
        for slot in (*link.slots[0], *link.slots[1]):
            parent = found.links[link.parent].block if link.parent >= 0 else None
            ends[slot] = (link.block, parent) if link.is_child else (parent, link.block)
    for world in range(2):
        jacobian = np.zeros((rows, 6 * count))
        for slot, (child, parent) in ends.items():
            for block, side in ((child, joints.child), (parent, joints.parent)):
                if block is not None:
                    values = [np.broadcast_to(x, (rows, 2))[slot, world] for x in jax.tree.leaves(side)]
                    jacobian[slot, 6 * block : 6 * block + 6] = values
        inverse = np.zeros((6 * count, 6 * count))
        for block in range(count):
            mass = float(model.mass[scene.dynamic_bodies[block]])
            axes = np.array([np.asarray(x)[block, world] for x in jax.tree.leaves(inertia.rotation)]).reshape(3, 3).T
            moments = np.asarray(model.inertia)[scene.dynamic_bodies[block]]
            start = 6 * block
            inverse[start : start + 3, start : start + 3] = np.eye(3) / mass
            inverse[start + 3 : start + 6, start + 3 : start + 6] = axes @ np.diag(1 / moments) @ axes.T
        truth = np.linalg.solve(jacobian @ inverse @ jacobian.T, wanted[:, world])
        scale = np.abs(truth).max()
        gate("impulse", (solved[:, world] - truth) / scale, 1e-9)
        moved = inverse @ jacobian.T @ truth
        gate("velocity", (change[:, :, world].T.reshape(-1) - moved) / np.abs(moved).max(), 1e-9)


def links_at(model, state):
    """The mechanisms of worlds-last arrays."""
    bodies = unpack(state)
    blocks = moving(model.scene, bodies)
    inertia = moving_inertia(model.scene, model, blocks.orientation)
    return mechanism_links.links(model.scene, joint_rows(model, bodies), blocks.position, inertia)


def in_float64(case):
    return jax.tree.map(
        lambda x: x.astype(jnp.result_type(float))[..., None] if x.dtype.kind == "f" else x[..., None], CASES[case]
    )


@pytest.mark.parametrize("case", ["branches", "floating chain"])
def test_derivative_of_the_response_by_the_poses(float64, case, gate):
    """Rows that turn find another motion of what already moves along them; against central differences."""
    model, state = in_float64(case)
    generator = np.random.default_rng(3)
    impulse = jnp.asarray(generator.normal(size=(6, len(model.scene.dynamic_bodies), 1)))
    place, turn = (0.1 * generator.normal(size=leaf.shape) for leaf in (state.position, state.orientation))

    @jax.jit
    def motion(size):
        moved = state.orientation + size * turn
        moved = moved / jnp.linalg.norm(moved, axis=1, keepdims=True)
        there = dataclasses.replace(state, position=state.position + size * place, orientation=moved)
        return mechanism.respond(links_at(model, there), impulse)

    slope = np.asarray(jax.jvp(motion, (jnp.asarray(0.0),), (jnp.asarray(1.0),))[1])
    quotient = np.asarray(motion(1e-5) - motion(-1e-5)) / 2e-5
    gate("slope - quotient, relative", (slope - quotient) / np.abs(quotient).max(), 1e-8)


@pytest.mark.parametrize("case", ["all kinds", "branches", "beside two boxes"])
def test_response_in_coordinates(float64, case, gate):
    """Impulses on all bodies, as generalized ones times what these do; as many coordinates as ways to move."""
    generator = np.random.default_rng(4)
    model, state = in_float64(case)
    scene, bodies = model.scene, unpack(state)
    blocks = moving(scene, bodies)
    inertia = moving_inertia(scene, model, blocks.orientation)
    links = links_at(model, state)
    motions = np.asarray(mechanism_coordinates.motions(links, 1))[..., 0]
    responses = np.asarray(mechanism_coordinates.responses(links, inertia, 1))[..., 0]
    ways = {"all kinds": 1 + 3 + 1 + 0 + 5 + 1, "branches": 6 + 1 + 3 + 1 + 1 + 1 + 1, "beside two boxes": 6 + 4 + 12}
    assert motions.shape[2] == mechanism_coordinates.coordinate_count(links.layout) == ways[case]
    impulse = generator.normal(size=(6, len(scene.dynamic_bodies), 1))
    found = np.einsum("cbq,q->cb", responses, np.einsum("cbq,cb->q", motions, impulse[..., 0]))
    truth = np.array(mechanism.respond(links, jnp.asarray(impulse))[..., 0])
    for block in set(range(len(scene.dynamic_bodies))) - set(links.layout.blocks):
        body = scene.dynamic_bodies[block]
        force, torque = impulse[:3, block, 0], impulse[3:, block, 0]
        # These boxes are upright.
        truth[:, block] = [*force / model.mass[body, 0], *torque / model.inertia[body, :, 0]]
    gate("velocity", (found - truth) / np.abs(truth).max(), 1e-10)


def test_worlds_that_differ_by_masses_alone(float64, gate):
    """At poses that all share, as where derivatives by the masses are taken in forward mode."""
    model, state = in_float64("branches")
    models = dataclasses.replace(model, mass=model.mass * jnp.array([1.0, 3.0]))
    links = links_at(models, state)
    wanted = tuple(jnp.ones((len(links.layout.links), 1)) for _ in range(6))
    found = mechanism.solve(links, mechanism_links.only_held(links, wanted)).impulses
    for world in range(2):
        alone = links_at(dataclasses.replace(model, mass=models.mass[:, world : world + 1]), state)
        truth = mechanism.solve(alone, mechanism_links.only_held(alone, wanted)).impulses
        gate("impulses", [np.abs(a[:, world] - b[:, 0]).max() for a, b in zip(found, truth, strict=True)], 1e-12)


def test_which_joints_are_links():
    """A loop is a tree and one joint more. Joints without a row that holds are left to the solver, and so are one or two
    joints beside these, or any number with small steps."""

    def found(build, **options):
        builder = SceneBuilder()
        ground = builder.add_body(Sphere(0.1), static=True, collides=False)
        for place in range(4):
            builder.add_body(Sphere(0.1), mass=1.0, position=(place + 1.0, 0, 0), collides=False)
        build(builder, ground)
        return layout(builder.build(undamped(**options))[0].scene)

    def count(build, **options):
        links = found(build, **options)
        return 0 if links is None else len(links.links)

    def chain(length, last=None):
        def build(builder, ground):
            for place in range(length):
                builder.add_joint(Hinge(place, place + 1, (place + 0.5, 0, 0), (0, 0, 1)))
            if last:
                last(builder, ground)

        return build

    assert count(chain(1)) == 1
    assert count(chain(2)) == 2
    assert count(chain(3)) == 3
    assert count(chain(4)) == 4
    assert count(chain(4), exact_joints=False) == 0
    assert count(chain(4), solver="soft_step") == 4
    assert count(chain(4), impact_events=1) == 4  # nothing bounces
    loop = found(chain(4, lambda builder, ground: builder.add_joint(Hinge(4, ground, (4.5, 0, 0), (0, 0, 1)))))
    assert loop is not None and len(loop.links) == 4 and len(loop.closings) == 1 and len(loop.closing_slots) == 5
    rope = Distance(2, 4, anchor=(2, 0, 0), lengths=(0, 5))
    assert count(chain(2, lambda builder, ground: builder.add_joint(rope))) == 0
    assert count(chain(3, lambda builder, ground: builder.add_joint(rope))) == 3
    assert count(chain(2, lambda builder, ground: builder.add_joint(rope)), solver="soft_step") == 2
