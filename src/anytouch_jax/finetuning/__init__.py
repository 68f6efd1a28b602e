"""Fine-tuning: the encoder and a head, trained together on a user's labels in minutes.

It starts from the linear head of `anytouch probe label --save` (Kumar et al., "Fine-tuning can
distort pretrained features and underperform out-of-distribution", 2022), keeps whole recordings out
for validation, and never ends below that head.
"""

from anytouch_jax.finetuning.options import FinetuneOptions
from anytouch_jax.finetuning.run import Finetuned, finetune

__all__ = ["FinetuneOptions", "Finetuned", "finetune"]
