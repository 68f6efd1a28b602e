"""The authors' key names as transformers has them; read by both sides, so without torch."""

from __future__ import annotations

_DECODER = {
    "attention.attention.query": "attention.q_proj",
    "attention.attention.key": "attention.k_proj",
    "attention.attention.value": "attention.v_proj",
    "attention.output.dense": "attention.o_proj",
    "intermediate.dense": "mlp.fc1",
    "output.dense": "mlp.fc2",
}


def renamed(key: str) -> str:
    """A key of the authors' files as this version of transformers names it."""
    if "touch_decoder_blocks" in key:
        for old, new in _DECODER.items():
            key = key.replace(f".{old}.", f".{new}.") if f".{old}." in key else key
    return key
