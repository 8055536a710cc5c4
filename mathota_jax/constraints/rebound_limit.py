"""As much of the restitution of a step as gains no energy.

Newton's restitution gives each contact its own rebound. With friction, with unequal coefficients, or where one impact
presses on another contact, all rebounds together can take more energy than the impacts had (T. R. Kane, D. A. Levinson,
"Dynamics: Theory and Applications", 1985). Without rebound an impact never gains any, and on the way from those impulses to
the full ones the work is a parabola: a world that gains gets the share at which its contacts do no work.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import pack_blocks
from mathota_jax.constraints import mechanism, mechanism_links
from mathota_jax.constraints.contact import ContactRows
from mathota_jax.constraints.mechanism_links import Links
from mathota_jax.solver.rows import Rows, row_velocity, with_first_bias
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.spread import add_all_slices
from mathota_jax.spatial.vector import Vec3

Impulses = tuple[Array, ...]

ROUND_OFF = 64
"""Multiples of the machine epsilon, of the work that is done and undone, within which a gain is round-off."""


def limit(
    solve: Callable[[list[ContactRows]], tuple[Array, Impulses]],
    contacts: Sequence[ContactRows],
    velocity: Array,
    solved: Array,
    impulses: Impulses,
) -> tuple[Array, Impulses]:
    """Velocity and impulses, with less rebound in the worlds that bounce and whose contacts do work.

    Differentiable: the share, too, depends on the impact.

    Args:
      solve: velocity, and impulses of all groups, with some contacts.
      contacts: all contacts of the step.
      velocity: (component, block, world) without them, with which joints that are solved as trees hold.
      solved, impulses: velocity, and impulses of all groups, those of the contacts last, with the full rebound.
    """
    joint_count = len(impulses) - len(contacts)
    gains = _gains(contacts, 0.5 * (velocity + solved), impulses[joint_count:])

    def share_out(solved: Array, impulses: Impulses) -> tuple[Array, Impulses]:
        stopped, stopping = solve([contact._replace(rows=_without_rebound(contact.rows)) for contact in contacts])
        more = tuple(last - first for first, last in zip(stopping, impulses, strict=True))
        share = _share(gains, contacts, velocity, stopped, solved, stopping[joint_count:], more[joint_count:])
        return jax.tree.map(
            lambda first, more, full: jnp.where(gains, first + share * more, full),
            (stopped, stopping),
            (solved - stopped, more),
            (solved, impulses),
        )

    # Nothing of it is stored for reverse mode, where it is rare as elsewhere.
    share_out = jax.checkpoint(share_out, prevent_cse=False)
    return lax.cond(gains.any(), share_out, lambda *unchanged: unchanged, solved, impulses)


def with_held_falling(links: Links, contacts: Sequence[ContactRows], gravity: Vec3) -> list[ContactRows]:
    """Contacts with what gravity (1, world) does where joints are solved as trees, which bear part of it."""
    falling = pack_blocks(gravity, gravity.map(jnp.zeros_like))
    falling = jnp.broadcast_to(falling, (len(falling), links.layout.block_count, falling.shape[-1]))
    bearing = mechanism.solve(links, jax.tree.map(jnp.negative, mechanism_links.rates(links, falling)))
    held = falling + bearing.change(links)
    return [contact._replace(falling=row_velocity(contact.rows, held) * contact.lever) for contact in contacts]


def _gains(contacts: Sequence[ContactRows], middle: Array, impulses: Impulses) -> Array:
    """Worlds (world,) where something bounces and all contacts together do work, at the mean velocity `middle`."""
    work, turnover, rebounds = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    for contact, impulse in zip(contacts, impulses, strict=True):
        done = impulse * _rate(contact, middle)
        rebound = impulse[:, :1] * jnp.maximum(-contact.rows.bias[:, :1], 0.0)
        work = work + add_all_slices(done)
        rebounds = rebounds + add_all_slices(rebound)
        turnover = turnover + add_all_slices(jnp.abs(done))
    noise = ROUND_OFF * jnp.finfo(middle.dtype).eps * (turnover + rebounds)
    return settle(jnp.where(rebounds > 0, jnp.where(work > noise, 1.0, 0.0), 0.0)) > 0.5


def _share(
    gains: Array,
    contacts: Sequence[ContactRows],
    velocity: Array,
    stopped: Array,
    solved: Array,
    stopping: Impulses,
    more: Impulses,
) -> Array:
    """Share (world,) of what rebounds add, `more`, to the impulses `stopping` at which contacts do no work.

    Or no more work than without rebound, where other things press them to do some.
    """
    lost, slope, bend = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    for contact, first, added in zip(contacts, stopping, more, strict=True):
        rate, faster = _rate(contact, 0.5 * (velocity + stopped)), row_velocity(contact.rows, solved - stopped)
        lost = lost - add_all_slices(first * rate)
        slope = slope + add_all_slices(added * rate + 0.5 * first * faster)
        bend = bend + add_all_slices(added * faster)
    return share_without_gain(gains, lost, slope, bend)


def share_without_gain(gains: Array, lost: Array, slope: Array, bend: Array) -> Array:
    """The share s (world,) of all rebounds at which the work ``slope s + bend s^2 / 2`` is what the impacts lost.

    Args:
      gains: whether the full rebound does more; 1 elsewhere.
      lost: energy [J] that impacts without rebound take; counts as none if it is negative.
      slope, bend: of the work of the rebound [J].
    """
    lost = jnp.maximum(lost, 0.0)
    root = safe_sqrt(jnp.where(gains, jnp.maximum(slope * slope + 2.0 * bend * lost, 0.0), 1.0))
    # Of two forms of the larger root the one in which nothing cancels.
    share = jnp.where(slope > 0, safe_divide(2.0 * lost, slope + root), safe_divide(root - slope, bend))
    return jnp.where(gains, jnp.clip(share, 0.0, 1.0), 1.0)


def _rate(contact: ContactRows, middle: Array) -> Array:
    """Rate (turn, row, column, world) of each row at the velocity `middle`, the mean over its impulse.

    Less what gravity does along the way that the impulse makes.
    """
    assert contact.falling is not None
    return row_velocity(contact.rows, middle) - contact.falling


def _without_rebound(rows: Rows) -> Rows:
    """Rows without the rebound, which alone has a negative bias."""
    return with_first_bias(rows, jnp.maximum(rows.bias[:, :1], 0.0))
