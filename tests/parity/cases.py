"""Numerical parity with the authors' PyTorch code: run every golden case of a folder through what
training runs.

One runner a kind of case, found by the letter its name starts with. Nothing is assembled a second
time here: losses come from `objectives`, gradients from `jax.grad` of them, steps from
`train.step`, weights from `weights.convert`.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax import objectives
from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.nn.anytouch import AnyTouch
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.ops import losses, tokens
from anytouch_jax.train.optim import learning_rate, optimizer
from anytouch_jax.train.step import TrainState, init_state, make_step, merge
from anytouch_jax.weights import convert
from tests.parity import families, weights
from tests.parity.golden_files import (
    GRADIENT,
    PARAMETER,
    Case,
    Row,
    channel_last,
    golden_config,
    golden_params,
    read_arrays,
    read_cases,
)
from tests.parity.losses import (
    align,
    align_edge,
    dead_keys,
    encode,
    match,
    setup,
    stage1,
    table_rows,
)
from tests.support.adam_moments import moments

Params = dict[str, Any]


def run(folder: Path) -> list[Row]:
    """Compare every case of `folder`; a case or an array that is not understood is a failing
    row.
    """
    found = read_cases(folder)
    rows = [row for case in found for row in run_case(case)]
    others = {name for case in found for name in case.info.get("files", ())}
    paths = sorted(path for path in folder.glob("*.pth") if path.name not in others)
    return rows + [
        row for path in paths for row in _tried(weights.checkpoint, Case(path.name, folder, {}))
    ]


def run_case(case: Case) -> list[Row]:
    """Compare one case; what this version cannot follow is a failing row that says why."""
    runner = next((fn for pattern, fn in _RUNNERS.items() if re.match(pattern, case.name)), None)
    runner = families.compare if "architecture" in case.info else runner
    if runner is None:
        case.fail("-", "not a case this version understands")
        return case.rows
    return _tried(runner, case)


def _tried(runner: Callable[[Case], None], case: Case) -> list[Row]:
    """The rows of a case; what stops its runner is a failing row."""
    try:
        with jax.default_matmul_precision("highest"):
            runner(case)
        case.finish()
        if not case.rows:
            case.fail("-", "nothing was compared")
    except (
        Exception
    ) as error:  # a folder of another make: any array or key may be absent or of another shape
        reason = (str(error).splitlines() or [""])[0]
        case.fail("-", f"not understood: {type(error).__name__}: {reason}")
    return case.rows


def _probe(case: Case) -> None:
    for name, sub in case.info["subcases"].items():
        stage = 2 if sub["encoder_params"].startswith("stage2") else 1
        file = re.match(r"\S+\.npz", sub["encoder_params"])
        assert file is not None
        info = {**case.info, "params_file": file.group()}
        net, _, params = setup(Case(case.name, case.folder, info), stage)
        sensor = np.asarray(table_rows(case.inputs(f"{name}/sensor_type_used"), net))
        feel = sub["dataset"] == "feel"
        images = case.inputs("feel_images" if feel else "images")
        case.seen |= {"in/sensors", "in/feel_sensors"}
        flat = np.asarray(channel_last(images.reshape(-1, *images.shape[-3:])))
        # the reference tiles ids batch-major (golden Q13)
        sensor = np.tile(sensor, len(flat) // len(sensor))
        if sub["pooling"] == "cls":
            out = encode(params, flat, sensor, net=net)
            case.compare(f"out/{name}/projected", out)
            head_input = out.reshape(len(images), -1)
        else:
            out = encode(params, flat, sensor, net=net, read=AnyTouch.encode_tokens)
            case.compare(
                f"out/{name}/projected", out[:, : case.arrays[f"out/{name}/projected"].shape[1]]
            )
            if (
                feel
            ):  # the reference interleaves the two images' tokens by a plain reshape (golden Q13)
                out = out.reshape(len(images), out.shape[1], -1)
                head_input = jnp.mean(out[:, 1 + net.model.sensor_tokens :], axis=1)
            else:
                head_input = encode(params, flat, sensor, net=net, read=AnyTouch.encode_poolings)[1]
        case.compare(f"out/{name}/head_input", head_input)
        _probe_head(case, name, head_input)


def _probe_head(case: Case, name: str, head_input: jax.Array) -> None:
    """Logits, loss and gradients of the authors' linear head on recorded weights."""
    head = {key: np.asarray(case.inputs(f"{name}/head_{key}")) for key in ("weight", "bias")}
    labels = np.asarray(case.inputs(f"{name}/labels"))

    def loss(head: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        logits = head_input @ head["weight"].T + head["bias"][None]
        if logits.shape[1] == 1:
            flat = labels.reshape(-1).astype(jnp.float32)
            return jnp.mean(optax.sigmoid_binary_cross_entropy(logits[:, 0], flat)), logits
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, labels)), logits

    (value, logits), grads = jax.jit(jax.value_and_grad(loss, has_aux=True))(head)
    case.compare(f"out/{name}/logits", logits)
    case.compare(f"out/{name}/loss", value)
    for key in head:
        case.compare(f"out/{name}/grad_head_{key}", grads[key], GRADIENT)


def _optimizer(case: Case) -> None:
    """Five AdamW steps through `make_step`; an epoch is as many steps as make all recorded epochs
    whole numbers.
    """
    net, config, params = setup(case, 1)
    args = case.info["args"]
    epochs = case.info["epoch_fraction"]
    per_epoch = int(
        np.lcm.reduce([Fraction(t).limit_denominator(1000).denominator for t in epochs])
    )
    optim = replace(
        config.optim,
        learning_rate=args["lr"],
        min_rate=args["min_lr"],
        warmup=args["warmup_epochs"] * per_epoch,
        beta1=case.info["optimizer"]["betas"][0],
        beta2=case.info["optimizer"]["betas"][1],
        eps=case.info["optimizer"]["eps"],
        weight_decay=case.info["optimizer"]["weight_decay"],
    )
    config = replace(config, optim=optim, run=replace(config.run, steps=args["epochs"] * per_epoch))

    def loss(p: Params, batch: Any, key: Any, progress: Any) -> Any:
        return objectives.stage1_terms(p, *batch, net=net, config=config)

    def trained(batch: Any) -> Any:
        return objectives.trained_by(TouchBatch(*batch[:2]), config=config)

    step = jax.jit(
        make_step(loss, optimizer(config), total_steps=config.run.steps, trained=trained)
    )
    state = init_state(params, config)
    values = []
    rates = []
    for i, epoch in enumerate(epochs):
        state = state._replace(step=jax.device_put(np.int32(round(epoch * per_epoch))))
        state, metrics = step(state, _optimizer_batch(case, net, i), jax.random.key(0))
        values.append(float(metrics["loss"]))
        rates.append(float(metrics["learning_rate"]))
    case.compare("out/losses", values)
    case.compare("out/lr", rates)
    _compare_final(case, params, state, config)
    if "schedule" in case.info:
        _compare_schedule(case)


def _compare_schedule(case: Case) -> None:
    s = case.info["schedule"]
    ends = {
        "peak": s["lr"],
        "floor": s["min_lr"],
        "warmup": s["warmup_epochs"],
        "total": s["epochs"],
    }
    ours = jax.jit(partial(learning_rate, **ends, decay="cosine"))(np.asarray(s["epoch"]))
    case.seen |= {"schedule/epoch"}
    case.compare("schedule/lr", ours)


def _optimizer_batch(case: Case, net: Net, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Batch of step i: the still batch of case A or the clip batch of case B, with this case's
    noise.
    """
    kinds = case.info.get("data_type", 0)
    source = (
        "A_stage1_image"
        if (kinds[i] if isinstance(kinds, list) else kinds) == 0
        else "B_stage1_video"
    )
    arrays = read_arrays(case.folder / f"{source}.npz")
    clip = channel_last(arrays["in/pixels"])
    sensor = table_rows(arrays["in/sensor_type"], net)
    return clip, sensor, case.inputs(f"noise_{i}")


def _compare_final(case: Case, params: Params, state: TrainState, config: Config) -> None:
    """Parameters after the steps: movement within 1e-5 absolute, untouched ones bit-equal,
    per-parameter counts.
    """
    before = convert.to_release(params, config.model)
    after = convert.to_release(merge(state.trainable, state.frozen), config.model)
    noisy = case.info.get("rounding_sensitive", {}).get("parameters", {})
    summed = float(np.sum(case.info["lr"]))
    for name in case.info["arrays"]:
        kind, _, key = name.partition("/")
        if kind in ("final", "final_every7"):
            value = after[key] if kind == "final" else after[key].reshape(-1)[::7]
            case.compare(name, value, 0.0, absolute=summed if key in noisy else PARAMETER)
    dead = dead_keys(config)
    for key in set(case.info["unchanged_parameters"]) - dead:
        if not np.array_equal(before[key], after[key]):
            case.fail(f"unchanged/{key}", "moved, although the reference leaves it")
    counts = jax.tree.map(
        lambda p, held: np.full(p.shape, held.updates, np.float32),
        state.trainable,
        moments(state.opt_state, state.trainable),
    )
    full = merge(counts, jax.tree.map(lambda p: np.zeros(p.shape, np.float32), state.frozen))
    for key, value in convert.to_release(full, config.model).items():
        expected = case.info["adam_step_count"].get(key)
        ours = 0 if key in dead else int(np.max(value, initial=0))
        if expected is not None and ours != expected:
            case.fail(f"adam_step_count/{key}", f"{ours} steps instead of {expected}")


def _positions(case: Case) -> None:
    for name, recorded in read_arrays(case.folder / f"{case.name}.npz").items():
        match = re.fullmatch(r"pos_embed_(\d+)_(\d+)_cls", name)
        if match is None:
            continue
        table = tokens.sincos_table(int(match[1]), int(match[2]))
        case.compare(name, table[:: -(-len(table) // len(recorded))])


@partial(jax.jit, static_argnames=("net", "read"))
def _tower(params: Params, *inputs: Any, net: Net, read: Callable[..., jax.Array]) -> jax.Array:
    """Return `read(module, *inputs)` of the network with these parameters."""
    return read(net.bind(params), *inputs)


def _image(module: Any, pixels: Any) -> jax.Array:
    return module.image(pixels)


def _text(module: Any, *text: Any) -> jax.Array:
    return module.text(*text)


def _clip(case: Case) -> None:
    pixels = np.asarray(channel_last(case.inputs("pixel_values"), clip=False))
    masks = {
        name: np.asarray(case.inputs(name).astype(bool))
        for name in ("attention_mask", "attention_mask_with_hole")
    }
    ids = {name: np.asarray(case.inputs(f"input_ids_{name}")) for name in ("pad_eot", "pad_zero")}
    texts = {
        "pad_eot": (ids["pad_eot"], masks["attention_mask"]),
        "pad_zero": (ids["pad_zero"], masks["attention_mask"]),
        "hole": (ids["pad_eot"], masks["attention_mask_with_hole"]),
        "nomask": (ids["pad_eot"], None),
    }
    for sub, clip in case.info["subcases"].items():
        info = {**case.info, "clip_config": {**case.info["clip_config"], **clip}}
        config = golden_config(info, stage=2)
        model = replace(config.model, lora_rank=0, match_head="none")
        net = build(model)
        params = golden_params(case.folder, case.info["params_file"], model)
        for name, (text, mask) in texts.items():
            for output, read in (
                ("last_hidden_state", lambda module, *text: module.text.hidden(*text)),
                ("pooled", lambda module, *text: module.text.pooled(*text)),
                ("projected", _text),
            ):
                array = f"out/{sub}/text_{output}_{name}"
                if array in case.arrays:
                    case.compare(array, _tower(params, text, mask, net=net, read=read))
        for output, read in (
            ("last_hidden_state", lambda module, image: module.image.hidden(image)),
            ("pooled", lambda module, image: module.image.pooled(image)),
            ("projected", _image),
        ):
            array = f"out/{sub}/vision_{output}"
            if array in case.arrays:
                case.compare(array, _tower(params, pixels, net=net, read=read))
        if f"out/{sub}/logits_per_image" in case.arrays:
            z_image = losses.normalise(_tower(params, pixels, net=net, read=_image))
            z_text = losses.normalise(_tower(params, *texts["pad_eot"], net=net, read=_text))
            case.compare(
                f"out/{sub}/logits_per_image", jnp.exp(params["logit_scale"]) * z_image @ z_text.T
            )


_RUNNERS: dict[str, Callable[[Case], None]] = {
    r"[ABC]_": stage1,
    r"D_": align,
    r"E_": align_edge,
    r"F_": match,
    r"G_": _probe,
    r"H_": _optimizer,
    r"I_": _positions,
    r"J_clip_params": weights.parameters,
    r"J_": _clip,
    r"K_weight_loading_map": weights.loading_map,
    r"K_manifest": weights.manifest,
    r"stage[12]_params": weights.parameters,
    r"preprocess_full_size": families.preprocess,
    r"manifest_full_size": families.full_size,
}
