"""Golden cases of the two losses: outputs, gradients and which parameters have none, through
`objectives`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from anytouch_jax import objectives
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch
from anytouch_jax.config import Config
from anytouch_jax.nn.anytouch import AnyTouch
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.ops import losses, tokens
from anytouch_jax.train.step import merge, split
from anytouch_jax.weights import convert
from tests.parity.golden_files import (
    GRADIENT,
    KEY_BIAS,
    Case,
    channel_last,
    golden_config,
    golden_params,
    read_arrays,
)
from tests.support.release_keys import release_names, release_shapes
from tests.support.used_parameters import used_parameters

Params = dict[str, Any]
Value = Callable[..., jax.Array]  # (params, inputs, *, net, config) -> scalar


def setup(case: Case, stage: int) -> tuple[Net, Config, Params]:
    """Network, config and parameters of a case."""
    weights = read_arrays(case.folder / case.info["params_file"])
    (table,) = [value for key, value in weights.items() if key.endswith("sensor_token")]
    config = golden_config(case.info, stage=stage, sensors=len(table))
    scale = _scale_rule(case.info["param_scale"]["factor"]) if "param_scale" in case.info else None
    return (
        build(config.model),
        config,
        golden_params(case.folder, case.info["params_file"], config.model, scale),
    )


def _scale_rule(factor: float) -> Callable[[str, np.ndarray], np.ndarray]:
    return lambda key, value: (
        value * np.float32(factor) if "pre_layrnorm" in key or "norm" not in key else value
    )


def table_rows(sensor: np.ndarray, net: Net) -> np.ndarray:
    """Sensor ids as rows of the table; the reference's -1 is the universal row."""
    return np.where(sensor < 0, net.model.universal_row, sensor)


@partial(jax.jit, static_argnames=("value", "net", "config"))
def _grad(
    trainable: Params, frozen: Params, inputs: Any, *, value: Value, net: Net, config: Config
) -> Params:
    return jax.grad(lambda p: value(merge(p, frozen), inputs, net=net, config=config))(trainable)


def _gradients(
    value: Value, params: Params, inputs: Any, exact: Any, net: Net, config: Config
) -> dict[str, Any]:
    """Gradients by the authors' key names; None for parameters that the loss does not use or the
    config freezes.

    `inputs` may be padded so that cases share a program; `exact` has the shapes that say what the
    loss reads.
    """
    trainable, frozen = split(params, config.frozen)
    grads = jax.device_get(_grad(trainable, frozen, inputs, value=value, net=net, config=config))
    used = used_parameters(
        lambda p: value(merge(p, frozen), exact, net=net, config=config), trainable
    )
    zeros = jax.tree.map(np.zeros_like, frozen)
    flags = merge(jax.tree.map(lambda u, g: np.full(g.shape, u, np.float32), used, grads), zeros)
    named, live = (convert.to_release(tree, config.model) for tree in (merge(grads, zeros), flags))
    dead = dead_keys(config)
    return {
        key: None if key in dead or not np.any(live[key]) else array for key, array in named.items()
    }


def dead_keys(config: Config) -> set[str]:
    """Keys of the authors' files that nothing reads (golden Q2)."""
    return set(release_shapes(config.model)) - set(release_names(config.model))


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


def _compare_norms(
    case: Case, label: str, grads: dict[str, Any], norms: dict[str, float | None]
) -> None:
    """L2 norms of all gradients and which are None, from the JSON (seven digits; absent keys are
    None).
    """
    wrong = sorted(key for key in grads if (grads[key] is None) != (norms.get(key) is None))
    unknown = sorted(set(norms) - set(grads))
    if wrong or unknown:
        case.fail(label, f"presence differs for {', '.join((wrong + unknown)[:4])}")
    for key, value in grads.items():
        theirs = norms.get(key)
        if value is not None and theirs is not None:
            loose = 1e-7 if key.endswith(KEY_BIAS) else 1e-9
            ours = float(np.linalg.norm(np.asarray(value, np.float64)))
            if abs(ours - theirs) > max(2 * GRADIENT * abs(theirs), loose):
                case.fail(f"{label}/{key}", f"{ours:.7g} instead of {theirs:.7g}")


@partial(jax.jit, static_argnames=("net", "config"))
def _stage1_outputs(params: Params, inputs: Any, *, net: Net, config: Config) -> dict[str, Any]:
    """Everything that the cases record of a stage-1 pass, in one program."""
    clip, sensor, noise, target = inputs
    keep_ids, restore_ids, hidden = tokens.random_mask(
        noise, tokens.count_visible(net.model.patches, config.objective.keep_ratio)
    )
    seen = clip[:, : net.model.frames]
    pred, _ = objectives.reconstruct(
        params, clip, sensor, noise, net=net, config=config, decoder_sensor=target
    )
    loss, metrics = objectives.stage1_terms(
        params, *inputs[:3], net=net, config=config, decoder_sensor=target
    )
    return {
        "ids_restore": restore_ids,
        "mask": hidden,
        "embeddings": net.bind(params).touch.tokens(seen, sensor, keep_ids),
        "last_hidden_state": net.bind(params).touch.hidden(seen, sensor, keep_ids),
        "latent": net.encode_tokens(params, seen, sensor, keep_ids),
        "features_unmasked": net.encode_touch(params, seen, sensor),
        "pred": pred,
        "loss": loss,
        "loss_recon": metrics["reconstruction"],
        "loss_pred": metrics.get("next_frame"),
    }


def _stage1_value(params: Params, inputs: Any, *, net: Net, config: Config) -> jax.Array:
    clip, sensor, noise, target = inputs
    return objectives.stage1_terms(
        params, clip, sensor, noise, net=net, config=config, decoder_sensor=target
    )[0]


def stage1(case: Case) -> None:
    """Cases A, B, C: every output of a stage-1 pass, its losses and gradients."""
    net, config, params = setup(case, 1)
    target = (
        table_rows(case.inputs("target_sensor_type"), net)
        if "in/target_sensor_type" in case.arrays
        else None
    )
    inputs = (
        channel_last(case.inputs("pixels")),
        table_rows(case.inputs("sensor_type"), net),
        case.inputs("noise"),
        target,
    )
    ours = _stage1_outputs(params, inputs, net=net, config=config)
    ours["pred_first2"] = ours["pred"][:2]
    for name, value in ours.items():
        if f"out/{name}" in case.arrays:
            recorded = case.arrays[f"out/{name}"]
            case.compare(
                f"out/{name}", np.reshape(value, recorded.shape) if "pred" in name else value
            )
    if any(name.startswith("grad") for name in case.info["arrays"]):
        _compare_gradients(case, _stage1_value, params, inputs, inputs, net, config)


def _align_batch(case: Case, net: Net, flags: str = "") -> tuple[AlignBatch, AlignBatch]:
    """The recorded batch twice: with a slot for every sample, unused ones at row B, and with the
    present ones alone.
    """
    rows = len(case.arrays["in/touch"])
    slots = {}
    for kind in ("vision", "text"):
        present = np.flatnonzero(case.inputs(f"{flags}{kind}_flag")).astype(np.int32)
        slots[kind] = (
            present,
            np.concatenate([present, np.full(rows - len(present), rows, np.int32)]),
        )
    clip = channel_last(case.inputs("touch"))
    sensor = table_rows(case.inputs("sensor_type"), net)
    image = channel_last(case.inputs("image"), clip=False)
    ids = case.inputs("input_ids")
    mask = case.inputs("attention_mask").astype(bool)

    def batch(vision: np.ndarray, text: np.ndarray) -> AlignBatch:
        v, t = (np.minimum(r, rows - 1) for r in (vision, text))
        return AlignBatch(
            clip,
            sensor,
            image[v],
            vision,
            ids[t],
            np.where((text < rows)[:, None], mask[t], True),
            text,
        )

    exact, padded = (batch(slots["vision"][i], slots["text"][i]) for i in (0, 1))
    return padded, exact


@partial(jax.jit, static_argnames=("net", "config"))
def _align_all(
    params: Params, inputs: Any, *, net: Net, config: Config
) -> tuple[Any, Any, Any, Any]:
    batch, noise, target = inputs
    total, metrics = objectives.stage2_terms(
        params, Stage2Batch(batch, None), noise, net=net, config=config, decoder_sensor=target
    )
    hidden = tokens.random_mask(
        noise, tokens.count_visible(net.model.patches, config.objective.keep_ratio)
    )[2]
    touch = losses.normalise(
        net.encode_touch(params, batch.clip[:, : net.model.frames], batch.sensor)
    )
    return total, metrics, objectives.align_embeddings(params, batch, touch, net=net), hidden


def _align_value(params: Params, inputs: Any, *, net: Net, config: Config) -> jax.Array:
    batch, noise, target = inputs
    step = Stage2Batch(batch, None)
    return objectives.stage2_terms(
        params, step, noise, net=net, config=config, decoder_sensor=target
    )[0]


_PAIRS = {
    "touch_image": ("touch_to_vision", "vision_to_touch", "touch_to_image", "image_to_touch"),
    "text_image": ("text_to_vision", "vision_to_text", "text_to_image", "image_to_text"),
    "touch_text": ("touch_to_text", "text_to_touch", "touch_to_text", "text_to_touch"),
}


def _align_outputs(
    case: Case, net: Net, config: Config, params: Params, inputs: Any, here: str
) -> None:
    """Compare embeddings, logits, masks and losses of one align batch."""
    total, metrics, z, hidden = jax.device_get(_align_all(params, inputs, net=net, config=config))
    scale = np.exp(params["logit_scale"])
    rows = {"touch": np.ones(len(z.touch), bool), "image": z.has_image, "text": z.has_text}
    for name in ("touch", "image", "text"):
        _if_recorded(case, f"{here}{name}_embeds", getattr(z, name)[rows[name]])
    for pair, (ours_forth, ours_back, forth, back) in _PAIRS.items():
        first, second = pair.split("_")
        both = rows[first] & rows[second]
        _if_recorded(
            case,
            f"{here}logits_{pair}",
            scale * getattr(z, first)[both] @ getattr(z, second)[both].T,
        )
        _if_recorded(case, f"{here}loss_{forth}", metrics[ours_forth])
        _if_recorded(case, f"{here}loss_{back}", metrics[ours_back])
    _if_recorded(case, f"{here}mask", hidden)
    _if_recorded(case, f"{here}align_loss", metrics["align"])
    _if_recorded(
        case, f"{here}mae_loss", metrics["reconstruction"] + metrics.get("next_frame", 0.0)
    )
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
    rest = (case.inputs("noise"), table_rows(case.inputs("target_sensor_type"), net))
    return (padded, *rest), (exact, *rest)


def align(case: Case) -> None:
    """Case D: alignment and reconstruction of one batch with mixed modalities."""
    net, config, params = setup(case, 2)
    inputs, exact = _align_inputs(case, net)
    _align_outputs(case, net, config, params, inputs, "out/")
    _compare_gradients(case, _align_value, params, inputs, exact, net, config)
    if "grad_no_mae_l2" in case.info:
        _compare_gradients(
            case,
            _align_value,
            params,
            _without_mae(inputs),
            _without_mae(exact),
            net,
            config,
            "grad_no_mae",
        )


def _without_mae(inputs: Any) -> Any:
    """Return inputs without the noise of the masks, so that nothing is reconstructed."""
    batch, _, target = inputs
    return batch, None, target


def align_edge(case: Case) -> None:
    """Case E: eight patterns of presence, their outputs and which gradients exist."""
    net, config, params = setup(case, 2)
    for name, sub in case.info["subcases"].items():
        inputs, exact = _align_inputs(case, net, f"{name}/")
        _align_outputs(case, net, config, params, inputs, f"out/{name}/")
        variants = {
            "with_mae": (inputs, exact),
            "without_mae": (_without_mae(inputs), _without_mae(exact)),
        }
        for label, both in variants.items():
            grads = _gradients(_align_value, params, *both, net, config)
            if not sub[
                f"grad_l2_{label}"
            ]:  # the reference has no graph there: no gradient reaches any parameter
                grads = {
                    key: None if value is None or not value.any() else value
                    for key, value in grads.items()
                }
            _compare_norms(case, f"{name}/grad_l2_{label}", grads, sub[f"grad_l2_{label}"])


@partial(jax.jit, static_argnames=("net", "read"))
def encode(
    params: Params,
    clip: Any,
    sensor: Any,
    *,
    net: Net,
    read: Callable[..., Any] = AnyTouch.encode_touch,
) -> Any:
    """Return `read(module, clip, sensor)`, compiled once for all cases of equal shapes."""
    return read(net.bind(params), clip, sensor)


def _match_value(params: Params, inputs: Any, *, net: Net, config: Config) -> jax.Array:
    return objectives.stage2_terms(params, Stage2Batch(None, inputs), None, net=net, config=config)[
        0
    ]


def match(case: Case) -> None:
    """Case F: matching logits, loss and gradients."""
    net, config, params = setup(case, 2)
    clips = [channel_last(case.inputs(name)) for name in ("touch", "positive", "negative")]
    sensors = [
        table_rows(case.inputs(name), net) for name in ("sensor_type", "pos_sensors", "neg_sensors")
    ]
    batch = MatchBatch(*(x for pair in zip(clips, sensors, strict=True) for x in pair))
    touches = list(zip(clips, sensors, strict=True))
    z = jax.jit(partial(objectives.touch_embeddings, net=net))(params, touches)
    for name, embedding in zip(("touch", "positive", "negative"), z, strict=True):
        case.compare(f"out/{name}_embeds", embedding)
    for name, other in zip(("positive", "negative"), z[1:], strict=True):
        case.compare(f"out/{name}_sim", jax.jit(net.match)(params, z[0], other))
    case.compare("out/loss", jax.jit(partial(_match_value, net=net, config=config))(params, batch))
    _compare_gradients(case, _match_value, params, batch, batch, net, config)
