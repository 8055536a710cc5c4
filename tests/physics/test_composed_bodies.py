"""Compounds and off-centre polyhedra in free flight: conservation, and the same body described in another way."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax import (
    Box,
    Compound,
    Cylinder,
    Plane,
    Polyhedron,
    SceneBuilder,
    Sphere,
    angular_momentum,
    contact_forces,
    contacts,
    energy,
    rollout,
)
from tests.hulls import BOX_CORNERS
from tests.scenes import angle_between, record_worlds, repeat, undamped

UNIT = (1.0, 0.0, 0.0, 0.0)
WEDGE = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0.7], [2, 0, 0.7], [0, 1, 0.7]]) + np.array([3, -1, 2])
TURN = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_quat()[[3, 0, 1, 2]]
START = Rotation.from_rotvec([-0.4, 0.1, 1.2])
HALF = np.array([0.2, 0.3, 0.5])
SPIN = (3.0, -4.0, 2.5)
STEPS, DT = 400, 1 / 240

BODIES = {
    "wedge": Polyhedron(WEDGE),
    "hammer": Compound([(Cylinder(0.05, 0.5), ((0, 0, 0), TURN)), (Box((0.2, 0.1, 0.1)), ((0.1, 0.5, 0.3), UNIT))]),
    "dumbbell": Compound([(Sphere(0.2), ((0.4, 0.4, 0), UNIT)), (Sphere(0.1), ((-0.4, 0, 0.3), UNIT))]),
}


def flight(shape, orientation=START, **body):
    builder = SceneBuilder(gravity=(0, 0, 0))
    quaternion = orientation.as_quat()[[3, 0, 1, 2]]
    builder.add_body(shape, mass=2.0, orientation=quaternion, velocity=(1.0, 0.5, -0.3), angular_velocity=SPIN, **body)
    return builder.build(undamped(dt=DT))


def observe(model, state):
    return {
        "momentum": angular_momentum(model, dataclasses.replace(state, position=jnp.zeros_like(state.position))),
        "energy": energy(model, state),
        "position": state.position,
        "orientation": state.orientation,
        "angular_velocity": state.angular_velocity,
    }


def record(model, state):
    _, found = record_worlds(repeat(model, 1), repeat(state, 1), STEPS, observe)
    return {name: np.asarray(values)[:, 0] for name, values in found.items()}


@pytest.mark.parametrize("name", BODIES)
def test_angular_momentum_is_conserved(name, precision, gate):
    model, state = flight(BODIES[name])
    assert model.inertia_frame is not None
    found = record(model, state)
    # The truth at the start, from the tensor itself.
    tensor = 2.0 * START.as_matrix() @ BODIES[name].mass_properties().unit_inertia @ START.as_matrix().T
    expected = tensor @ SPIN
    limit = 1e-5 if precision == "float32" else 1e-12
    gate("spin / truth - 1", np.linalg.norm(found["momentum"] - expected, axis=-1) / np.linalg.norm(expected), limit)
    gate("energy / start - 1", found["energy"] / found["energy"][0] - 1, 1e-4 if precision == "float32" else 1e-5)
    gate("spin axis varies", 1.0 / np.ptp(found["angular_velocity"], axis=0).max(), 10.0)  # it does tumble


OTHER = Rotation.from_quat(TURN[[1, 2, 3, 0]])
# The same solid as Box(HALF): (shape, orientation of its frame seen from that of the box, centre of mass in its frame)
TWINS = {
    "points": (Polyhedron(BOX_CORNERS * HALF), Rotation.identity(), np.zeros(3)),
    "points elsewhere": (Polyhedron(BOX_CORNERS * HALF + [3, 4, 5]), Rotation.identity(), np.array([3.0, 4.0, 5.0])),
    "turned points": (Polyhedron((BOX_CORNERS * HALF) @ OTHER.as_matrix().T + 1.0), OTHER, np.ones(3)),
    "turned part": (Compound([(Box(HALF), ((1, 0, 0), TURN))]), OTHER, np.array([1.0, 0.0, 0.0])),
    "two halves": (
        Compound([(Box(HALF * [1, 0.5, 1]), ((0, y, 0), UNIT)) for y in (-0.15, 0.15)]),
        Rotation.identity(),
        np.zeros(3),
    ),
}


@pytest.mark.parametrize("name", TWINS)
def test_a_box_described_otherwise_moves_like_the_box(name, float64, gate):
    shape, frame, center = TWINS[name]
    box = record(*flight(Box(HALF)))
    turned = START * frame.inv()
    twin = record(*flight(shape, turned, position=-turned.apply(center)))
    back = Rotation.from_quat(twin["orientation"][:, 0][:, [1, 2, 3, 0]]) * frame
    gate("angle", angle_between(back.as_quat()[:, [3, 0, 1, 2]], box["orientation"][:, 0]), 1e-6)
    gate("position", twin["position"] - box["position"], 1e-6)
    gate("angular velocity", twin["angular_velocity"] - box["angular_velocity"], 1e-6)


def changed(model, path, change):
    return jax.tree_util.tree_map_with_path(lambda p, x: x + change if p == path else x, model)


def test_derivatives_reach_every_parameter_of_a_compound(float64, gate):
    """Directional derivatives of a fall, box first, onto a plane against central differences, leaf by leaf."""
    parts = [(Box((0.2, 0.1, 0.15)), ((0.1, 0.5, 0.3), TURN)), (Sphere(0.2), ((0.2, -0.3, 0), UNIT))]

    def build(height):
        builder = SceneBuilder()
        builder.add_body(Plane((0, 1, 0), 0.0), static=True, friction=0.3)
        start = {"position": (0, height, 0), "orientation": (0, 1, 0, 0), "velocity": (0.3, -1, 0.2)}
        builder.add_body(Compound(parts), density=500.0, friction=0.3, angular_velocity=(1, -2, 1), **start)
        return builder.build(undamped(dt=DT, velocity_iterations=40))

    gap = float(contacts(*build(1.0)).separation.min())
    model, state = build(1.0 - gap + 0.01)  # it lands in the third step
    rng = np.random.default_rng(0)

    @jax.jit
    def outcome(model):
        final, _ = rollout(model, state, 6)
        return jnp.concatenate([final.position[1], final.orientation[1], final.angular_velocity[1]])

    assert jnp.any(contact_forces(model, rollout(model, state, 6)[0]) != 0)
    gradients = jax.jit(jax.jacrev(outcome))(model)
    for path, leaf in jax.tree_util.tree_leaves_with_path(model):
        if leaf.size == 0 or path[0].name not in ("mass", "inertia", "inertia_frame", "shapes") or "plane" in str(path):
            continue
        direction = rng.normal(size=leaf.shape)
        after, before = (outcome(changed(model, path, sign * 1e-7 * direction)) for sign in (1, -1))
        difference = (after - before) / 2e-7
        ours = dict(jax.tree_util.tree_leaves_with_path(gradients))[path]
        ours = np.tensordot(ours, direction, leaf.ndim)
        gate(jax.tree_util.keystr(path), np.abs(ours - difference).max() / (1.0 + np.abs(difference).max()), 1e-5)
    for leaf in (gradients.inertia_frame[:, 1], *gradients.shapes["box"].values()):
        assert np.abs(leaf).max() > 1e-3
