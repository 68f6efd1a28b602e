"""Sources of a run: the manifests or the source of batches that --data names, and the tokenizer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import jax
from jax.sharding import Mesh

from anytouch_jax import doors
from anytouch_jax.batch import BatchSource
from anytouch_jax.config import Config
from anytouch_jax.data.loading import pools
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.tokenizer import Tokenizer, load_tokenizer
from anytouch_jax.training.checks import PathLike, check_sources, source_words

Log = Callable[[str], None]
SCRATCH_VOCABULARY = 2048
TOKENIZER = "tokenizer.json"


class SourceKind(Protocol):
    """A row of `doors.BATCHES`: makes the batches of a word of --data, and their tokenizer.

    `manifest` has real recordings to mix in, or is None.
    """

    def __call__(
        self,
        config: Config,
        manifest: manifests.Manifest | None,
        *,
        tokenizer: Tokenizer | None,
        devices: int,
        log: Log,
    ) -> BatchSource: ...

    def train_tokenizer(self, config: Config, manifest: manifests.Manifest | None) -> Tokenizer: ...


@dataclass(frozen=True)
class RunData:
    """What --data names: manifests, a source of batches, or both."""

    manifest: manifests.Manifest | None
    word: str | None  # of `doors.BATCHES`

    @property
    def kind(self) -> SourceKind | None:
        """The source of batches, imported now."""
        if self.word is None:
            return None
        kind: SourceKind = doors.enter(doors.BATCHES[self.word])
        return kind

    @property
    def content(self) -> str:
        """What tells one content from another: the hash of the rows, or the word."""
        if self.manifest is None:
            return self.word or ""
        return self.manifest.content_hash


def read_data(config: Config) -> RunData:
    """Read the manifests that --data names, and find the source of batches beside them."""
    words = source_words(config)
    check_sources(words)
    files = tuple(name for name in config.data.manifests if name not in words)
    manifest = None
    # Without any word of --data the reader of manifests reports that nothing was named.
    if files or not words:
        manifest = manifests.read(files)
    return RunData(manifest, words[0] if words else None)


def open_batches(
    config: Config, data: RunData, tokenizer: Tokenizer | None, mesh: Mesh, log: Log
) -> BatchSource:
    """Return the batches of this process.

    Args:
        config: of the run.
        data: the manifest, or the source of simulated batches.
        tokenizer: of captions, if there are any.
        mesh: the devices, whose number decides the slots of a batch.
        log: takes a sentence on samples that were replaced.
    """
    kind = data.kind
    if kind is not None:
        return kind(config, data.manifest, tokenizer=tokenizer, devices=mesh.size, log=log)
    assert data.manifest is not None
    shard = (jax.process_index(), jax.process_count())
    return Loader(
        data.manifest, config, tokenizer=tokenizer, devices=mesh.size, shard=shard, log=log
    )


def tokenizer_of_run(
    config: Config, data: RunData, clip: PathLike | None, stored: Path | None
) -> Tokenizer | None:
    """Return the tokenizer of stage 2, or None.

    It is the run's, the option's, CLIP's, or one trained on captions.

    Args:
        config: of the run.
        data: the manifest, or the source of simulated batches.
        clip: CLIP's weights, whose tokenizer pretrained towers need.
        stored: the tokenizer of a run that is continued.
    """
    if config.model.text is None:
        return None
    file = stored
    if file is None and config.data.tokenizer is None and config.towers == "pretrained":
        assert clip is not None
        folder = Path(clip)
        if not folder.is_dir():
            folder = folder.parent
        file = folder / TOKENIZER
    kind = data.kind
    if kind is not None:
        if file is not None:
            return load_tokenizer(file)
        return kind.train_tokenizer(config, data.manifest)
    assert data.manifest is not None
    rows = data.manifest.rows_of(config.data.split)
    most = min(SCRATCH_VOCABULARY, config.model.text.vocab)
    tokenizer, _ = pools.choose_tokenizer(data.manifest, rows, config, file=file, vocabulary=most)
    return tokenizer


def with_vocabulary(config: Config, tokenizer: Tokenizer | None, data: RunData) -> Config:
    """Return the config whose text tower has a token for each of the tokenizer's.

    CLIP's tower has the size of its weights.
    """
    if config.model.text is None or tokenizer is None or config.towers == "pretrained":
        return config
    vocabulary = tokenizer.vocab_size
    if data.word is None:
        # the start and the end, where no caption is left to train on
        vocabulary = max(vocabulary, 2)
    text = replace(config.model.text, vocab=vocabulary)
    return config.with_settings({"model.text": text})
