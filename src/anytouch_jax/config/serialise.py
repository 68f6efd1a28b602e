"""Configurations as JSON, read strictly."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from anytouch_jax.config.parsing import build
from anytouch_jax.config.train import Config
from anytouch_jax.errors import ConfigError


def to_json(config: Any) -> str:
    """A config dataclass as indented JSON; `from_json` reads it back to an equal value."""
    return json.dumps(dataclasses.asdict(config), indent=2)


def from_json(text: str, cls: type = Config) -> Any:
    """Read a config written by `to_json`. An unknown, missing or mistyped key is a ConfigError that names it."""
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ConfigError(f"not a JSON configuration: {error}") from None
    return build(cls, data, cls.__name__.lower())
