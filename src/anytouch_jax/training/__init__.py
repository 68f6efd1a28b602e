"""Pre-training runs: config, data, network, first parameters and loss, for `train.loop`.

A run is resolved once (`start.resolve`), then executed (`run.execute`).
"""

from anytouch_jax.training.run import pretrain
from anytouch_jax.training.start import CHECKPOINTS, TOKENIZER

__all__ = ["CHECKPOINTS", "TOKENIZER", "pretrain"]
