"""Steps of the PyTorch rival on demand: one JSON line in, one out, so that another process can take
turns with it.

{"do": "setup", "work": ..., "weights": file, "batch": file}      -> {"torch": version, ...} {"do":
"values", "variant": name, "out": file}                    -> {"loss": x}; output and gradients go
to the file {"do": "run", "variant": name, "count": k}                        -> {"seconds": [...]}
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

import torch
import transformers
from safetensors.torch import load_file, save_file

from experiments.benchmarks.pytorch.model import Stage2, TouchMAE, adamw, load

MEAN = {"touch": (0.485, 0.456, 0.406), "image": (0.48145466, 0.4578275, 0.40821073)}
STD = {"touch": (0.229, 0.224, 0.225), "image": (0.26862954, 0.26130258, 0.27577711)}


def floats(pixels: torch.Tensor, kind: str) -> torch.Tensor:
    """uint8 (..., H, W, 3) -> normalised float (..., 3, H, W), as torchvision leaves it:
    contiguous.
    """
    mean, std = (torch.tensor(table[kind]) for table in (MEAN, STD))
    return ((pixels.float() / 255.0 - mean) / std).movedim(-1, -3).contiguous()


class Rival:
    """One workload: the model, its optimiser, its batch, and a loss for each variant."""

    def __init__(self, work: dict[str, Any], weights: str, batch: str) -> None:
        self.work = work
        model = work["model"]
        self.trains = work["kind"] != "embed"
        self.model = (Stage2 if work["stage"] == 2 else TouchMAE)(model)
        load(self.model, load_file(weights))
        self.model.train(self.trains)  # no dropout anywhere
        self.optimizer = adamw(self.model) if self.trains else None
        self.raw = load_file(batch)
        self.noise = self.raw.pop("noise")
        self.losses: dict[bool, Any] = {}
        if work["kind"] == "align":  # places of the rows that have an image and a text
            images = self.raw["image_row"].tolist()
            texts = self.raw["text_row"].tolist()
            both = [row for row in images if row in texts]
            self.both = (
                torch.tensor([images.index(r) for r in both]),
                torch.tensor([texts.index(r) for r in both]),
            )

    def batch(self) -> dict[str, torch.Tensor]:
        """The batch as the model takes it, from uint8."""
        images = {"image": "image"}
        result = {
            name: floats(x, images.get(name, "touch"))
            if x.dtype == torch.uint8 and x.ndim > 3
            else x
            for name, x in self.raw.items()
        }
        if self.work["kind"] == "align":
            result["both_image"], result["both_text"] = self.both
        return result

    def value(
        self, batch: dict[str, torch.Tensor], noise: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(loss, output); an embedding has no loss."""
        kind = self.work["kind"]
        kept = self.work["kept"]
        if kind == "embed":
            z = self.model.embed(batch["clip"], batch["sensor"]).float()
            return z.new_zeros(()), z
        if kind == "stage1":
            return self.model.loss(batch["clip"], batch["sensor"], noise, kept)
        if kind == "align":
            return self.model.align(batch, noise, kept, self.work["weights"])
        return self.model.match(batch, self.work["match_weight"])

    def function(self, variant: str) -> Any:
        compiled = "compiled" in variant
        if compiled not in self.losses:
            self.losses[compiled] = torch.compile(self.value) if compiled else self.value
        inner = self.losses[compiled]
        half = "bfloat16" in variant

        def call(batch: dict[str, torch.Tensor], noise: torch.Tensor) -> Any:
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                return inner(batch, noise)

        return call

    def values(self, variant: str, out: str) -> dict[str, Any]:
        """Loss, output and gradients with the noise that was given, before any step."""
        self.model.zero_grad(set_to_none=True)
        with torch.set_grad_enabled(self.trains):
            loss, output = self.function(variant)(self.batch(), self.noise)
        if self.trains:
            loss.backward()
        result = {
            f"grad/{k}": p.grad for k, p in self.model.named_parameters() if p.grad is not None
        }
        save_file(
            {k: v.detach().float().contiguous() for k, v in (result | {"output": output}).items()},
            out,
        )
        self.model.zero_grad(set_to_none=True)
        return {"loss": float(loss.detach())}

    def step(self, variant: str) -> None:
        if not self.trains:
            with torch.inference_mode():
                self.function(variant)(self.batch(), self.noise)[1].numpy()
            return
        self.optimizer.zero_grad(set_to_none=True)
        loss, _ = self.function(variant)(self.batch(), torch.rand_like(self.noise))
        loss.backward()
        self.optimizer.step()
        float(loss.detach())


def main() -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what libraries print is no answer
    torch.set_float32_matmul_precision("highest")
    rival: Rival | None = None
    for line in sys.stdin:
        question = json.loads(line)
        what = question.pop("do")
        try:
            if what == "setup":
                rival = Rival(**question)
                count = sum(p.numel() for p in rival.model.parameters())
                answer = {
                    "torch": torch.__version__,
                    "transformers": transformers.__version__,
                    "parameters": count,
                }
                answer["threads"] = torch.get_num_threads()
            elif what == "values":
                answer = rival.values(**question)
            else:
                seconds = []
                for _ in range(question["count"]):
                    start = time.perf_counter()
                    rival.step(question["variant"])
                    seconds.append(time.perf_counter() - start)
                answer = {"seconds": seconds}
        except Exception as error:
            answer = {
                "error": (
                    f"{type(error).__name__}: "
                    f"{str(error).strip().splitlines()[0] if str(error) else ''}"
                )
            }
        answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
