"""Baselines and ablations: small changes of the configuration.

A baseline keeps what distinguishes the method it is named after (Sec. 4.1 and appendix "Baselines"). All run on this
network, on the same data, from the same first weights. The ablations are the rows of Table 6. Baselines with an equal
stage may share its run.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from anytouch_jax.config.train import Config
from anytouch_jax.errors import UserError


@dataclass(frozen=True)
class Baseline:
    """A baseline: the `stages` that it trains, and its `changes` of their configuration by section.field.

    Without `changes_stage1` they are made in stage 2 only.
    """

    name: str
    about: str
    stages: tuple[int, ...] = (1, 2)
    changes: dict[str, Any] = field(default_factory=dict)
    changes_stage1: bool = True

    @property
    def starts_from_stage1(self) -> bool:
        """Whether stage 2 starts from a stage 1 (`--init`)."""
        return self.stages == (1, 2)


def apply(name: str, config: Config) -> Config:
    """Return `config` changed to a baseline. Raises UserError if it is unknown, or does not train the stage."""
    baseline = find(name)
    if not baseline.stages:
        raise UserError(f"baseline {name} is not trained. Evaluate the image tower of a stage-2 run, or that of CLIP.")
    if config.stage not in baseline.stages:
        only = f"only stage {baseline.stages[0]} ({baseline.about})"
        raise UserError(f"baseline {name} has no stage {config.stage}, {only}")
    return config.with_settings(baseline.changes if config.stage == 2 or baseline.changes_stage1 else {})


def find(name: str) -> Baseline:
    """Return the baseline called `name`. Raises UserError."""
    if name not in BASELINES:
        raise UserError(f"no baseline is called {name!r}. Choose one of {', '.join(BASELINES)}")
    return BASELINES[name]


# The universal tokens are never drawn and never trained.
_SENSOR_TOKENS: dict[str, Any] = {"objective.universal_start": 0.0, "objective.universal_end": 0.0}
_STILLS: dict[str, Any] = {"data.clip_share": 0.0}
_NO_CLIPS = _STILLS | {"objective.next_frame": False}
_ALL = (
    Baseline("anytouch", "the paper's model, both stages"),
    Baseline("no_pretraining", "the image tower as touch encoder, no tactile training (the paper's row CLIP)", ()),
    Baseline(
        "unitouch",
        "UniTouch: touch-vision InfoNCE on stills with a photograph, tokens of each sensor alone",
        (2,),
        {"model.text": None, "model.match_head": "none", "data.require": ("image",)} | _SENSOR_TOKENS | _STILLS,
    ),
    Baseline(
        "tlv_link",
        "TLV-Link: touch-language-vision alignment on stills that have all three; no sensor tokens, no matching",
        (2,),
        {"model.match_head": "none", "model.sensor_tokens": 0, "data.require": ("image", "text")}
        | _SENSOR_TOKENS
        | _STILLS,
    ),
    Baseline(
        "t3",
        "T3: one patch encoder a sensor, a shared trunk, masked autoencoding of stills",
        (1,),
        {"model.patch_encoder": "sensor", "model.sensor_tokens": 0} | _SENSOR_TOKENS | _NO_CLIPS,
    ),
    # The paper has one model for both names: "trained solely on tactile images" in Table 4, "w/o Dynamic Perception" in
    # Table 6.
    Baseline("static_only", "AnyTouch without clips in both stages (Table 4)", changes=_NO_CLIPS),
    Baseline("no_dynamic", "without dynamic perception: the same model as static_only (Table 6)", changes=_NO_CLIPS),
    # Stage 1 has no towers and no matching head.
    Baseline(
        "no_text", "without text: no text tower, no touch-text and vision-text pairs", changes={"model.text": None}
    ),
    Baseline(
        "no_vision",
        "without vision: no image tower, no touch-vision and vision-text pairs",
        changes={"model.image": None, "model.lora_rank": 0},
    ),
    Baseline(
        "no_text_aligned",
        "no text for touches that other sensors or units recorded too",
        changes={"data.aligned_text": False},
        changes_stage1=False,
    ),
    Baseline("no_stage1", "stage 2 alone, from the same first weights as stage 1", (2,)),
    Baseline("no_stage2", "stage 1 alone", (1,)),
    Baseline("no_matching", "without cross-sensor matching", changes={"model.match_head": "none"}),
    Baseline("no_universal", "without universal tokens: each sensor its own, always", changes=_SENSOR_TOKENS),
)
BASELINES: dict[str, Baseline] = {baseline.name: baseline for baseline in _ALL}
