"""Start of a run, resolved once: config, tokenizer, batches, first parameters, metadata."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import jax
from jax.sharding import Mesh

from anytouch_jax import doors
from anytouch_jax.batch import BatchSource
from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.data.loading import pools
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.tokenizer import Tokenizer, load_tokenizer
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.train.progress import begun_with
from anytouch_jax.training.checks import PathLike, check_sources, check_start, source_words
from anytouch_jax.weights import checkpoint
from anytouch_jax.weights.load import load_init

Params = dict[str, Any]
Log = Callable[[str], None]
SCRATCH_VOCABULARY = 2048
TOKENIZER = "tokenizer.json"
CHECKPOINTS = "checkpoints"


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
class Start:
    """A run before its first step: all that its settings and its folder decide.

    `config` has the warm-up and the vocabulary of this run. When it resumes, only the shapes of
    `params` matter. `notes` are sentences for the user.
    """

    run: Path
    config: Config
    resumes: bool
    net: Net
    params: Params
    tokenizer: Tokenizer | None
    batches: BatchSource
    notes: tuple[str, ...]
    metadata: dict[str, Any]


@dataclass(frozen=True)
class _Data:
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


def resolve(
    config: Config,
    run: Path,
    *,
    init: PathLike | None,
    clip: PathLike | None,
    mesh: Mesh,
    log: Log,
) -> Start:
    """Return the start of a run. Writes nothing.

    Args:
        config: The settings.
        run: The run folder, which need not exist.
        init: A stage-1 run or weights, see `pretrain`.
        clip: CLIP weights, see `pretrain`.
        mesh: The devices, whose number decides the slots of a batch.
        log: Gets what the loader reports later, such as samples that were replaced.

    Raises:
        UserError: For a mistake in the settings, the data or the folder.
    """
    resumes = bool(checkpoint.steps(run / CHECKPOINTS))
    has_tokenizer = (run / TOKENIZER).exists()
    check_start(config, run, init=init, clip=clip, resumes=resumes, has_tokenizer=has_tokenizer)
    data = _read_data(config)
    # Without a checkpoint a tokenizer is left from a start that failed.
    stored_tokenizer = run / TOKENIZER if resumes and has_tokenizer else None
    tokenizer = _choose_tokenizer(config, data, clip, stored_tokenizer)
    config = _with_vocabulary(config, tokenizer, data)
    net = build(config.model)
    params = net.init(jax.random.key(config.run.seed))
    stored: dict[str, Any] = {}
    trained: tuple[str, ...] = ()
    if resumes:
        # `fit` reports a damaged checkpoint
        with suppress(checkpoint.CheckpointError):
            stored = checkpoint.read_metadata(run)
        notes = _check_resume(run, data, stored, init=init, clip=clip)
    else:
        params, notes, trained = _first_params(params, config, init, clip)
    batches = _open(config, data, tokenizer, mesh, log)
    trained_sensors = {*batches.trained_sensors, *trained, *stored.get("seen", ())}
    config = _with_warmup(config, run, batches)
    metadata = {
        "sensors": list(config.model.sensors),
        "seen": [name for name in config.model.sensors if name in trained_sensors],
        "preprocessing": _preprocessing(config),
        "source": stored.get("source", {"init": init and str(init), "clip": clip and str(clip)}),
        "data": data.content,
    }
    return Start(
        run=run,
        config=config,
        resumes=resumes,
        net=net,
        params=params,
        tokenizer=tokenizer,
        batches=batches,
        notes=(*notes, *batches.notes),
        metadata=metadata,
    )


def _read_data(config: Config) -> _Data:
    """Read the manifests that --data names, and find the source of batches beside them."""
    words = source_words(config)
    check_sources(words)
    files = tuple(name for name in config.data.manifests if name not in words)
    manifest = None
    # Without any word of --data the reader of manifests reports that nothing was named.
    if files or not words:
        manifest = manifests.read(files)
    return _Data(manifest, words[0] if words else None)


def _first_params(
    fresh: Params, config: Config, init: PathLike | None, clip: PathLike | None
) -> tuple[Params, list[str], tuple[str, ...]]:
    """Return the first parameters of a run, notes, and the sensors that they were trained on."""
    if init is None:
        start = load_init(fresh, config, clip=clip)
    else:
        # a file of any family: DINOv2, ViT-MAE, ViT and DeiT start a touch encoder too
        start = doors.enter(doors.WEIGHTS["start"])(fresh, config, init=init, clip=clip)
    return start.params, list(start.notes), tuple(start.trained_sensors)


def _open(
    config: Config, data: _Data, tokenizer: Tokenizer | None, mesh: Mesh, log: Log
) -> BatchSource:
    """Return the batches of this process."""
    kind = data.kind
    if kind is not None:
        return kind(config, data.manifest, tokenizer=tokenizer, devices=mesh.size, log=log)
    assert data.manifest is not None
    shard = (jax.process_index(), jax.process_count())
    return Loader(
        data.manifest, config, tokenizer=tokenizer, devices=mesh.size, shard=shard, log=log
    )


def _preprocessing(config: Config) -> dict[str, Any]:
    """Return how images are prepared, for who reads the weights without this package."""
    size = config.model.image_size
    return {
        "touch": {"size": size, "mean": IMAGENET_MEAN, "std": IMAGENET_STD, "channels": "RGB"},
        "image": {"size": size, "mean": CLIP_MEAN, "std": CLIP_STD, "channels": "RGB"},
    }


def _check_resume(
    run: Path, data: _Data, stored: Mapping[str, Any], **paths: PathLike | None
) -> list[str]:
    """Return notes on weights that differ from those that a run started from.

    Raises UserError if it resumes on other rows.
    """
    if stored.get("data") not in (None, data.content):
        raise UserError(
            f"the rows of the manifests have changed since {run} was started; restore them, or "
            f"start another run with --init {run}, whose touch encoder and decoder it starts from"
        )
    if not stored:
        return []
    notes = []
    source = stored.get("source") or {}
    for name, path in paths.items():
        before = source.get(name)
        if path is None:
            continue
        if before is not None and Path(before).resolve() == Path(path).resolve():
            continue
        option = "--clip-weights" if name == "clip" else "--init"
        notes.append(
            f"{run} resumes and was started with {option} {before or '(nothing)'}: {path} is "
            "not read"
        )
    return notes


def _with_warmup(config: Config, run: Path, batches: BatchSource) -> Config:
    """Return the config with a warm-up of one epoch, or less in a short run.

    An epoch is the paper's (appendix "Implementation details"). A run that started without one
    keeps that.
    """
    if config.optim.warmup is not None:
        return config
    earlier = begun_with(run)
    if earlier is not None and earlier.optim.warmup is None:
        return config
    return config.with_settings({"optim.warmup": min(batches.steps_per_epoch, config.warmup)})


def _choose_tokenizer(
    config: Config, data: _Data, clip: PathLike | None, stored: Path | None
) -> Tokenizer | None:
    """Return the tokenizer of stage 2, or None.

    It is the run's, the option's, CLIP's, or one trained on captions.
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


def _with_vocabulary(config: Config, tokenizer: Tokenizer | None, data: _Data) -> Config:
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
