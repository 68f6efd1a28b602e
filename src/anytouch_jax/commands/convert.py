"""`anytouch convert`: weights in and out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.commands.output import check_folder
from anytouch_jax.commands.words import say
from anytouch_jax.config import UNIVERSAL, Model, UserError
from anytouch_jax.options import Convert


def run(options: Convert) -> int:
    """Write a run or a weights file as safetensors, by the authors' key names or by ours."""
    from anytouch_jax.config import from_json, to_json
    from anytouch_jax.io import checkpoint, release

    source: Path = options.source
    if options.target.suffix != ".safetensors":
        raise UserError(f"{options.target} must end in .safetensors, the form that is written")
    check_folder(options.target, "TARGET", read=() if source.is_dir() else (source,))
    about = {"source": str(source)}
    if source.is_dir():
        params, text, told = checkpoint.load_params(source)
        config = from_json(text)
        model = config.model
        about |= {release.BACKGROUND_KEY: config.data.background}
        params = release.served(params, config, told)
        if "touch" in params and "seen" in told:
            about |= {release.SEEN_KEY: ",".join(told["seen"])}
    else:
        kept = release.read_metadata(source)
        about |= {key: kept[key] for key in (release.BACKGROUND_KEY,) if key in kept}
        weights = release.read_weights(source)
        model = release.model_of(source, weights)
        params = release.to_params(weights, model)
        seen = release.seen_by_file(kept, model) if "touch" in params else None
        about |= {} if seen is None else {release.SEEN_KEY: ",".join(seen)}
    if options.names == "release" and not {"touch", "decoder"} <= params.keys():
        raise UserError(f"{source} lacks a touch encoder or a decoder, which the authors' files hold: add --names own")
    if options.names == "release" and model.sensors[-1] != UNIVERSAL:
        params, model = _universal_last(params, model)
    about |= {release.MODEL_KEY: to_json(model)}
    if options.names == "own":
        checkpoint.export_safetensors(options.target, params, about)
    else:
        if "matcher" in params and model.match_head == "mlp":
            say("the matching MLP of recipe paper is stored as cross_sensor_mlp.*: the authors' code does not read it")
        if "force" in params:
            say("the force heads are left out: the authors' files have none (--names own keeps them)")
            params = {name: tree for name, tree in params.items() if name != "force"}
        arrays = release.to_release(params, model, allow_extra=True)
        release.write_safetensors(options.target, arrays, about | {"format": "pt"})
    print(f"{options.target}: written")
    return 0


def _universal_last(params: dict[str, Any], model: Model) -> tuple[dict[str, Any], Model]:
    """The same model with its universal tokens in the last row, where the authors' code looks for them (id -1)."""
    from anytouch_jax.io import release

    names = (*(name for name in model.sensors if name != UNIVERSAL), UNIVERSAL)
    rows = release.match_sensors(np.asarray(params["touch"]["sensor_tokens"]), model.sensors, names)
    return params | {"touch": params["touch"] | {"sensor_tokens": rows}}, replace(model, sensors=names)
