"""State dicts of training frameworks: their wrappings and the prefixes of their names, for every file format."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any, TypeVar

T = TypeVar("T")

_WRAPPERS = ("model", "state_dict", "model_state_dict", "module", "student")
_AVERAGES = ("state_dict_ema", "model_ema", "ema", "teacher")  # read only where no plain weights are
_PREFIX = re.compile(r"(module|_orig_mod|model)\.")  # DistributedDataParallel, torch.compile, Lightning
_INNER = re.compile(r"(^|\.)(_orig_mod|_fsdp_wrapped_module|_checkpoint_wrapped_module)\.")
_DEPTH = 4  # of wrappings in each other


def unwrap(content: Any, source: Any) -> Any:
    """Return the state dict inside the usual wrappings, plain weights before averaged ones.

    A warning that names `source` reports averaged weights. Content without a wrapping is returned unchanged.
    """
    for _ in range(_DEPTH):
        names = _WRAPPERS + _AVERAGES
        inner = (name for name in names if isinstance(content, dict) and isinstance(content.get(name), dict))
        name = next(inner, None)
        if name is None:
            break
        if name in _AVERAGES:
            warnings.warn(f"{source} has no plain weights; the averaged ones in {name!r} are read", stacklevel=4)
        content = content[name]
    return content


def strip_prefixes(weights: Mapping[str, T]) -> dict[str, T]:
    """Return the arrays without the prefixes that all names share, such as `module._orig_mod.`.

    Wrappers of torch.compile and FSDP inside a name are removed too, unless two names would become equal.
    """
    names = {name: _INNER.sub(r"\1", name) for name in weights}
    while names and all(_PREFIX.match(name) for name in names.values()):
        shared = {_PREFIX.match(name)[0] for name in names.values()}  # type: ignore[index]
        if len(shared) > 1:
            break
        names = {old: _INNER.sub(r"\1", new.removeprefix(*shared)) for old, new in names.items()}
    if len(set(names.values())) < len(names):
        return dict(weights)
    return {names[old]: value for old, value in weights.items()}
