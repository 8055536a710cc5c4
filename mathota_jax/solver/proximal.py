"""Laws as proximal operators: the same fixed points, approached with other step lengths.

A law's fixed points do not depend on its effective masses (`laws`). With masses `stiffness` times as large, one update is
a step of the proximal point method on impulses with weight ``1 / (stiffness * mass)``: the stiffer, the nearer a single
step comes to the solution, and the worse the linear systems behind it are conditioned.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.solver.laws import Bounded, Law


def masses(law: Law) -> Array:
    """(turn, row, column, world) effective mass of each row; 0 where a row is void."""
    if isinstance(law, Bounded):
        return law.effective_mass
    return jnp.stack([law.normal_mass, law.tangent_mass, law.tangent_mass], axis=1)


def stiffen(law: Law, stiffness: Array) -> Law:
    """The law with longer steps. The softness of a row is part of its step, taken implicitly, so it bounds its length."""
    if isinstance(law, Bounded):
        mass = stiffness * law.effective_mass
        return dataclasses.replace(law, effective_mass=mass / (1.0 + mass * law.softness))
    return dataclasses.replace(law, normal_mass=stiffness * law.normal_mass, tangent_mass=stiffness * law.tangent_mass)


def slope(law: Law, impulse: Array, error: Array) -> Array:
    """Jacobian (turn, row, row', column, world) of the change by the error; semismooth: one of its elements."""
    row_count = impulse.shape[1]
    zero = jnp.zeros_like(error)
    columns = [
        jax.jvp(lambda error: law.change(impulse, error), (error,), (zero.at[:, row].set(1.0),))[1]
        for row in range(row_count)
    ]
    return jnp.stack(columns, axis=2)
