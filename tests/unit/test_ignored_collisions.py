"""`SceneBuilder.ignore_collisions`: bodies that pass through each other, and what that leaves of the program."""

import numpy as np
import pytest

from mathota_jax import Box, Options, Plane, SceneBuilder, Sphere, contact_forces, describe, rollout
from mathota_jax.collision.broadphase import BROADPHASES
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, GRAVITY, quadruped, stiffened, undamped


def columns_of_balls(count=2, broadphase="auto"):
    """Builder, handles (column, level) and options of balls in columns of three, each 0.3 m above the one below."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.0, name="ground")
    balls = np.empty((count, 3), int)
    for column in range(count):
        for level in range(3):
            place = (3.0 * column, 0.1 + 0.5 * level, 0.0)
            balls[column, level] = builder.add_body(Sphere(0.1), mass=1.0, position=place, friction=0.0)
    return builder, balls, undamped(dt=1 / 120, broadphase=broadphase)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("broadphase", slow_but(["none", "grid"], ["none", *BROADPHASES]))
def test_bodies_fall_through_what_they_ignore(broadphase, precision, gate):
    """The middle ball of a column ignores those of the column; the plane stops it where it lies in the lowest."""
    builder, balls, options = columns_of_balls(broadphase=broadphase)
    builder.ignore_collisions(int(balls[0, 1]), balls[0])
    model, state = builder.build(options)
    places, steps = np.asarray(rollout(model, state, 240)[1].position, float), 24
    free = 0.6 - 0.5 * GRAVITY * (steps * options.dt) ** 2
    fallen = places[steps - 1, balls[:, 1], 1]
    gate("free fall [m]", fallen - free, {"float32": 1e-6, "float64": 1e-12}[str(precision)])
    # In the first column the upper ball, too, comes to rest on the lowest: the middle one is no obstacle.
    expected = [[0.1, 0.1, 0.3], [0.1, 0.3, 0.5]]
    gate("heights at rest [m]", places[-1, balls, 1] - np.array(expected), 2e-4)


def test_no_two_of_one_set_collide(gate):
    builder, balls, options = columns_of_balls()
    builder.ignore_collisions(balls[0])
    model, state = builder.build(options)
    final = rollout(model, state, 240)[0]
    gate("heights at rest [m]", np.asarray(final.position)[balls, 1] - [[0.1, 0.1, 0.1], [0.1, 0.3, 0.5]], 2e-4)
    forces = np.asarray(contact_forces(model, final), float)[:6, 1]  # the slots of the plane come first
    gate("borne by the plane / weight of all - 1", np.abs(forces).sum() / (6 * GRAVITY) - 1, 1e-3)


def test_what_is_ignored_is_absent():
    """Slots, broadphase and kinds of pairs are those of the pairs that are left (benchmark M3)."""
    builder, balls, options = columns_of_balls(count=3)
    assert builder.build(options)[0].scene.broadphase is not None
    for column in balls:
        builder.ignore_collisions(column)
    builder.ignore_collisions(balls[0], [*balls[1], *balls[2]])
    scene = builder.build(options)[0].scene
    assert scene.broadphase is None
    found = {(group.kind_a, group.kind_b): len(group.bodies_a) for group in scene.pair_groups}
    assert found == {("plane", "sphere"): 9, ("sphere", "sphere"): 9}
    builder.ignore_collisions(balls[1], balls[2])
    builder.ignore_collisions("ground", balls[0])
    model, state = builder.build(options)
    assert "sphere-sphere" not in describe(model)
    assert model.scene.slot_count == 6 and state.contact_force.shape[0] == 6


@pytest.mark.parametrize("broadphase", BROADPHASES)
def test_listed_kinds_and_capacity_are_those_of_possible_pairs(broadphase):
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Box((9.0, 1.0, 9.0)), static=True, position=(0, -1, 0), name="floor")
    boxes = [builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(k, 0.1, 0)) for k in range(5)]
    balls = [builder.add_body(Sphere(0.1), mass=1.0, position=(k, 0.1, 1)) for k in range(4)]
    builder.ignore_collisions(boxes, balls)
    builder.ignore_collisions(balls)
    plan = builder.build(Options(broadphase=broadphase))[0].scene.broadphase
    kinds = {(group.kind_a, group.kind_b, group.side_count) for group in plan.groups}
    assert kinds == {("box", "box", 1), ("sphere", "box", 1), ("box", "box", 2)}
    assert plan.capacity == 10 + 5 + 4


def test_what_never_meets_may_be_ignored_at_no_change(float64, gate):
    """One huge filter equals none (benchmark M2); with a broadphase, since slots of their own are swept in another order."""
    finals = []
    for ignores in (False, True):
        builder, balls, options = columns_of_balls(broadphase="all_pairs")
        if ignores:
            builder.ignore_collisions(balls[0], balls[1])
        finals.append(rollout(*builder.build(options), 60)[0])
    for leaf in ("position", "velocity", "orientation", "angular_velocity"):
        gate(leaf, np.asarray(getattr(finals[0], leaf) - getattr(finals[1], leaf)), 1e-12)


@pytest.mark.slow
def test_a_robot_that_ignores_itself_stands_on_light_feet(precision, gate):
    """Four legs of two capsules: with their own pairs left out, contacts are solved with the joints held."""
    options = undamped(dt=1 / 240)
    crowded = quadruped("spring", options, ignores_itself=False)[0]
    model, state = quadruped("spring", options)
    model = stiffened(model, "spring", 2e3, 20.0)
    assert crowded.scene.broadphase is not None and model.scene.broadphase is None
    assert "contacts with the joints held" in describe(model).split("absent")[0]
    final = rollout(model, state, 240)[0]
    gate("moved [m]", np.asarray(final.position - state.position, float), 1e-4)
    gate("speed at the end [m/s]", np.asarray(final.velocity, float), 1e-3)
    borne = np.abs(np.asarray(contact_forces(model, final), float)[:, 1]).sum()
    gate("borne by the ground / weight - 1", borne / (22.4 * GRAVITY) - 1, 1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("ball",), "at least two bodies are needed, got 'ball' and None"),
        (([],), "at least two bodies are needed"),
        ((["ball", "bal"],), "ignore_collisions: bodies: no body is called 'bal'; known: 0 'ball', 1 'wall'"),
        (("ball", 7), "ignore_collisions: others: no body has the handle 7"),
        ((["ball", None],), "no body has the handle None"),
    ],
)
def test_errors_name_what_is_wrong(arguments, message):
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Sphere(1.0), mass=1.0, name="ball")
    builder.add_body(Box((1, 1, 1)), static=True, name="wall")
    with pytest.raises(ValueError) as error:
        builder.ignore_collisions(*arguments)
    assert message in str(error.value)
