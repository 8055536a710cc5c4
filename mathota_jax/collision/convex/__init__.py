"""Distance, penetration depth, normal and witness points of any two convex shapes, from their support functions alone."""

from mathota_jax.collision.convex.contact import ConvexContact, convex_distance
from mathota_jax.collision.convex.support import SUPPORT, Support, support

__all__ = ["SUPPORT", "ConvexContact", "Support", "convex_distance", "support"]
