"""Tests that only `make test-slow` runs: each compiles for long or repeats, for other shapes, what a quicker one covers."""

from __future__ import annotations

CONVEX = "tests/unit/test_convex.py::"
HEIGHTFIELD = "tests/unit/test_heightfield.py::"
FACES = "tests/unit/test_face_manifold.py::"
QUERY = "tests/unit/test_queries.py::test_every_pair_answers_with_finite_derivatives"
QUICK_QUERIES = ("plane-", "sphere-sphere", "sphere-box", "sphere-cone", "sphere-polyhedron", "capsule-box", "box-box")

SWEEPS: tuple[str, ...] = (
    CONVEX + "test_touching_and_shallow_poses",
    CONVEX + "test_extreme_forms",
    CONVEX + "test_nearly_coincident_centres",
    CONVEX + "test_degenerate_poses",
    CONVEX + "test_derivatives_against_central_differences",
    CONVEX + "test_reverse_mode_agrees_with_forward",
    HEIGHTFIELD + "test_distance_from_hills",
    HEIGHTFIELD + "test_derivatives_are_those_of_differences",
    HEIGHTFIELD + "test_beside_the_field_there_is_no_ground",
    HEIGHTFIELD + "test_even_ground_is_a_plane[flat-c",
    HEIGHTFIELD + "test_even_ground_is_a_plane[flat-p",
    HEIGHTFIELD + "test_even_ground_is_a_plane[inclined-c",
    HEIGHTFIELD + "test_even_ground_is_a_plane[inclined-p",
    HEIGHTFIELD + "test_peak_under_a_face",
    HEIGHTFIELD + "test_rotated_and_moved_field",
    HEIGHTFIELD + "test_bodies_come_to_rest_on_hills",
    HEIGHTFIELD + "test_queries_with_heightfields",
    FACES + "test_no_value_or_derivative_is_ever_nan",
    FACES + "test_derivative_against_central_differences",
    FACES + "test_generic_pair_on_a_plate",
    FACES + "test_patch_of_flat_prisms_against_polygon_intersection",
    "tests/physics/test_many_bodies.py::test_cloud_conserves_momentum_and_does_not_gain_energy[float32-200",
    "tests/physics/test_many_bodies.py::test_cloud_conserves_momentum_and_does_not_gain_energy[float64-200",
    "tests/unit/test_raycast.py::test_normals_are_those_of_the_surface",
    "tests/unit/test_raycast.py::test_derivatives_match_central_differences",
)


def is_sweep(nodeid: str) -> bool:
    """Whether a test belongs to the slow runs alone."""
    if nodeid.startswith(QUERY):
        return not nodeid.removeprefix(QUERY + "[").startswith(QUICK_QUERIES)
    return nodeid.startswith(SWEEPS)
