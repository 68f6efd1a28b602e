"""Whether weights fit a run: the same activation, size and form, else one sentence with the options that lack."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path

from anytouch_jax.config import Config, ModelConfig
from anytouch_jax.errors import UserError


def same_activation(path: Path, told: str | None, config: Config) -> None:
    """Raise UserError where weights were trained with another activation than the run's; None: nothing tells."""
    ours = config.model.activation
    if told not in (None, ours):
        raise UserError(f"{path} was trained with {told}, this run would use {ours}: add --model.activation {told}")


def same_size(path: Path, before: Config, config: Config) -> None:
    """Raise UserError where a run is of another preset than this one, and of towers of another size."""
    theirs, ours = ((model.touch.width, model.touch.depth) for model in (before.model, config.model))
    if theirs != ours and before.preset not in (config.preset, "custom"):
        raise UserError(
            f"{path} is of preset {before.preset} and this run would be of preset {config.preset}: add --preset "
            f"{before.preset}"
        )


SHAPES: tuple[str, ...] = ("patch", "patch_encoder", "embed", "frames", "sensor_tokens")
SHAPES += tuple(f"{tower}.{size}" for tower in ("touch", "decoder") for size in ("width", "depth", "mlp"))
UNSEEN = ("touch.heads", "decoder.heads", "norm_eps", "decoder_norm_eps")  # no shape hangs on them


def same_form(path: Path, before: ModelConfig, config: Config, names: Sequence[str] = (*SHAPES, *UNSEEN)) -> None:
    """Raise UserError, with all the options that are missing, where weights are of a network of another form."""
    pairs = {name: tuple(attrgetter(name)(model) for model in (before, config.model)) for name in names}
    other = {name: (theirs, ours) for name, (theirs, ours) in pairs.items() if theirs != ours}
    if other:
        told = ", ".join(f"{name} {theirs}" for name, (theirs, _) in other.items())
        used = ", ".join(str(ours) for _, ours in other.values())
        options = " ".join(f"--model.{name.replace('_', '-')} {theirs}" for name, (theirs, _) in other.items())
        raise UserError(f"{path} was trained with {told}, this run would use {used}: add {options}")


def same_towers(path: Path, clip: ModelConfig, config: Config, *, touch: bool) -> None:
    """Raise UserError where CLIP's image tower is of another size than the parts that start from it: the run's image
    tower, and its `touch` encoder."""
    theirs = (clip.touch.width, clip.touch.depth, clip.patch)
    for name, stack in (("image tower", config.model.image), ("touch encoder", config.model.touch if touch else None)):
        if stack is None or (ours := (stack.width, stack.depth, config.model.patch)) == theirs:
            continue
        sizes = [f"width {width}, depth {depth} and patches of {patch}" for width, depth, patch in (theirs, ours)]
        raise UserError(
            f"the image tower in {path} has {sizes[0]}, this run's {name} {sizes[1]}: --preset large is for ViT-L/14, "
            "--preset base for ViT-B/16; add the one that fits, or give other --clip weights"
        )
