import contextlib
import json
import resource
import shutil
import subprocess
import sys
import textwrap
import threading
import time
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from anytouch_jax.weights import checkpoint
from anytouch_jax.weights.checkpoint import (
    CheckpointError,
    Checkpoints,
    load_params,
    read_metadata,
    steps,
)
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.tree import flatten

DATA = Path(__file__).parent / "data"
METADATA = {
    "sensors": ["digit", "universal"],
    "preprocessing": {"mean": [0.5], "size": 112},
    "source": {"init": "a test"},
}


class State(NamedTuple):
    step: Any
    trainable: Any
    frozen: Any
    opt_state: Any


def params(seed: int = 0, width: int = 6) -> dict[str, Any]:
    draw = np.random.default_rng(seed).standard_normal
    touch = {"kernel": draw((5, width)).astype("f4"), "none": np.zeros((0, 3), "f4")}
    return jax.device_put(
        {"touch": touch, "half": draw(7).astype(jnp.bfloat16), "logit_scale": np.float32(draw())}
    )


def state_of(seed: int = 0, width: int = 6) -> State:
    trainable = params(seed, width)
    frozen = {
        "touch": {"table": np.arange(4, dtype=np.uint32)},
        "ids": np.array([seed, -1], np.int32),
    }
    return State(*jax.device_put((np.int32(seed), trainable, frozen)), START(trainable))


START = jax.jit(
    optax.chain(
        optax.identity(), optax.adamw(1e-3, mask=lambda tree: jax.tree.map(lambda _: True, tree))
    ).init
)


def same(first: Any, second: Any) -> None:
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for name, leaf in flatten(first).items():
        other = flatten(second)[name]
        assert leaf.dtype == other.dtype and leaf.shape == other.shape, name
        assert np.asarray(leaf).tobytes() == np.asarray(other).tobytes(), name


def opened(folder: Path, keep: int = 3) -> Checkpoints:
    return Checkpoints(folder, keep=keep, config_json='{"stage": 1}', metadata=METADATA)


def filled(folder: Path, *losses: float, keep: int = 3) -> Checkpoints:
    saver = opened(folder, keep)
    for step, loss in enumerate(losses, 1):
        saver.save(step, state_of(step), {"loss": loss})
    saver.wait()
    return saver


def test_a_loss_of_few_steps_is_never_the_best(tmp_path):
    saver = opened(tmp_path, keep=1)
    saved = ({"loss": 0.1, checkpoint.PARTIAL: 1}, {"loss": 3.0}, {"loss": 2.0}, {"loss": 9.0})
    for step, metrics in enumerate(saved, 1):
        saver.save(step, state_of(step), metrics)
    saver.wait()
    assert checkpoint.steps(tmp_path) == [3, 4] and checkpoint.best_of(tmp_path) == 3


def test_every_type_comes_back_bit_equal(tmp_path):
    with_nan = state_of(3)
    # a NaN with payload, -0, a denormal
    odd = np.array([0x7FC00001, 0x80000000, 1], np.uint32).view(np.float32)
    more = {"odd": jax.device_put(odd), "numpy": np.arange(3, dtype=np.int32)}
    with_nan = with_nan._replace(frozen=with_nan.frozen | more)
    saver = opened(tmp_path)
    saver.save(12, with_nan, {"loss": 1.0})
    saver.close()
    same(saver.restore(jax.eval_shape(lambda: with_nan)), with_nan)
    assert opened(tmp_path).latest() == 12


def test_one_thread_saves_while_another_loads(tmp_path):
    """Orbax runs one operation a process: each waits for the other's."""
    filled(tmp_path / "read", 1).close()
    saver = opened(tmp_path / "written", keep=20)
    done = []
    loaded = []

    def load() -> None:
        while not done:
            loaded.append(load_params(tmp_path / "read")[0]["logit_scale"])
            time.sleep(0.01)  # a lock is not fair: on one core the other would wait for minutes

    with ThreadPoolExecutor(1) as other:
        loading = other.submit(load)
        try:
            for step in range(1, 5):
                saver.save(step, state_of(step), {"loss": 1.0})
                if step % 3 == 0:  # the same thread, while its own save may run
                    same(saver.restore(jax.eval_shape(state_of)), state_of(step))
                    load_params(tmp_path / "read")
            saver.close()
        finally:
            done.append(True)
        loading.result()
    assert steps(tmp_path / "written") == list(range(1, 5)) and len(loaded) > 1
    assert all(scale == state_of(1).trainable["logit_scale"] for scale in loaded)


def test_a_failed_or_abandoned_save_does_not_block_a_load(tmp_path, monkeypatch):
    saver = filled(tmp_path, 1)
    monkeypatch.setattr(checkpoint.ocp, "save_async", lambda *_: 1 / 0)
    with pytest.raises(CheckpointError, match="division"):
        saver.save(2, state_of(2), {})
    load_params(tmp_path)

    class _Never:
        def result(self) -> None:
            never.wait()

    never = threading.Event()
    monkeypatch.setattr(checkpoint.ocp, "save_async", lambda *_: _Never())
    saver.save(3, state_of(3), {})
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.jax, "process_count", lambda: 2)
        patch.setattr(checkpoint, "_PATIENCE", 0.1)
        saver.leave(ValueError, ValueError("another process"), None)
    with ThreadPoolExecutor(1) as other:
        loading = other.submit(load_params, tmp_path)
        try:
            loading.result(timeout=60)
        finally:
            never.set()
            other.shutdown(wait=False)


@pytest.mark.parametrize("times", [2, 3])
@pytest.mark.parametrize("when", ["checked", "_load"])
def test_a_checkpoint_that_its_run_removes_while_it_is_read(tmp_path, monkeypatch, when, times):
    """The one after it is read; where that happens again and again the error says so, and not that
    it is damaged.
    """
    filled(tmp_path, 1).close()
    real = getattr(checkpoint, when)
    read = []

    def pruned(folder, *more):
        read.append(int(folder.name))
        if len(read) <= times:
            shutil.copytree(folder, tmp_path / f"{read[-1] + 1:08d}")
            shutil.rmtree(folder)
        return real(folder, *more)

    monkeypatch.setattr(checkpoint, when, pruned)
    if times == 2:
        np.testing.assert_array_equal(
            load_params(tmp_path)[0]["half"], state_of(1).trainable["half"]
        )
    else:
        with pytest.raises(
            CheckpointError, match=r"00000003 was removed while it was read; read the latest"
        ):
            load_params(tmp_path)
    assert read == [1, 2, 3]
    read.clear()
    monkeypatch.setattr(
        checkpoint, when, lambda folder, *more: (shutil.rmtree(folder), real(folder, *more))
    )
    with pytest.raises(CheckpointError, match=r"was removed while it was read"):
        load_params(tmp_path, steps(tmp_path)[0])


@pytest.mark.parametrize(
    ("losses", "kept"),
    [
        ([5, 1, 4, 3, 2], [2, 4, 5]),
        ([5, 4, 3, 2, 1], [4, 5]),
        ([1, 1, 1, 1], [3, 4]),  # of equals the latest is the best
        ([float("nan"), float("inf"), 3, 4, 5], [3, 4, 5]),
        ([float("nan")] * 4, [3, 4]),
    ],
)
def test_keeps_the_last_and_the_best(tmp_path, losses, kept):
    saver = filled(tmp_path, *losses, keep=2)
    assert steps(tmp_path) == kept and saver.latest() == len(losses)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [f"{step:08d}" for step in kept]


def test_describes_itself(tmp_path):
    filled(tmp_path / "checkpoints", 2.5, float("nan")).close()
    for folder in (tmp_path, tmp_path / "checkpoints", tmp_path / "checkpoints" / "00000001"):
        metadata = read_metadata(folder, 1)
        assert metadata == METADATA | {
            "step": 1,
            "config": '{"stage": 1}',
            "metrics": {"loss": 2.5},
        }
    assert read_metadata(tmp_path)["metrics"] == {"loss": None}
    tree, config, metadata = load_params(tmp_path, 2)
    assert config == '{"stage": 1}' and metadata["sensors"] == ["digit", "universal"]
    expected = state_of(2)
    assert all(isinstance(leaf, np.ndarray) for leaf in flatten(tree).values())
    touch = expected.trainable["touch"] | expected.frozen["touch"]
    same(
        tree,
        jax.tree.map(
            np.asarray, expected.trainable | {"ids": expected.frozen["ids"], "touch": touch}
        ),
    )


def test_another_configuration_is_named_with_both_shapes(tmp_path):
    saver = filled(tmp_path, 1)
    with pytest.raises(CheckpointError, match="use the preset") as caught:
        saver.restore(jax.eval_shape(lambda: state_of(width=8)))
    message = str(caught.value)
    assert "trainable/touch/kernel: (5, 6) float32 stored, (5, 8) float32 wanted" in message
    assert "opt_state/" in message and "3 entries differ" in message
    wanted = jax.eval_shape(state_of)
    many = wanted._replace(
        trainable={f"n{i}": jax.ShapeDtypeStruct((i + 1,), jnp.float32) for i in range(9)}
    )
    with pytest.raises(CheckpointError, match=r"nothing stored, .* wanted.*; \.\.\.") as caught:
        saver.restore(many)
    assert str(caught.value).count(" wanted") == 5
    other = wanted._replace(step=jax.ShapeDtypeStruct((), jnp.float32))
    with pytest.raises(CheckpointError, match=r"step: \(\) int32 stored, \(\) float32 wanted"):
        saver.restore(other)
    same(saver.restore(wanted), state_of(1))


@pytest.mark.parametrize("damage", ["half", "empty", "gone", "flipped"])
def test_any_damaged_file_is_named_and_the_older_step_is_intact(tmp_path, damage):
    saver = filled(tmp_path / "run", 1, 2)
    target = tmp_path / "run" / "00000002"
    copy = tmp_path / "kept"
    shutil.copytree(target, copy)
    names = [
        path.relative_to(target)
        for path in sorted(target.rglob("*"))
        if path.is_file() and path.stat().st_size
    ]
    assert len(names) > 5
    for name in names:
        shutil.rmtree(target)
        shutil.copytree(copy, target)
        path = target / name
        content = (target / name).read_bytes()
        middle = len(content) // 2
        flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        path.write_bytes(
            {"half": content[:middle], "empty": b"", "gone": b"", "flipped": flipped}[damage]
        )
        if damage == "gone":
            path.unlink()
        for attempt in (
            lambda: saver.restore(jax.eval_shape(state_of)),
            lambda: load_params(tmp_path / "run"),
        ):
            with pytest.raises(CheckpointError, match="step 1 is intact") as caught:
                attempt()
            assert str(target) in str(caught.value) and path.name in str(caught.value)
            assert "\n" not in str(caught.value)
    same(saver.restore(jax.eval_shape(state_of), 1), state_of(1))
    (tmp_path / "run" / "00000001" / "checkpoint.json").unlink()
    with pytest.raises(CheckpointError, match="no older checkpoint is intact"):
        load_params(tmp_path / "run")


def test_leftovers_of_a_killed_run_are_swept(tmp_path):
    filled(tmp_path, 1)
    for name in ("00000002.writing", "00000002.writing.orbax-checkpoint-tmp", "00000000.deleted"):
        (tmp_path / name / "state").mkdir(parents=True)
    users = ["00000001.bak", "00000002.broken", "notes"]
    for name in users:
        (tmp_path / name).mkdir()
    assert steps(tmp_path) == [1]
    # a reader leaves them alone: a run may be writing
    load_params(tmp_path)
    assert len(list(tmp_path.iterdir())) == 7
    saver = opened(tmp_path)
    assert (
        sorted(path.name for path in tmp_path.iterdir()) == ["00000001", *users]
        and saver.latest() == 1
    )


@contextlib.contextmanager
def _limited_files(limit: int):
    """Let no file of this process grow beyond `limit` bytes: a real failing write, without root."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_failing_write_spares_the_older_checkpoint(tmp_path, capfd):
    noise = jax.device_put(np.random.default_rng(0).standard_normal((300, 1000)).astype("f4"))
    saver = opened(tmp_path)
    saver.save(1, {"trainable": {"x": noise}}, {"loss": 1})
    saver.wait()
    with _limited_files(100_000):
        saver.save(2, {"trainable": {"x": noise + 1}}, {"loss": 1})
        with pytest.raises(
            CheckpointError,
            match=r"could not write checkpoint .*00000002.*older ones are untouched",
        ):
            saver.wait()
    assert capfd.readouterr().err == ""
    # the debris would keep the disk full
    assert [path.name for path in tmp_path.iterdir()] == ["00000001"]
    np.testing.assert_array_equal(load_params(tmp_path)[0]["x"], noise)
    # and the run may go on
    saver.save(2, {"trainable": {"x": noise + 1}}, {"loss": 1})
    saver.close()
    np.testing.assert_array_equal(load_params(tmp_path)[0]["x"], noise + 1)


def test_a_disk_without_space_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    saver = filled(tmp_path, 1)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(checkpoint.shutil, "disk_usage", lambda _: usage._replace(free=100))
    saving = jax.eval_shape(lambda: state_of(2))
    for attempt in (lambda: saver.check_space(saving), lambda: saver.save(2, state_of(2), {})):
        with pytest.raises(
            CheckpointError, match=r"the disk is full. It needs [\d,]+ bytes and has 100\."
        ):
            attempt()
    monkeypatch.setattr(checkpoint.shutil, "disk_usage", lambda _: usage._replace(total=0, free=0))
    saver.check_space(saving)  # a disk that does not know its size
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["00000001"]
    saver.save(2, state_of(2), {})
    saver.close()
    same(saver.restore(saving), state_of(2))


CHILD = """
    import os, pathlib, signal, sys
    import numpy as np
    from anytouch_jax.weights import checkpoint

    folder, where = pathlib.Path(sys.argv[1]), sys.argv[2]

    assert "quiet_hook" not in sys.excepthook.__qualname__  # set by the first use

    def die(*args, **kwargs):
        os.kill(os.getpid(), signal.SIGKILL)

    def after(function, times):
        calls = []
        def wrapped(*args, **kwargs):
            result = function(*args, **kwargs)
            calls.append(0)
            return die() if len(calls) == times else result
        return wrapped

    saver = checkpoint.Checkpoints(folder, keep=1, config_json="{}", metadata={})
    for step in range(1, 5):
        if step == 3:
            if where == "arrays written":
                checkpoint.write_record = die
            elif where == "renamed":
                checkpoint.best_of = die
            elif where == "removing":
                half = lambda path, **_: (path / "checkpoint.json").unlink(missing_ok=True)
                checkpoint.shutil.rmtree = after(half, 2)
        saver.save(step, {"trainable": {"x": np.full((200, 300), step, "f4")}}, {"loss": -step})
        if where == "writing" and step == 3:
            die()
        saver.wait()
    print("survived")
"""


@pytest.mark.parametrize(
    ("where", "last"), [("arrays written", 2), ("renamed", 3), ("removing", 3), ("writing", 2)]
)
def test_kill_at_any_moment_leaves_a_whole_checkpoint(tmp_path, where, last):
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(CHILD), str(tmp_path), where],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == -9, done.stderr
    present = steps(tmp_path)
    assert present[-1] == last or (where == "writing" and present[-1] == 3)
    for step in present:
        np.testing.assert_array_equal(
            load_params(tmp_path, step)[0]["x"], np.full((200, 300), step, "f4")
        )
    saver = Checkpoints(tmp_path, keep=1, config_json="{}", metadata={})
    assert all(path.name.isdigit() for path in tmp_path.iterdir())
    saver.save(9, {"trainable": {"x": np.zeros(3, "f4")}}, {"loss": -9})
    saver.close()
    assert steps(tmp_path) == [9]


def test_a_checkpoint_of_the_first_format_loads_to_the_bit(tmp_path):
    """It was written before the weights were reorganised: a stage-2 run of width 16 with both
    towers.
    """
    with zipfile.ZipFile(DATA / "checkpoint_1.zip") as archive:
        archive.extractall(tmp_path / "run" / "checkpoints")
    loaded = load_model(tmp_path / "run")
    stored = json.loads((DATA / "checkpoint_1.json").read_text())
    raw, _, metadata = load_params(tmp_path / "run")
    numbers = {
        name: [
            list(array.shape),
            float(np.asarray(array, np.float64).sum()),
            zlib.crc32(array.tobytes()),
        ]
        for name, array in flatten(raw).items()
    }
    assert numbers == stored
    assert metadata["step"] == 3 and metadata["metrics"] == {"loss": 1.5}
    assert loaded.trained_sensors == ("digit", "gelsight_mini")
    assert {"touch", "decoder", "image", "text"} <= loaded.params.keys()
    model = loaded.config.model
    tokens = loaded.params["touch"]["sensor_tokens"]
    universal = raw["touch"]["sensor_tokens"][model.universal_row]
    for row, name in enumerate(model.sensors):
        trained = name in loaded.trained_sensors
        np.testing.assert_array_equal(
            tokens[row], raw["touch"]["sensor_tokens"][row] if trained else universal
        )
