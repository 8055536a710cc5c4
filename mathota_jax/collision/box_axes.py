"""Which axis separates two boxes best: the 15-axis test, one number out."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Mat3, Vec3

REFERENCE_MARGIN = 1e-3
"""A later candidate must beat an earlier one by this share of the size: A's faces before B's, faces before edges."""
EDGE_DEPTH_SHARE = 0.05
"""An edge must besides be shallower than the face by this share of the depth."""
FADE_GAP = 1e-2
"""Gap, as a share of the size, at which the preference is gone: separated boxes report their true axis."""
ROUND_OFFS = 64.0
"""Round-offs of size and gap by which it must win in any case."""
FIRST_EDGE = 6


def relative_rotation(a: Mat3, b: Mat3) -> list[list[Array]]:
    """Matrix ``c[i][j]``: component i of B's axis j in the frame of A."""
    return [[p.x * q.x + p.y * q.y + p.z * q.z for q in b] for p in a]


def contact_size(half_a: Vec3, half_b: Vec3) -> Array:
    """Upper bound of the extent of the touching patch: the largest half extent of the smaller box."""
    return jnp.minimum(
        jnp.maximum(half_a.x, jnp.maximum(half_a.y, half_a.z)), jnp.maximum(half_b.x, jnp.maximum(half_b.y, half_b.z))
    )


def best_axis(c: list[list[Array]], t: Vec3, t_b: Vec3, half_a: Vec3, half_b: Vec3, size: Any) -> Array:
    """Code of the axis of least overlap (or largest gap) of two boxes.

    The separating axis theorem for boxes: S. Gottschalk, M. Lin, D. Manocha, "OBBTree" (SIGGRAPH 1996). Edge axes that
    are parallel to round-off are left out. Ties go to A's faces, then to B's, so that a stack that rocks by 1e-3 rad
    keeps its face contact.

    Args:
        c: B's axes in A's frame.
        t: Centre of B from the centre of A, in A's frame.
        t_b: The same vector in B's frame.
        half_a: Half extents of A.
        half_b: Half extents of B.
        size: Length that scales the preference for faces.

    Returns:
        int32 ``2 * index + (1 if the axis must be reversed to point from A to B)``; index 0-2 faces of A, 3-5 faces of
        B, ``6 + 3 i + j`` the cross product of A's axis i with B's axis j. Computed once (see `settle`).
    """
    c, t, t_b, half_a, half_b, size = lax.stop_gradient((c, t, t_b, half_a, half_b, size))
    absolute = [[jnp.abs(value) for value in row] for row in c]
    number = c[0][0].dtype

    def fold(candidates: list[tuple[int, Array, Array]]) -> tuple[Array, Array]:
        best, code = None, None
        for index, separation, projection in candidates:
            this = 2.0 * index + (projection < 0).astype(number)
            if best is None or code is None:
                best, code = separation, this
            else:
                better = separation > best
                best, code = jnp.where(better, separation, best), jnp.where(better, this, code)
        assert best is not None
        assert code is not None
        return best, code

    faces_a = [
        (i, jnp.abs(t[i]) - half_a[i] - sum(absolute[i][j] * half_b[j] for j in range(3)), t[i]) for i in range(3)
    ]
    faces_b = [
        (3 + j, jnp.abs(t_b[j]) - half_b[j] - sum(absolute[i][j] * half_a[i] for i in range(3)), t_b[j])
        for j in range(3)
    ]
    edges = []
    negligible = jnp.finfo(number).eps ** (2.0 / 3.0)
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            projection = t[i2] * c[i1][j] - t[i1] * c[i2][j]
            reach = (
                half_a[i1] * absolute[i2][j]
                + half_a[i2] * absolute[i1][j]
                + half_b[j1] * absolute[i][j2]
                + half_b[j2] * absolute[i][j1]
            )
            squared = c[i1][j] * c[i1][j] + c[i2][j] * c[i2][j]
            usable = squared > negligible
            separation = (jnp.abs(projection) - reach) * lax.rsqrt(jnp.where(usable, squared, 1.0))
            separation = jnp.where(usable, separation, -jnp.finfo(number).max)
            edges.append((FIRST_EDGE + 3 * i + j, separation, projection))

    best, code = fold(faces_a)
    best_b, code_b = fold(faces_b)
    use_b = best_b > best + preference_margin(best, size)
    best, code = jnp.where(use_b, best_b, best), jnp.where(use_b, code_b, code)
    best_edge, code_edge = fold(edges)
    use_edge = best_edge > best + preference_margin(best, size) - EDGE_DEPTH_SHARE * jnp.minimum(best, 0.0)
    return settle_code(jnp.where(use_edge, code_edge, code))


def preference_margin(separation: Array, size: Any) -> Array:
    """By how much [m] a less preferred feature must win; fades to round-off as the gap opens.

    Not to nothing: boxes turned about one axis have pairs of edges whose axis is that of a face, and one corner of that face
    is no contact for it.
    """
    round_off = ROUND_OFFS * jnp.finfo(separation.dtype).eps * (size + jnp.abs(separation))
    return REFERENCE_MARGIN * jnp.clip(size - jnp.maximum(separation, 0.0) / FADE_GAP, 0.0) + round_off
