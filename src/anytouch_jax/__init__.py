"""AnyTouch (ICLR 2025) in JAX: one representation of touch for many camera-based tactile sensors.

The public names, imported when they are first used: `import anytouch_jax` alone costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOMES = {
    "config": [
        "Config",
        "DataConfig",
        "LossConfig",
        "ModelConfig",
        "OptimConfig",
        "RunConfig",
        "from_json",
        "preset",
        "to_json",
    ],
    "errors": ["UserError"],
    "batch": ["AlignBatch", "MatchBatch", "Stage2Batch", "TouchBatch"],
    "nn.functional": ["Net", "build"],
    "ops.tokens": ["patchify", "unpatchify"],
    "ops.masking": ["random_mask"],
    "ops.losses": ["alignment_loss", "info_nce", "matching_loss", "reconstruction_loss"],
    "objectives": ["stage1_loss", "stage1_terms", "stage2_loss", "stage2_terms"],
    "train.step": ["TrainState", "init_state", "make_step"],
    "train.optim": ["optimizer"],
    "train.loop": ["fit"],
    "pretrain": ["pretrain"],
    "evaluate.array_probes": ["knn_probe", "leave_groups_out", "linear_probe", "regression_probe"],
    "evaluate.heads": ["load_head"],
    "evaluate.probing": ["probe_benchmark", "probe_label", "probe_tasks"],
    "encoder.encoder": ["Encoder", "load_encoder", "random_encoder"],
    "encoder.preprocess": ["Preprocess"],
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'anytouch_jax' has no attribute {name!r}")
    return getattr(import_module(f"anytouch_jax.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
