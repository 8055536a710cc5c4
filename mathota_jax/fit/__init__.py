"""Fitting parameters of a scene to recorded motions: `fit`, and the layouts of the data."""

from mathota_jax.fit.files import load, load_csv, load_npz, save_npz
from mathota_jax.fit.fitting import fit
from mathota_jax.fit.objective import Noise, Spread
from mathota_jax.fit.parameters import Parameter
from mathota_jax.fit.quantities import QUANTITIES
from mathota_jax.fit.result import FitResult, StartResult
from mathota_jax.fit.trajectories import Trajectories

__all__ = [
    "QUANTITIES",
    "FitResult",
    "Noise",
    "Parameter",
    "Spread",
    "StartResult",
    "Trajectories",
    "fit",
    "load",
    "load_csv",
    "load_npz",
    "save_npz",
]
