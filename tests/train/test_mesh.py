import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

from anytouch_jax.errors import ConfigError
from anytouch_jax.train import mesh as meshes


def test_the_mesh_takes_all_devices_and_leaves_placement_to_jit():
    mesh = meshes.make_mesh()
    assert dict(mesh.shape) == {"data": 4, "fsdp": 1}
    assert mesh.axis_types == (AxisType.Auto, AxisType.Auto)
    assert dict(meshes.make_mesh(fsdp=2).shape) == {"data": 2, "fsdp": 2}
    assert dict(meshes.make_mesh(1, 2).shape) == {"data": 1, "fsdp": 2}


def test_parameters_are_cut_on_their_largest_divisible_axis():
    shapes = {
        "kernel": (6, 128, 512),
        "odd": (512, 129),
        "prime": (509, 131),
        "small": (4, 4),
        "packed": (2**18,),
        "scalar": (),
    }
    abstract = {name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in shapes.items()}
    places = {
        name: place.spec
        for name, place in meshes.state_sharding(abstract, meshes.make_mesh(fsdp=4)).items()
    }
    assert places == {
        "kernel": PartitionSpec(None, None, "fsdp"),
        "odd": PartitionSpec("fsdp"),
        "prime": PartitionSpec(),
        "small": PartitionSpec(),
        "packed": PartitionSpec(),
        "scalar": PartitionSpec(),
    }
    assert {
        place.spec for place in meshes.state_sharding(abstract, meshes.make_mesh()).values()
    } == {PartitionSpec()}


def test_a_batch_is_shared_out_by_rows_and_an_empty_axis_is_fine():
    sharding = meshes.batch_sharding(meshes.make_mesh(fsdp=2))
    batch = {"clip": np.arange(8 * 3).reshape(8, 3), "none": np.zeros((0, 5), np.int32)}
    placed = meshes.put_batch(batch, sharding)
    assert [shard.data.shape for shard in placed["clip"].addressable_shards] == [(2, 3)] * 4
    np.testing.assert_array_equal(placed["clip"], batch["clip"])
    assert placed["none"].shape == (0, 5)
    with pytest.raises(ConfigError, match="6 rows cannot be divided among 4 devices"):
        meshes.put_batch({"clip": np.zeros((6, 2))}, sharding)


def test_sharded_parameters_are_gathered_once_and_their_gradients_come_back_cut():
    mesh = meshes.make_mesh(fsdp=4)
    shared = meshes.make_mesh()
    params = {"kernel": np.ones((8, 16), "f4"), "bias": np.ones(16, "f4")}
    places = meshes.state_sharding(params, mesh, small=0)
    assert (
        places["kernel"].spec == PartitionSpec(None, "fsdp")
        and places["bias"].spec == PartitionSpec()
    )

    def loss(params, x):
        return jnp.mean(jnp.tanh(x @ params["kernel"] + params["bias"][None])), {}

    # nothing is added where nothing is cut
    assert meshes.gathering(loss, shared) is loss
    slope = jax.grad(meshes.gathering(loss, mesh), has_aux=True)
    grads = jax.jit(slope, out_shardings=(places, meshes.replicated(mesh)))
    x = jax.device_put(
        np.arange(64, dtype=np.float32).reshape(8, 8) / 64, meshes.batch_sharding(mesh)
    )
    compiled = grads.lower(jax.device_put(params, places), x).compile()
    text = compiled.as_text()
    assert (
        text.count(" all-gather(") == 1
        and " all-to-all(" not in text
        and " collective-permute(" not in text
    )
    found = compiled(jax.device_put(params, places), x)[0]
    wanted = jax.jit(jax.grad(loss, has_aux=True))(params, np.asarray(x))[0]
    assert {shard.data.shape for shard in found["kernel"].addressable_shards} == {(8, 4)}
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7), found, wanted)


@pytest.mark.parametrize("devices", [1, 4])
@pytest.mark.parametrize("kind", ["host", "device"])
def test_a_step_that_overwrites_its_state_leaves_the_callers_arrays(kind, devices):
    array = jnp.array(np.ones((256, 256), np.float32))
    # aligned, so that a CPU may share it
    tree = {"kernel": array if kind == "device" else np.asarray(array)}
    placed = meshes.put_state(tree, meshes.state_sharding(tree, meshes.make_mesh(devices)))
    for _ in range(2):
        placed, before = (
            jax.jit(lambda tree: jax.tree.map(lambda x: x - 3, tree), donate_argnums=0)(placed),
            placed,
        )
    assert before["kernel"].is_deleted()
    np.testing.assert_array_equal(placed["kernel"], -5)
    np.testing.assert_array_equal(tree["kernel"], 1)


def test_the_compilation_cache_has_a_default_place(tmp_path, monkeypatch):
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    try:
        assert meshes.enable_compilation_cache() == tmp_path / "cache" / "anytouch_jax"
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "cache" / "anytouch_jax")
        (tmp_path / "file").write_text("")
        # what cannot be looked at stays
        (tmp_path / "cache" / "anytouch_jax" / "z-cache").symlink_to("nowhere")
        kept, old, other = (
            tmp_path / "cache" / "anytouch_jax" / name for name in ("a-cache", "b-cache", "notes")
        )
        for file in (kept, old, other):
            file.write_bytes(b"a program")
        for file in (old, other):
            os.utime(file, (0, 0))
        assert meshes.enable_compilation_cache() is not None
        assert kept.exists() and other.exists() and not old.exists()
        assert meshes.enable_compilation_cache(tmp_path / "file" / "below") is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
