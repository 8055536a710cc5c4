"""Loops of joints solved beside their trees, against dense projections."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from mathota_jax import BallAndSocket, Box, Distance, Fixed, Hinge, SceneBuilder, Sphere
from mathota_jax.bodies import moving, moving_inertia, unpack
from mathota_jax.constraints import mechanism, mechanism_links
from mathota_jax.constraints.joint_rows import joint_rows
from mathota_jax.constraints.mechanism_layout import covers, layout
from tests.marks import slow_but
from tests.scenes import undamped

ACROSS = (0, 0, 1)


def boxes(places, *joints):
    builder = SceneBuilder()
    builder.add_body(Sphere(0.1), static=True, collides=False)
    for place in places:
        builder.add_body(Box((0.1, 0.2, 0.3)), mass=1.0 + place[0] ** 2, position=place, collides=False)
    for joint in joints:
        builder.add_joint(joint)
    return builder.build(undamped())


BARS = [(0, 0.5, 0), (0.5, 1, 0), (1, 0.5, 0)]
SQUARE = (
    Hinge(0, 1, (0, 0, 0), ACROSS), Hinge(1, 2, (0, 1, 0), ACROSS), Hinge(2, 3, (1, 1, 0), ACROSS),
    Hinge(3, 0, (1, 0, 0), ACROSS),
)  # fmt: skip
CASES = {
    "four bars": boxes(BARS, *SQUARE),
    "free ring": boxes(
        [*BARS, (0.5, 0, 0.3)],
        BallAndSocket(1, 2, (0, 1, 0)),
        BallAndSocket(2, 3, (1, 1, 0)),
        BallAndSocket(3, 4, (1, 0, 0)),
        BallAndSocket(1, 4, (0, 0, 0)),
    ),
    "two loops of several kinds": boxes(
        [*BARS, (2, 0.5, 0.2)],
        *SQUARE,
        Distance(0, 2, anchor=(0.5, 0, 1), child_anchor=(0.5, 1, 0)),
        Fixed(3, 4, (1, 0.5, 0)),
        BallAndSocket(4, 2, (1, 1.2, 0)),
    ),
}


@pytest.mark.parametrize("case", slow_but(("two loops of several kinds",), CASES))
def test_velocities_are_projected(float64, case, gate):
    """Bodies hit at random: what is left is the part of their motion that the joints allow, of least change.

    Rows that close loops give way by 4e-11 of what their bodies allow, and the truth with them.
    """
    model, state = jax.tree.map(
        lambda x: x.astype(jnp.result_type(float))[..., None] if x.dtype.kind == "f" else x[..., None], CASES[case]
    )
    scene, bodies = model.scene, unpack(state)
    joints, blocks = joint_rows(model, bodies), moving(model.scene, unpack(state))
    inertia = moving_inertia(scene, model, blocks.orientation)
    found = layout(scene)
    assert found is not None and found.closings and covers(scene)
    links = mechanism_links.links(scene, joints, blocks.position, inertia)
    count, rows = len(scene.dynamic_bodies), joints.error.shape[0]
    velocity = jnp.asarray(np.random.default_rng(0).normal(size=(6, count, 1)))
    solution = mechanism.solve(links, jax.tree.map(jnp.negative, mechanism_links.rates(links, velocity)))
    left = velocity + solution.change(links)

    # All boxes are upright, so that their principal axes are those of the world.
    masses = np.concatenate(
        [np.r_[[mass] * 3, moments] for mass, moments in zip(model.mass[1:, 0], model.inertia[1:, :, 0], strict=True)]
    )
    jacobian = np.zeros((rows, 6 * count))
    slots = {
        slot: (link.parent, place) for place, link in enumerate(found.links) for part in link.slots for slot in part
    }
    own = {slot: found.links[place].is_child for slot, (_, place) in slots.items()}
    ends = {slot: (parent, place) if own[slot] else (place, parent) for slot, (parent, place) in slots.items()} | {
        slot: (closing.parent, closing.child) for closing in found.closings for slot in closing.rows
    }
    assert len(ends) == rows
    for slot, pair in ends.items():
        for place, side in zip(pair, (joints.parent, joints.child), strict=True):
            if place >= 0:
                block = found.links[place].block
                values = [np.broadcast_to(x, (rows, 1))[slot, 0] for x in jax.tree.leaves(side)]
                jacobian[slot, 6 * block : 6 * block + 6] = values
    weighted = jacobian / np.sqrt(masses)
    first = np.asarray(velocity)[..., 0].T.reshape(-1) * np.sqrt(masses)
    closing = list(found.closing_slots)
    allowed = scipy.linalg.null_space(np.delete(weighted, closing, axis=0))
    assert links.loops is not None
    stiffness = 1 / np.sqrt(np.asarray(links.loops.compliance)[:, 0])
    _, stiff, modes = np.linalg.svd(stiffness[:, None] * (weighted[closing] @ allowed))
    yields = np.ones(len(modes))
    yields[: len(stiff)] = 1 / (1 + stiff**2)
    truth = allowed @ (modes.T @ (yields * (modes @ (allowed.T @ first)))) / np.sqrt(masses)
    assert np.abs(jacobian @ truth).max() < 1e-6 * np.abs(jacobian @ np.asarray(velocity)[..., 0].T.reshape(-1)).max()
    gate("velocity", np.asarray(left)[..., 0].T.reshape(-1) - truth, 1e-9)
    by_response = mechanism.respond(links, jnp.asarray((first * np.sqrt(masses)).reshape(count, 6).T[..., None]))
    gate("response to the momenta", np.asarray(by_response)[..., 0].T.reshape(-1) - truth, 1e-9)
    redundant = rows > np.linalg.matrix_rank(weighted, tol=1e-9)
    assert redundant == (case != "free ring")
