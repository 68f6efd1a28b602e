"""Configurations as JSON: strict reading, settings of older versions."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from anytouch_jax.config.parsing import read_value
from anytouch_jax.config.train import Config
from anytouch_jax.errors import ConfigError

# Settings of version 0.1 by section. A new name, or the values that change nothing ("recipe": what the recipe implies).
_RENAMED = {("objective", "centre"): "center_embeddings", ("optim", "clip_norm"): "grad_clip"}
_RETIRED: dict[tuple[str, str], tuple[Any, ...] | str] = {
    ("model", "force_head"): (False,),
    ("objective", "differences"): (0.0,),
    ("objective", "force"): (0.0,),
    ("objective", "touch_text_sum"): "recipe",
    ("objective", "reconstruct"): "recipe",
    ("objective", "universal_shared"): "recipe",
    ("optim", "ema"): (None,),
    ("data", "split_steps"): "recipe",
}


def to_json(config: Any) -> str:
    """Write a config dataclass as indented JSON. `from_json` reads it back to an equal value."""
    return json.dumps(dataclasses.asdict(config), indent=2)


def from_json(text: str, cls: type = Config, *, allow_retired: bool = True) -> Any:
    """Read a config written by `to_json`, of this version or an older one.

    Settings that no longer exist are dropped. With `allow_retired` False, one that changed the training is an error:
    the run cannot be continued. Raises ConfigError, which names an unknown, missing, mistyped or retired setting.
    """
    try:
        data = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ConfigError(f"not a JSON configuration: {error}") from None
    if cls is Config and isinstance(data, dict):
        data = _modern(data, allow_retired)
    elif isinstance(data, dict):
        data = {name: value for name, value in data.items() if ("model", name) not in _RETIRED}
    return read_value(cls, data, "config" if cls is Config else cls.__name__.lower())


def _modern(data: Mapping[str, Any], allow_retired: bool) -> dict[str, Any]:
    """Return the settings of a run under today's names, without the retired ones."""
    modern = {name: dict(part) if isinstance(part, dict) else part for name, part in data.items()}
    for (section, name), new_name in _RENAMED.items():
        part = modern.get(section)
        if isinstance(part, dict) and name in part:
            part[new_name] = part.pop(name)
    for (section, name), inert in _RETIRED.items():
        part = modern.get(section)
        if not isinstance(part, dict) or name not in part:
            continue
        value = part.pop(name)
        release = data.get("recipe") == "release"
        implied = (release and (data.get("stage") == 2 or name == "touch_text_sum"),) if inert == "recipe" else inert
        if not allow_retired and value not in implied:
            raise ConfigError(
                f"the run sets {section}.{name} to {value!r}, which this version no longer has. "
                "Continue it with version 0.1, or start a new run from it with --init."
            )
    return modern
