"""A training run, assembled: config -> data, network, first parameters, loss -> `train.loop.fit` in a run folder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from anytouch_jax import objectives
from anytouch_jax.batch import Stage2Batch
from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, Config, from_json
from anytouch_jax.data import tokenizer as texts
from anytouch_jax.data.loading import pools
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import figures
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.train.loop import FitResult, fit
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.train.metrics import alone_in, begun_with
from anytouch_jax.train.progress import silent
from anytouch_jax.weights import checkpoint, fits, release
from anytouch_jax.weights.record import steps

Params = dict[str, Any]
Log = Callable[[str], None]
SCRATCH_VOCABULARY, TOKENIZER = 2048, "tokenizer.json"
_NO_CLIP = "towers=pretrained needs CLIP weights: --clip <folder or file>, with tokenizer.json beside them"


def pretrain(
    config: Config,
    run: str | Path,
    *,
    init: str | Path | None = None,
    clip: str | Path | None = None,
    stop_after: int | None = None,
    log: Log = print,
    mesh: Mesh | None = None,
) -> FitResult:
    """Train stage 1 or stage 2 in the folder `run`, or go on with it (Sec. 3.6).

    `init`: a stage-1 run (or AnyTouch weights) that stage 2 starts from, or weights for the touch encoder of stage 1.
    `clip`: CLIP weights for the towers; stage 1 starts the touch encoder from their image tower, as the paper does. A
    run that goes on reads neither.
    `mesh`: the devices to train on, all of them if None. Raises UserError for a mistake in the settings, the data or
    the folder.
    """
    run, mesh = Path(run), mesh or make_mesh(fsdp=config.run.fsdp)
    log = log if jax.process_index() == 0 else silent
    _possible(config)
    if config.stage == 1 and init is not None and clip is not None:
        raise UserError(
            "--clip is not read beside --init in stage 1, where each gives the touch encoder: leave one out"
        )
    _same_stage(run, config)
    manifest = manifests.read(config.data.manifests)
    config, tokenizer = _with_tokenizer(config, run, manifest, clip)
    net = build(config.model)
    params = net.init(jax.random.key(config.run.seed))
    if not steps(run / "checkpoints"):  # else only their shapes matter
        params = _first_params(params, config, init, clip, log)
    else:
        _same_start(run, log, init=init, clip=clip)
    _same_data(run, manifest)
    shard = (jax.process_index(), jax.process_count())
    loader = Loader(manifest, config, tokenizer=tokenizer, devices=mesh.size, shard=shard)
    for note in loader.notes:
        log(note)
    config = _warmed(config, run, loader)
    loss = objectives.stage1_loss if config.stage == 1 else objectives.stage2_loss
    with alone_in(run) if jax.process_index() == 0 else nullcontext():
        if jax.process_index() == 0 and tokenizer is not None and not steps(run / "checkpoints"):
            tokenizer.save(run / TOKENIZER)
        return fit(
            config,
            params=params,
            loss_fn=partial(loss, net=net, config=config),
            batches=loader.stream,
            run_dir=run,
            stop_after=stop_after,
            on_report=partial(_report, run=run, net=net, config=config),
            metadata=_describe(config, run, init, clip, manifest, loader),
            log=log,
            mesh=mesh,
        )


def _possible(config: Config) -> None:
    """Raise UserError for settings that this machine or this stage cannot follow, before anything is read."""
    model, objective = config.model, config.objective
    if model.attention == "cudnn" and jax.default_backend() != "gpu":
        raise UserError("--model.attention cudnn needs a GPU of NVIDIA; leave it out here")
    if model.attention == "cudnn" and model.dtype != "bfloat16":
        raise UserError("--model.attention cudnn computes in 16 bits: add --model.dtype bfloat16, or leave it out")
    if model.dtype == "float64" and not jax.config.read("jax_enable_x64"):
        raise UserError("--model.dtype float64 needs JAX_ENABLE_X64=1 in the environment, else jax computes in float32")
    if config.stage == 2 and config.optim.accumulate > 1 and (model.image or model.text):
        raise UserError(
            "--optim.accumulate must be 1 in stage 2 with photographs or captions, whose slots belong to rows of the "
            "whole batch; lower --batch instead"
        )
    if config.stage == 2 and objective.force:
        raise UserError("--objective.force is a loss of stage 1; leave it out in stage 2")
    if config.stage == 2 and objective.differences and not objective.reconstruct:
        raise UserError("--objective.differences needs --objective.reconstruct in stage 2, or leave it out")


def _warmed(config: Config, run: Path, loader: Loader) -> Config:
    """Warm-up of one epoch (appendix "Implementation details"), or a share of the run where that is less."""
    begun = begun_with(run)
    if config.optim.warmup is not None or (begun is not None and begun.optim.warmup is None):
        return config
    return replace(config, optim=replace(config.optim, warmup=min(loader.steps_per_epoch, config.warmup)))


def _same_stage(run: Path, config: Config) -> None:
    """Raise UserError for a file, and for a folder with a run of the other stage."""
    if run.is_file():
        raise UserError(f"{run} is a file, not a folder; choose another --run")
    begun = begun_with(run)
    if begun is not None and begun.stage != config.stage:
        raise UserError(f"{run} holds a run of stage {begun.stage}; choose another --run for stage {config.stage}")


def _same_data(run: Path, manifest: manifests.Manifest) -> None:
    """Raise UserError where a run is gone on with on other rows than it was begun with: it would not be the same."""
    with suppress(checkpoint.CheckpointError):  # nothing is trained yet
        before = checkpoint.read_metadata(run).get("data")
        if before not in (None, manifest.content_hash):
            raise UserError(
                f"the rows of the manifests have changed since {run} was begun; restore them, or begin another run "
                f"with --init {run}, whose touch encoder and decoder it starts from"
            )


def _same_start(run: Path, log: Log, **given: str | Path | None) -> None:
    """Say so where a run that goes on is given another `init` or `clip` than it had: they are not read again."""
    with suppress(checkpoint.CheckpointError):
        source = checkpoint.read_metadata(run).get("source") or {}
        for name, path in given.items():
            before = source.get(name)
            if path is not None and (before is None or Path(before).resolve() != Path(path).resolve()):
                told = f"from {before}" if before else f"without --{name}"
                log(f"{run} goes on and was begun {told}: {path} is not read")


def _describe(
    config: Config, run: Path, init: Any, clip: Any, manifest: manifests.Manifest, loader: Loader
) -> dict[str, Any]:
    """What a checkpoint says of itself beside its config; `seen`: the sensors that it, or `init`, was trained on."""
    seen: set[str] = set(loader.trained_sensors)
    source = {"init": None if init is None else str(init), "clip": None if clip is None else str(clip)}
    if steps(run / "checkpoints"):  # a run that goes on knows what it began from
        with suppress(checkpoint.CheckpointError):
            told = checkpoint.read_metadata(run)
            seen, source = seen | set(told.get("seen", ())), told.get("source", source)
    elif init is not None:
        seen |= _seen_by(Path(init))
    return {
        "sensors": list(config.model.sensors),
        "seen": [name for name in config.model.sensors if name in seen],
        "preprocessing": {
            "touch": {"size": config.model.image_size, "mean": IMAGENET_MEAN, "std": IMAGENET_STD, "channels": "RGB"},
            "image": {"size": config.model.image_size, "mean": CLIP_MEAN, "std": CLIP_STD, "channels": "RGB"},
        },
        "source": source,
        "data": manifest.content_hash,
    }


def _seen_by(before: Path) -> set[str]:
    """The sensors that a run or a weights file was trained on; the authors' own for a file that does not tell."""
    if not before.exists():
        return set()
    if before.is_dir() and not any(before.glob("*.pth")):
        with suppress(checkpoint.CheckpointError):  # nothing is trained yet
            return set(checkpoint.read_metadata(before).get("seen", ()))
        return set()
    told = release.read_metadata(_weights_file(before)).get(release.SEEN_KEY)
    return set(release.RELEASED if told is None else told.split(","))


def _with_tokenizer(config: Config, run: Path, manifest: Any, clip: Any) -> tuple[Config, Any]:
    """The tokenizer of stage 2: the run's own, the one asked for, CLIP's, or one trained on the captions."""
    if config.model.text is None:
        return config, None
    own = run / TOKENIZER
    if own.exists() and steps(run / "checkpoints"):  # else it is left from a start that failed
        tokenizer = texts.load_tokenizer(own)
    elif config.data.tokenizer is not None:
        tokenizer = texts.load_tokenizer(config.data.tokenizer)
    elif config.towers == "pretrained":
        tokenizer = texts.load_tokenizer(_beside(clip, TOKENIZER))
    else:
        rows = manifest.rows_of(config.data.split)
        captions = pools.training_captions(manifest, rows, aligned_text=config.data.aligned_text)
        if not captions:
            return config, None
        tokenizer = texts.train_tokenizer(captions, min(SCRATCH_VOCABULARY, config.model.text.vocab))
    if config.towers == "pretrained":
        return config, tokenizer
    text = replace(config.model.text, vocab=max(tokenizer.vocab_size, 2))
    return replace(config, model=replace(config.model, text=text)), tokenizer


def _beside(weights: Any, name: str) -> Path:
    if weights is None:
        raise UserError(_NO_CLIP)
    path = Path(weights)
    return (path if path.is_dir() else path.parent) / name


def _weights_file(path: Path) -> Path:
    """The weights in a folder as it is downloaded, or the file itself."""
    if not path.is_dir():
        return path
    for pattern in ("*.safetensors", "*.bin", "*.pth", "*.pt"):
        found = sorted(path.glob(pattern))
        if found:
            return found[0]
    raise UserError(f"no weights (*.safetensors, *.bin, *.pth) in {path}")


def _first_params(params: Params, config: Config, init: Any, clip: Any, log: Log) -> Params:
    """Fresh `params`, with CLIP's and those of `init` in their places (golden K_weight_loading_map)."""
    if config.towers == "pretrained" and clip is None:
        raise UserError(_NO_CLIP)
    fresh = set(params) - ({"image", "text"} if clip else set())
    first = None if init is None else _load(Path(init), config, log, fresh)
    weights = None if clip is None else _read_clip(_weights_file(Path(clip)), config, touch=init is None)
    if config.stage == 2 and init is None:
        log("stage 2 starts without a stage-1 run (--init): its touch encoder has seen no touch yet")
    return release.first_params(params, config.model, stage1=first, clip=weights)


def _read_clip(file: Path, config: Config, *, touch: bool) -> dict[str, np.ndarray]:
    """The arrays of CLIP weights, for the towers and, where asked for, the touch encoder."""
    fits.same_activation(file, release.told_activation(file), config)
    weights = release.read_weights(file)
    if release.detect_layout(weights) in ("clip", "openclip"):
        fits.same_towers(file, release.detect_model(weights), config, touch=touch)
    return weights


def _load(path: Path, config: Config, log: Log, parts: set[str]) -> Params:
    """Touch encoder and decoder of a run folder or of a weights file, its sensors in the order of the model's.

    Tells of other `parts` of the new model that it has too: they start anew.
    """
    if not path.exists():
        raise UserError(f"no run folder or weights file at {path}; train stage 1 first, or give another --init")
    if path.is_dir() and not any(path.glob("*.pth")):
        params, text, told = checkpoint.load_params(path)
        before = from_json(text)
        fits.same_size(path, before, config)
        fits.same_activation(path, before.model.activation, config)
        fits.same_form(path, before.model, config)
        params = release.served(params, before, told)
        stored, shown, seen = before.model.sensors, before.data.background, told.get("seen", ())
    else:
        file = _weights_file(path)
        fits.same_activation(file, release.told_activation(file), config)
        weights = release.read_weights(file)
        detected = release.model_of(file, weights)
        about = release.read_metadata(file)
        shown, known = about.get(release.BACKGROUND_KEY, "keep"), release.seen_by_file(about, detected)
        params, stored, seen = release.to_params(weights, detected), detected.sensors, known or ()
        if known is not None and "touch" in params:
            params |= {"touch": release.serve_unseen(params["touch"], detected, known, universal_drawn=True)}
        if "decoder" in params:  # else it is refused below
            guessed = release.MODEL_KEY not in about  # its heads are, where it does not tell
            fits.same_form(file, detected, config, fits.SHAPES if guessed else (*fits.SHAPES, *fits.UNSEEN))
    if "touch" not in params or "decoder" not in params:
        raise UserError(f"{path} holds no touch encoder and decoder; give a stage-1 run or the authors' weights")
    if shown != config.data.background:
        log(
            f"{path} was trained with --loader.background {shown}, this run with {config.data.background}: its "
            "encoder has never seen touches like these"
        )
    if lost := [name for name in stored if name in seen and name not in config.model.sensors]:
        kept = " ".join((*config.model.sensors, *lost))
        log(f"the tokens of {', '.join(lost)} in {path} are left behind; --model.sensors {kept} keeps them")
    if anew := sorted((parts & set(params)) - {"touch", "decoder"}):
        log(f"of {path} the touch encoder and the decoder are taken; {', '.join(anew)} start anew")
    if params["touch"]["position"].shape[0] != config.model.patches + 1:
        log(f"the positions of {path} are resized for pictures of {config.model.image_size} pixels")
        params = release.resized(params, config.model.patches)
    touch, wanted = params["touch"], config.model.sensors
    touch = touch | {"sensor_tokens": release.match_sensors(np.asarray(touch["sensor_tokens"]), stored, wanted)}
    if config.model.patch_encoder == "sensor" and touch["patch"]["kernel"].ndim == 4:
        touch |= {"patch": {"kernel": release.match_sensors(np.asarray(touch["patch"]["kernel"]), stored, wanted)}}
    return {"touch": touch, "decoder": params["decoder"]}


def _report(step: int, params: Params, batch: Any, *, run: Path, net: Net, config: Config) -> None:
    """Draw the first samples of the batch: reconstructions wherever the batch holds touches to reconstruct."""
    if isinstance(batch, Stage2Batch):
        batch = batch.align
        if batch is None or not config.objective.reconstruct:
            return
    clip, sensor = (np.asarray(jax.device_get(x[:6])) for x in (batch.clip, batch.sensor))
    params = {name: params[name] for name in ("touch", "decoder")}
    if jax.process_index():
        return
    image = figures.reconstruction_panels(params, clip, sensor, net=net, config=config)
    figures.write_png(run / "figures" / f"reconstruction_{step:06d}.png", image)
