"""Worlds spread over two devices, in a process that has two, against all of them on one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.marks import QUICK_COMPILER

ROOT = Path(__file__).resolve().parents[2]
WORLDS = 6

PROGRAM = f"""
import dataclasses, functools, json
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
from mathota_jax import Box, Options, Plane, SceneBuilder, Sphere, step

builder = SceneBuilder()
builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.4)
builder.add_body(Sphere(0.1), mass=1.0, position=(0, 0.1, 0), friction=0.4)
model, state = builder.build(Options(dt=1 / 240))
states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, ({WORLDS}, *leaf.shape)), state)
speeds = jnp.linspace(1.0, 3.0, {WORLDS})
states = dataclasses.replace(states, velocity=states.velocity.at[:, 1, 0].set(speeds))

def run(model, states):
    return jax.lax.scan(lambda now, _: (jax.vmap(step, (None, 0))(model, now), None), states, length=3)[0]

def loss(model, states):
    return (run(model, states).position[:, 1, 0] ** 2).sum()

def real(tree):
    return [np.asarray(leaf, float) for leaf in jax.tree.leaves(tree) if leaf.dtype != jax.dtypes.float0]

def apart(first, second):
    return max(np.abs(a - b).max(initial=0) for a, b in zip(real(first), real(second), strict=True))

mesh = Mesh(np.array(jax.devices()), ("world",))
shared, spread = P(), P("world")
by_both = functools.partial(jax.grad, argnums=(0, 1), allow_int=True)
found = {{"devices": len(jax.devices())}}
# First where devices have types of their own: what is traced there must not serve elsewhere.
over_devices = {{
    str(check): jax.jit(jax.shard_map(run, mesh=mesh, in_specs=(shared, spread), out_specs=spread, check_vma=check))
    (model, states)
    for check in (True, False)
}}

def along_velocities(model, states):
    moved = lambda velocity: run(model, dataclasses.replace(states, velocity=velocity)).position
    return jax.jvp(moved, [states.velocity], [states.velocity])[1]

def spread_out(function, out_specs):
    return jax.jit(jax.shard_map(function, mesh=mesh, in_specs=(shared, spread), out_specs=out_specs))(model, states)

inside = spread_out(by_both(loss), (shared, spread))
tangent = spread_out(along_velocities, spread)
one = jax.jit(run)(model, states)
placed = jax.device_put(states, NamedSharding(mesh, spread))
by_placement = jax.jit(run)(jax.device_put(model, NamedSharding(mesh, shared)), placed)
halves = jax.tree.map(lambda leaf: leaf.reshape(2, {WORLDS // 2}, *leaf.shape[1:]), states)
mapped = jax.tree.map(lambda leaf: leaf.reshape({WORLDS}, *leaf.shape[2:]), jax.pmap(run, in_axes=(None, 0))(model, halves))
whole = jax.jit(by_both(loss))(model, states)
direct = jax.jit(along_velocities)(model, states)
found |= {{"shard_map, " + name: apart(one, value) for name, value in over_devices.items()}}
found |= {{"placement": apart(one, by_placement), "pmap": apart(one, mapped)}}
found |= {{"gradient": apart(whole, inside)}}
found |= {{"largest gradient": max(np.abs(leaf).max(initial=0) for leaf in real(whole[0]))}}
found |= {{"tangent": apart([direct], [tangent]), "motion": apart(states, one)}}
found["on both"] = len(by_placement.position.sharding.device_set)
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found():
    flags = f"{QUICK_COMPILER} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment, timeout=600
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return json.loads(result.stdout.splitlines()[-1])


@pytest.mark.parametrize("way", ["shard_map, True", "shard_map, False", "placement", "pmap"])
def test_worlds_on_two_devices_move_as_on_one(found, way, gate):
    assert found["devices"] == found["on both"] == 2
    assert found["motion"] > 1e-3
    gate("largest difference of a leaf", found[way], 1e-6)


def test_derivatives_add_up_over_devices(found, gate):
    assert found["largest gradient"] > 1e-3
    gate("gradient by model and state", found["gradient"], 1e-5)
    gate("derivative along the velocities", found["tangent"], 1e-6)
