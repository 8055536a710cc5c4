"""Trace and XLA time of a step from nothing: no cache on disk, none in memory, CPU seconds of the whole process."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.marks import QUICK_COMPILER

ROOT = Path(__file__).resolve().parents[2]

PROGRAM = """
import json, time, sys
import jax, jax.numpy as jnp
from mathota_jax import step
from tests import scenes
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((3, 3))).block_until_ready()  # starts the backend
model, state = scenes.box_stack(int(sys.argv[1]))
jax.block_until_ready((model, state))
processor, wall = time.process_time(), time.perf_counter()
compiled = jax.jit(step).lower(model, state).compile()
print(json.dumps({"processor": time.process_time() - processor, "wall": time.perf_counter() - wall}))
jax.block_until_ready(compiled(model, state))
"""


@pytest.mark.parametrize(
    "flags", [pytest.param("", id="default"), pytest.param(QUICK_COMPILER, id="quick", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(("count", "limit"), [(1, 2.0), (10, 6.0)])
def test_compile_time_of_a_step(count, limit, flags, gate):
    environment = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false", "XLA_FLAGS": flags}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(count)], capture_output=True, text=True, env=environment, timeout=300
    )
    assert result.returncode == 0, result.stderr[-2000:]
    seconds = json.loads(result.stdout.splitlines()[-1])
    gate(f"{count} boxes: trace + XLA [CPU s] (wall {seconds['wall']:.2f} s)", seconds["processor"], limit)
