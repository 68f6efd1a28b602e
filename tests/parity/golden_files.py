"""Golden folders: cases of arrays recorded from the authors' PyTorch code, and the comparison with
ours.

A case is `<name>.json` and `<name>.npz`: arrays in/..., out/..., grad/..., final/... and what they
mean.
"""

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import (
    SENSORS,
    UNIVERSAL,
    Config,
    DataConfig,
    LossConfig,
    ModelConfig,
    OptimConfig,
    RunConfig,
    Stack,
    TextTower,
)
from anytouch_jax.errors import UserError
from anytouch_jax.weights import convert

Arrays = dict[str, np.ndarray]

# relative, relative, absolute
OUTPUT = 1e-5
GRADIENT = 5e-5
PARAMETER = 1e-5
# exact gradient 0: softmax does not feel a shift of all keys
KEY_BIAS = ("k_proj.bias", "key.bias")


@dataclass(frozen=True)
class Row:
    """One comparison: the worst error of an array against its tolerance, both in units of the
    array's maximum.
    """

    case: str
    array: str
    error: float
    tolerance: float
    note: str = ""

    @property
    def good(self) -> bool:
        return bool(self.error <= self.tolerance)  # NaN is not good


@dataclass
class Case:
    """One golden case and the rows found so far; an array without a comparison is a failure."""

    name: str
    folder: Path
    info: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    seen: set[str] = field(default_factory=set)

    @cached_property
    def arrays(self) -> Arrays:
        return read_arrays(self.folder / f"{self.name}.npz")

    def inputs(self, name: str) -> np.ndarray:
        """The recorded input called `name`."""
        self.seen.add(f"in/{name}")
        return self.arrays[f"in/{name}"]

    def noise(self, name: str) -> float:
        """Absolute rounding noise of the reference on an array, as recorded; 0 where it was not."""
        return float(self.info.get("float32_vs_float64", {}).get("arrays", {}).get(name, [0.0])[0])

    def compare(
        self, name: str, ours: Any, relative: float = OUTPUT, absolute: float = 0.0
    ) -> None:
        """Compare `ours` with the recorded array `name`; tolerance as in the issue: relative, or 5
        x noise.
        """
        self.seen.add(name)
        self.check(name, ours, self.arrays[name], relative, max(absolute, 5 * self.noise(name)))

    def check(
        self, name: str, ours: Any, theirs: Any, relative: float, absolute: float = 0.0
    ) -> None:
        """Compare two arrays; the tolerance is the larger of `relative` x max |theirs| and
        `absolute`.
        """
        ours = np.asarray(ours, np.float64)
        theirs = np.asarray(theirs, np.float64)
        if ours.shape != theirs.shape:
            self.fail(name, f"shape {ours.shape} instead of {theirs.shape}")
            return
        largest = float(np.max(np.abs(theirs), initial=0.0))
        unit = largest if largest > 1e-12 else 1.0
        error = float(np.max(np.abs(ours - theirs), initial=0.0)) / unit
        self.rows.append(Row(self.name, name, error, max(relative * largest, absolute) / unit))

    def fail(self, name: str, why: str) -> None:
        """Record a failure that has no number."""
        self.rows.append(Row(self.name, name, float("inf"), 0.0, why))

    def finish(self) -> None:
        """Every recorded output must have been compared, listed in the JSON or not."""
        listed = self.info.get("arrays", {})
        stored = self.arrays if listed and (self.folder / f"{self.name}.npz").exists() else {}
        for name in {**listed, **stored}:
            if not name.startswith("in/") and name not in self.seen:
                self.fail(name, "recorded but not understood")


def read_arrays(path: Path) -> Arrays:
    """The arrays of an `.npz` file, without pickle. Raises UserError."""
    try:
        # np.load alone leaves a broken file open
        with open(path, "rb") as file, np.load(file) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"cannot read the golden arrays {path}: {error}") from None


def read_cases(folder: Path) -> list[Case]:
    """All cases of a golden folder, in order. Raises UserError when there is none."""
    if not folder.is_dir():
        raise UserError(
            f"no golden folder at {folder}; give the folder that holds A_*.json, B_*.json, ..."
        )
    cases = []
    for path in sorted(folder.glob("*.json")):
        try:
            cases.append(Case(path.stem, folder, json.loads(path.read_text())))
        except json.JSONDecodeError as error:
            raise UserError(f"{path} is not JSON: {error}") from None
    if not cases:
        raise UserError(f"{folder} holds no golden case (*.json)")
    return cases


def golden_config(info: dict[str, Any], *, stage: int, sensors: int = 10) -> Config:
    """The recipe `release` in the sizes and arguments that a case's JSON gives."""
    size = info["config"]
    args = info.get("args", {})
    clip = info["clip_config"]
    tower = Stack(size["hidden"], size["layers"], size["heads"], size["mlp"])
    text_stack = Stack(size["th"], size["tl"], size["theads"], size["tmlp"])
    end = clip["text_eos_token_id"]
    model = ModelConfig(
        image_size=size["image"],
        patch=size["patch"],
        embed=size["proj"],
        touch=tower,
        decoder=Stack(size["dh"], size["dl"], size["dheads"], size["dmlp"]),
        image=tower if stage == 2 else None,
        text=TextTower(text_stack, size["vocab"], size["maxpos"], None if end == 2 else end)
        if stage == 2
        else None,
        sensors=_sensor_names(sensors),
        activation=clip["hidden_act"],
        norm_eps=clip["layer_norm_eps"],
        decoder_norm_eps=info.get("decoder_config", {}).get("layer_norm_eps", 1e-12),
        decoder_sensor_tokens=args.get("new_decoder_sensor_token", False),
        match_head="linear" if stage == 2 else "none",
        lora_rank=args.get("lora_r", size["lora_r"]) if stage == 2 else 0,
        lora_alpha=args.get("lora_alpha", size["lora_alpha"]),
    )
    objective = LossConfig(
        mask_ratio=args.get("mask_ratio", 0.75),
        norm_pix_loss=args.get("norm_pix_loss", False),
        alpha_tv=args.get("alpha_vt", 1.0),
        alpha_tl=args.get("alpha_lt", 1.0),
        alpha_vl=args.get("alpha_vl", 0.2),
        match_weight=args.get("cross_alpha", 0.1),
    )
    return Config(
        model,
        stage=2 if stage == 2 else 1,
        recipe="release",
        towers="pretrained" if stage == 2 else "none",
        objective=objective,
        optim=OptimConfig(decay="cosine"),
        data=DataConfig(),
        run=RunConfig(),
    )


def _sensor_names(rows: int) -> tuple[str, ...]:
    """Names for a table of `rows` sensors whose last row is the universal one (the reference's id
    -1).
    """
    if rows == len(SENSORS):
        return SENSORS
    return (*(f"sensor_{i}" for i in range(rows - 1)), UNIVERSAL)


def golden_params(folder: Path, file: str, model: ModelConfig, scale: Any = None) -> dict[str, Any]:
    """Parameters of a golden `.npz` in our layout; keys of parts that `model` leaves out are
    dropped.
    """
    weights = read_arrays(folder / file)
    if not model.decoder_sensor_tokens:
        weights = {k: v for k, v in weights.items() if not k.endswith("sensor_token_proj.weight")}
    if scale is not None:
        weights = {key: scale(key, value) for key, value in weights.items()}
    return convert.to_params(weights, model)


def channel_last(pixels: np.ndarray, *, clip: bool = True) -> np.ndarray:
    """(B, 3, H, W) or (B, T, 3, H, W) -> (B, T, H, W, 3), or (B, H, W, 3) of an RGB image with
    `clip` False.
    """
    pixels = np.moveaxis(pixels, -3, -1)
    if clip and pixels.ndim == 4:
        return pixels[:, None]
    return pixels
