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
from experiments.benchmarks import speed, variants
from experiments.benchmarks.workloads import Workload, make_batch, normalised
from experiments.records import read_records

STAGE1 = Workload("stage1 clips", tiny_config(1), 4, 4)
FAST = (variants.BASELINE, variants.Variant("bfloat16", variants.BFLOAT16))


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


@pytest.mark.parametrize("work", [
    Workload("stage1 clips", shallow(preset("small")), 2, 4),
    pytest.param(Workload("stage1 stills", shallow(preset("small")), 2, 1), marks=pytest.mark.slow),
    Workload("stage2 align", shallow(preset("small", stage=2)), 4, 3),
    pytest.param(Workload("stage2 match", shallow(preset("small", stage=2)), 4, 3), marks=pytest.mark.slow),
    Workload("embed", shallow(preset("small")), 2, 3),
], ids=lambda work: work.name)  # fmt: skip
@pytest.mark.slow
def test_useful_operations_are_nearly_all_that_xla_counts(work):
    batch, net = normalised(make_batch(work)), build(work.config.model)
    one, two = (
        partial(terms, net=net, config=work.config) for terms in (objectives.stage1_terms, objectives.stage2_terms)
    )
    if work.name == "embed":
        run = lambda p: net.encode_touch(p, batch.clip, batch.sensor)  # noqa: E731
    elif work.config.stage == 1:
        run = jax.grad(lambda p: one(p, batch.clip, batch.sensor, noise_of(work))[0])
    else:
        run = jax.grad(lambda p: two(p, batch, None)[0])
    assert 1 < counted(run, net.abstract()) / work.operations < 1.06  # the rest: norms, softmax, GELU, the loss


NOWHERE = {"dtype": "float7"}


@pytest.mark.slow
def test_a_step_is_measured_and_what_does_not_run_here_is_a_row_with_a_note():
    tried = (*FAST[:1], variants.Variant("remat", {"remat": True}), variants.Variant("seven bits", NOWHERE))
    rows = speed.measure(STAGE1, tried, rounds=2, with_errors=False, peak_size=64)
    base, remat, absent = rows
    assert base.ratio == 1 and base.ratio_iqr == 0 and base.calls == 2 and base.error_loss is None
    assert base.gflops == pytest.approx(base.operations / base.seconds / 1e9) and base.peak_share > 0
    assert remat.peak_bytes > remat.temp_bytes > 0 and remat.ratio > 0 and base.copies > 0
    assert absent.note and np.isnan(absent.ratio) and absent.variant == "seven bits"
    assert speed.record_of(absent)["seconds"] is None
    json.dumps([speed.record_of(row) for row in rows], allow_nan=False)


_BARE = """
import sys
for name in ("tyro", "pyarrow", "cv2", "matplotlib", "sklearn", "tokenizers", "safetensors", "taxim", "threadpoolctl"):
    sys.modules[name] = None  # an import of it fails
sys.argv = "run.py embed --preset tiny --batch 1 --rounds 1 --peak-size 64 --out".split() + [{out!r}]
sys.path[:0] = [{root!r}, {root!r} + "/src"]
import runpy
runpy.run_path({script!r}, run_name="__main__")
ours = sorted(name for name in sys.modules if name.startswith("anytouch_jax."))
print("OURS", *ours)
"""


@pytest.mark.slow
def test_the_accelerator_benchmark_needs_jax_flax_optax_and_numpy_alone(tmp_path):
    out = tmp_path / "gpu.jsonl"
    code = _BARE.format(out=str(out), root=str(ROOT), script=str(ROOT / "experiments" / "benchmarks" / "run.py"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "anytouch_jax.weights.checkpoint" not in done.stdout and "| float32 | 1 |" in done.stdout
    assert next(iter(read_records(out).values()))["results"]["embed one still, preset tiny"][0]["variant"] == "float32"
