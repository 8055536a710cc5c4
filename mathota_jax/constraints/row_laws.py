"""What each law of a joint row asks of the solver: bias, softness and bounds of the impulse.

A row strives for ``u + bias + softness * impulse = 0`` within its bounds, where u is the rate along the row at the end of
the step. Arrays are (column, world).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.constraints.joints.rows import DRIVE, DRY, ELASTIC, HOLD, SERVO, STOP, VISCOUS
from mathota_jax.constraints.oscillator import end_weight, oscillator_weights

LARGEST_DECAY = 30.0
"""Cap on damping * J M^-1 J^T * dt, beyond which the velocity left is below round-off of either precision."""

LEAST = 1e-15
"""What resists less than this, of the inertia, is no row: it is below round-off, and its softness has no finite slope."""

CORRECTED = (HOLD, STOP)
"""Laws whose errors the position correction removes."""


class Columns(NamedTuple):
    """Columns of a table: what the laws know.

    Attributes:
      mass: ``J M^-1 J^T``.
      error, rate: at the start of the step.
      angular: static, whether the error is an angle.
      coefficients: see `row_coefficients`.
      dt, baumgarte: time step; share of an error turned into velocity in a step.
    """

    mass: Array
    error: Array
    rate: Array
    angular: np.ndarray
    coefficients: dict[str, Array]
    dt: Array
    baumgarte: float


class Response(NamedTuple):
    """Coefficients of the solver's law; `works` says where the row acts at all."""

    bias: Array
    softness: Array | float = 0.0
    lower: Array | float = -math.inf
    upper: Array | float = math.inf
    works: Array | bool = True


def _hold(columns: Columns) -> Response:
    """No rate, or the one that corrects a share of the error in the step (guide 9.5)."""
    if not columns.baumgarte:
        return Response(jnp.zeros_like(columns.error))
    return Response(columns.baumgarte * columns.error / columns.dt)


def rate_to_stop(room: Array, opening: Array, dt: Array) -> Array:
    """Largest rate at the end of the step towards a stop, from the room left before it and the rate at which that grows.

    The room left changes by ``dt (start + end) / 2``: the rate at the end may just close it, and is 0 where the present
    rate would close it in less than half the step. At the stop itself derivatives are those of what it holds.
    """
    room = jnp.where(room < 0, 0.0, room)
    rate = 2.0 * room / dt + opening
    return jnp.where(rate < 0, 0.0, rate)


def _stop(columns: Columns) -> Response:
    """No further than the stop, without restitution.

    What is too far after the step the position correction takes back, without energy. (Impulses of a shorter lever, as
    contacts have, would part the joints that pass them on.)
    """
    return Response(rate_to_stop(columns.error, columns.rate, columns.dt), lower=0.0)


def _viscous(columns: Columns) -> Response:
    """Resistance proportional to the rate."""
    mass, dt = columns.mass, columns.dt
    decay = jnp.clip(columns.coefficients["damping"] * mass * dt, 0.0, LARGEST_DECAY)
    works = decay > LEAST
    safe_decay = jnp.where(works, decay, 1.0)
    weight = end_weight(safe_decay)
    return Response(columns.rate * (1.0 / weight - 1.0), mass / (weight * safe_decay), works=works)


def _elastic(columns: Columns) -> Response:
    """Spring, damper and rotor in one: the rotor resists a change of the rate, the others as `oscillator` says."""
    return _oscillator(columns, rotor=True)


def _servo(columns: Columns) -> Response:
    """Spring and damper towards the target of a motor, whose torque is bounded."""
    impulse = columns.coefficients["cap"] * columns.dt
    return _oscillator(columns, rotor=False)._replace(lower=-impulse, upper=impulse)


def _oscillator(columns: Columns, rotor: bool) -> Response:
    dt, given = columns.dt, columns.coefficients
    mass = columns.mass
    if "armature" in given:
        # The rotor, which has a row of its own, makes the coordinate heavier.
        mass = mass / (1.0 + mass * given["armature"])
    stiffness, damping = given["stiffness"] * mass * dt * dt, given["damping"] * mass * dt
    at_end, at_start = oscillator_weights(stiffness, damping)
    if rotor:
        inertia = mass * given["armature"]
        at_end, at_start = at_end + inertia, at_start - inertia
    works = at_end > LEAST
    divisor = jnp.where(works, at_end, 1.0)
    error = columns.error - given["target"]
    if columns.angular.any():
        turns = jnp.round(error * (0.5 / math.pi))
        error = jnp.where(columns.angular, error - turns * (2.0 * math.pi), error)
    bias = (at_start * columns.rate + stiffness / dt * error) / divisor
    return Response(bias, mass / divisor, works=works)


def _dry(columns: Columns) -> Response:
    """No motion, by at most the friction."""
    impulse = columns.coefficients["cap"] * columns.dt
    return Response(jnp.zeros_like(columns.rate), lower=-impulse, upper=impulse)


def _drive(columns: Columns) -> Response:
    """The target rate, by at most the cap."""
    return _dry(columns)._replace(bias=-columns.coefficients["target"])


LAWS: dict[str, Callable[[Columns], Response]] = {
    HOLD: _hold,
    STOP: _stop,
    VISCOUS: _viscous,
    ELASTIC: _elastic,
    DRY: _dry,
    DRIVE: _drive,
    SERVO: _servo,
}
