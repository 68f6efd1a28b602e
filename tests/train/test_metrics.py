import contextlib
import dataclasses
import functools
import json
import re
import resource

import numpy as np
import pytest
from train_toy import toy_config

from anytouch_jax.config import from_json, preset
from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.train.progress import Record, _flat, continues, open_run


def lines(run_dir):
    return [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]


def test_lines_are_json_and_what_is_not_finite_is_null(tmp_path):
    record = Record(tmp_path, 0)
    row = record.write(
        0,
        {"loss": np.float32(0.1), "grad_norm": float("nan"), "skipped": 0.0, "images": np.int64(3)},
    )
    record.write(1, {"loss": np.float32("inf"), "skipped": 1.0})
    record.close()
    first = {
        "step": 0,
        "loss": float(np.float32(0.1)),
        "grad_norm": None,
        "skipped": 0.0,
        "images": 3,
    }
    second = {"step": 1, "loss": None, "skipped": 1.0, "skipped_batches": 1}
    assert lines(tmp_path) == [first | {"skipped_batches": 0}, second]
    assert row == lines(tmp_path)[0]
    assert (record.skipped, record.in_a_row) == (1, 1)


def test_going_on_cuts_later_and_torn_lines_and_recalls_the_counts(tmp_path):
    record = Record(tmp_path, 0)
    for step in range(6):
        record.write(step, {"loss": 1.0, "skipped": float(step in (1, 3, 4))})
    record.close()
    path = tmp_path / "metrics.jsonl"
    before = path.read_text().splitlines(keepends=True)
    path.write_text("".join(before) + '{"step": 6, "lo')
    record = Record(tmp_path, 5)
    assert path.read_text() == "".join(before[:5])
    assert (record.skipped, record.in_a_row) == (3, 2)
    assert record.write(5, {"loss": 1.0, "skipped": 1.0})["skipped_batches"] == 4
    record.close()
    Record(tmp_path, 0).close()
    assert path.read_text() == ""
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_a_full_disk_is_one_sentence(tmp_path):
    record = Record(tmp_path, 0)
    record.write(0, {"loss": 1.0, "skipped": 0.0})
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (record.path.stat().st_size + 10, limit[1]))
        with pytest.raises(
            UserError, match=r"^cannot write .*metrics\.jsonl: .*run the same command again"
        ):
            record.write(1, {"loss": 1.0, "skipped": 0.0})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        record.close()
    assert json.loads(record.path.read_text().splitlines()[0])["step"] == 0


def begun(run):
    """The run has a complete checkpoint."""
    (run / "checkpoints" / "00000001").mkdir(parents=True)


def test_the_config_is_written_once_and_read_back(tmp_path):
    config = toy_config(steps=30)
    open_run(tmp_path / "run", config)
    assert from_json((tmp_path / "run" / "config.json").read_text()) == config
    begun(tmp_path / "run")
    open_run(tmp_path / "run", config)
    data = dataclasses.replace(config.data, threads=9, prefetch=9, on_bad_sample="skip")
    run = dataclasses.replace(
        config.run, save_every=7, keep=9, figure_every=9, tensorboard=True, fsdp=2, max_skipped=9
    )
    open_run(tmp_path / "run", dataclasses.replace(config, data=data, run=run))
    assert from_json((tmp_path / "run" / "config.json").read_text()) == config


# What may change between the parts of a run: it decides where and how fast the run goes, not what
# it computes.
MAY_CHANGE = (
    "data.cache",
    "data.manifests",
    "data.on_bad_sample",
    "data.prefetch",
    "data.threads",
    "data.tokenizer",
    "run.figure_every",
    "run.fsdp",
    "run.keep",
    "run.max_skipped",
    "run.save_every",
    "run.tensorboard",
)
WORDS = (
    "release",
    "scratch",
    "quick_gelu",
    "sensor",
    "linear",
    "cosine",
    "bfloat16",
    "mapped",
    "random",
    "same_sensor",
    "subtract",
    "skip",
    "another",
)


def others(value):
    """Other values for a field of a configuration, one of which it can have."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, 2 * value, value - 1]
    if isinstance(value, float):
        return [value / 2 + 0.01]
    if isinstance(value, str):
        return WORDS
    if value is None:
        return [1, "another", [["a", 1.0]], 0.5]
    return [
        [*value, "another"],
        [*value, "image"],
        [*value, ["a", 1.0]],
        [one / 2 + 0.01 for one in value if isinstance(one, float)],
    ]


def changed(config, path):
    """JSON of `config` with another value of the field at a dotted path."""
    *parts, last = path.split(".")
    data = dataclasses.asdict(config)
    place = functools.reduce(lambda tree, name: tree[name], parts, data)
    for value in others(place[last]):
        place[last] = value
        with contextlib.suppress(ConfigError):
            if from_json(json.dumps(data)) != config:
                return json.dumps(data)
    raise AssertionError(f"no other value of {path} is known here")


def test_a_run_goes_on_with_no_other_setting_than_these(tmp_path):
    config = preset("tiny", stage=2, towers="pretrained")
    begun(tmp_path)
    paths = list(_flat(dataclasses.asdict(config)))
    assert set(MAY_CHANGE) < set(paths) and len(paths) > 80
    for path in paths:
        (tmp_path / "config.json").write_text(changed(config, path))
        if path in MAY_CHANGE:
            assert continues(tmp_path, config), path
        else:
            with pytest.raises(
                UserError, match=rf"settings: {re.escape(path)} was [^;]*\. Use the same"
            ):
                continues(tmp_path, config)


def test_tensorboard_gets_the_numbers(tmp_path):
    pytest.importorskip("tensorboardX")
    record = Record(tmp_path, 0, tensorboard=True)
    record.write(0, {"loss": 1.0, "skipped": 0.0, "grad_norm": float("nan")})
    record.close()
    (event,) = (tmp_path / "tensorboard").iterdir()
    assert b"loss" in event.read_bytes() and b"grad_norm" not in event.read_bytes()
