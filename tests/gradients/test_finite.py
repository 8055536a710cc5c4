"""No derivative is ever NaN: at rest, touching, never touching, coincident, for every pair of shapes and a joint."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Hinge, Plane, SceneBuilder, Slider, Sphere, contacts, energy, rollout, step
from mathota_jax.constraints.impact import Approach, stop
from mathota_jax.spatial.vector import Vec3
from tests.scenes import DOWN, stack, undamped

HALF = 0.1  # every shape reaches this far below its centre

SHAPES = {"sphere": Sphere(HALF), "box": Box((HALF, HALF, HALF)), "capsule": Capsule(0.04, 0.06)}

TINY = (1e-9, 1e-12, 1e-15, 1e-20, 1e-25, 1e-30, 1e-36)
"""Speeds of bodies at rest but for round-off, and coefficients that all but vanish."""

EVERYTHING = ("sphere", "sphere", "box", "box", "capsule", "capsule")


def scene(kinds, restitution):
    """Bodies of some kinds on a plane; of all kinds, beside them joints with limits and motors."""
    builder = SceneBuilder(gravity=DOWN)
    surface = {"friction": 0.5, "restitution": restitution}
    ground = builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, **surface)
    for kind in kinds:
        builder.add_body(SHAPES[kind], mass=1.0, **surface)
    if kinds == EVERYTHING:
        add_joints(builder, ground)
    return builder.build(undamped(dt=1 / 60))


def add_joints(builder, ground):
    """A hinge and a slider."""
    lever = builder.add_body(Box((0.02, 0.1, 0.02)), mass=0.5, position=(5.0, 1.0, 0.0), collides=False)
    hinge = builder.add_joint(
        Hinge(parent=ground, child=lever, anchor=(5, 1.1, 0), axis=(0, 0, 1), limits=(-0.5, 0.5), damping=0.01)
    )
    builder.add_motor(hinge, kind="torque", limit=1.0)
    cart = builder.add_body(Sphere(0.1), mass=0.5, position=(7.0, 1.0, 0.0), collides=False)
    slider = builder.add_joint(Slider(parent=ground, child=cart, anchor=(7, 1, 0), axis=(1, 0, 0), limits=(0.0, 0.5)))
    builder.add_motor(slider, kind="torque", limit=1.0)


def placements(count):
    """Centres of the free bodies in each situation."""
    apart = np.array([[0.5 * index, 0.0, 0.0] for index in range(count)])
    up = np.array([0.0, HALF, 0.0])
    row = np.array([[2 * HALF * index, HALF, 0.0] for index in range(count)])
    return {
        "resting on the plane": apart + up,
        "never touching": apart + 3 * up + [0.0, 10.0, 0.0],
        "touching one another in a row": row,
        "a hair apart": row * [1.0 + 1e-7, 1.0, 1.0],
        "all coincident": np.tile(up, (count, 1)),
        "coincident in pairs": np.repeat(apart[::2], 2, axis=0) + up,
        "centre on the plane": apart,
        "below the plane": apart - up,
    }


@pytest.mark.parametrize(
    ("kinds", "restitution", "double"),
    [
        (("sphere", "box"), 0.5, False),
        pytest.param(EVERYTHING, 0.5, False, marks=pytest.mark.slow),
        pytest.param(EVERYTHING, 0.0, True, marks=pytest.mark.slow),
        pytest.param(EVERYTHING, 0.0, False, marks=pytest.mark.slow),
        pytest.param(EVERYTHING, 0.5, True, marks=pytest.mark.slow),
    ],
)
def test_every_gradient_is_finite(kinds, restitution, double):
    with jax.enable_x64(double):
        check_every_gradient(kinds, restitution)


def check_every_gradient(kinds, restitution):
    model, state = scene(kinds, restitution)
    names, centres = zip(*placements(len(kinds)).items(), strict=True)
    free = slice(1, 1 + len(kinds))
    states = stack([dataclasses.replace(state, position=state.position.at[free].set(jnp.asarray(p))) for p in centres])
    # An impact must not divide by a vanishing approach speed, nor by the square of one that underflows.
    motions = ((0.0, 0.0), (0.5, 0.0), *((speed, speed) for speed in TINY))
    moving = [
        dataclasses.replace(
            states,
            velocity=states.velocity.at[:, free, 1].add(-speed),
            angular_velocity=states.angular_velocity.at[:, free, 2].add(-spin),
        )
        for speed, spin in motions
    ]
    states = jax.tree.map(lambda *parts: jnp.concatenate(parts), *moving)
    names = [f"{name}, at {speed:g} m/s, {spin:g} rad/s" for speed, spin in motions for name in names]
    weights = [np.random.default_rng(3).normal(size=(model.scene.body_count, size)) for size in (3, 4, 3, 3)]

    def loss(model, state, action):
        final, _ = rollout(model, state, jnp.broadcast_to(action, (2, *action.shape)))
        leaves = (final.position, final.orientation, final.velocity, final.angular_velocity)
        found = contacts(model, final)
        seen = jnp.sum(found.separation) + jnp.sum(found.normal) + jnp.sum(found.position)
        return sum(jnp.sum(w * leaf) for w, leaf in zip(weights, leaves, strict=True)) + energy(model, final) + seen

    gradient = jax.grad(loss, argnums=(0, 1, 2), allow_int=True)
    batch = jax.jit(jax.vmap(gradient, in_axes=(None, 0, None)))(
        model, states, jnp.array([0.3, -0.2][: len(model.scene.motors)])
    )
    bad = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(batch):
        if leaf.dtype == jax.dtypes.float0:
            continue
        finite = np.isfinite(np.asarray(leaf)).reshape(len(names), -1).all(axis=1)
        bad += [f"{name}: d / d {jax.tree_util.keystr(path)}" for name, ok in zip(names, finite, strict=True) if not ok]
    assert not bad, "not finite:\n" + "\n".join(bad)


@pytest.mark.parametrize("speed", [0.0, 1e-30, 1e-19, 1e-9, 1.0])
def test_a_wide_gap_that_hardly_closes(speed):
    """The time of an impact that does not come in this step has no derivative, and no infinite one times 0 either."""

    def lever(start):
        one = jnp.ones(1)
        gravity = Vec3(0.0 * one, -9.81 * one, 0.0 * one)
        return stop(Approach(20.0 * one, -start * one, -start * one, None, gravity), None, jnp.asarray(0.01))

    assert np.isfinite(np.asarray(jax.jacrev(lambda start: jnp.stack(lever(start)))(speed))).all()


@pytest.mark.slow
def test_a_joint_that_hardly_resists():
    """The softness of a spring, damper or rotor is the reciprocal of what vanishes here; of all, then of each alone."""
    resisting = ("joint_damping", "joint_stiffness", "joint_armature", "joint_friction")
    builder = SceneBuilder(gravity=DOWN)
    ground = builder.add_body(Sphere(0.02), static=True, collides=False)
    lever = builder.add_body(Box((0.02, 0.1, 0.02)), mass=0.5, position=(0, -0.1, 0), collides=False)
    builder.add_joint(
        Hinge(ground, lever, (0, 0, 0), (0, 0, 1), damping=1.0, stiffness=1.0, armature=1.0, friction=1.0, rest=0.1)
    )
    model, state = builder.build(undamped(dt=1 / 240))

    def loss(values):
        changed = dataclasses.replace(
            model, **{name: value[None] for name, value in zip(resisting, values, strict=True)}
        )
        final = step(changed, state)
        return final.angular_velocity[1, 2] + final.position[1, 0]

    all_small = [[value] * 4 for value in (0.0, *TINY)]
    one_small = [[value if k == alone else 1.0 for k in range(4)] for alone in range(4) for value in (0.0, *TINY)]
    values = jnp.array(all_small + one_small)
    gradient = np.asarray(jax.jit(jax.vmap(jax.grad(loss)))(values))
    bad = ~np.isfinite(gradient).all(axis=1)
    assert not bad.any(), f"not finite with {', '.join(resisting)} =\n{np.asarray(values)[bad]}"
