"""The benchmark script: its records, its table, mistakes; our side of the PyTorch comparison."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tiny_models import tiny_config

from anytouch_jax.nn.functional import build
from anytouch_jax.weights import convert, load, safetensors
from experiments.benchmarks import run as bench
from experiments.benchmarks import speed, workloads
from experiments.benchmarks.pytorch import run as pytorch
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


@pytest.mark.slow
def test_what_was_measured_outlives_what_fails_later(tiny, tmp_path, monkeypatch):
    measure, works = speed.measure, []

    def once(work, *rest, **options):
        works.append(work)
        if len(works) > 1:
            raise RuntimeError("RESOURCE_EXHAUSTED: out of memory")
        return measure(work, *rest, **options)

    monkeypatch.setattr(speed, "measure", once)
    work = bench.workloads("embed", "tiny")[0]
    monkeypatch.setattr(bench, "workloads", lambda *_: [work, replace(work, name="embed one clip", frames=3)])
    out = tmp_path / "bench.jsonl"
    assert run("embed", "--quick", "--no-errors", "--out", out) == 0
    found = read_records(out)[next(iter(read_records(out)))]["results"]
    assert found["embed one still, preset tiny"][0]["ratio"] == 1
    assert "RESOURCE_EXHAUSTED" in found["embed one clip"][0]["note"]


def test_mistakes(tiny, tmp_path, capsys):
    cases = (("speed",), ("embed", "--rounds", 0), ("embed", "--batch", -2), ("embed", "--variants", "none"))
    for words in cases:
        assert run(*words, "--out", tmp_path / "a.jsonl") == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert str(words[-2 if len(words) > 2 else 0]).removeprefix("--variants") in error
    assert not any(tmp_path.iterdir())


# The comparison with PyTorch ------------------------------------------------------------------------------------------


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


def test_what_differs_is_not_timed():
    work = workloads.Workload("stage1 clips", tiny_config(1), 2, 4)
    pytorch.check(work, "eager float32", {"output": 1e-6, "loss": 1e-7, "gradient": 1e-6})
    for wrong in ({"loss": 2e-5}, {"gradient": 2e-4}, {"output": 2e-4}):
        with pytest.raises(
            SystemExit, match=f"{next(iter(wrong))} differs by 0.0002|{next(iter(wrong))} differs by 2e-05"
        ):
            pytorch.check(work, "eager float32", wrong)


def test_a_gradient_that_the_rival_lacks_is_noticed(tmp_path):
    exact = {"output": np.ones(2), "loss": 2.0, "gradient": {"a": np.ones(2), "b": np.ones(2)}}
    file = tmp_path / "values.safetensors"
    safetensors.write_safetensors(file, {"output": np.ones(2, np.float32), "grad/a": np.full(2, 1.5, np.float32)}, {})
    with pytest.raises(SystemExit, match="no gradient for"):
        pytorch.rival_errors(2.0, file, exact)
    exact["gradient"]["b"] = np.zeros(2)
    errors = pytorch.rival_errors(2.2, file, exact)
    assert errors["output"] == 0 and errors["loss"] == pytest.approx(0.1) and errors["gradient"] == pytest.approx(0.5)
