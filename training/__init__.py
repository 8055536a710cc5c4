"""Training, evaluation and replays for the environments of ``mathota_envs``.

Run the modules as programs, for example ``python -m training.train --env mathota/InvertedPendulum-v0``.
They need the extra packages of ``pip install 'mathota-jax[train]'``.
"""
