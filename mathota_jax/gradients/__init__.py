"""Helpers for gradients through many steps, through impacts that are missed, and of expected losses.

`mathota_jax.rollout` and JAX's own transforms come first; what is differentiated, and what these helpers change about it,
is told in ``docs/gradients.md``.
"""

from mathota_jax.gradients.clipping import clip_cotangent
from mathota_jax.gradients.contacts_from_a_distance import smoothed_step
from mathota_jax.gradients.expected_loss import Estimate, first_order, mixed_order, zeroth_order
from mathota_jax.gradients.long_rollout import long_rollout

__all__ = [
    "Estimate",
    "clip_cotangent",
    "first_order",
    "long_rollout",
    "mixed_order",
    "smoothed_step",
    "zeroth_order",
]
