"""Numerical parity with the authors' PyTorch code: run every golden case of a folder through what training runs.

One runner a kind of case, found by the letter its name starts with. Nothing is assembled a second time here: losses
come from `objectives`, gradients from `jax.grad` of them, optimiser steps from `train.step`, weights from `io.release`.
"""

from __future__ import annotations

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
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch
from anytouch_jax.config import Config, preset
from anytouch_jax.evaluate.golden import (
    GRADIENT,
    KEY_BIAS,
    OUTPUT,
    PARAMETER,
    Arrays,
    Case,
    Row,
    channel_last,
    golden_config,
    golden_params,
    read_arrays,
    read_cases,
)
from anytouch_jax.io import release
from anytouch_jax.io.shapes import param_shapes
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.ops import losses, masking, tokens
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import TrainState, init_state, make_step, merge, split, used_parameters

Params = dict[str, Any]
Value = Callable[..., jax.Array]  # (params, inputs, *, net, config) -> scalar


def run(folder: Path) -> list[Row]:
    """Compare every case of `folder`; a case or an array that is not understood is a failing row."""
    rows: list[Row] = []
    with jax.default_matmul_precision("highest"):
        for case in read_cases(folder):
            runner = next((fn for pattern, fn in _RUNNERS.items() if re.match(pattern, case.name)), None)
            if runner is None:
                case.fail("-", "not a case this version understands")
            else:
                runner(case)
                case.finish()
            rows += case.rows
        rows += [row for path in sorted(folder.glob("*.pth")) for row in _checkpoint(path)]
    return rows


def _setup(case: Case, stage: int) -> tuple[Net, Config, Params]:
    """Network, config and parameters of a case."""
    weights = read_arrays(case.folder / case.info["params_file"])
    (table,) = [value for key, value in weights.items() if key.endswith("sensor_token")]
    config = golden_config(case.info, stage=stage, sensors=len(table))
    scale = _scale_rule(case.info["param_scale"]["factor"]) if "param_scale" in case.info else None
    return build(config.model), config, golden_params(case.folder, case.info["params_file"], config.model, scale)


def _scale_rule(factor: float) -> Callable[[str, np.ndarray], np.ndarray]:
    return lambda key, value: value * np.float32(factor) if "pre_layrnorm" in key or "norm" not in key else value


def _rows(sensor: np.ndarray, net: Net) -> np.ndarray:
    """Sensor ids as rows of the table; the reference's -1 is the universal row."""
    return np.where(sensor < 0, net.model.universal_row, sensor)


@partial(jax.jit, static_argnames=("value", "net", "config"))
def _grad(trainable: Params, frozen: Params, inputs: Any, *, value: Value, net: Net, config: Config) -> Params:
    return jax.grad(lambda p: value(merge(p, frozen), inputs, net=net, config=config))(trainable)


def _gradients(value: Value, params: Params, inputs: Any, exact: Any, net: Net, config: Config) -> dict[str, Any]:
    """Gradients by the authors' key names; None for parameters that the loss does not use or the config freezes.

    `inputs` may be padded so that cases share a program; `exact` has the shapes that say what the loss reads.
    """
    trainable, frozen = split(params, config.frozen)
    grads = jax.device_get(_grad(trainable, frozen, inputs, value=value, net=net, config=config))
    used = used_parameters(lambda p: value(merge(p, frozen), exact, net=net, config=config), trainable)
    zeros = jax.tree.map(np.zeros_like, frozen)
    flags = merge(jax.tree.map(lambda u, g: np.full(g.shape, u, np.float32), used, grads), zeros)
    named, live = (release.to_release(tree, config.model) for tree in (merge(grads, zeros), flags))
    dead = _dead_keys(config)
    return {key: None if key in dead or not np.any(live[key]) else array for key, array in named.items()}


def _dead_keys(config: Config) -> set[str]:
    """Keys of the authors' files that nothing reads (golden Q2)."""
    return set(release.release_shapes(config.model)) - set(release.release_names(config.model))


def _compare_gradients(
    case: Case,
    value: Value,
    params: Params,
    inputs: Any,
    exact: Any,
    net: Net,
    config: Config,
    prefix: str = "grad",
) -> None:
    """Values, presence (golden Q7) and norms of all gradients."""
    grads = _gradients(value, params, inputs, exact, net, config)
    for name in case.info["arrays"]:
        kind, _, key = name.partition("/")
        if kind not in (prefix, f"{prefix}_every7", f"{prefix}_sum_l2"):
            continue
        if grads.get(key) is None:
            case.seen.add(name)
            case.fail(name, "no gradient here, but one in the reference")
        elif kind == f"{prefix}_sum_l2":
            g = grads[key].astype(np.float64)
            pair = np.array([g.sum(), np.sqrt((g * g).sum())])
            case.compare(name, pair, 0.0, absolute=GRADIENT * float(pair[1]))
        else:
            value = grads[key] if kind == prefix else grads[key].reshape(-1)[::7]
            case.compare(name, value, GRADIENT, absolute=1e-7 if key.endswith(KEY_BIAS) else 0.0)
    norms = case.info.get("grad_l2" if prefix == "grad" else f"{prefix}_l2")
    if norms is not None:
        _compare_norms(case, f"{prefix}_l2", grads, norms)


def _compare_norms(case: Case, label: str, grads: dict[str, Any], norms: dict[str, float | None]) -> None:
    """L2 norms of all gradients and which are None, from the JSON (seven digits; absent keys are None)."""
    wrong = sorted(key for key in grads if (grads[key] is None) != (norms.get(key) is None))
    unknown = sorted(set(norms) - set(grads))
    if wrong or unknown:
        case.fail(label, f"presence differs for {', '.join((wrong + unknown)[:4])}")
    for key, value in grads.items():
        if value is not None and norms.get(key) is not None:
            loose = 1e-7 if key.endswith(KEY_BIAS) else 1e-9
            norm = float(np.linalg.norm(np.asarray(value, np.float64)))
            if abs(norm - norms[key]) > max(2 * GRADIENT * abs(norms[key]), loose):
                case.fail(f"{label}/{key}", f"{norm:.7g} instead of {norms[key]:.7g}")


@partial(jax.jit, static_argnames=("net", "config"))
def _stage1_outputs(params: Params, inputs: Any, *, net: Net, config: Config) -> dict[str, Any]:
    """Everything that the cases record of a stage-1 pass, in one program."""
    clip, sensor, noise, target = inputs
    keep_ids, restore_ids, hidden = masking.random_mask(
        noise, masking.kept(net.model.patches, config.objective.keep_ratio)
    )
    seen = clip[:, : net.model.frames]
    pred, _ = objectives.reconstruct(params, clip, sensor, noise, net=net, config=config, decoder_sensor=target)
    loss, metrics = objectives.stage1_terms(params, *inputs[:3], net=net, config=config, decoder_sensor=target)
    return {
        "ids_restore": restore_ids,
        "mask": hidden,
        "embeddings": net.apply(params, "touch_tokens", seen, sensor, keep_ids),
        "last_hidden_state": net.apply(params, "touch_hidden", seen, sensor, keep_ids),
        "latent": net.apply(params, "encode_tokens", seen, sensor, keep_ids),
        "features_unmasked": net.apply(params, "encode", seen, sensor),
        "pred": pred,
        "loss": loss,
        "loss_recon": metrics["reconstruction"],
        "loss_pred": metrics.get("next_frame"),
    }


def _stage1_value(params: Params, inputs: Any, *, net: Net, config: Config) -> jax.Array:
    clip, sensor, noise, target = inputs
    return objectives.stage1_terms(params, clip, sensor, noise, net=net, config=config, decoder_sensor=target)[0]


def _stage1(case: Case) -> None:
    net, config, params = _setup(case, 1)
    target = _rows(case.inputs("target_sensor_type"), net) if "in/target_sensor_type" in case.arrays else None
    inputs = (channel_last(case.inputs("pixels")), _rows(case.inputs("sensor_type"), net), case.inputs("noise"), target)
    ours = _stage1_outputs(params, inputs, net=net, config=config)
    ours["pred_first2"] = ours["pred"][:2]
    for name, value in ours.items():
        if f"out/{name}" in case.arrays:
            recorded = case.arrays[f"out/{name}"]
            case.compare(f"out/{name}", np.reshape(value, recorded.shape) if "pred" in name else value)
    if any(name.startswith("grad") for name in case.info["arrays"]):
        _compare_gradients(case, _stage1_value, params, inputs, inputs, net, config)


def _align_batch(case: Case, net: Net, flags: str = "") -> tuple[AlignBatch, AlignBatch]:
    """The recorded batch twice: with a slot for every sample, unused ones at row B, and with the present ones alone."""
    rows, slots = len(case.arrays["in/touch"]), {}
    for kind in ("vision", "text"):
        present = np.flatnonzero(case.inputs(f"{flags}{kind}_flag")).astype(np.int32)
        slots[kind] = (present, np.concatenate([present, np.full(rows - len(present), rows, np.int32)]))
    clip, sensor = channel_last(case.inputs("touch")), _rows(case.inputs("sensor_type"), net)
    image, ids = channel_last(case.inputs("image"), clip=False), case.inputs("input_ids")
    mask = case.inputs("attention_mask").astype(bool)

    def batch(vision: np.ndarray, text: np.ndarray) -> AlignBatch:
        v, t = (np.minimum(r, rows - 1) for r in (vision, text))
        return AlignBatch(clip, sensor, image[v], vision, ids[t], np.where((text < rows)[:, None], mask[t], True), text)

    exact, padded = (batch(slots["vision"][i], slots["text"][i]) for i in (0, 1))
    return padded, exact


@partial(jax.jit, static_argnames=("net", "config"))
def _align_all(params: Params, inputs: Any, *, net: Net, config: Config) -> tuple[Any, Any, Any, Any]:
    batch, noise, target = inputs
    total, metrics = objectives.stage2_terms(
        params, Stage2Batch(batch, None), noise, net=net, config=config, decoder_sensor=target
    )
    hidden = masking.random_mask(noise, masking.kept(net.model.patches, config.objective.keep_ratio))[2]
    return total, metrics, objectives.align_embeddings(params, batch, net=net), hidden


def _align_value(params: Params, inputs: Any, *, net: Net, config: Config) -> jax.Array:
    batch, noise, target = inputs
    step = Stage2Batch(batch, None)
    return objectives.stage2_terms(params, step, noise, net=net, config=config, decoder_sensor=target)[0]


_PAIRS = {
    "touch_image": ("touch_to_vision", "vision_to_touch", "touch_to_image", "image_to_touch"),
    "text_image": ("text_to_vision", "vision_to_text", "text_to_image", "image_to_text"),
    "touch_text": ("touch_to_text", "text_to_touch", "touch_to_text", "text_to_touch"),
}


def _align_outputs(case: Case, net: Net, config: Config, params: Params, inputs: Any, here: str) -> None:
    """Compare embeddings, logits, masks and losses of one align batch."""
    total, metrics, z, hidden = jax.device_get(_align_all(params, inputs, net=net, config=config))
    scale = np.exp(params["logit_scale"])
    rows = {"touch": np.ones(len(z.touch), bool), "image": z.has_image, "text": z.has_text}
    for name in ("touch", "image", "text"):
        _if_recorded(case, f"{here}{name}_embeds", getattr(z, name)[rows[name]])
    for pair, (ours_forth, ours_back, forth, back) in _PAIRS.items():
        first, second = pair.split("_")
        both = rows[first] & rows[second]
        _if_recorded(case, f"{here}logits_{pair}", scale * getattr(z, first)[both] @ getattr(z, second)[both].T)
        _if_recorded(case, f"{here}loss_{forth}", metrics[ours_forth])
        _if_recorded(case, f"{here}loss_{back}", metrics[ours_back])
    _if_recorded(case, f"{here}mask", hidden)
    _if_recorded(case, f"{here}align_loss", metrics["align"])
    _if_recorded(case, f"{here}mae_loss", metrics["reconstruction"] + metrics.get("next_frame", 0.0))
    _if_recorded(case, f"{here}total_loss", total)
    _if_recorded(case, f"{here}no_mae_total_loss", metrics["align"])
    _if_recorded(case, f"{here}no_mae_mae_loss", 0.0)


def _if_recorded(case: Case, name: str, ours: Any) -> None:
    """Compare an output where the case has it; the reference gives some scalars the shape (1,)."""
    if name in case.arrays:
        recorded = case.arrays[name]
        case.compare(name, np.reshape(ours, recorded.shape) if recorded.size == 1 else ours)


def _align_inputs(case: Case, net: Net, flags: str = "") -> tuple[Any, Any]:
    padded, exact = _align_batch(case, net, flags)
    rest = (case.inputs("noise"), _rows(case.inputs("target_sensor_type"), net))
    return (padded, *rest), (exact, *rest)


def _align(case: Case) -> None:
    net, config, params = _setup(case, 2)
    inputs, exact = _align_inputs(case, net)
    _align_outputs(case, net, config, params, inputs, "out/")
    _compare_gradients(case, _align_value, params, inputs, exact, net, config)
    if "grad_no_mae_l2" in case.info:
        _compare_gradients(case, _align_value, params, inputs, exact, net, _without_mae(config), "grad_no_mae")
    if "no_text_variant" in case.info:  # the same sum without LoRA
        plain = {name: value for name, value in params.items() if name != "lora"}
        value = jax.jit(partial(_align_value, net=net, config=config))(plain, inputs)
        case.check("no_text_variant", value, case.info["no_text_variant"]["total_loss"], OUTPUT)


def _without_mae(config: Config) -> Config:
    return replace(config, objective=replace(config.objective, reconstruct=False))


def _align_edge(case: Case) -> None:
    net, config, params = _setup(case, 2)
    for name, sub in case.info["subcases"].items():
        inputs, exact = _align_inputs(case, net, f"{name}/")
        _align_outputs(case, net, config, params, inputs, f"out/{name}/")
        for label, recipe in (("with_mae", config), ("without_mae", _without_mae(config))):
            grads = _gradients(_align_value, params, inputs, exact, net, recipe)
            if not sub[f"grad_l2_{label}"]:  # the reference has no graph there: no gradient reaches any parameter
                grads = {key: None if value is None or not value.any() else value for key, value in grads.items()}
            _compare_norms(case, f"{name}/grad_l2_{label}", grads, sub[f"grad_l2_{label}"])


@partial(jax.jit, static_argnames=("net", "method"))
def _encode(params: Params, clip: Any, sensor: Any, *, net: Net, method: str = "encode") -> jax.Array:
    return net.apply(params, method, clip, sensor)


def _match_value(params: Params, inputs: Any, *, net: Net, config: Config) -> jax.Array:
    return objectives.stage2_terms(params, Stage2Batch(None, inputs), None, net=net, config=config)[0]


def _match(case: Case) -> None:
    net, config, params = _setup(case, 2)
    clips = [channel_last(case.inputs(name)) for name in ("touch", "positive", "negative")]
    sensors = [_rows(case.inputs(name), net) for name in ("sensor_type", "pos_sensors", "neg_sensors")]
    batch = MatchBatch(*(x for pair in zip(clips, sensors, strict=True) for x in pair))
    for name, clip, sensor in zip(("touch", "positive", "negative"), clips, sensors, strict=True):
        case.compare(f"out/{name}_embeds", losses.normalise(_encode(params, clip, sensor, net=net)))
    logits = jax.jit(partial(objectives.match_logits, net=net))(params, batch)
    for name, logit in zip(("positive", "negative"), logits, strict=True):
        case.compare(f"out/{name}_sim", logit)
    case.compare("out/loss", jax.jit(partial(_match_value, net=net, config=config))(params, batch))
    _compare_gradients(case, _match_value, params, batch, batch, net, config)


def _probe(case: Case) -> None:
    for name, sub in case.info["subcases"].items():
        stage = 2 if sub["encoder_params"].startswith("stage2") else 1
        file = re.match(r"\S+\.npz", sub["encoder_params"])
        assert file is not None
        info = {**case.info, "params_file": file.group()}
        net, _, params = _setup(Case(case.name, case.folder, info), stage)
        sensor = jnp.asarray(_rows(case.inputs(f"{name}/sensor_type_used"), net))
        feel = sub["dataset"] == "feel"
        images = case.inputs("feel_images" if feel else "images")
        case.seen |= {"in/sensors", "in/feel_sensors"}
        flat = jnp.asarray(channel_last(images.reshape(-1, *images.shape[-3:])))
        if sub["pooling"] == "cls":
            out = _encode(params, flat, sensor, net=net)
            case.compare(f"out/{name}/projected", out)
            head_input = out.reshape(len(images), -1)
        else:
            out = _encode(params, flat, sensor, net=net, method="encode_tokens")
            case.compare(f"out/{name}/projected", out[:, : case.arrays[f"out/{name}/projected"].shape[1]])
            if feel:  # the reference interleaves the two images' tokens by a plain reshape (golden Q13)
                out = out.reshape(len(images), out.shape[1], -1)
            head_input = jnp.mean(out[:, 1 + net.model.sensor_tokens :], axis=1)
        case.compare(f"out/{name}/head_input", head_input)
        _probe_head(case, name, head_input)


def _probe_head(case: Case, name: str, head_input: jax.Array) -> None:
    """Logits, loss and gradients of the authors' linear head on recorded weights."""
    head = {key: jnp.asarray(case.inputs(f"{name}/head_{key}")) for key in ("weight", "bias")}
    labels = jnp.asarray(case.inputs(f"{name}/labels"))

    def loss(head: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        logits = head_input @ head["weight"].T + head["bias"][None]
        if logits.shape[1] == 1:
            flat = labels.reshape(-1).astype(jnp.float32)
            return jnp.mean(optax.sigmoid_binary_cross_entropy(logits[:, 0], flat)), logits
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, labels)), logits

    (value, logits), grads = jax.value_and_grad(loss, has_aux=True)(head)
    case.compare(f"out/{name}/logits", logits)
    case.compare(f"out/{name}/loss", value)
    for key in head:
        case.compare(f"out/{name}/grad_head_{key}", grads[key], GRADIENT)


def _optimizer(case: Case) -> None:
    """Five AdamW steps through `make_step`; an epoch is as many steps as make all recorded epochs whole numbers."""
    net, config, params = _setup(case, 1)
    args, epochs = case.info["args"], case.info["epoch_fraction"]
    per_epoch = int(np.lcm.reduce([Fraction(t).limit_denominator(1000).denominator for t in epochs]))
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

    step = jax.jit(make_step(loss, optimizer(config), total_steps=config.run.steps))
    state, values, rates = init_state(params, config), [], []
    for i, epoch in enumerate(epochs):
        state = state._replace(step=jnp.asarray(round(epoch * per_epoch), jnp.int32))
        state, metrics = step(state, _optimizer_batch(case, net, i), jax.random.key(0))
        values.append(float(metrics["loss"]))
        rates.append(float(metrics["learning_rate"]))
    case.compare("out/losses", values)
    case.compare("out/lr", rates)
    _compare_final(case, params, state, config)
    if "schedule" in case.info:
        _compare_schedule(case)


def _compare_schedule(case: Case) -> None:
    from anytouch_jax.train.optim import learning_rate

    s = case.info["schedule"]
    ours = learning_rate(
        jnp.asarray(s["epoch"]),
        peak=s["lr"],
        floor=s["min_lr"],
        warmup=s["warmup_epochs"],
        total=s["epochs"],
        decay="cosine",
    )
    case.seen |= {"schedule/epoch"}
    case.compare("schedule/lr", ours)


def _optimizer_batch(case: Case, net: Net, i: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Batch of step i: the still batch of case A or the clip batch of case B, with this case's noise."""
    kinds = case.info.get("data_type", 0)
    source = "A_stage1_image" if (kinds[i] if isinstance(kinds, list) else kinds) == 0 else "B_stage1_video"
    arrays = read_arrays(case.folder / f"{source}.npz")
    clip, sensor = channel_last(arrays["in/pixels"]), _rows(arrays["in/sensor_type"], net)
    return jnp.asarray(clip), jnp.asarray(sensor), jnp.asarray(case.inputs(f"noise_{i}"))


def _compare_final(case: Case, params: Params, state: TrainState, config: Config) -> None:
    """Parameters after the steps: movement within 1e-5 absolute, untouched ones bit-equal, per-parameter counts."""
    before = release.to_release(params, config.model)
    after = release.to_release(merge(state.trainable, state.frozen), config.model)
    noisy = case.info.get("rounding_sensitive", {}).get("parameters", {})
    summed = float(np.sum(case.info["lr"]))
    for name in case.info["arrays"]:
        kind, _, key = name.partition("/")
        if kind in ("final", "final_every7"):
            value = after[key] if kind == "final" else after[key].reshape(-1)[::7]
            case.compare(name, value, 0.0, absolute=summed if key in noisy else PARAMETER)
    for key in case.info["unchanged_parameters"]:
        if not np.array_equal(before[key], after[key]):
            case.fail(f"unchanged/{key}", "moved, although the reference leaves it")
    counts = jax.tree.map(
        lambda moments, p: np.full(p.shape, moments.count, np.float32),
        state.opt_state.moments,
        state.trainable,
        is_leaf=lambda node: hasattr(node, "count"),
    )
    full = merge(counts, jax.tree.map(lambda p: np.zeros(p.shape, np.float32), state.frozen))
    dead = _dead_keys(config)
    for key, value in release.to_release(full, config.model).items():
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


@partial(jax.jit, static_argnames=("net", "method"))
def _tower(params: Params, *inputs: Any, net: Net, method: str) -> jax.Array:
    return net.apply(params, method, *inputs)


def _clip(case: Case) -> None:
    pixels = jnp.asarray(channel_last(case.inputs("pixel_values"), clip=False))
    masks = {
        name: jnp.asarray(case.inputs(name).astype(bool)) for name in ("attention_mask", "attention_mask_with_hole")
    }
    ids = {name: jnp.asarray(case.inputs(f"input_ids_{name}")) for name in ("pad_eot", "pad_zero")}
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
        net, params = build(model), golden_params(case.folder, case.info["params_file"], model)
        for name, (text, mask) in texts.items():
            for output, method in (
                ("last_hidden_state", "text_hidden"),
                ("pooled", "text_pooled"),
                ("projected", "embed_text"),
            ):
                array = f"out/{sub}/text_{output}_{name}"
                if array in case.arrays:
                    case.compare(array, _tower(params, text, mask, net=net, method=method))
        for output, method in (
            ("last_hidden_state", "image_hidden"),
            ("pooled", "image_pooled"),
            ("projected", "embed_image"),
        ):
            array = f"out/{sub}/vision_{output}"
            if array in case.arrays:
                case.compare(array, _tower(params, pixels, net=net, method=method))
        if f"out/{sub}/logits_per_image" in case.arrays:
            z_image = losses.normalise(_tower(params, pixels, net=net, method="embed_image"))
            z_text = losses.normalise(_tower(params, *texts["pad_eot"], net=net, method="embed_text"))
            case.compare(f"out/{sub}/logits_per_image", jnp.exp(params["logit_scale"]) * z_image @ z_text.T)


def _manifest(case: Case) -> None:
    """Keys and shapes of the full-size model against preset large, and its decay groups against our rules."""
    for stage, kind in ((1, "stage1"), (2, "stage2")):
        config = preset("large", stage=stage, recipe="release", towers="pretrained")  # type: ignore[arg-type]
        shapes = jax.tree.map(
            lambda leaf: leaf.shape, build(config.model).abstract(), is_leaf=lambda x: hasattr(x, "shape")
        )
        ours = release.release_shapes(config.model)
        theirs = {key: tuple(shape) for key, shape, *_ in case.info[kind]["state_dict"]}
        for key in sorted(set(ours) | set(theirs)):
            if ours.get(key) != theirs.get(key):
                case.fail(f"{kind}/{key}", f"{ours.get(key)} instead of {theirs.get(key)}")
        implied = param_shapes(config.model)
        if implied != shapes:
            case.fail(f"{kind}/Net.abstract", "the network's shapes are not those of the weight files")
        case.check(f"{kind}/keys", len(ours), len(theirs), 0.0)


def _reference_only(case: Case) -> None:
    """Files that hold parameters or a loading map: used by other cases, nothing to compare on their own."""
    case.seen |= set(case.info.get("arrays", {}))


def _checkpoint(path: Path) -> list[Row]:
    """A `.pth` in the authors' format gives exactly the parameters stored beside it."""
    case = Case(path.name, path.parent, {})
    stage = 2 if path.name.startswith("stage2") else 1
    weights = release.read_weights(path)
    stored: Arrays = read_arrays(path.parent / f"stage{stage}_params.npz")
    ours, theirs = (release.to_params(w, release.detect_model(w)) for w in (weights, _without_extra(stored, weights)))
    for (name, a), b in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
        if not np.array_equal(a, b):
            case.fail(jax.tree_util.keystr(name), "differs from the parameters beside it")
    case.check("parameters", len(jax.tree.leaves(ours)), len(jax.tree.leaves(theirs)), 0.0)
    return case.rows


def _without_extra(stored: Arrays, weights: Arrays) -> Arrays:
    return {
        key: value for key, value in stored.items() if key in weights or not key.endswith("sensor_token_proj.weight")
    }


_RUNNERS: dict[str, Callable[[Case], None]] = {
    r"[ABC]_": _stage1,
    r"D_": _align,
    r"E_": _align_edge,
    r"F_": _match,
    r"G_": _probe,
    r"H_": _optimizer,
    r"I_": _positions,
    r"J_clip_params": _reference_only,
    r"J_": _clip,
    r"K_weight_loading_map": _reference_only,
    r"K_manifest": _manifest,
    r"stage[12]_params": _reference_only,
}
