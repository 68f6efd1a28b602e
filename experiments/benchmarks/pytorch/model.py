"""AnyTouch in PyTorch, from the modules of `transformers`, by the authors' key names.

Runs in a separate environment (torch, transformers, safetensors, numpy); the package never imports
it. Attention is PyTorch's fused one, the optimiser its fused AdamW; images and texts are packed as
in ours, so that what is compared is the framework and not a detour.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from transformers import CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModel, ViTConfig
from transformers.models.clip.modeling_clip import CLIPEncoder
from transformers.models.vit.modeling_vit import ViTLayer

from experiments.benchmarks.pytorch.keys import renamed

ATTENTION = "sdpa"


def vision_config(stack: dict[str, int], model: dict[str, Any]) -> CLIPVisionConfig:
    config = CLIPVisionConfig(
        hidden_size=stack["width"],
        intermediate_size=stack["mlp"],
        num_hidden_layers=stack["depth"],
        num_attention_heads=stack["heads"],
        image_size=model["image_size"],
        patch_size=model["patch"],
        hidden_act=model["activation"],
        layer_norm_eps=model["norm_eps"],
    )
    config._attn_implementation = ATTENTION
    return config


class TouchModel(nn.Module):
    """CLIP's vision tower without its patches: what the authors keep of it."""

    def __init__(self, model: dict[str, Any]) -> None:
        super().__init__()
        width = model["touch"]["width"]
        positions = (model["image_size"] // model["patch"]) ** 2 + 1
        self.embeddings = nn.Module()
        self.embeddings.class_embedding = nn.Parameter(torch.zeros(width))
        self.embeddings.position_embedding = nn.Embedding(positions, width)
        self.pre_layrnorm = nn.LayerNorm(width, model["norm_eps"])
        self.encoder = CLIPEncoder(vision_config(model["touch"], model))
        self.post_layernorm = nn.LayerNorm(width, model["norm_eps"])


class TouchMAE(nn.Module):
    """Stage 1: masked autoencoder of stills and clips, next frame."""

    def __init__(self, model: dict[str, Any]) -> None:
        super().__init__()
        self.patch = model["patch"]
        self.frames = model["frames"]
        width = model["touch"]["width"]
        self.touch_model = TouchModel(model)
        size = (self.frames, self.patch, self.patch)
        self.video_patch_embedding = nn.Conv3d(
            self.frames, width, (3, *size[1:]), (3, *size[1:]), bias=False
        )
        self.sensor_token = nn.Parameter(
            torch.zeros(len(model["sensors"]), model["sensor_tokens"], width)
        )
        self.touch_projection = nn.Linear(width, model["embed"], bias=False)
        inner = model["decoder"]
        pixels = self.patch**2 * 3
        self.decoder_embed = nn.Linear(model["embed"], inner["width"])
        self.mask_token = nn.Parameter(torch.zeros(1, 1, inner["width"]))
        positions = self.touch_model.embeddings.position_embedding.num_embeddings
        self.decoder_pos_embed = nn.Parameter(
            torch.zeros(1, positions, inner["width"]), requires_grad=False
        )
        config = ViTConfig(
            hidden_size=inner["width"],
            intermediate_size=inner["mlp"],
            num_hidden_layers=inner["depth"],
            num_attention_heads=inner["heads"],
            hidden_act="gelu",
            layer_norm_eps=model["decoder_norm_eps"],
        )
        config._attn_implementation = ATTENTION
        self.touch_decoder_blocks = nn.ModuleList(ViTLayer(config) for _ in range(inner["depth"]))
        self.decoder_norm = nn.LayerNorm(inner["width"], model["decoder_norm_eps"])
        self.decoder_pred = nn.Linear(inner["width"], pixels)
        self.decoder_pred_video = nn.Linear(inner["width"], pixels * (self.frames + 1))

    def tokens(self, clip: Tensor, sensor: Tensor, keep: Tensor | None) -> Tensor:
        """(B, T, 3, H, W), T = 1 or 3 -> (B, 1 + S + K, D)."""
        if clip.shape[1] == 1:
            clip = clip.expand(-1, self.frames, -1, -1, -1)
        x = self.video_patch_embedding(clip).flatten(2).transpose(1, 2)
        position = self.touch_model.embeddings.position_embedding.weight
        x = x + position[None, 1:]
        if keep is not None:
            x = torch.gather(x, 1, keep[..., None].expand(-1, -1, x.shape[-1]))
        start = (self.touch_model.embeddings.class_embedding + position[0]).expand(len(x), 1, -1)
        return torch.cat([start, self.sensor_token[sensor], x], dim=1)

    def hidden(self, clip: Tensor, sensor: Tensor, keep: Tensor | None = None) -> Tensor:
        x = self.touch_model.pre_layrnorm(self.tokens(clip, sensor, keep))
        return self.touch_model.encoder(inputs_embeds=x).last_hidden_state

    def embed(self, clip: Tensor, sensor: Tensor) -> Tensor:
        return self.touch_projection(
            self.touch_model.post_layernorm(self.hidden(clip, sensor)[:, 0])
        )

    def paint(
        self, clip: Tensor, sensor: Tensor, noise: Tensor, kept: int
    ) -> tuple[Tensor, Tensor]:
        order = torch.argsort(noise, dim=1)
        restore = torch.argsort(order, dim=1)
        x = self.decoder_embed(
            self.touch_projection(self.hidden(clip[:, : self.frames], sensor, order[:, :kept]))
        )
        special = x.shape[1] - kept
        blank = self.mask_token.to(x.dtype).expand(len(x), noise.shape[1] - kept, -1)
        grid = torch.cat([x[:, special:], blank], dim=1)
        grid = torch.gather(grid, 1, restore[..., None].expand(-1, -1, grid.shape[-1]))
        start = x[:, :1] + self.decoder_pos_embed[:, :1]
        x = torch.cat([start, x[:, 1:special], grid + self.decoder_pos_embed[:, 1:]], dim=1)
        for block in self.touch_decoder_blocks:
            x = block(x)
        x = self.decoder_norm(x)[:, special:]
        pred = (self.decoder_pred if clip.shape[1] == 1 else self.decoder_pred_video)(x)
        return pred.reshape(*x.shape[:2], clip.shape[1], -1), restore >= kept

    def loss(self, clip: Tensor, sensor: Tensor, noise: Tensor, kept: int) -> tuple[Tensor, Tensor]:
        pred, hidden = self.paint(clip, sensor, noise, kept)
        error = ((pred.float() - patchify(clip, self.patch)) ** 2).mean(-1)
        hidden = hidden.float()
        shown = error[..., : self.frames].mean(-1)
        loss = (shown * hidden).sum() / hidden.sum()
        return loss + error[..., self.frames].mean() if clip.shape[1] > self.frames else loss, pred


def patchify(clip: Tensor, patch: int) -> Tensor:
    b, t, c, h, w = clip.shape
    grid = clip.reshape(b, t, c, h // patch, patch, w // patch, patch)
    return grid.permute(0, 3, 5, 1, 4, 6, 2).reshape(b, -1, t, patch * patch * c)


class Stage2(nn.Module):
    """Stage 2: touch, image and text towers, the linear matching head of the release."""

    def __init__(self, model: dict[str, Any]) -> None:
        super().__init__()
        self.touch_mae_model = TouchMAE(model)
        self.vision_model = CLIPVisionModel(vision_config(model["image"], model))
        self.visual_projection = nn.Linear(model["image"]["width"], model["embed"], bias=False)
        stack = model["text"]["stack"]
        config = CLIPTextConfig(
            vocab_size=model["text"]["vocab"],
            hidden_size=stack["width"],
            intermediate_size=stack["mlp"],
            num_hidden_layers=stack["depth"],
            num_attention_heads=stack["heads"],
            max_position_embeddings=model["text"]["length"],
            hidden_act=model["activation"],
            layer_norm_eps=model["norm_eps"],
            eos_token_id=2,  # pools at the largest id, as OpenAI's CLIP
        )
        config._attn_implementation = ATTENTION
        self.text_model = CLIPTextModel(config)
        self.text_projection = nn.Linear(stack["width"], model["embed"], bias=False)
        self.logit_scale = nn.Parameter(torch.zeros(()))
        self.cross_sensor_head = nn.Linear(model["embed"], 1)

    def align(
        self, b: dict[str, Tensor], noise: Tensor, kept: int, weights: list[float]
    ) -> tuple[Tensor, Tensor]:
        touch = self.touch_mae_model
        z = unit(touch.embed(b["clip"][:, : touch.frames], b["sensor"]))
        image = unit(self.visual_projection(self.vision_model(b["image"]).pooler_output))
        text = self.text_model(input_ids=b["text"], attention_mask=b["text_mask"]).pooler_output
        text = unit(self.text_projection(text))
        scale = self.logit_scale.exp()
        total = weights[0] * both_ways(z[b["image_row"]], image, scale)
        total = total + weights[1] * both_ways(z[b["text_row"]], text, scale)
        if len(b["both_image"]):
            total = total + weights[2] * both_ways(
                image[b["both_image"]], text[b["both_text"]], scale
            )
        pixels, _ = touch.loss(b["clip"], b["sensor"], noise, kept)
        return total + pixels, z

    def match(self, b: dict[str, Tensor], weight: float) -> tuple[Tensor, Tensor]:
        z = unit(
            self.touch_mae_model.embed(
                torch.cat([b["clip"], b["positive"], b["negative"]]),
                torch.cat([b["sensor"], b["positive_sensor"], b["negative_sensor"]]),
            )
        )
        anchor, positive, negative = z.chunk(3)
        right = self.cross_sensor_head(anchor * positive).float()
        wrong = self.cross_sensor_head(anchor * negative).float()
        return weight * (F.softplus(-right).mean() + F.softplus(wrong).mean()), anchor


def unit(x: Tensor) -> Tensor:
    return F.normalize(x.float(), dim=-1)


def both_ways(a: Tensor, b: Tensor, scale: Tensor) -> Tensor:
    logits = scale * a @ b.T
    own = torch.arange(len(a), device=a.device)
    return F.cross_entropy(logits.float(), own) + F.cross_entropy(logits.T.float(), own)


def load(model: nn.Module, weights: dict[str, Tensor]) -> None:
    """Fill a model from the authors' key names; every key that the model has must be there."""
    own = model.state_dict()
    named = {renamed(key): value for key, value in weights.items()}
    missing = sorted(set(own) - set(named))
    if missing:
        raise SystemExit(f"weights lack {missing[:5]} and {len(missing)} in all")
    model.load_state_dict({key: named[key] for key in own})


def adamw(model: nn.Module) -> torch.optim.Optimizer:
    """Fused AdamW with the paper's constants; no decay for vectors."""
    trained = [p for p in model.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in trained if p.ndim > 1], "weight_decay": 0.1},
        {"params": [p for p in trained if p.ndim <= 1], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=1e-6, betas=(0.9, 0.99), eps=1e-8, fused=True)
