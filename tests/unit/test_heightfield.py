"""Convex shapes against heightfields: float64 oracles, the plane as the limit of flat ground, derivatives, scenes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax import Box, Capsule, Heightfield, Options, Plane, Polyhedron, SceneBuilder, Sphere, rollout, step
from mathota_jax.collision.height_grid import window_size
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.collision.pairs.plane_box import plane_box
from mathota_jax.collision.pairs.plane_capsule import plane_capsule
from mathota_jax.collision.pairs.plane_cone import plane_cone
from mathota_jax.collision.pairs.plane_cylinder import plane_cylinder
from mathota_jax.collision.pairs.plane_polyhedron import plane_polyhedron
from mathota_jax.collision.pairs.plane_sphere import plane_sphere
from mathota_jax.queries import Geometry, manifold, signed_distance
from mathota_jax.spatial.vector import Vec3
from tests.heightfields import CELL, REACH, SIZES, STONE, STONE_FACES, UPRIGHT, field_of, natural, place, run, shape_of
from tests.marks import slow_but
from tests.scenes import undamped

FUNCTIONS = {
    "sphere": plane_sphere,
    "capsule": plane_capsule,
    "box": plane_box,
    "cylinder": plane_cylinder,
    "cone": plane_cone,
    "polyhedron": plane_polyhedron,
}
KINDS = list(FUNCTIONS)
QUICK_AND_SLOW_KINDS = [
    kind if kind in ("sphere", "box") else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS
]


def poses(count, seed, spread=0.5, height=(0.0, 0.6)):
    rng = np.random.default_rng(seed)
    position = np.stack(
        [rng.uniform(-spread, spread, count), rng.uniform(*height, count), rng.uniform(-spread, spread, count)], -1
    )
    return position, Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]


# ---- flat and inclined ground equals the plane --------------------------------------------------------------------


@pytest.mark.parametrize("kind", QUICK_AND_SLOW_KINDS)
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.2)], ids=["flat", "inclined"])
def test_even_ground_is_a_plane(kind, slope, float64, gate):
    rows, columns = 13, 15
    along = (np.arange(rows) - 6.0) * CELL
    across = (np.arange(columns) - 7.0) * CELL
    heights = slope[0] * along[:, None] + slope[1] * across
    normal = np.array([-slope[0], 1.0, -slope[1]])
    normal /= np.linalg.norm(normal)
    position, orientation = poses(200, 3)
    position[:, 1] += slope[0] * position[:, 0] + slope[1] * position[:, 2]
    found = run(kind, heights, position, orientation)

    pose = place(position, orientation)
    plane = {"normal": Vec3(*(jnp.full((1, 1), n) for n in normal)), "offset": jnp.zeros((1, 1))}
    truth = natural(FUNCTIONS[kind](plane, None, shape_of(kind, SIZES[kind]), pose), 200)

    used = found["active"]
    assert used[0].all()
    gate("normal", np.abs(found["normal"] + normal)[used], 1e-13)
    worst = 0.0
    for world in range(200):
        ours = found["position"][used[:, world], world], found["separation"][used[:, world], world]
        theirs = (
            truth["position"][truth["active"][:, world], world],
            truth["separation"][truth["active"][:, world], world],
        )
        assert len(ours[0]) == len(theirs[0])
        for point, gap in zip(*theirs, strict=True):
            worst = max(worst, np.min(np.linalg.norm(ours[0] - point, axis=1) + np.abs(ours[1] - gap)))
    gate("points", worst, 1e-12)


# ---- hills: exact distances --------------------------------------------------------------------------------------

HILLS = np.random.default_rng(5).normal(size=(11, 12)) * 0.12


def grid_points(heights, cell=CELL):
    rows, columns = heights.shape
    along, across = (np.arange(rows) - 0.5 * (rows - 1)) * cell, (np.arange(columns) - 0.5 * (columns - 1)) * cell
    return np.stack(np.broadcast_arrays(along[:, None], heights, across), -1)


def triangles(heights, cell=CELL):
    p = grid_points(heights, cell)
    corner, opposite, beyond, beside = p[:-1, :-1], p[1:, 1:], p[1:, :-1], p[:-1, 1:]
    parts = [np.stack([corner, beyond, opposite], -2), np.stack([corner, opposite, beside], -2)]
    return np.concatenate([part.reshape(-1, 3, 3) for part in parts])


def surface(heights, points, cell=CELL):
    """Height of the ground at points (..., 3)."""
    rows, columns = heights.shape
    u, v = points[..., 0] / cell + 0.5 * (rows - 1), points[..., 2] / cell + 0.5 * (columns - 1)
    i, j = np.clip(np.floor(u), 0, rows - 2).astype(int), np.clip(np.floor(v), 0, columns - 2).astype(int)
    a, b = u - i, v - j
    h = heights
    left = h[i, j] + (h[i + 1, j] - h[i, j]) * a + (h[i + 1, j + 1] - h[i + 1, j]) * b
    right = h[i, j] + (h[i + 1, j + 1] - h[i, j + 1]) * a + (h[i, j + 1] - h[i, j]) * b
    return np.where(b > a, right, left)


def nearest_on_segment(point, start, end):
    span = end - start
    share = np.clip(((point - start) * span).sum(-1) / (span * span).sum(-1), 0.0, 1.0)
    return start + share[..., None] * span


def nearest_on_triangles(point, corners):
    """Nearest point of each triangle (triangle, 3, 3) to each point (..., 1, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    best = point - ((point - a) * normal).sum(-1, keepdims=True) * normal
    inside = np.ones(best.shape[:-1], bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - start, best - start) * normal).sum(-1) >= 0
    distance = np.where(inside, np.linalg.norm(point - best, axis=-1), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        other = nearest_on_segment(point, start, end)
        away = np.linalg.norm(point - other, axis=-1)
        best, distance = np.where((away < distance)[..., None], other, best), np.minimum(away, distance)
    return best, distance


def over_the_hills(kind, count, seed=11):
    """Poses near the surface and which of them are clear of it."""
    position, orientation = poses(count, seed, 0.55)
    position[:, 1] += surface(HILLS, position) - 0.05
    return position, orientation


def test_sphere_distance_is_that_of_the_nearest_triangle(float64, gate):
    position, orientation = over_the_hills("sphere", 400)
    found = run("sphere", HILLS, position, orientation)
    above = position[:, 1] > surface(HILLS, position)
    assert above.sum() > 300
    distance = nearest_on_triangles(position[:, None], triangles(HILLS))[1].min(1)
    gate("separation", (found["separation"][0] - distance + SIZES["sphere"]["radius"])[above], 1e-12)
    foot = position + found["normal"][0] * (found["separation"][0] + SIZES["sphere"]["radius"])[:, None]
    gate("foot on the ground", (surface(HILLS, foot) - foot[:, 1])[above], 1e-12)
    # A centre in the ground leaves upward.
    assert (~above).sum() > 10 and found["active"][0][~above].all() and (found["normal"][0][~above][:, 1] < 0).all()
    assert (found["separation"][0][~above] < -SIZES["sphere"]["radius"]).all()


def samples(kind):
    """Points all over the surface of a shape (of a capsule: of its axis)."""
    if kind == "capsule":
        axis = np.linspace(-1.0, 1.0, 801)[:, None]
        return axis * [0.0, SIZES[kind]["half_height"], 0.0]
    grid = np.linspace(-1.0, 1.0, 31)
    if kind == "box":
        cube = np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3)
        return cube[np.abs(cube).max(1) == 1] * SIZES[kind]["half_extents"]
    if kind == "polyhedron":
        parts = []
        first, second = (x.ravel() for x in np.meshgrid(0.5 * (grid + 1), 0.5 * (grid + 1)))
        inside = first + second <= 1
        first, second = first[inside, None], second[inside, None]
        for face in STONE_FACES:
            corners = STONE[list(face)]
            for k in range(1, len(corners) - 1):
                parts.append(corners[0] * (1 - first - second) + corners[k] * first + corners[k + 1] * second)
        return np.concatenate(parts)
    radius, half = SIZES[kind]["radius"], SIZES[kind]["half_height"]
    share, angle = (x.ravel() for x in np.meshgrid(0.5 * (grid + 1), np.linspace(0, 2 * np.pi, 120, endpoint=False)))
    disc = radius * share[:, None] * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    rim = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    if kind == "cylinder":
        side = rim + (2 * share - 1)[:, None] * [0, half, 0]
        return np.concatenate([side, disc - [0, half, 0], disc - [0, -half, 0]])
    side = rim * (1 - share)[:, None] + (2.0 * share - 0.5)[:, None] * [0, half, 0]
    return np.concatenate([side, disc - [0, 0.5 * half, 0]])


def nearest_in_body(kind, point):
    """Nearest point of the body (its core) to points (count, 3) outside of it, by formulas of its own."""
    if kind == "capsule":
        half = SIZES[kind]["half_height"]
        return np.clip(point, [0, -half, 0], [0, half, 0])
    if kind == "box":
        return np.clip(point, -SIZES[kind]["half_extents"], SIZES[kind]["half_extents"])
    if kind == "polyhedron":
        corners = np.array([STONE[[f[0], f[k], f[k + 1]]] for f in STONE_FACES for k in range(1, len(f) - 1)])
        best, distance = nearest_on_triangles(point[:, None], corners)
        return best[np.arange(len(point)), distance.argmin(1)]
    radius, half = SIZES[kind]["radius"], SIZES[kind]["half_height"]
    across = np.hypot(point[:, 0], point[:, 2])
    flat = np.stack([across, point[:, 1]], -1)
    if kind == "cylinder":
        best = np.clip(flat, [0, -half], [radius, half])
    else:
        rim, apex, middle = np.array([radius, -0.5 * half]), np.array([0, 1.5 * half]), np.array([0, -0.5 * half])
        choices = np.stack([nearest_on_segment(flat, rim, apex), nearest_on_segment(flat, middle, rim)])
        best = choices[np.linalg.norm(choices - flat, axis=-1).argmin(0), np.arange(len(point))]
    direction = point[:, [0, 2]] / np.where(across > 0, across, 1.0)[:, None]
    return np.stack([best[:, 0] * direction[:, 0], best[:, 1], best[:, 0] * direction[:, 1]], -1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS[1:])
def test_distance_from_hills(kind, float64, gate):
    """Dense samples of the body find the nearest triangles, alternating projections the distance from each."""
    count = 60
    position, orientation = over_the_hills(kind, count)
    position[:, 1] += 0.1
    found = run(kind, HILLS, position, orientation)
    turns = Rotation.from_quat(orientation[:, [1, 2, 3, 0]]).as_matrix()
    ground = triangles(HILLS)
    radius = SIZES[kind]["radius"] if kind == "capsule" else 0.0
    errors = []
    for world in range(count):
        points = position[world] + samples(kind) @ turns[world].T
        clearance = points[:, 1] - surface(HILLS, points)
        if clearance.min() < 1e-3:
            continue
        lowest = points[np.argsort(clearance)[:: max(1, len(points) // 1500)][:700]]
        distance = nearest_on_triangles(lowest[:, None], ground)[1]
        for triangle in np.argsort(distance.min(0))[:8]:
            point = lowest[distance[:, triangle].argmin()]
            for _ in range(3000):
                on_ground = nearest_on_triangles(point[None, None], ground[triangle][None])[0][0]
                before, point = (
                    point,
                    position[world]
                    + nearest_in_body(kind, (on_ground - position[world]) @ turns[world])[0] @ turns[world].T,
                )
                if np.linalg.norm(point - before) < 1e-12:
                    break
            errors.append((world, np.linalg.norm(point - on_ground[0])))
    errors = np.array(errors)
    worlds = np.unique(errors[:, 0]).astype(int)
    assert len(worlds) >= 12
    truth = np.array([errors[errors[:, 0] == world, 1].min() for world in worlds])
    least = np.where(found["active"], found["separation"], np.inf).min(0)
    gate("separation", least[worlds] + radius - truth, 1e-8)


# ---- derivatives -------------------------------------------------------------------------------------------------


def deepest(kind, position, orientation, heights, cell, sizes):
    """Separation, normal and position of slot 0 (world, 7), its feature and whether it is active."""
    pose = place(position, orientation / jnp.linalg.norm(orientation, axis=-1, keepdims=True))
    field = field_of(heights, cell, REACH[kind])
    still = place(jnp.zeros((1, 3)), jnp.asarray(UPRIGHT)[None])
    found = PAIRS[kind, "heightfield"].function(shape_of(kind, sizes), pose, field, still)
    point = found.points[0]
    values = jnp.stack([point.separation[0], *(c[0] for c in found.normal), *(c[0] for c in point.position)], -1)
    return values, point.feature[0], point.active[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_those_of_differences(kind, float64, gate):
    """By the pose, the heights, the cell size and the sizes of the body, along random directions."""
    count, step = 60, 1e-7
    position, orientation = over_the_hills(kind, count, 12)
    position[:, 1] += 0.1
    arguments = (position, orientation, HILLS, np.array(CELL), SIZES[kind])
    arguments = jax.tree.map(jnp.asarray, arguments)
    rng = np.random.default_rng(3)
    tangents = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), arguments)

    @jax.jit
    def along(*arguments):
        values, rates, (feature, active) = jax.jvp(
            lambda *x: (lambda v, *rest: (v, rest))(*deepest(kind, *x)), arguments, tangents, has_aux=True
        )
        return values, rates, feature, active

    _, rate, feature, active = along(*arguments)
    ahead, behind = (along(*jax.tree.map(lambda x, t, s=s: x + s * t, arguments, tangents)) for s in (step, -step))
    same = active & (feature == ahead[2]) & (feature == behind[2])
    assert same.sum() > 0.8 * count
    difference = (ahead[0] - behind[0]) / (2 * step)
    # The normal of an edge nearly parallel to a ridge turns so fast that its difference is good to its size only.
    error = (rate - difference) / jnp.maximum(1.0, jnp.abs(rate))
    gate("derivative", jnp.where(same[:, None], error, 0.0), 1e-6)
    # Reverse mode: the same numbers, and none that is not finite.
    weights = jnp.asarray(rng.normal(size=rate.shape))
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(weights * deepest(kind, *x)[0])))(arguments)
    total = sum(jnp.sum(g * t) for g, t in zip(jax.tree.leaves(gradient), jax.tree.leaves(tangents), strict=True))
    gate("reverse mode", total / jnp.sum(weights * rate) - 1.0, 1e-9)


# ---- features ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "cylinder", "cone", "polyhedron", "capsule"])
def test_peak_under_a_face(kind, float64):
    """A thin spike holds a body that lies over it; nothing else of the body is near the ground."""
    heights = np.zeros((11, 11))
    heights[5, 5] = 0.4
    low = {"box": -0.15, "cylinder": -0.2, "cone": -0.1, "capsule": -0.15}.get(kind)
    turn = Rotation.identity()
    if kind == "polyhedron":
        first, second, third = STONE[list(STONE_FACES[0][:3])]
        outward = np.cross(second - first, third - first)
        outward /= np.linalg.norm(outward)
        turn = Rotation.align_vectors([[0.0, -1.0, 0.0]], [outward])[0]
        middle = turn.apply((first + second + third) / 3.0)
        offset, low = np.array([-middle[0], 0.0, -middle[2]]), middle[1]
    else:
        offset = np.array([0.02, 0.0, 0.03])
    if kind == "capsule":
        turn, offset = Rotation.from_rotvec([np.pi / 2, 0, 0]), np.array([0.0, 0.0, 0.03])
    for depth in (-0.01, 0.02):
        position = offset + np.array([0.0, 0.4 - low - depth, 0.0])
        found = run(kind, heights, position, turn.as_quat()[[3, 0, 1, 2]])
        np.testing.assert_allclose(found["separation"][0], -depth, atol=1e-12)
        np.testing.assert_allclose(found["normal"][0, 0], [0.0, -1.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(found["position"][0, 0], [0.0, 0.4 - 0.5 * depth, 0.0], atol=1e-12)


def test_ridge_across_an_edge(float64):
    """The edge of a tilted box lies across a ridge along x: closed form of two crossing lines."""
    heights = np.tile(0.5 - np.abs(np.arange(11) - 5.0) * 0.2, (11, 1))
    half = SIZES["box"]["half_extents"]
    turn = Rotation.from_euler("z", 45.0, degrees=True)
    drop = (half[0] + half[1]) / np.sqrt(2.0)
    shift = (half[0] - half[1]) / np.sqrt(2.0)
    # Found where the lower edge along z crosses; in x in the middle of a cell, away from grid points.
    for gap in (0.03, -0.01):
        position = np.array([0.11 - shift, 0.5 + drop + gap, 0.07])
        lowest = position + turn.apply(np.array([[-1, -1, 0], [1, -1, 0]]) * half)
        lowest = lowest[lowest[:, 1].argmin()]
        found = run("box", heights, position, turn.as_quat()[[3, 0, 1, 2]])
        np.testing.assert_allclose(found["separation"][0], gap, atol=1e-12)
        np.testing.assert_allclose(found["normal"][0, 0], [0.0, -1.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(found["position"][0, 0], [lowest[0], 0.5 + 0.5 * gap, 0.0], atol=1e-12)


@pytest.mark.slow
def test_rotated_and_moved_field(float64):
    """Contacts move with the pose of the field."""
    position, orientation = over_the_hills("box", 20, 14)
    found = run("box", HILLS, position, orientation)
    turn, shift = Rotation.from_rotvec([0.4, -0.3, 0.9]), np.array([3.0, -2.0, 1.0])
    moved = turn.apply(position) + shift
    turned = (turn * Rotation.from_quat(orientation[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    again = run("box", HILLS, moved, turned, (shift, turn.as_quat()[[3, 0, 1, 2]]))
    used = found["active"]
    np.testing.assert_array_equal(used, again["active"])
    np.testing.assert_allclose(again["separation"][0], found["separation"][0], atol=1e-9)
    np.testing.assert_allclose(again["normal"][0], turn.apply(found["normal"][0]), atol=1e-9)


# ---- scenes and queries ------------------------------------------------------------------------------------------


def simulate(shape, ground, seconds, dt=0.005, **body):
    builder = SceneBuilder()
    builder.add_body(ground, static=True, friction=0.8, name="ground")
    builder.add_body(shape, mass=1.0, friction=0.8, name="body", **body)
    model, state = builder.build(Options(dt=dt))

    def turn(state, _):
        state = step(model, state)
        return state, (state.position[1], state.velocity[1], state.angular_velocity[1])

    return jax.tree.map(np.asarray, jax.jit(lambda s: jax.lax.scan(turn, s, None, length=round(seconds / dt)))(state))


@pytest.mark.parametrize("slope", slow_but((0.3,), (0.0, 0.3)), ids=["flat", "inclined"])
def test_box_rests_and_slides_as_on_a_plane(slope, float64, gate):
    along = (np.arange(13) - 6.0) * CELL
    ground = Heightfield(np.tile(slope * along[:, None], (1, 13)), CELL)
    box = Box((0.3, 0.15, 0.25))
    angle = np.arctan(slope)
    pose = {
        "position": np.array([-np.sin(angle), np.cos(angle), 0.0]) * 0.15,
        "orientation": Rotation.from_rotvec([0, 0, angle]).as_quat()[[3, 0, 1, 2]],
        "velocity": (0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.2),
    }
    _, ours = simulate(box, ground, 1.0, **pose)
    _, truth = simulate(box, Plane((-slope, 1.0, 0.0)), 1.0, **pose)
    # The points come in another order, and the solver iterates.
    gate("position", ours[0] - truth[0], 1e-5)
    gate("angular velocity at rest", ours[2][-1] - truth[2][-1], 1e-6)
    assert np.abs(truth[1][-1]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["capsule", "hull", "box"])
def test_bodies_come_to_rest_on_hills(name):
    shape = {"capsule": Capsule(0.12, 0.3), "hull": Polyhedron(STONE), "box": Box((0.3, 0.15, 0.25))}[name]
    heights = np.random.default_rng(0).normal(size=(17, 17)) * 0.12
    start = {"position": (0.05, 0.8, -0.1), "angular_velocity": (1.0, 0.5, 2.0)}
    _, (position, velocity, _) = simulate(shape, Heightfield(heights, CELL), 5.0, **start)
    assert np.isfinite(position).all()
    above = position[:, 1] - surface(heights, position)
    assert above.min() > 0.0, "the centre fell into the ground"
    speed = np.linalg.norm(velocity[-100:], axis=1).max()
    assert speed < (1.0 if name == "capsule" else 1e-3)  # a capsule has nothing that stops it from rolling


@pytest.mark.parametrize("ground", ["plateau", "wall", "ridges"])
def test_a_face_rests_on_what_is_smaller(ground, gate):
    """Box fell through a plateau, whose corners lie under its face alone, and rocked for ever on ridges."""
    heights = np.zeros((13, 13))
    if ground == "ridges":
        heights[1::2] = 0.2
    else:
        heights[(slice(5, 8), slice(5, 8) if ground == "plateau" else slice(None))] = 0.2
    model, state = box_over_ground()
    field = {**model.shapes["heightfield"], "heights": jnp.asarray(heights[None], state.position.dtype)}
    model = dataclasses.replace(model, shapes={**model.shapes, "heightfield": field})
    for angle, lift in ((0.0, 0.001), (0.01, 0.001), (0.03, 0.5)):
        tilt = jnp.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)], state.position.dtype)
        start = dataclasses.replace(
            state,
            position=state.position.at[1, 1].add(lift),
            orientation=state.orientation.at[1].set(tilt),
        )
        final = fall(model, start)
        gate("height over its rest [m]", final.position[1, 1] - 0.25, 1e-4)
        gate("rate [rad/s]", final.angular_velocity[1], 1e-3)


@functools.cache
def box_over_ground():
    builder = SceneBuilder()
    builder.add_body(Heightfield(np.zeros((13, 13)), 0.2), static=True, friction=0.7)
    builder.add_body(Box((0.4, 0.05, 0.4)), mass=1.0, position=(0, 0.25, 0), friction=0.7)
    return builder.build(undamped(dt=1 / 120))


@jax.jit
def fall(model, state):
    """Three seconds; one program for all grounds."""
    return rollout(model, state, 360)[0]


def test_sphere_rolls_in_a_bowl(gate):
    """The centre comes back to the height it started from, but for what the facets take."""
    points = (np.arange(41) - 20.0) * 0.1
    ground = Heightfield(0.15 * (points[:, None] ** 2 + points**2), 0.1)
    _, (position, velocity, spin) = simulate(
        Sphere(0.3), ground, 5.0, position=(1.2, 0.15 * 1.44 + 0.325, 0.05)
    )  # 3 mm above
    energy = 9.81 * position[:, 1] + 0.5 * (velocity**2).sum(1) + 0.5 * 0.4 * 0.3**2 * (spin**2).sum(1)
    assert position[:, 0].min() < -0.3 and np.abs(position).max() < 1.3
    # Half a step's fall is what the semi-implicit integrator's energy swings by.
    swing = 0.5 * 9.81 * 0.005 * 2.0 * np.abs(velocity[:, 1]).max()
    gate("energy gained", np.maximum(energy - energy[0], 0.0), swing)
    assert (position[:, 1] > 0.29).all()


@pytest.mark.slow
def test_queries_with_heightfields(float64, gate):
    ground, sphere = Heightfield(HILLS, CELL), Sphere(0.3)
    position = np.array([0.1, 0.6, -0.2])
    found = signed_distance(ground, (np.zeros(3), UPRIGHT), sphere, (position, UPRIGHT))
    nearest, distance = nearest_on_triangles(position[None, None], triangles(HILLS))
    gate("separation", found.separation - distance.min() + 0.3, 1e-12)
    gate("point on the ground", found.point_a - nearest[0, distance.argmin()], 1e-12)
    contacts = manifold(sphere, (position, UPRIGHT), ground, (np.zeros(3), UPRIGHT))
    gate("normals", jnp.linalg.norm(contacts.normals, axis=1) - 1.0, 1e-12)

    def gap(radius, window):
        ball = dataclasses.replace(Geometry.of(sphere), parameters={"radius": radius})
        field = dataclasses.replace(Geometry.of(ground), window=window)
        return signed_distance(ball, (position, UPRIGHT), field, (np.zeros(3), UPRIGHT)).separation

    gate("by the radius", jax.grad(gap)(jnp.array(0.3), 4) + 1.0, 1e-12)
    with pytest.raises(ValueError, match="window"):
        jax.grad(gap)(jnp.array(0.3), None)


def test_window_follows_from_body_and_cells():
    builder = SceneBuilder()
    builder.add_body(Heightfield(np.zeros((9, 9)), 0.5), static=True)
    builder.add_body(Sphere(0.3), mass=1.0, position=(0, 1, 0))
    builder.add_body(Sphere(0.6), mass=1.0, position=(0, 3, 0))
    groups = {group.kind_b: group for group in builder.build()[0].scene.pair_groups}
    assert groups["heightfield"].window == window_size(0.6, 0.5) == 4
