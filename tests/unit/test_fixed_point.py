"""The dense system behind derivatives of contacts with the joints held."""

import jax.numpy as jnp
import numpy as np

from mathota_jax.constraints import fixed_point


def test_what_no_impulses_answer_to_is_left_out(precision, gate):
    """A face on four points, which slide in different directions: normal rows of rank three, and friction by them.

    What does not fit over the corners made impulses over the weight of the proximal steps, and friction velocities of
    these: derivatives of up to 1e7 for 1e2 where ten sweeps had left errors.
    """
    rng = np.random.default_rng(0)
    corners = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, -1.0, -1.0], [1.0, 1.0, -1.0]])  # 1, x, z
    normals = corners @ np.diag([1.0, 0.5, 0.7]) @ corners.T
    unfit = np.array([1.0, -1.0, 1.0, -1.0])
    friction = np.diag(rng.normal(size=4))
    system = np.block([[normals, np.zeros((4, 4))], [-friction, np.eye(4)]])
    wanted = corners @ rng.normal(size=3)
    truth = np.concatenate([wanted, friction @ wanted])
    right = system @ truth
    for unanswered in (0.0, 0.1):
        given = right + unanswered * np.concatenate([unfit, np.zeros(4)])
        found = fixed_point._solve(jnp.asarray(system, precision)[None], jnp.asarray(given, precision)[:, None])[:, 0]
        # What is taken out is of its size.
        limit = 1.5 * unanswered + (1e-3 if precision == np.float32 else 1e-7)
        gate(f"impulses with {unanswered} of it", np.asarray(found) - truth, limit)
