import json

import numpy as np
import pytest
from tiny_models import tiny_config

from anytouch_jax.nn.functional import build
from anytouch_jax.weights import convert, load
from experiments.benchmarks import run as bench
from experiments.benchmarks import simulator, workloads
from experiments.benchmarks.pytorch import run as pytorch
from experiments.benchmarks.table import simulated_table
from experiments.records import read_records
from tests.support.release_keys import release_names


@pytest.fixture
def tiny(monkeypatch):
    """The workloads at the size of tests."""
    work = workloads.Workload("embed one still", tiny_config(1), 1, 1)
    monkeypatch.setattr(bench, "workloads", lambda *_: [work])


def run(*args):
    return bench.main([*map(str, args)])


@pytest.mark.slow
def test_a_record_and_a_table_of_a_workload(tiny, tmp_path, capsys):
    out = tmp_path / "bench.jsonl"
    assert run("embed", "--quick", "--out", out) == 0
    (record,) = read_records(out).values()
    rows = record["results"]["embed one still, preset tiny"]
    assert [row["variant"] for row in rows] == ["float32", "bfloat16"] and record["rounds"] == 2
    assert rows[0]["ratio"] == 1 and 0 < rows[0]["error_output"] < 1e-5 < rows[1]["error_output"]
    assert {"cores", "load", "jax"} <= set(record["machine"])
    assert "| bfloat16 | 1 |" in capsys.readouterr().out


def test_mistakes(tiny, tmp_path, capsys):
    cases = (("speed",), ("embed", "--rounds", 0), ("embed", "--batch", -2), ("embed", "--variants", "none"))
    for words in cases:
        assert run(*words, "--out", tmp_path / "a.jsonl") == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert str(words[-2 if len(words) > 2 else 0]).removeprefix("--variants") in error
    assert not any(tmp_path.iterdir())


def test_the_rival_gets_the_same_numbers_under_the_authors_names(tmp_path):
    work = workloads.Workload("stage2 align", tiny_config(2, "release"), 4, 4)
    pytorch.batch_file(work, tmp_path / "batch.safetensors")
    found = load.read_weights(tmp_path / "batch.safetensors")
    batch, noise = pytorch.given(work)
    np.testing.assert_array_equal(found["clip"], batch.align.clip)
    np.testing.assert_array_equal(found["noise"], noise)
    assert found["clip"].dtype == np.uint8 and found["text_row"].dtype == np.int64
    spec = json.loads(json.dumps(pytorch.spec(work)))
    assert spec["kind"] == "align" and spec["kept"] == 4 and spec["weights"] == [0.5, 1.0, 0.1]
    named = release_names(work.config.model)
    assert set(named) == set(
        convert.to_release(build(work.config.model).init(pytorch.jax.random.key(0)), work.config.model)
    ) - pytorch.UNUSED | ({k for k in named if k in pytorch.UNUSED})
    old = "touch_mae_model.touch_decoder_blocks.0.attention.output.dense.weight"
    assert pytorch.renamed(old) == "touch_mae_model.touch_decoder_blocks.0.attention.o_proj.weight"
    assert pytorch.renamed("a.output.dense.bias") == "a.output.dense.bias"  # of the decoder's blocks only


@pytest.mark.slow
def test_the_simulator_is_measured_and_stored(tmp_path):
    out = tmp_path / "simulator.jsonl"
    options = "--sensors digit --sizes 28 --frames 2 --batch 2 --rounds 1 --objects 8 --peak-size 64 --out"
    assert simulator.main([*options.split(), str(out)]) == 0
    fast, exact = (read_records(out)[f"cpu, 28, 2, digit, {name}"] for name in ("fast", "exact"))
    assert 0 < fast["mm"] < 0.1 and 0 < fast["levels"] < 10 and "mm" not in exact
    assert min(fast[name] for name in ("frames_s", "processor_ms", "mflop", "mbyte", "roofline")) > 0
    rows = simulated_table(tmp_path).rows
    assert [row[1] for row in rows] == ["28 pixels, clips, exact", "28 pixels, clips, fast"]
    assert rows[1][5] == fast["mm"]
