import json
import subprocess
import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import ROOT
from tiny_models import tiny_config

from anytouch_jax import objectives
from anytouch_jax.config import preset
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import load
from experiments.benchmarks import run as bench
from experiments.benchmarks import simulator, speed, variants, workloads
from experiments.benchmarks.pytorch import run as pytorch
from experiments.benchmarks.table import simulated_table
from experiments.benchmarks.workloads import Workload, make_batch, normalised
from experiments.records import read_records


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
    cases = (
        ("speed",),
        ("embed", "--rounds", 0),
        ("embed", "--batch", -2),
        ("embed", "--variants", "none"),
    )
    for words in cases:
        assert run(*words, "--out", tmp_path / "a.jsonl") == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert str(words[-2 if len(words) > 2 else 0]).removeprefix("--variants") in error
    assert not any(tmp_path.iterdir())


def test_the_rival_gets_the_same_numbers(tmp_path):
    work = workloads.Workload("stage2 align", tiny_config(2, "release"), 4, 4)
    pytorch.batch_file(work, tmp_path / "batch.safetensors")
    found = load.read_weights(tmp_path / "batch.safetensors")
    batch, noise = pytorch.given(work)
    np.testing.assert_array_equal(found["clip"], batch.align.clip)
    np.testing.assert_array_equal(found["noise"], noise)
    assert found["clip"].dtype == np.uint8 and found["text_row"].dtype == np.int64
    spec = json.loads(json.dumps(pytorch.spec(work)))
    assert spec["kind"] == "align" and spec["kept"] == 4 and spec["weights"] == [0.5, 1.0, 0.1]


@pytest.mark.slow
def test_the_simulator_is_measured_and_stored(tmp_path):
    out = tmp_path / "simulator.jsonl"
    options = (
        "--sensors digit --sizes 28 --frames 2 --batch 2 --rounds 1 --objects 8 --peak-size 64 "
        "--out"
    )
    assert simulator.main([*options.split(), str(out)]) == 0
    fast, exact = (read_records(out)[f"cpu, 28, 2, digit, {name}"] for name in ("fast", "exact"))
    assert 0 < fast["mm"] < 0.1 and 0 < fast["levels"] < 10 and "mm" not in exact
    assert (
        min(fast[name] for name in ("frames_s", "processor_ms", "mflop", "mbyte", "roofline")) > 0
    )
    rows = simulated_table(tmp_path).rows
    assert [row[1] for row in rows] == ["28 pixels, clips, exact", "28 pixels, clips, fast"]
    assert rows[1][5] == fast["mm"]


def shallow(config):
    """One block a stack: XLA counts the body of a loop once, however often it runs."""
    one = lambda stack: None if stack is None else replace(stack, depth=1)  # noqa: E731
    model = config.model
    text = None if model.text is None else replace(model.text, stack=one(model.text.stack))
    parts = {name: one(getattr(model, name)) for name in ("touch", "decoder", "image")}
    return replace(config, model=replace(model, **parts, text=text))


def counted(function, *args):
    """Operations of a program as XLA counts them, before it optimises."""
    return jax.jit(function).lower(*args).cost_analysis()["flops"]


def noise_of(work):
    return jnp.zeros((work.samples, work.config.model.patches))


@pytest.mark.parametrize(
    "work",
    [
        Workload("stage1 clips", shallow(preset("small")), 2, 4),
        pytest.param(
            Workload("stage1 stills", shallow(preset("small")), 2, 1), marks=pytest.mark.slow
        ),
        Workload("stage2 align", shallow(preset("small", stage=2)), 4, 3),
        pytest.param(
            Workload("stage2 match", shallow(preset("small", stage=2)), 4, 3),
            marks=pytest.mark.slow,
        ),
        Workload("embed", shallow(preset("small")), 2, 3),
    ],
    ids=lambda work: work.name,
)
@pytest.mark.slow
def test_useful_operations_are_nearly_all_that_xla_counts(work):
    batch = normalised(make_batch(work))
    net = build(work.config.model)
    one, two = (
        partial(terms, net=net, config=work.config)
        for terms in (objectives.stage1_terms, objectives.stage2_terms)
    )
    if work.name == "embed":
        run = lambda p: net.encode_touch(p, batch.clip, batch.sensor)  # noqa: E731
    elif work.config.stage == 1:
        run = jax.grad(lambda p: one(p, batch.clip, batch.sensor, noise_of(work))[0])
    else:
        run = jax.grad(lambda p: two(p, batch, None)[0])
    # the rest: norms, softmax, GELU, the loss
    assert 1 < counted(run, net.abstract()) / work.operations < 1.06


@pytest.mark.slow
def test_what_does_not_run_here_is_a_row_with_a_note():
    work = Workload("stage1 clips", tiny_config(1), 4, 4)
    tried = [variants.BASELINE, variants.Variant("remat", {"remat": True})]
    tried.append(variants.Variant("seven bits", {"dtype": "float7"}))
    rows = base, remat, absent = speed.measure(
        work, tried, rounds=2, with_errors=False, peak_size=64
    )
    assert (
        base.gflops == pytest.approx(base.operations / base.seconds / 1e9)
        and base.peak_fraction > 0
    )
    assert remat.peak_bytes > remat.temp_bytes > 0 and remat.ratio > 0
    assert absent.note and np.isnan(absent.ratio) and absent.variant == "seven bits"
    json.dumps([speed.record_of(row) for row in rows], allow_nan=False)


_BARE = """
import sys
for name in (
    "tyro", "pyarrow", "cv2", "matplotlib", "sklearn", "tokenizers", "safetensors", "taxim",
    "threadpoolctl",
):
    sys.modules[name] = None  # an import of it fails
words = "run.py embed --preset tiny --batch 1 --rounds 1 --peak-size 64 --out"
sys.argv = [*words.split(), {out!r}]
sys.path[:0] = [{root!r}, {root!r} + "/src"]
import runpy
runpy.run_path({script!r}, run_name="__main__")
ours = sorted(name for name in sys.modules if name.startswith("anytouch_jax."))
print("OURS", *ours)
"""


@pytest.mark.slow
def test_the_accelerator_benchmark_needs_jax_flax_optax_and_numpy_alone(tmp_path):
    out = tmp_path / "gpu.jsonl"
    code = _BARE.format(
        out=str(out), root=str(ROOT), script=str(ROOT / "experiments" / "benchmarks" / "run.py")
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "anytouch_jax.weights.checkpoint" not in done.stdout and "| float32 | 1 |" in done.stdout
    assert (
        next(iter(read_records(out).values()))["results"]["embed one still, preset tiny"][0][
            "variant"
        ]
        == "float32"
    )
