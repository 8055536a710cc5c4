"""Reading from files. Needs the extra `io`: ``pip install "mathota-jax[io]"``."""

from mathota_jax.io.meshes import load_convex_parts, load_mesh, simplified_hull

__all__ = ["load_convex_parts", "load_mesh", "simplified_hull"]
