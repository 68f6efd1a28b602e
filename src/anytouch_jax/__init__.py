"""AnyTouch (ICLR 2025) in JAX: one representation of touch for many camera-based tactile sensors.

Public names are imported on first use, so that `import anytouch_jax` is fast.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "config": (
        "Config DataConfig LossConfig ModelConfig OptimConfig RunConfig from_json preset to_json"
    ),
    "errors": "UserError",
    "batch": "AlignBatch MatchBatch Stage2Batch TouchBatch",
    "nn.functional": "Net build",
    "ops.tokens": "patchify random_mask unpatchify",
    "ops.losses": "alignment_loss info_nce matching_loss reconstruction_loss",
    "objectives": "stage1_loss stage1_terms stage2_loss stage2_terms trained_by",
    "train.step": "TrainState init_state make_step",
    "train.optim": "optimizer",
    "train.loop": "fit",
    "training": "pretrain",
    "finetuning": "FinetuneOptions finetune",
    "sim.recorder": "simulate_touch",
    "evaluate.heads": "ProbeHead",
    "evaluate.probing": "leave_groups_out probe_benchmark probe_features probe_label probe_tasks",
    "data.background.rule": "estimate_background",
    "data.loading.loader": "Loader",
    "data.manifest.manifest": "Manifest",
    "weights.registry": "list_encoders",
    "weights.tree": "interpolate",
    "encoder.base": "Preprocess",
    "encoder.encoder": "Encoder example_touches load_encoder random_encoder",
    "zoo.encoder": "FamilyEncoder",
    "encoder.linear_head": "load_head",
}
_ALIASES = {  # public names that say more outside their module
    "load_exported": ("export.export", "load"),
    "read_manifest": ("data.manifest.manifest", "read"),
}
_HOME = {
    name: (module, name) for module, names in _HOMES.items() for name in names.split()
} | _ALIASES

__all__ = sorted(_HOME)
__version__ = "0.3.0"


def __getattr__(name: str) -> Any:
    if name == "sim":  # for `anytouch_jax.sim.mujoco`, whose names are used by their room
        return import_module("anytouch_jax.sim")
    if name not in _HOME:
        # Imported here, because only an old name or a mistake needs it. `from anytouch_jax import
        # renamed` would ask this function for it.
        renamed = import_module("anytouch_jax.renamed")
        if name in renamed.NAMES:
            new = renamed.NAMES[name]
            renamed.warn(f"anytouch_jax.{name}", f"anytouch_jax.{new}")
            return __getattr__(new)
        raise AttributeError(f"module 'anytouch_jax' has no attribute {name!r}")
    module, attribute = _HOME[name]
    return getattr(import_module(f"anytouch_jax.{module}"), attribute)


def __dir__() -> list[str]:
    return __all__
