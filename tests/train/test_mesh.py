from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec
from train_toy import toy_batch, toy_batches, toy_config, toy_loss, toy_params

from anytouch_jax.config import ConfigError
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import (
    batch_sharding,
    enable_compilation_cache,
    initialize_distributed,
    make_mesh,
    put_batch,
    replicated,
    state_sharding,
)
from anytouch_jax.train.optim import moments, optimizer
from anytouch_jax.train.step import init_state, make_step

SRC = Path(__file__).parents[2] / "src"


def test_the_mesh_takes_all_devices_and_leaves_placement_to_jit():
    mesh = make_mesh()
    assert dict(mesh.shape) == {"data": 4, "fsdp": 1}
    assert mesh.axis_types == (AxisType.Auto, AxisType.Auto)
    assert dict(make_mesh(fsdp=2).shape) == {"data": 2, "fsdp": 2}
    assert dict(make_mesh(1, 2).shape) == {"data": 1, "fsdp": 2}


def test_a_mesh_that_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match=r"run\.fsdp=3 must be a divisor of the 4 devices"):
        make_mesh(fsdp=3)
    with pytest.raises(ConfigError, match="needs 8 devices, but there are 4"):
        make_mesh(4, 2)


def test_parameters_are_cut_on_their_largest_divisible_axis():
    shapes = {
        "kernel": (6, 128, 512),
        "odd": (512, 129),
        "prime": (509, 131),
        "small": (4, 4),
        "scalar": (),
    }
    abstract = {name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in shapes.items()}
    places = {name: place.spec for name, place in state_sharding(abstract, make_mesh(fsdp=4)).items()}
    assert places == {
        "kernel": PartitionSpec(None, None, "fsdp"),
        "odd": PartitionSpec("fsdp"),
        "prime": PartitionSpec(),
        "small": PartitionSpec(),
        "scalar": PartitionSpec(),
    }
    assert {place.spec for place in state_sharding(abstract, make_mesh()).values()} == {PartitionSpec()}


def test_a_batch_is_shared_out_by_rows_and_an_empty_axis_is_fine():
    sharding = batch_sharding(make_mesh(fsdp=2))
    batch = {"clip": np.arange(8 * 3).reshape(8, 3), "none": np.zeros((0, 5), np.int32)}
    placed = put_batch(batch, sharding)
    assert [shard.data.shape for shard in placed["clip"].addressable_shards] == [(2, 3)] * 4
    np.testing.assert_array_equal(placed["clip"], batch["clip"])
    assert placed["none"].shape == (0, 5)
    with pytest.raises(ConfigError, match="6 rows cannot be shared by 4 devices"):
        put_batch({"clip": np.zeros((6, 2))}, sharding)


def train(mesh):
    config = toy_config(optim={"warmup": 0})
    state = init_state(toy_params(), config)
    places = state_sharding(state, mesh, small=0)
    state = jax.device_put(state, places)
    step = make_step(toy_loss, optimizer(config), total_steps=8)
    step = jax.jit(step, out_shardings=(places, replicated(mesh)))
    key = jax.device_put(jax.random.key(1), replicated(mesh))
    losses = []
    for index in (1, 3, 5):
        state, metrics = step(state, put_batch(toy_batch(index), batch_sharding(mesh)), key)
        losses.append(float(metrics["loss"]))
    return state, losses


def test_one_two_and_four_devices_agree():
    one, losses = train(make_mesh(1, 1))
    for data, fsdp in ((2, 1), (2, 2)):
        other, other_losses = train(make_mesh(data, fsdp))
        np.testing.assert_allclose(other_losses, losses, rtol=1e-5)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), other, one)
        kernel = other.trainable["trunk"]["kernel"]
        assert kernel.sharding.spec == (PartitionSpec("fsdp") if fsdp > 1 else PartitionSpec())
        held = moments(other.opt_state, other.trainable)["trunk"]["kernel"]
        assert held.updates == 3 and np.abs(held.mu).max() > 0


def test_no_cluster_is_joined_unless_asked():
    assert initialize_distributed({}) is False
    with pytest.raises(ConfigError, match="JAX_NUM_PROCESSES must be a number, not ''"):
        initialize_distributed({"JAX_COORDINATOR_ADDRESS": "localhost:1"})
    with pytest.raises(ConfigError, match="JAX_PROCESS_ID must be a number, not 'one'"):
        initialize_distributed(
            {"JAX_COORDINATOR_ADDRESS": "localhost:1", "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "one"}
        )


def test_the_compilation_cache_has_a_default_place(tmp_path, monkeypatch):
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    try:
        assert enable_compilation_cache() == tmp_path / "cache" / "anytouch_jax"
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "cache" / "anytouch_jax")
        (tmp_path / "file").write_text("")
        assert enable_compilation_cache(tmp_path / "file" / "below") is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


TWO = """
import sys, json, jax
sys.path.insert(0, {tests!r})
jax.config.update("jax_num_cpu_devices", 1)
from anytouch_jax.train.mesh import initialize_distributed
assert initialize_distributed()
import train_toy
from anytouch_jax.train.loop import fit
assert jax.process_count() == 2 and jax.device_count() == 2
rank = jax.process_index()
def batches(start, stop):
    for step, batch, info in train_toy.toy_batches(start, stop):
        half = slice(4 * rank, 4 * rank + 4)
        yield step, type(batch)(batch.clip[half], batch.sensor[half]), info
result = fit(train_toy.toy_config(steps=4), params=train_toy.toy_params(), loss_fn=train_toy.toy_loss,
             batches=batches, run_dir={run!r})
assert result.step == 4
"""


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    script = TWO.format(tests=str(Path(__file__).parent), run=str(tmp_path / "two"))
    base = os.environ | {
        "PYTHONPATH": str(SRC),
        "JAX_COORDINATOR_ADDRESS": f"localhost:{port}",
        "JAX_NUM_PROCESSES": "2",
    }
    children = [
        subprocess.Popen(
            [sys.executable, "-c", script], env=base | {"JAX_PROCESS_ID": str(rank)}, stderr=subprocess.PIPE
        )
        for rank in range(2)
    ]
    outcomes = [child.communicate(timeout=120)[1].decode() for child in children]
    assert [child.returncode for child in children] == [0, 0], outcomes
    fit(
        toy_config(steps=4),
        params=toy_params(),
        loss_fn=toy_loss,
        batches=toy_batches,
        run_dir=tmp_path / "one",
        mesh=make_mesh(1),
        say=lambda sentence: None,
    )
    rows = [
        [json.loads(line)["loss"] for line in (tmp_path / name / "metrics.jsonl").read_text().splitlines()]
        for name in ("one", "two")
    ]
    np.testing.assert_allclose(rows[0], rows[1], rtol=1e-5)
