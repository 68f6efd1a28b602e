"""`anytouch convert`: weights in and out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.cli.options import Convert
from anytouch_jax.cli.output import check_folder
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config import UNIVERSAL, ModelConfig
from anytouch_jax.errors import UserError

Loaded = tuple[dict[str, Any], ModelConfig, dict[str, str]]  # parameters, their model, what a file says of them


def run(options: Convert) -> int:
    """Write a run or a weights file as safetensors, by the authors' key names or by ours."""
    from anytouch_jax.config import to_json
    from anytouch_jax.weights import convert, safetensors

    source, other = options.source, options.between
    if options.target.suffix != ".safetensors":
        raise UserError(f"{options.target} must end in .safetensors, the form that is written")
    if other is None:
        refuse(options, ("share",), "without --between")
    if not 0 <= options.share <= 1:
        raise UserError(f"--share is the share of the way to {source}, 0 to 1, not {options.share:g}")
    read = [path for path in (source, other) if path is not None and not path.is_dir()]
    check_folder(options.target, "TARGET", read=read)
    params, model, about = _loaded(source)
    if other is not None:
        params = _between(_loaded(other), (params, model, about), options)
        about |= {"source": f"{options.share:g} of the way from {other} to {source}"}
    if options.names == "release" and not {"touch", "decoder"} <= params.keys():
        raise UserError(f"{source} lacks a touch encoder or a decoder, which the authors' files hold: add --names own")
    if options.names == "release" and model.sensors[-1] != UNIVERSAL:
        params, model = _universal_last(params, model)
    about |= {safetensors.MODEL_KEY: to_json(model)}
    if options.names == "own":
        safetensors.export_safetensors(options.target, params, about)
    else:
        if "matcher" in params and model.match_head == "mlp":
            log("the matching MLP of recipe paper is stored as cross_sensor_mlp.*: the authors' code does not read it")
        if "force" in params:
            log("the force heads are left out: the authors' files have none (--names own keeps them)")
            params = {name: tree for name, tree in params.items() if name != "force"}
        arrays = convert.to_release(params, model, allow_extra=True)
        safetensors.write_safetensors(options.target, arrays, about | {"format": "pt"})
    print(f"{options.target}: written")
    return 0


def _loaded(source: Path) -> Loaded:
    """The parameters of a run or a file as they are used, the model, and what a file says of them."""
    from anytouch_jax.weights import load

    loaded = load.load_model(source, stored_rows=True)
    return loaded.params, loaded.config.model, loaded.export_metadata()


def _between(first: Loaded, second: Loaded, options: Convert) -> dict[str, Any]:
    """Parameters on the way from `first` to `second`. Raises UserError where they are not of one network."""
    from anytouch_jax.weights import safetensors, tree

    names = ("touch", "patch", "patch_encoder", "image_size", "frames", "embed", "norm_eps", "activation", "sensors")
    other = [name for name in names if getattr(first[1], name) != getattr(second[1], name)]
    if first[2].get(safetensors.BACKGROUND_KEY, "keep") != second[2].get(safetensors.BACKGROUND_KEY, "keep"):
        other.append("background")
    if other:
        raise UserError(
            f"{options.between} and {options.source} are of different networks ({', '.join(other)}): --between takes "
            "what SOURCE was trained from, as its stage 1"
        )
    return tree.interpolate(first[0], second[0], options.share)


def _universal_last(params: dict[str, Any], model: ModelConfig) -> tuple[dict[str, Any], ModelConfig]:
    """The same model with its universal tokens in the last row, where the authors' code looks for them (id -1)."""
    from anytouch_jax.weights import compatible

    names = (*(name for name in model.sensors if name != UNIVERSAL), UNIVERSAL)
    rows = compatible.match_sensors(np.asarray(params["touch"]["sensor_tokens"]), model.sensors, names)
    return params | {"touch": params["touch"] | {"sensor_tokens": rows}}, replace(model, sensors=names)
