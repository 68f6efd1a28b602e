"""Tokenizers of captions: CLIP's, read from its file, or a small one trained on captions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import tokenizers
from tokenizers import decoders, models, normalizers, pre_tokenizers, processors, trainers

from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

START = "<|startoftext|>"
END = "<|endoftext|>"
_AT_ONCE = 10_000  # texts that are encoded together
_BYTES = 256  # a byte-level vocabulary has them all, so that any text can be encoded


class Tokenizer:
    """A tokenizer with CLIP's conventions.

    A text has a start token first and an end token last, and is padded with the end token. There
    are `vocab_size` ids. The end token `end_id` has the largest one, because CLIP's text tower
    pools at the position of the largest id: that is the first end token.
    """

    def __init__(self, inner: tokenizers.Tokenizer, name: str = "the tokenizer") -> None:
        inner.no_padding()
        inner.no_truncation()
        empty = inner.encode("").ids
        self.vocab_size: int = inner.get_vocab_size()
        if len(empty) != 2 or empty[1] != self.vocab_size - 1:
            raise UserError(
                f"{name} is not of CLIP's kind: it must put a start and an end token around a "
                "text, and the end token must have the largest id"
            )
        self.start_id, self.end_id = empty
        self._inner = inner

    def encode(self, texts: Sequence[str], length: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids i32 (L, length) and the mask bool (L, length) of L texts.

        A long text keeps its first tokens and the end token. A short text is padded with the end
        token. The mask is true on real tokens, which include the first end token.

        Raises UserError for a length below 2.
        """
        if length < 2:
            raise UserError(
                f"a text needs room for a start and an end token, not a length of {length}"
            )
        ids = np.full((len(texts), length), self.end_id, np.int32)
        mask = np.zeros((len(texts), length), bool)
        for row, text in enumerate(texts):
            tokens = self._inner.encode(text).ids
            if len(tokens) > length:
                tokens = [*tokens[: length - 1], self.end_id]
            ids[row, : len(tokens)] = tokens
            mask[row, : len(tokens)] = True
        return ids, mask

    def longest(self, texts: Sequence[str]) -> int:
        """Return the tokens of the longest text, start and end included; 2 without texts."""
        longest = 2
        # Encodings of a million captions at once would take gigabytes.
        for start in range(0, len(texts), _AT_ONCE):
            part = list(texts[start : start + _AT_ONCE])
            for encoding in self._inner.encode_batch_fast(part):
                longest = max(longest, len(encoding.ids))
        return longest

    def save(self, path: str | Path) -> None:
        """Write a tokenizer.json for `load_tokenizer`; `path` is the file or its folder."""
        target = Path(path)
        if target.suffix != ".json":
            target /= "tokenizer.json"
        atomic_write(target, self._inner.to_str())


def load_tokenizer(path: str | Path) -> Tokenizer:
    """Load a `tokenizer.json`; `path` is the file or its folder.

    Raises UserError if it is missing or unfit.
    """
    path = Path(path).expanduser()
    if not path.exists() and path.name != "tokenizer.json":
        raise UserError(f"there is no tokenizer at {path}; give a tokenizer.json or its folder")
    file = path / "tokenizer.json" if path.is_dir() else path
    if not file.is_file():
        raise UserError(
            f"there is no tokenizer {file}; give the tokenizer.json in the folder of CLIP's weights"
        )
    try:
        inner = tokenizers.Tokenizer.from_file(str(file))
    except Exception as error:  # the library raises plain Exception
        raise UserError(f"{file} is not a tokenizer.json: {error}") from None
    return Tokenizer(inner, str(file))


def train_tokenizer(captions: Iterable[str], vocab_size: int) -> Tokenizer:
    """Train a byte-level BPE tokenizer of at most `vocab_size` ids.

    It encodes any text, in lower case and with single spaces. The start and end token take the last
    two ids. The same captions give the same ids, in any order.

    Raises UserError if there is no caption, or if `vocab_size` is below 258: the 256 bytes and the
    two tokens.
    """
    # The trainer breaks ties between pairs of tokens by the order in which it met them.
    texts = sorted(set(captions))
    if not texts:
        raise UserError("a tokenizer cannot be trained without captions")
    special = [START, END]
    least = _BYTES + len(special)
    if vocab_size < least:
        raise UserError(f"a tokenizer needs room for at least {least} tokens, not {vocab_size}")
    inner = tokenizers.Tokenizer(models.BPE())
    blanks = normalizers.Replace(tokenizers.Regex(r"\s+"), " ")
    inner.normalizer = normalizers.Sequence(
        [normalizers.NFC(), blanks, normalizers.Strip(), normalizers.Lowercase()]
    )
    inner.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    inner.decoder = decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(
        vocab_size=vocab_size - len(special), initial_alphabet=alphabet, show_progress=False
    )
    inner.train_from_iterator(texts, trainer)
    # Added after the training, so that the end token has the largest id.
    inner.add_special_tokens(special)
    ids = [(token, inner.token_to_id(token)) for token in special]
    inner.post_processor = processors.TemplateProcessing(
        single=f"{START} $A {END}", special_tokens=ids
    )
    return Tokenizer(inner, "the trained tokenizer")
