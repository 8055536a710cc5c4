"""Far from the origin, tiny and huge: the same problem gives the same answer (benchmark B13)."""

import functools

import numpy as np
import pytest

from mathota_jax import Box, Flag, Plane, SceneBuilder
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import GRAVITY, axis_angle, motion_and_penetration, record_worlds, stack, undamped

SCALES = (1e-4, 1e-3, 1e-2, 1.0, 1e2, 1e4)
UNIT = SCALES.index(1.0)


def column(count, offset=0.0, scale=1.0, gravity=GRAVITY, **options):
    """Cubes of one scale stacked on a plane, moved along all axes."""
    builder = SceneBuilder(gravity=(0.0, -gravity, 0.0))
    builder.add_body(Plane((0, 1, 0), offset=offset), static=True, friction=0.6)
    half = 0.5 * scale
    for level in range(count):
        place = (offset, offset + half * (2 * level + 1), -offset)
        builder.add_body(Box((half, half, half)), density=1.0, position=place, friction=0.6)
    return builder.build(undamped(**options))


def leaning_cards(scale=1.0, gravity=GRAVITY, **options):
    """The top level of the card house (B5a)."""
    builder = SceneBuilder(gravity=(0.0, -gravity, 0.0))
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.7)
    for along, angle in ((0.0, 65.0), (0.175, -65.0)):
        builder.add_body(
            Box((0.2 * scale, 0.001 * scale, 0.1 * scale)), density=1.0, friction=0.7,
            position=(along * scale, 0.18 * scale, 0.0), orientation=axis_angle((0, 0, 1), np.radians(angle)),
        )  # fmt: skip
    return builder.build(undamped(**options))


def run(worlds, step_count):
    """Records (step, world, ...) of worlds of one scene in float64, and how far each body is from its start."""
    models, states = stack([model for model, _ in worlds]), stack([state for _, state in worlds])
    final, record = record_worlds(models, states, step_count, motion_and_penetration)
    assert not (np.asarray(final.flags) & ~Flag.DEEP_OVERLAP).any()  # the cards start deep in each other
    record = {name: np.asarray(values, float) for name, values in record.items()}
    return record, record["position"] - np.asarray(states.position, float)


@pytest.mark.slow
def test_ten_cubes_far_from_the_origin(precision, gate):
    """A stack at a distance drifts as one at the origin does: to 1 km in float32, to 1e4 km in float64."""
    distances = (0.0, 1e2, 1e3) if precision == "float32" else (0.0, 1e3, 1e5, 1e7)
    _, moved = run([column(10, offset, dt=1 / 60) for offset in distances], 600)
    for world, offset in enumerate(distances[1:], start=1):
        gate(f"drift at {offset:g} m - drift at the origin [m]", moved[-1, world] - moved[-1, 0], 1e-3)


KINDS = {
    "dt unchanged, gravity scaled": lambda scale: {"gravity": GRAVITY * scale, "dt": 1 / 60},
    "gravity unchanged, dt scaled": lambda scale: {"gravity": GRAVITY, "dt": np.sqrt(scale) / 60},
}


SCENES = {"stack": (functools.partial(column, 5), 1.0), "cards": (leaning_cards, 0.4)}
"""Builder and size at scale 1 [m]."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", slow_but(("stack",), SCENES))
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_penetration_scales_with_size(precision, name, kind, gate):
    """Five cubes, and two cards that lean on each other, of 0.1 mm to 10 km: the same share of their size overlaps."""
    build, size = SCENES[name]
    record, moved = run([build(scale=scale, **KINDS[kind](scale)) for scale in SCALES], 300)
    sizes = np.array(SCALES) * size
    depth, way = record["penetration"].max(0) / sizes, np.abs(moved[-1]).max((1, 2)) / sizes
    gate("depth / that at scale 1 - 1", depth / depth[UNIT] - 1, 0.1)
    gate("way / size - that at scale 1", way - way[UNIT], 0.1 * depth[UNIT])
