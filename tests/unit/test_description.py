"""`describe` says what a scene compiles to."""

import jax
import pytest

from mathota_jax import Box, Cylinder, Hinge, Options, Plane, SceneBuilder, Sphere, describe
from tests.scenes import quadruped, sphere_on_plane, undamped, with_dt


def lines(model):
    return dict(line.split(": ", 1) for line in describe(model).splitlines())


def workshop(options=None, spheres=2):
    """The plane, a crate with a limited, driven door, and loose balls."""
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    crate = builder.add_body(Box((0.5, 0.5, 0.5)), mass=5.0, position=(0, 0.5, 0))
    door = builder.add_body(Box((0.4, 0.4, 0.02)), mass=1.0, position=(0, 0.5, 0.6))
    hinge = builder.add_joint(
        Hinge(parent=crate, child=door, anchor=(-0.4, 0.5, 0.6), axis=(0, 1, 0), limits=(0, 1), damping=0.1)
    )
    builder.add_motor(hinge)
    for k in range(spheres):
        builder.add_body(Sphere(0.1), mass=1.0, position=(3.0 + k, 0.1, 0.0), restitution=0.0)
    return builder.build(options or Options())


def balls(count):
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    for k in range(count):
        builder.add_body(Sphere(0.1), mass=1.0, position=(3.0 + k, 0.1, 0.0))
    return builder.build()[0]


def test_what_a_scene_has():
    found = lines(workshop()[0])
    assert found["bodies"] == "5 (4 moving, 1 static)"
    assert found["shapes"] == "1 plane, 2 box, 2 sphere"
    # Two boxes and two spheres on the plane, two spheres with two boxes, two spheres; the joined boxes do not collide.
    assert found["pairs with slots of their own, plane-box"].startswith("2 of up to 4 points")
    assert found["pairs with slots of their own, sphere-box"].startswith("4 of up to 1 points, closed form")
    assert "pairs with slots of their own, box-box" not in found
    slots = 2 * 4 + 2 + 4 + 1
    assert found["contact slots"] == str(slots)
    assert found["rows"] == f"{3 * slots} of contacts, {5 + 2 + 1} of joints"
    assert found["joints"] == "1 hinge (rows of their own: 1 lower, 1 upper, 1 damping)"
    assert found["motors"] == "1 torque"
    assert found["broadphase"] == "none"
    present, absent = (set(found[key].split(", ")) for key in ("present", "absent"))
    assert {"friction", "joints", "warm start", "linear damping", "gyroscopic torque"} <= present
    assert absent == {"restitution", "sleep", "continuous collision", "steps split at impacts"}
    assert "dt=0.0166667" in found["settings"] and "velocity_iterations=10" in found["settings"]


def test_a_robot_on_the_ground():
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    links = [builder.add_body(Sphere(0.1), mass=1.0, position=(0.3 * k, 0.1, 0)) for k in range(4)]
    for k in range(3):
        builder.add_joint(Hinge(links[k], links[k + 1], (0.3 * k + 0.15, 0.1, 0), (0, 0, 1)))
    found = lines(builder.build()[0])
    present = found["present"].split(", ")
    assert "exact joints" in present and "contacts with the joints held" in present
    assert found["expected cost"] == "not measured for these settings", "it would be wrong by an order of magnitude"


def test_what_a_scene_lacks():
    builder = SceneBuilder()
    builder.add_body(Sphere(0.1), mass=1.0)
    model, _ = builder.build(undamped(warm_start=False, position_iterations=0))
    found = lines(model)
    assert found["present"] == "nothing"
    assert found["contact slots"] == "0" and found["turns of a sweep"] == "0" and found["joints"] == "none"


def test_what_is_no_model():
    _, state = workshop()
    with pytest.raises(ValueError, match="describe: expected a Model, got State"):
        describe(state)


def test_the_broadphase_and_its_capacities():
    model, _ = workshop(Options(broadphase="all_pairs", pair_capacity=7), spheres=4)
    found = lines(model)
    assert found["broadphase"] == "all_pairs of 6 shapes, up to 7 close pairs"
    assert any(name.startswith("close pairs, sphere-sphere with a moving body") for name in found)


def test_pairs_that_touch_with_the_joints_held():
    model, _ = quadruped("servo", Options(touching_capacity=5), ignores_itself=False)
    places = "those of close pairs in up to 5 places of 2 points at a time"
    assert lines(model)["rows"] == f"276 of contacts ({places}), 48 of joints"


def tins(options):
    """Cylinders on the plane: their contacts are matched by distance from step to step, unless that is switched off."""
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    for k in range(3):
        builder.add_body(Cylinder(0.1, 0.1), mass=1.0, position=(k, 0.1, 0.0))
    return builder.build(options)


@pytest.mark.parametrize(
    ("scene", "options"),
    [
        (workshop, Options()),
        (workshop, Options(sleep=True)),
        (workshop, Options(broadphase="all_pairs", sleep=True)),
        (workshop, Options(solver="soft_step")),
        (tins, Options()),
        (tins, Options(warm_start_match=0.0)),
        (tins, Options(broadphase="all_pairs")),
        (tins, Options(solver="soft_step", sleep=True)),
    ],
)
def test_memory_is_that_of_the_state(precision, scene, options):
    model, state = scene(options)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    assert lines(model)["memory of a state"] == f"{size} bytes a world"


def test_the_present_time_step_is_shown():
    assert "dt=0.25" in lines(with_dt(sphere_on_plane()[0], 0.25))["settings"]


def test_expected_cost():
    def cost(**options):
        found = lines(sphere_on_plane(options=undamped(**options))[0])["expected cost"]
        return float(found.split()[0]) if found[0].isdigit() else None

    ten, twenty = cost(), cost(velocity_iterations=20)
    assert 0 < ten <= twenty < 1e3
    assert cost(solver="converged") > ten
    assert cost(solver="soft_step", substeps=8) is None and cost(sleep=True) is None
    assert cost(impact_events=4) == ten, "nothing bounces: the option is absent"


def test_a_larger_scene_is_expected_to_cost_more():
    few, many = (float(lines(balls(count))["expected cost"].split()[0]) for count in (1, 6))
    assert few < many
