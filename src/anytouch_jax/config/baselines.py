"""Baselines and ablations: small changes of the configuration.

A baseline keeps what distinguishes the method it is named after (Sec. 4.1 and appendix "Baselines"). All run on this
network, on the same data, from the same first weights. The ablations are the rows of Table 6. Baselines with an equal
stage may share its run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from anytouch_jax.config.train import Config
from anytouch_jax.errors import UserError


@dataclass(frozen=True)
class Baseline:
    """A baseline: the `stages` that it trains, and its `change` of a stage's configuration."""

    name: str
    about: str
    stages: tuple[int, ...]
    change: Callable[[Config], Config]

    @property
    def starts_from_stage1(self) -> bool:
        """Whether stage 2 starts from a stage 1 (`--init`)."""
        return self.stages == (1, 2)


def apply(name: str, config: Config) -> Config:
    """Return `config` changed to a baseline. Raises UserError if it is unknown, or does not train the stage."""
    baseline = find(name)
    if config.stage in baseline.stages:
        return baseline.change(config)
    if not baseline.stages:
        raise UserError(f"baseline {name} is not trained. Evaluate the image tower of a stage-2 run, or that of CLIP.")
    raise UserError(f"baseline {name} has no stage {config.stage}, only stage {baseline.stages[0]} ({baseline.about})")


def find(name: str) -> Baseline:
    """Return the baseline called `name`. Raises UserError."""
    if name not in BASELINES:
        raise UserError(f"no baseline is called {name!r}. Choose one of {', '.join(BASELINES)}")
    return BASELINES[name]


def _change(
    stages: tuple[int, ...] = (1, 2),
    *,
    model: dict[str, Any] | None = None,
    objective: dict[str, Any] | None = None,
    data: dict[str, Any] | None = None,
) -> Callable[[Config], Config]:
    """Return a change that sets these fields in `stages` only."""

    def change(config: Config) -> Config:
        if config.stage not in stages:
            return config
        return replace(
            config,
            model=replace(config.model, **(model or {})),
            objective=replace(config.objective, **(objective or {})),
            data=replace(config.data, **(data or {})),
        )

    return change


_OWN_TOKENS: dict[str, Any] = {
    "universal_start": 0.0,
    "universal_end": 0.0,
}  # the universal tokens are never drawn and never trained
_STILLS: dict[str, Any] = {"clip_share": 0.0}
_NO_CLIPS = _change(data=_STILLS, objective={"next_frame": False})
_ALL = (
    Baseline("anytouch", "the paper's model, both stages", (1, 2), _change(())),
    Baseline(
        "no_pretraining",
        "the image tower as touch encoder, no tactile training (the paper's row CLIP)",
        (),
        _change(()),
    ),
    Baseline(
        "unitouch",
        "UniTouch: touch-vision InfoNCE on stills with a photograph, tokens of each sensor alone",
        (2,),
        _change(
            model={"text": None, "match_head": "none"},
            objective=_OWN_TOKENS,
            data=_STILLS | {"require": ("image",)},
        ),
    ),
    Baseline(
        "tlv_link",
        "TLV-Link: touch-language-vision alignment on stills that have all three; no sensor tokens, no matching",
        (2,),
        _change(
            model={"match_head": "none", "sensor_tokens": 0},
            objective=_OWN_TOKENS,
            data=_STILLS | {"require": ("image", "text")},
        ),
    ),
    Baseline(
        "t3",
        "T3: one patch encoder a sensor, a shared trunk, masked autoencoding of stills",
        (1,),
        _change(
            model={"patch_encoder": "sensor", "sensor_tokens": 0},
            objective=_OWN_TOKENS | {"next_frame": False},
            data=_STILLS,
        ),
    ),
    # The paper has one model for both names: "trained solely on tactile images" in Table 4, "w/o Dynamic Perception" in
    # Table 6.
    Baseline("static_only", "AnyTouch without clips in both stages (Table 4)", (1, 2), _NO_CLIPS),
    Baseline("no_dynamic", "without dynamic perception: the same model as static_only (Table 6)", (1, 2), _NO_CLIPS),
    Baseline(
        "no_text",
        "without text: no text tower, no touch-text and vision-text pairs",
        (1, 2),
        _change((2,), model={"text": None}),
    ),
    Baseline(
        "no_vision",
        "without vision: no image tower, no touch-vision and vision-text pairs",
        (1, 2),
        _change((2,), model={"image": None, "lora_rank": 0}),
    ),
    Baseline(
        "no_text_aligned",
        "no text for touches that other sensors or units recorded too",
        (1, 2),
        _change((2,), data={"aligned_text": False}),
    ),
    Baseline("no_stage1", "stage 2 alone, from the same first weights as stage 1", (2,), _change(())),
    Baseline("no_stage2", "stage 1 alone", (1,), _change(())),
    Baseline("no_matching", "without cross-sensor matching", (1, 2), _change((2,), model={"match_head": "none"})),
    Baseline(
        "no_universal", "without universal tokens: each sensor its own, always", (1, 2), _change(objective=_OWN_TOKENS)
    ),
)
BASELINES: dict[str, Baseline] = {baseline.name: baseline for baseline in _ALL}
