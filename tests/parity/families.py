"""Encoders of other families against outputs of their authors' code: from raw frames, through the
public interface.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax import load_encoder
from anytouch_jax.nn.functional import Part
from anytouch_jax.nn.vit import Vit
from anytouch_jax.weights.convert import check_arrays, file_shapes
from anytouch_jax.zoo import families
from anytouch_jax.zoo.encoder import FamilyEncoder, prepare
from tests.parity.golden_files import Case

# Inside the encoder, or of heads and decoders that are no part of it.
LEFT_OUT = re.compile(
    r"pooler/.*|out/.*/(embedded|block\d+|positions|pos_embed|attentive_pooled|logits|proj)"
)
PIXEL = 1e-6  # of the largest value: the preparation is exact to rounding


def compare(case: Case) -> None:
    """Compare every file of a case of a family with every output that is recorded for it."""
    case.seen |= {name for name in case.arrays if LEFT_OUT.fullmatch(name)}
    for file in [
        name for name in case.info["files"] if not name.endswith(("config.json", "trunk.pth"))
    ]:
        for name in dict.fromkeys(
            key.split("/")[1] for key in case.arrays if key.startswith("out/")
        ):
            if (
                case.info["family"] != "t3"
                or case.info["cases"][name]["encoder"] == Path(file).stem
            ):
                _case(case, file, name)


def _case(case: Case, file: str, name: str) -> None:
    info, about = case.info, case.info["cases"].get(name, {})
    source = {"b_universal": "b", "still": "b", "small_scale": _input_of(about)}.get(name, name)
    theirs = case.inputs(f"{source}/preprocessed")
    path = case.folder / (file if info["family"] != "t3" else "t3")
    encoder = load_encoder(path, heads=info["architecture"]["heads"], image_size=theirs.shape[-2:])
    assert isinstance(encoder, FamilyEncoder)
    if "mean" in info:
        steps = replace(
            encoder.preparation,
            mean=tuple(info["mean"]),
            std=tuple(info["std"]),
            shorter=info["resize"],
        )
        encoder = replace(encoder, preparation=steps)
    if name == "small_scale":
        power = float(eval(re.search(r"2\^(-\d+)", about["rule"])[0].replace("^", "**")))  # type: ignore[index]
        encoder = replace(encoder, params=_scaled(encoder.params, power))
    if encoder.form.calibration:
        images = case.inputs("a/calibration_frames")
        gel = case.inputs("a/background")
        encoder = encoder.calibrated(list(images), gel)
        if name == "a":
            ours = encoder.calibration.transpose(0, 3, 1, 2).reshape(1, -1, *theirs.shape[-2:])
            case.check("in/a/calibration", ours, case.inputs("a/calibration"), PIXEL)
    clips = _ours(theirs, info["family"], encoder)
    if f"in/{name}/frames" in case.arrays:
        frames = _prepared(case, name, encoder, about)
        if frames.shape[1] > clips.shape[1]:
            used = np.sort(case.inputs(f"{name}/frame_indices"))
            case.check(f"in/{name}/preprocessed", frames[:, used], clips, PIXEL)
        else:
            case.check(f"in/{name}/preprocessed", frames, clips, PIXEL)
        clips = frames
    clips = clips[:, -1:] if name == "still" else clips
    sensor: Any = about.get("encoder", "universal")
    if f"in/{name}/sensor_ids" in case.arrays or info["family"] == "anytouch2":
        ids = case.inputs(f"{'a' if name == 'small_scale' else name}/sensor_ids")
        sensor = np.where(ids < 0, len(encoder.form.model.sensors) - 1, ids)
        sensor = np.full(len(clips), 7) if name == "small_scale" else sensor
    variants = [("", encoder)]
    if info["family"].startswith("dinov2"):
        variants = (
            [("facebook/", encoder)] if file.endswith(".pth") or encoder.form.registers else []
        )
        if not file.endswith(".pth"):
            shifted = replace(encoder, form=replace(encoder.form, resample="shifted"))
            variants += [("", encoder), ("hf_4_42/", shifted)]
            if not any(name.endswith(".pth") for name in info["files"]):
                variants.append(("facebook/", encoder if encoder.form.registers else shifted))
    for prefix, one in variants:
        for output, ours in _outputs(one, clips, sensor).items():
            if (key := f"out/{name}/{prefix}{output}") in case.arrays:
                case.compare(key, ours())


def _input_of(about: dict[str, Any]) -> str:
    return str(about.get("input", "in/a/")).split("/")[1]


def _scaled(params: Any, power: float) -> Any:
    """Multiply all parameters but those of LayerNorms; that before the blocks is scaled too."""

    def scale(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if "norm" in name and not name.startswith("pre_norm"):
            return leaf
        return leaf * np.float32(power)

    return jax.tree_util.tree_map_with_path(scale, params)


def _ours(theirs: np.ndarray, family: str, encoder: FamilyEncoder) -> np.ndarray:
    """Return the tensor that a family's network reads as (B, T, H, W, 3), oldest frame first."""
    if family == "anytouch2":
        return np.moveaxis(theirs, 2, -1)
    if theirs.ndim == 5:  # (B, 3, T, H, W), newest first
        return np.moveaxis(theirs, 1, -1)[:, ::-1]
    count = encoder.form.model.frames
    frames = theirs.reshape(len(theirs), count, 3, *theirs.shape[2:])
    return np.moveaxis(frames, 2, -1)[:, ::-1]


def _prepared(case: Case, name: str, encoder: FamilyEncoder, about: dict[str, Any]) -> np.ndarray:
    """Return raw frames prepared by the encoder, (B, T, H, W, 3)."""
    frames = case.inputs(f"{name}/frames")
    key = f"in/{name}/background"
    background = case.inputs(f"{name}/background") if key in case.arrays else None
    if frames.ndim == 5:  # clips with a background each
        assert background is not None
        rows = zip(frames, background, strict=True)
        return np.stack(
            [np.stack([encoder.preprocess(frame, gel) for frame in clip]) for clip, gel in rows]
        )
    done = np.stack([encoder.preprocess(frame, background) for frame in frames])
    if "newest_frame" in about:
        return done[None, : about["newest_frame"] + 1]
    return done[:, None]


def _outputs(
    encoder: FamilyEncoder, clips: np.ndarray, sensor: Any
) -> dict[str, Callable[[], Any]]:
    """Return how each output of an encoder is computed, under the names of all families."""
    clips, form, start = np.ascontiguousarray(clips), encoder.form, encoder.form.start

    @cache
    def network() -> Any:
        rows = (
            np.full(len(clips), encoder.sensor_row(sensor, lambda _: None))
            if isinstance(sensor, str)
            else sensor
        )
        parts = encoder._clips(jnp.asarray(clips))[:, 0]
        return jax.jit(encoder._run)(encoder.params, parts, jnp.asarray(rows))

    own = cache(lambda: encoder.encode_touch(clips, sensor))
    mean = cache(lambda: encoder.encode_touch(clips, sensor, pooling="mean"))
    tokens = cache(lambda: encoder.encode_tokens(clips, sensor))
    last = 0 if form.grid is None else form.grid[1] * form.grid[2]
    return {
        **dict.fromkeys(("tokens", "latent", "last_hidden_state"), tokens),
        **dict.fromkeys(("mean_patch", "feature_mean_patch", "mean_patch_normed"), mean),
        "feature_contrastive": own,
        "feature_cls": (lambda: network().normed[:, 0]) if encoder.family.name == "sitr" else own,
        "registers": lambda: network().normed[:, form.class_token : start],
        "encoder_tokens": lambda: network().encoded,
        "projected_tokens": lambda: network().projected,
        "feature_global_pooling": lambda: network().hidden[:, start:].mean(axis=1),
        "feature_last": lambda: network().hidden[:, -last:].mean(axis=1),
    }


def preprocess(case: Case) -> None:
    """Compare the preparations at their real sizes, every seventh pixel."""
    frames = case.inputs("frames")
    background = case.inputs("background")
    of = {family.name: family.preparation for family in reversed(families.FAMILIES)}
    t3 = {"mean": (0.51808, 0.503, 0.51457), "std": (0.13893, 0.11343, 0.13497)}
    steps = of | {"t3": replace(of["t3"], **t3)}
    for name in case.info["cases"]:
        family = name.split("_")[0]
        size = (320, 240) if name.endswith("320x240") else (224, 224)
        gel = (
            background
            if steps[family].background != "keep" and "no_background" not in name
            else None
        )
        used = frames if family == "anytouch2" else frames[:1]
        done = np.stack([prepare(frame, gel, steps[family], size) for frame in used]).transpose(
            0, 3, 1, 2
        )
        done = done if family == "anytouch2" else done[0]
        case.compare(f"out/{name}", done[..., ::7, ::7])
        axes = (-2, -1)
        done = done.astype(np.float64)
        case.compare(f"out/{name}_mean_std", np.stack([done.mean(axis=axes), done.std(axis=axes)]))


def full_size(case: Case) -> None:
    """Read the key lists of the released files into abstract shapes, without a missing or an
    unknown key.
    """
    for name, rows in key_lists(case.info):
        zeros = {key: np.broadcast_to(np.float32(0), shape) for key, shape, *_ in rows}
        family = families.find_family(zeros)
        if family is None:
            case.fail(name, "a file of no family")
            continue
        form, _ = families.form_of(family[0], family[1], {}, None, None, ())
        entries, shapes = families.entries_of(family[0], form)
        try:
            check_arrays(name, family[1], file_shapes(entries, shapes))
            case.check(name, len(Part(Vit, form).abstract()) > 0, True, 0)
        except Exception as error:
            case.fail(name, str(error))


def key_lists(lists: dict[str, Any]) -> Iterator[tuple[str, list[Any]]]:
    """Yield the names of released files and their keys and shapes."""

    def replaced(name: str, changed: list[Any], without: str = "") -> list[Any]:
        new = {row[0]: row for row in changed}
        return [new.pop(row[0], row) for row in lists[name] if row[0] != without] + list(
            new.values()
        )

    for name, rows in lists.items():
        if name == "t3_medium_encoder":
            rows = rows + [[f"trunk.{row[0]}", *row[1:]] for row in lists["t3_medium_trunk"]]
        if name.startswith("sitr_classification"):
            rows = rows + [[f"base_model.{row[0]}", *row[1:]] for row in lists["sitr_base_18"]]
        if isinstance(rows, list) and name != "t3_medium_trunk":
            yield name, rows
    for size in ("small", "base"):
        name = f"sparsh_vjepa_{size}"
        (learned,) = lists[f"{name}_if_learned_positions"].values()
        yield f"{name}_learned", replaced(name, learned, "pos_embed.frequency_bands")
        yield (
            f"dinov2_registers_hf_{size}",
            replaced(f"dinov2_hf_{size}", lists[f"dinov2_registers_hf_{size}"]["plus"]),
        )
    for count, shape in lists["sitr_base_c_patch_embed_for_4_8_9"].items():
        yield f"sitr_base_{count}", replaced("sitr_base_18", [["c_patch_embed.proj.weight", shape]])
    (fewer,) = lists["anytouch2_vit_b_2frames_encoder_part"].values()
    yield "anytouch2_2frames", replaced("anytouch2_vit_b_4frames_encoder_part", fewer)
