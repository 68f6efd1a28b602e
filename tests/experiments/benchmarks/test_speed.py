"""Speed against error: what is counted, what is compared, what is read from a compiled program."""

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
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from experiments.benchmarks import machine, speed, variants
from experiments.benchmarks.workloads import (
    Workload,
    make_batch,
    normalised,
    products,
    values_of,
    workloads,
)
from experiments.records import read_records

STAGE1 = Workload("stage1 clips", tiny_config(1), 4, 4)
ALIGN = Workload("stage2 align", tiny_config(2, "release"), 8, 4)
MATCH = Workload("stage2 match", tiny_config(2, "release"), 4, 3)
EMBED = Workload("embed clips", tiny_config(1), 2, 3)
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


def shapes(tree):
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)


def noise_of(work):
    return jnp.zeros((work.samples, work.config.model.patches))


# Useful operations --------------------------------------------------------------------------------------------------


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


def test_operations_of_a_loop_count_for_each_turn():
    def twice(x, w):
        return jax.lax.scan(lambda x, w: (x @ w, None), x, w)[0]

    jaxpr = jax.make_jaxpr(twice)(jnp.zeros((2, 3)), jnp.zeros((5, 3, 3)))
    assert products(jaxpr.jaxpr) == 5 * 2 * 2 * 3 * 3


@pytest.mark.slow
def test_remat_and_precision_are_no_useful_operations():
    model = replace(ALIGN.config.model, remat=True, dtype="bfloat16", attention="mapped")
    other = replace(ALIGN, config=replace(ALIGN.config, model=model))
    assert other.operations == ALIGN.operations


def test_the_compiled_encoder_of_preset_large_costs_at_most_27_percent_of_the_unmasked_one():
    config = shallow(preset("large"))
    model, net = config.model, build(config.model)
    clip = jax.ShapeDtypeStruct((1, 3, 224, 224, 3), jnp.float32)
    kept = jax.ShapeDtypeStruct((1, model.patches // 4), jnp.int32)
    sensor = jax.ShapeDtypeStruct((1,), jnp.int32)
    hidden = lambda p, c, s, k=None: net.bind(p).touch.hidden(c, s, k)  # noqa: E731
    masked, whole = counted(hidden, net.abstract(), clip, sensor, kept), counted(hidden, net.abstract(), clip, sensor)
    assert 0.2 < masked / whole <= 0.27


@pytest.mark.slow
def test_a_batch_without_vision_costs_nothing_for_the_image_tower():
    config = shallow(preset("tiny", stage=2))
    work, net = Workload("stage2 align", config, 4, 3), build(config.model)
    batch = normalised(make_batch(work)).align
    blind = batch._replace(image=batch.image[:0], image_row=batch.image_row[:0])
    terms = lambda p, b: objectives.stage2_terms(p, objectives.Stage2Batch(b, None), None, net=net, config=config)[0]  # noqa: E731
    costs = [counted(jax.grad(terms), net.abstract(), b) for b in (batch, blind)]
    width, patches = config.model.image.width, config.model.patches
    assert costs[0] - costs[1] >= 3 * 2 * patches * width * (4 * width + 2 * config.model.image.mlp)  # of one image


def test_a_still_is_projected_as_one_frame():
    model, net = preset("small").model, build(preset("small").model)
    args = (jax.ShapeDtypeStruct((16, 1, 224, 224, 3), jnp.float32), jax.ShapeDtypeStruct((16,), jnp.int32))
    one_frame = 2 * 16 * model.patches * 588 * 384
    summed, positions = 3 * 588 * 384, 8 * 16 * 262 * 384  # adding kernels and tables is no projection
    assert one_frame < counted(lambda p, *a: net.bind(p).touch.tokens(*a), net.abstract(), *args)
    assert counted(lambda p, *a: net.bind(p).touch.tokens(*a), net.abstract(), *args) < one_frame + summed + positions


# Batches ------------------------------------------------------------------------------------------------------------


def test_a_batch_is_the_same_for_the_same_seed_and_has_the_shares_it_says():
    one, again = make_batch(ALIGN).align, make_batch(ALIGN).align
    jax.tree.map(np.testing.assert_array_equal, one, again)
    assert one.image_row.tolist() == [0, 4] and len(one.text_row) == 4 and one.clip.shape == (8, 4, 28, 28, 3)
    assert (one.text.argmax(1) == one.text_mask.sum(1) - 1).all()  # the end token is the last readable one
    names = {w.name: w for what in ("stage1", "stage2", "embed") for w in workloads(what, "tiny", 8)}
    assert names["stage2 match"].samples == 4 and names["embed one still"].samples == 1
    assert make_batch(names["stage1 stills"]).clip.shape == (8, 1, 112, 112, 3)


# Errors -------------------------------------------------------------------------------------------------------------


def test_relative_is_the_norm_of_the_difference():
    exact = [np.array([3.0, 0.0]), np.array([[4.0]])]
    assert speed.relative([np.array([3.0, 1.0]), np.array([[4.0]])], exact) == pytest.approx(0.2)
    assert speed.relative(exact, exact) == 0 and speed.relative([np.ones(4)], [np.zeros(4)]) == 2


@pytest.mark.parametrize("work", [pytest.param(STAGE1, marks=pytest.mark.slow), MATCH], ids=lambda w: w.name)
@pytest.mark.slow
def test_errors_are_rounding_in_float32_and_coarser_in_bfloat16(work):
    params = build(work.config.model).init(jax.random.key(0))
    single, half = speed.errors(FAST, work, params)
    assert set(single) == {"output", "loss", "gradient"}
    assert all(0 <= value < 5e-6 for value in single.values()) and single["gradient"] > 0
    assert all(1e-5 < half[name] < 0.1 for name in ("output", "gradient"))


def test_the_reference_is_float64_and_nothing_else_becomes_so():
    params, noise = build(EMBED.config.model).init(jax.random.key(0)), np.asarray(noise_of(EMBED))
    wide = replace(variants.BASELINE, model={"dtype": "float64"})
    dtypes = [speed.values_in(v, EMBED, params, noise)["output"][0].dtype for v in (wide, variants.BASELINE)]
    assert dtypes == [np.float64, np.float32] and not jax.config.jax_enable_x64
    assert [speed.widened(np.zeros(1, kind)).dtype for kind in (np.float32, np.int32)] == [np.float64, np.int32]


@pytest.mark.slow
def test_the_output_of_stage_1_belongs_to_its_loss():
    params = build(STAGE1.config.model).init(jax.random.key(0))
    batch, noise = normalised(make_batch(STAGE1)), jnp.asarray(np.random.default_rng(0).random((4, 16)), jnp.float32)
    values = jax.jit(values_of(STAGE1.config))(params, batch, noise)
    assert "position" not in values["gradient"]["decoder"]  # a fixed table
    flat = batch.clip.reshape(4, 4, 4, 7, 4, 7, 3).transpose(0, 2, 4, 1, 3, 5, 6).reshape(4, 16, 4, -1)
    error = ((np.asarray(values["output"]) - flat) ** 2).mean(-1)
    hidden = np.argsort(np.argsort(np.asarray(noise), 1), 1) >= 4
    np.testing.assert_allclose(values["loss"], error[..., :3].mean(-1)[hidden].mean() + error[..., 3].mean(), rtol=1e-5)


# Timing -------------------------------------------------------------------------------------------------------------


def test_all_take_turns_and_each_round_begins_with_another():
    received = []
    times = speed.interleaved([partial(received.append, i) for i in range(3)], 2, [1, 2, 1])
    assert "".join(map(str, received)) == "01201121120"  # a warm-up, then two rounds
    assert [t.shape for t in times] == [(2, 1), (2, 2), (2, 1)] and all((t > 0).all() for t in times)
    with pytest.raises(UserError, match="at least one round"):
        speed.interleaved([print], 0)


NOWHERE = {"dtype": "float7"}


@pytest.mark.slow
def test_a_variant_that_fails_when_it_is_run_is_a_row_with_a_note(monkeypatch):
    """As a GPU does that runs out of memory at the first call: the others are measured."""
    whole = speed.compiled

    def broken(variant, work, state):
        program = whole(variant, work, state)

        def fail(*_):
            raise RuntimeError("RESOURCE_EXHAUSTED: out of memory\nand more")

        return replace(program, call=fail) if variant.name == "large" else program

    monkeypatch.setattr(speed, "compiled", broken)
    tried = (*FAST[:1], variants.Variant("large", {"remat": True}))
    base, large = speed.measure(STAGE1, tried, rounds=1, with_errors=False, peak_size=64)
    assert base.calls == 1 and base.ratio == 1 and large.note == "RuntimeError: RESOURCE_EXHAUSTED: out of memory"


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


@pytest.mark.slow
def test_an_embedding_is_measured_from_pixels_on_the_host():
    one = EMBED.resized(1)
    rows = speed.measure(one, FAST, rounds=2, peak_size=64)
    assert rows[0].calls == 40 and rows[0].p50 <= rows[0].p99 and rows[0].error_gradient is None
    assert rows[0].error_output < 1e-5 < rows[1].error_output


def test_the_peak_is_that_of_a_square_product():
    run, operations = machine.matmul("float32", 32)
    assert run()[0].shape == (32, 32) and operations == 2 * 32**3
    (product,) = machine.matmul("bfloat16", 32)[0]()
    assert product.dtype == jnp.float32  # the one form of it that a CPU computes fast
    assert machine.describe().cores >= 1 and "jax" in machine.describe().sentence()
    assert machine.describe().vectors in {"", *machine.VECTORS.values()}


@pytest.mark.parametrize(
    ("flags", "found"),
    [("sse avx2 avx512f amx_tile", "AMX"), ("avx2 avx512f", "AVX-512"), ("avx avx2", "AVX2"), ("sse", "")],
)
def test_a_machine_names_its_widest_vectors(flags, found, monkeypatch):
    known = {"model name": "A processor", "flags": flags}
    monkeypatch.setattr(machine, "_cpuinfo", known.__getitem__)
    here = machine.describe()
    assert here.vectors == found and here.processor == "A processor"
    assert (f"A processor with {found}," if found else "A processor,") in here.sentence()


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
