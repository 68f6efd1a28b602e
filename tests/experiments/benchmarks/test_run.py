"""The benchmark script: its page, its numbers, mistakes; our side of the PyTorch comparison."""

import json
from dataclasses import asdict

import numpy as np
import pytest
from places import EXPERIMENTS
from tiny_models import tiny_config

from anytouch_jax.nn.functional import build
from anytouch_jax.weights import convert, load, safetensors
from experiments.benchmarks import compilation, speed, workloads
from experiments.benchmarks import run as bench
from experiments.benchmarks.pytorch import run as pytorch
from experiments.records import read_records
from tests.support.release_keys import release_names

RESULTS = EXPERIMENTS / "results"


@pytest.fixture
def tiny(monkeypatch):
    """The workloads at the size of tests."""
    work = workloads.Workload("embed one still", tiny_config(1), 1, 1)
    monkeypatch.setattr(workloads, "workloads", lambda *_: [work])


def run(*args):
    try:
        return bench.main([*map(str, args)])
    except SystemExit as stop:
        return int(stop.code or 0)


def numbers_of(folder, name):
    return json.loads((folder / f"speed_{name}.json").read_text())


@pytest.mark.parametrize("numbers", [None, '{"quick": false}'])
def test_another_page_and_a_measurement_are_not_replaced(numbers, tiny, tmp_path, capsys):
    page = tmp_path / "speed_embed_tiny.md"
    page.write_text("as it was")
    if numbers:
        page.with_suffix(".json").write_text(numbers)
    assert run("embed", "--quick", "--out", tmp_path) == 2
    assert "--out" in capsys.readouterr().err and page.read_text() == "as it was"


@pytest.mark.slow
def test_a_table_of_numbers_of_words_and_a_figure(tiny, tmp_path, capsys):
    assert run("embed", "--quick", "--out", tmp_path) == 0
    text, numbers = (tmp_path / "speed_embed_tiny.md").read_text(), numbers_of(tmp_path, "embed_tiny")
    (rows,) = numbers["results"].values()
    assert [row["variant"] for row in rows] == ["float32", "bfloat16"] and numbers["rounds"] == 2
    assert rows[0]["ratio"] == 1 and 0 < rows[0]["error_output"] < 1e-5 < rows[1]["error_output"]
    assert {"cores", "load", "jax"} <= set(numbers["machine"])
    (figure,) = (tmp_path / "figures").iterdir()
    assert figure.read_bytes()[:4] == b"\x89PNG" and f"figures/{figure.name}" in text
    assert "Not for comparison" in text and "of its peak" in text
    assert "| bfloat16 | 1 |" in capsys.readouterr().out


@pytest.mark.slow
def test_what_was_measured_outlives_what_fails_later(tiny, tmp_path, capsys, monkeypatch):
    def fail(*_):
        raise RuntimeError("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr(speed, "errors", fail)
    assert run("embed", "--quick", "--out", tmp_path) == 0
    assert "no errors, the float64 reference failed: RESOURCE_EXHAUSTED" in capsys.readouterr().err
    (rows,) = numbers_of(tmp_path, "embed_tiny")["results"].values()
    assert all(row["ratio"] > 0 and row["error_output"] is None for row in rows)
    monkeypatch.setitem(bench.SECTIONS, "loader", fail)
    with pytest.raises(RuntimeError, match="out of memory"):
        run("embed", "loader", "--quick", "--out", tmp_path / "second")
    assert "embed one still" in (tmp_path / "second" / "speed_embed_loader_tiny.md").read_text()


@pytest.mark.slow
def test_loader_and_simulator(tmp_path):
    assert run("loader", "simulator", "--quick", "--out", tmp_path) == 0
    numbers = numbers_of(tmp_path, "loader_simulator_tiny")["results"]
    rows = numbers["Loader compared with plain decoding, and a large manifest"]
    assert {row["variant"] for row in rows if "variant" in row} >= {"decode + resize", "all augmentations"}
    assert [row["stage"] for row in rows if "stage" in row] == [1, 2]
    assert {row["fidelity"] for row in numbers["Simulator"]} == {"exact", "fast"}
    whole = numbers["Simulator, whole recordings of two frames at 32 pixels, default fidelity"]
    assert [row["sensor"] for row in whole] == ["digit", "all, two at a time"]
    assert all(row["frames_per_second"] > 0 for row in whole)


def test_memory_and_compile_are_asked_of_other_processes(monkeypatch, tmp_path, capsys):
    asked = []

    def simulate(preset, devices, fsdp, batch, *rest, **more):
        asked.append((preset, devices, fsdp, batch))
        return compilation.Layout(
            devices, fsdp, batch, 2**20, 2**20, 2**21, 2.0**22, {"all-reduce": 2.0**22}, {"all-reduce": 7}, True, 1.0
        )

    monkeypatch.setattr(compilation, "simulate", simulate)
    monkeypatch.setattr(
        compilation, "ask", lambda *_: asdict(compilation.Start("w", "paper", "tiny", 2, False, 1.0, 2.0, 3.0))
    )
    assert run("memory", "compile", "--quick", "--preset", "large", "--out", tmp_path) == 0
    assert asked == [("large", 1, 1, 2), ("large", 2, 1, 2), ("large", 2, 2, 2)]
    printed = capsys.readouterr().out
    assert "| 2 | 1 x 2 | 4 | 1.0 | 2.0 | 4.0 | 7 all-reduce (4.0) |" in printed and "| 6.00 |" in printed
    page = (tmp_path / "speed_memory_compile_large.md").read_text()
    assert "simulated CPU devices" in page  # how it was measured stands beside it


def test_mistakes(tiny, tmp_path, capsys):
    assert run("speed") == 2
    for words in (("--rounds", 0), ("--batch", -2)):
        assert run("embed", *words, "--out", tmp_path) == 2
        assert words[0] in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_page_is_made_from_its_numbers_alone(tiny, tmp_path):
    assert run("embed", "--quick", "--out", tmp_path) == 0
    assert (tmp_path / "speed_embed_tiny.md").read_text() == bench.page_of(numbers_of(tmp_path, "embed_tiny"))
    for name, page_of in (("variants", bench.page_of), ("torch", pytorch.page_of)):
        numbers = read_records(RESULTS / f"{name}.jsonl")["small"]
        page = page_of(numbers)
        assert page.startswith("# ") and page == page_of(json.loads(json.dumps(numbers))), name


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
