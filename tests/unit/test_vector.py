"""Frames around a direction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.spatial.vector import Vec3, tangent_basis

AXES = np.concatenate([np.eye(3), -np.eye(3)])


def directions():
    random = np.random.default_rng(0).normal(size=(500, 3))
    near_poles = np.array([[1e-9, 0, -1], [1e-4, -1e-4, -1], [0, 1e-7, 1], [1, 0, -1e-12]])
    found = np.concatenate([AXES, random, near_poles])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def basis(normals):
    return np.asarray(
        [jnp.stack(tangent, axis=-1) for tangent in jax.jit(tangent_basis)(Vec3(*jnp.asarray(normals).T))]
    )


def test_tangents_are_a_right_handed_frame(float64):
    normals = directions()
    first, second = basis(normals)
    frames = np.stack([first, second, normals], axis=1)
    np.testing.assert_allclose(frames @ np.swapaxes(frames, 1, 2), np.broadcast_to(np.eye(3), frames.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-14)


def test_tangents_are_orthogonal_to_normals_whose_length_is_only_nearly_one(float64):
    """The first formula of the source gives 2e-3 here."""
    normals = directions() * 1.001
    for tangent in basis(normals):
        assert np.abs((tangent * normals).sum(1)).max() < 1e-15


@pytest.mark.parametrize("length", [1 - 2**-24, 1.0, 1 + 2**-23])
def test_tangents_of_axes_have_nothing_along_them(length):
    """To the last bit in float32, for the neighbours of 1 too."""
    normals = (AXES * length).astype(np.float32)
    for tangent in basis(normals):
        assert not tangent[normals != 0].any()
