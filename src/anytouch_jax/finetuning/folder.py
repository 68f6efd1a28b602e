"""The folder that fine-tuning leaves: an encoder, its head, a model card and the scores."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from anytouch_jax.encoder.base import Encoder
from anytouch_jax.encoder.linear_head import HEAD, Head, save_head
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_folder, atomic_write
from anytouch_jax.weights.registry import write_encoder
from anytouch_jax.weights.safetensors import Loaded

SCORES = "finetune.json"


def refuse_filled(out: Path) -> None:
    """Raise UserError for a folder that has files, before any work."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        what = "is not empty"
        if (out / SCORES).is_file():
            what = "holds an encoder that was fine-tuned before"
        raise UserError(
            f"{out} {what}. Name another folder with --out, or give it to --model to train on from "
            "there."
        )


def write_folder(out: Path, encoder: Encoder, head: Head, about: dict[str, Any]) -> None:
    """Write the folder, whole or not at all.

    Args:
        out: missing or empty.
        encoder: the tuned one, or the frozen one where nothing beat it.
        head: fitted on its features.
        about: scores and settings, which go to finetune.json and the model card.
    """
    loaded = Loaded(
        Path(encoder.source),
        {"touch": encoder.params["touch"]},
        encoder.config,
        encoder.trained_sensors,
        encoder.universal_drawn,
        {},
        from_run=False,
    )
    with atomic_folder(out) as folder:
        write_encoder(folder, loaded, _notes(about), parts=("touch",), stored="float32")
        save_head(folder / HEAD, head)
        atomic_write(folder / SCORES, json.dumps(about, indent=2) + "\n")


def _notes(about: dict[str, Any]) -> str:
    """Return what the model card says."""
    lines = [
        f"Fine-tuned from {about['model']} by `anytouch finetune` for {about['label']}, on "
        f"{about['touches']} touches. `{HEAD}` is its head: `embed`, `stream` and `view` use it.",
        "",
        about["sentence"],
    ]
    if "test" in about:
        lines += ["", about["test"]["sentence"]]
    return "\n".join(lines)
