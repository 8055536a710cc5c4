"""Poses and motions of single shapes, as the queries take them."""

import numpy as np

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
STILL = (np.zeros(3), np.zeros(3))


def at(*position, orientation=UPRIGHT):
    """A pose."""
    return np.asarray(position, float), np.asarray(orientation, float)


def turned(axis, angle):
    """Quaternion of a rotation about a unit vector."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.asarray(axis, float))])
