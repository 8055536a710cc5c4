"""What stands beside a scene to disturb its gradients: a contact at rest and a pair that never touches."""

from mathota_jax import Sphere


def add_bystanders(builder, **surface):
    """Adds a sphere that touches the plane y = 0 of the scene, far from all else, and a static one that nothing meets."""
    builder.add_body(Sphere(0.1), mass=0.7, position=(0.0, 0.1, 20.0), **surface)
    builder.add_body(Sphere(0.1), static=True, position=(0.0, 9.0, 20.0), **surface)
