"""Presets, baselines and ablations: named configurations of a network and its training."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from anytouch_jax.config.model import ModelConfig, Stack, TextTower
from anytouch_jax.config.parsing import read_value
from anytouch_jax.config.train import Config, DataConfig, PresetName, Recipe, Towers
from anytouch_jax.errors import ConfigError, UserError

# name -> pixels, patch, embedding; (width, blocks, heads) of touch encoder and image tower, of
# decoder, of text tower; batch
_PRESETS = {
    "tiny": (112, 14, 128, (192, 6, 6), (128, 2, 4), (128, 4, 4), 64),
    "small": (224, 14, 512, (384, 6, 6), (512, 8, 16), (384, 6, 6), 64),
    "base": (224, 16, 512, (768, 12, 12), (512, 8, 16), (512, 12, 8), 256),
    "large": (224, 14, 768, (1024, 24, 16), (512, 8, 16), (768, 12, 12), 256),
}


def preset(
    name: PresetName | str,
    *,
    stage: Literal[1, 2] = 1,
    recipe: Recipe = "paper",
    towers: Towers = "scratch",
) -> Config:
    """Return the configuration called `name` (tiny, small, base, large) for a stage and a recipe.

    One point of the release depends on the machine and is set by hand: negatives stay within a
    device's 64 rows, so `objective.groups` is 4 for a batch of 256. Raises ConfigError for an
    unknown name or choice.

    Args:
        name: tiny, small, base or large, which is the paper's.
        stage: 1 (masked and next-frame reconstruction) or 2 (alignment and matching).
        recipe: "paper", or "release" for the settings of the authors' released code.
        towers: of stage 2. "scratch" trains small image and text towers whole. "pretrained"
            expects CLIP weights, freezes the text tower and adapts the image tower by LoRA.
    """
    if name not in _PRESETS:
        raise ConfigError(f"unknown preset {name!r}. Choose one of {', '.join(_PRESETS)}")
    # stage 1 has no towers, but a wrong choice is an error there too
    read_value(Towers, towers, "towers")
    pixels, patch, embed, *sizes, batch = _PRESETS[name]
    touch, decoder, text = (Stack(width, depth, heads, 4 * width) for width, depth, heads in sizes)
    model = ModelConfig(pixels, patch, embed, touch, decoder)
    config = Config(model, stage, recipe, preset=name, data=DataConfig(batch_size=batch))
    if stage == 2:
        if towers == "none":
            raise ConfigError(
                "stage 2 needs towers. Choose --towers scratch or --towers pretrained."
            )
        model = replace(
            model,
            image=touch,
            text=TextTower(text),
            lora_rank=16 if towers == "pretrained" else 0,
            match_head="linear" if recipe == "release" else "mlp",
        )
        config = replace(config, model=model, towers=towers)
        # Untrained towers share one large direction, which the loss would grow until all
        # embeddings are equal. CLIP's do not, and the release does not subtract it.
        center = towers == "scratch" and recipe == "paper"
        config = config.with_settings({"objective.center_embeddings": center})
    if recipe == "release":
        config = config.with_settings({"optim.decay": "cosine", "data.order": "random"})
    return config


@dataclass(frozen=True)
class Baseline:
    """A baseline or ablation: what distinguishes a method, on this network and the same data.

    `stages` are those that it trains, and `changes` what it changes in their configuration, by
    section.field. Without `changes_stage1` they are made in stage 2 only. Baselines are those of
    Sec. 4.1 and the appendix ("Baselines"), ablations the rows of Table 6.
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


def apply_baseline(name: str, config: Config) -> Config:
    """Return `config` changed to a baseline.

    Raises UserError if it is unknown, or does not train the stage.
    """
    baseline = find_baseline(name)
    if not baseline.stages:
        raise UserError(
            f"baseline {name} is not trained. Evaluate the image tower of a stage-2 run, or that "
            "of CLIP."
        )
    if config.stage not in baseline.stages:
        only = f"only stage {baseline.stages[0]} ({baseline.about})"
        raise UserError(f"baseline {name} has no stage {config.stage}, {only}")
    if config.stage == 1 and not baseline.changes_stage1:
        return config
    return config.with_settings(baseline.changes)


def find_baseline(name: str) -> Baseline:
    """Return the baseline called `name`. Raises UserError."""
    if name not in BASELINES:
        raise UserError(f"no baseline is called {name!r}. Choose one of {', '.join(BASELINES)}")
    return BASELINES[name]


# The universal tokens are never drawn and never trained.
_SENSOR_TOKENS: dict[str, Any] = {"objective.universal_start": 0.0, "objective.universal_end": 0.0}
_STILLS: dict[str, Any] = {"data.clip_fraction": 0.0}
_NO_CLIPS = _STILLS | {"objective.next_frame": False}
_ALL = (
    Baseline("anytouch", "the paper's model, both stages"),
    Baseline(
        "no_pretraining",
        "the image tower as touch encoder, no tactile training (the paper's row CLIP)",
        (),
    ),
    Baseline(
        "unitouch",
        "UniTouch: touch-vision InfoNCE on stills with an RGB image, tokens of each sensor alone",
        (2,),
        {"model.text": None, "model.match_head": "none", "data.require": ("image",)}
        | _SENSOR_TOKENS
        | _STILLS,
    ),
    Baseline(
        "tlv_link",
        "TLV-Link: touch-language-vision alignment on stills that have all three; no sensor "
        "tokens, no matching",
        (2,),
        {
            "model.match_head": "none",
            "model.sensor_tokens": 0,
            "data.require": ("image", "text"),
            **_SENSOR_TOKENS,
            **_STILLS,
        },
    ),
    Baseline(
        "t3",
        "T3: one patch encoder a sensor, a shared trunk, masked autoencoding of stills",
        (1,),
        {"model.patch_encoder": "sensor", "model.sensor_tokens": 0} | _SENSOR_TOKENS | _NO_CLIPS,
    ),
    # The paper has one model for both names: "trained solely on tactile images" in Table 4, "w/o
    # Dynamic Perception" in Table 6.
    Baseline("static_only", "AnyTouch without clips in both stages (Table 4)", changes=_NO_CLIPS),
    Baseline(
        "no_dynamic",
        "without dynamic perception: the same model as static_only (Table 6)",
        changes=_NO_CLIPS,
    ),
    # Stage 1 has no towers and no matching head.
    Baseline(
        "no_text",
        "without text: no text tower, no touch-text and vision-text pairs",
        changes={"model.text": None},
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
    Baseline(
        "no_universal",
        "without universal tokens: each sensor its own, always",
        changes=_SENSOR_TOKENS,
    ),
)
BASELINES: dict[str, Baseline] = {baseline.name: baseline for baseline in _ALL}
