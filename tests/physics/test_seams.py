"""Floors of many boxes are as even as floors of one: nothing trips over their seams, and what does protrude still stops.

Closed forms: ``x = v t - mu g t^2 / 2`` until a box stops; a ball slides until it rolls at 5/7 of its speed.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import (
    Box,
    Compound,
    Cone,
    Cylinder,
    Plane,
    Polyhedron,
    SceneBuilder,
    Sphere,
    step,
)
from mathota_jax.constraints.ground import has_seams
from tests.scenes import DOWN, GRAVITY, undamped

FRICTION, STEPS, DT = 0.3, 60, 1 / 60
UNTURNED = (1.0, 0.0, 0.0, 0.0)
RIM = [(0.12 * np.cos(k), -0.1, 0.12 * np.sin(k)) for k in np.arange(6) * np.pi / 3]
TAPERED = Polyhedron(RIM + [(0.7 * x, 0.1, 0.7 * z) for x, _, z in RIM])
SHAPES = {
    "sphere": (Sphere(0.1), 0.1),
    "box": (Box((0.15, 0.1, 0.1)), 0.1),
    "cylinder": (Cylinder(0.12, 0.1), 0.1),
    "cone": (Cone(0.15, 0.1), 0.05),
    "polyhedron": (TAPERED, 0.1),
}
ROLLING = {"sphere": 2 / 5}


def tiles(kind):
    """Static bodies that make a level floor from x = -3 to 3: shapes and positions."""
    if kind == "plane":
        return [(Plane((0, 1, 0)), (0, 0, 0))]
    places = [(-2.25 + 1.5 * k, -0.25, 0) for k in range(4)]
    box = Box((0.75, 0.25, 2))
    if kind == "compound":
        return [(Compound([(box, (place, UNTURNED)) for place in places]), (0, 0, 0))]
    if kind == "mixed":
        hull = Polyhedron([(x, y, z) for x in (-0.75, 0.75) for y in (-0.25, 0.25) for z in (-2, 2)])
        part = Compound([(hull, (places[2], UNTURNED)), (Sphere(0.1), ((0.75, -0.3, 0), UNTURNED))])
        return [(hull, places[0]), (box, places[1]), (part, (0, 0, 0)), (box, places[3])]
    return [(box, place) for place in places]


def floor(kind, names, obstacle=False, **options):
    """Model, state and handles of bodies on a floor, beside each other; the obstacle is a box to be put somewhere."""
    builder = SceneBuilder(gravity=DOWN)
    for shape, place in tiles(kind):
        builder.add_body(shape, static=True, position=place, friction=FRICTION)
    block = (
        builder.add_body(Box((0.5, 0.5, 2)), static=True, position=(0, 0.5, 0), friction=FRICTION) if obstacle else None
    )
    movers = []
    for number, name in enumerate(names):
        shape, height = SHAPES[name]
        place = (-1, height, 0.5 * number - 0.25 * (len(names) - 1))
        movers.append(builder.add_body(shape, mass=1.0, position=place, friction=FRICTION))
    if len(movers) > 1:
        builder.ignore_collisions(movers)
    return *builder.build(undamped(dt=DT, **options)), movers, block


def thrown(state, movers, speeds, starts=0.0):
    """A world for each speed."""
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(speeds), *leaf.shape)), state)
    starts = np.broadcast_to(starts, len(speeds))
    for mover in movers:
        states = dataclasses.replace(
            states,
            velocity=states.velocity.at[:, mover, 0].set(speeds),
            position=states.position.at[:, mover, 0].add(-starts),
        )
    return states


@jax.jit
def paths(model, states):
    """Positions and flags of all worlds after every step."""

    def advance(states, _):
        states = jax.vmap(step, (None, 0))(model, states)
        return states, (states.position, states.flags)

    return jax.lax.scan(advance, states, length=STEPS)[1]


SPEEDS, STARTS = np.linspace(1.5, 4.0, 16), np.linspace(0.0, 0.3, 16)


def way(name, time):
    """Closed form (time, world)."""
    speed = SPEEDS[None]
    share = ROLLING.get(name)
    slides = speed / (FRICTION * GRAVITY) * (1.0 if share is None else share / (1.0 + share))
    during = np.minimum(time[:, None], slides)
    way = speed * during - 0.5 * FRICTION * GRAVITY * during**2
    return way + (time[:, None] - during) * (0.0 if share is None else speed / (1.0 + share))


@pytest.mark.parametrize(
    ("kind", "names", "options"),
    [
        pytest.param("boxes", ("sphere", "box"), {}, id="boxes"),
        pytest.param("boxes", ("sphere", "box"), {"broadphase": "grid"}, id="boxes-grid"),
        *(
            pytest.param(kind, names, options, id=name, marks=pytest.mark.slow)
            for name, kind, names, options in (
                ("compound", "compound", ("sphere", "box"), {}),
                ("mixed", "mixed", ("sphere", "box"), {}),
                ("soft_step", "boxes", ("sphere", "box"), {"solver": "soft_step"}),
                ("converged", "boxes", ("sphere", "box"), {"solver": "converged"}),
                ("continuous", "boxes", ("sphere",), {"continuous": True}),
                ("polyhedron", "boxes", ("polyhedron",), {}),
                ("cylinder", "boxes", ("cylinder",), {}),
                ("cone", "boxes", ("cone",), {}),
                ("polyhedron-grid", "boxes", ("polyhedron", "cylinder"), {"broadphase": "grid"}),
            )
        ),
    ],
)
def test_nothing_trips_over_a_seam(kind, names, options, gate):
    model, state, movers, _ = floor(kind, names, **options)
    position, flags = paths(model, thrown(state, movers, SPEEDS, STARTS))
    assert not np.asarray(flags).any()
    found, time = np.asarray(position, np.float64), DT * np.arange(1, STEPS + 1)
    for name, mover in zip(names, movers, strict=True):
        height = found[:, :, mover, 1] - np.float64(state.position[mover, 1])
        gate(f"{name}: height over the floor [m]", np.abs(height).max(), 2e-4)
        moved = found[:, :, mover, 0] - (-1 - STARTS)
        # A step in which sliding ends is a step of mean friction.
        gate(f"{name}: way [m]", np.abs(moved - way(name, time)).max(), 8e-3)


OBSTACLES = {
    "wall": ((1.0, 0.5, 0.0), 0.0),
    "curb": ((1.0, -0.48, 0.0), 0.0),
    "low curb": ((1.0, -0.498, 0.0), 0.0),
    "ramp": ((1.0, -0.3, 0.0), 0.3),
}
"""Where the centre of the block is, and by what angle [rad] it is turned."""


def test_what_protrudes_still_stops(gate):
    """Beside the same obstacles on a plane, which has no seams: the block at most one static shape that ends."""
    speeds = np.linspace(2.0, 5.0, 16)
    paths_on = {}
    for kind in ("plane", "boxes"):
        model, state, movers, block = floor(kind, ("sphere", "box"), obstacle=True)
        assert has_seams(model.scene) == (kind == "boxes")
        states = thrown(state, movers, speeds)
        for name, (place, angle) in OBSTACLES.items():
            turn = jnp.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
            put = dataclasses.replace(
                states,
                position=states.position.at[:, block].set(jnp.asarray(place)),
                orientation=states.orientation.at[:, block].set(turn),
            )
            paths_on[kind, name] = np.asarray(paths(model, put)[0])[:, :, -2:]
    for name in OBSTACLES:
        plane, boxes = paths_on["plane", name], paths_on["boxes", name]
        # Later, boxes that tumble have gone ways of their own: those on planes have other contact points.
        gate(f"{name}: beside a floor of one plane [m]", np.abs(plane - boxes)[:30].max(), 2e-3)
        assert name == "wall" or np.abs(boxes - paths_on["boxes", "wall"]).max() > 0.05
    assert paths_on["boxes", "wall"][-1, -1, :, 0] == pytest.approx([0.5 - 0.1, 0.5 - 0.15], abs=2e-3)


def test_scenes_without_seams_have_no_code_for_them():
    for kind in ("plane", "boxes"):
        for obstacle in (False, True):
            model, *_ = floor(kind, ("box",), obstacle)
            assert has_seams(model.scene) == (kind == "boxes")


def test_a_falling_plank_lands_on_both_tiles(gate):
    """It stands on end over a tile, leans over the seam, and ends level on both: its underside never sinks in."""
    builder = SceneBuilder(gravity=DOWN)
    for shape, place in tiles("boxes"):
        builder.add_body(shape, static=True, position=place, friction=1.0)
    lean = 0.2
    turn = (np.cos(0.5 * (np.pi / 2 - lean)), 0.0, 0.0, np.sin(0.5 * (np.pi / 2 - lean)))
    plank = builder.add_body(
        Box((0.5, 0.02, 0.1)),
        mass=1.0,
        friction=1.0,
        orientation=turn,
        position=(-0.2 + 0.5 * np.sin(lean), 0.5 * np.cos(lean) + 0.02 * np.sin(lean), 0.0),
    )
    model, state = builder.build(undamped(dt=DT))
    positions = np.asarray(paths(model, thrown(state, [plank], np.zeros(2)))[0])[:, :, plank]
    gate("lowest centre [m]", 0.02 - positions[..., 1].min(), 2e-3)
    gate("height at the end [m]", np.abs(positions[-1, :, 1] - 0.02).max(), 1e-3)
