"""Heads beside the embedding: what the network needs to know of one (`doors.HEADS`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from jax import Array

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import ModelConfig


class Head(NamedTuple):
    """A head of the network: what makes its module, and how many hidden states it reads.

    The module is called with the states (B, 1 + S + N, states * D) of the touch encoder, the
    normalised clip (B, T, H, W, 3) and the logarithm (B,) of height over width that it shows.
    """

    build: Callable[[ModelConfig], Callable[[Array, Array, Array], FieldOutput]]
    states: int
