"""Keys of the authors' files and of CLIP's, as the key maps give them."""

from anytouch_jax.config import ModelConfig
from anytouch_jax.weights.convert import KEYMAPS, detect_form, file_shapes, refuse_unknown
from anytouch_jax.weights.keymaps import Heads, KeyMap, Shape, Weights, param_shapes


def _keymap(model: ModelConfig, layout: str | None) -> KeyMap:
    return KEYMAPS[layout or ("stage2" if model.image or model.text else "stage1")]


def release_shapes(model: ModelConfig, layout: str | None = None) -> dict[str, Shape]:
    """Key -> shape of a file of `model`, without the classifier of a probe: stage 2 if it has a
    tower, else stage 1.
    """
    keymap = _keymap(model, layout)
    shapes = file_shapes(keymap.entries(model), param_shapes(model))
    for key, source in keymap.unused.items():
        theirs = shapes[source]
        shapes[key] = (theirs[0], *theirs[2:]) if len(theirs) == 5 else theirs
    return shapes


def release_names(model: ModelConfig, layout: str | None = None) -> dict[str, str]:
    """Key -> our parameter name, for the keys of `release_shapes` that are used."""
    return {entry.key: entry.name for entry in _keymap(model, layout).entries(model)}


def detect_model(weights: Weights, heads: Heads | None = None) -> ModelConfig:
    """The model that a file was made for; WeightsError for unknown head counts."""
    model, unknown = detect_form(weights, heads or {})
    refuse_unknown(unknown)
    return model
