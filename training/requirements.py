"""Check that the optional packages are there before anything slow begins."""

import importlib
from collections.abc import Sequence

REQUIRED_PACKAGES = {
    "sb3": ("torch", "stable_baselines3", "matplotlib", "tqdm"),
    "jax": ("optax", "matplotlib", "tqdm"),
    "gradient": ("optax", "matplotlib", "tqdm"),
}


class MissingExtraError(ImportError):
    """An optional package is not installed."""


def require_packages(packages: Sequence[str], purpose: str) -> None:
    """Import each package, or say how to install it.

    Args:
        packages: Import names.
        purpose: What needs them, for the message.

    Raises:
        MissingExtraError: (an ``ImportError``) if one cannot be imported.
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise MissingExtraError(
                f"{purpose} needs the package {package!r} ({error}); install it with: pip install 'mathota-jax[train]'"
            ) from error
