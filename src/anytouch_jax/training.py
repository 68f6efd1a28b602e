"""Pre-training runs: config, data, network, first parameters and loss, put together for
`train.loop.fit`.
"""

import sys
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from anytouch_jax import objectives
from anytouch_jax.batch import Stage2Batch
from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.data.images import encode
from anytouch_jax.data.loading import pools
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.tokenizer import load_tokenizer
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.evaluate import reconstruction
from anytouch_jax.files import atomic_write
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.sim import batches as simulated
from anytouch_jax.sim.batches import SIMULATED, SimulatedLoader
from anytouch_jax.train.loop import FitResult, fit
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.train.progress import alone_in, begun_with, silent
from anytouch_jax.weights.checkpoint import CheckpointError, read_metadata, steps
from anytouch_jax.weights.start import load_start

Params = dict[str, Any]
Log = Callable[[str], None]
SCRATCH_VOCABULARY = 2048
TOKENIZER = "tokenizer.json"
CHECKPOINTS = "checkpoints"


def pretrain(
    config: Config,
    run: str | Path,
    *,
    init: str | Path | None = None,
    clip: str | Path | None = None,
    stop_after: int | None = None,
    log: Log = print,
    mesh: Mesh | None = None,
    curve: bool = False,
    until: float | None = None,
) -> FitResult:
    """Train stage 1 or stage 2 in the folder `run`, or resume it (Sec. 3.6).

    `init` is a stage-1 run or AnyTouch weights that stage 2 starts from, or weights for the touch
    encoder of stage 1 (see `load_start`). `clip` is CLIP weights for the towers, and for the touch
    encoder of stage 1. A resumed run reads neither. `mesh` is the devices to train on. `curve` and
    `until` are as in `fit`. Raises UserError for a mistake in the settings, the data or the folder.
    """
    refuse_forked()
    run, mesh = Path(run), mesh or make_mesh(fsdp=config.run.fsdp)
    # every process reads other samples
    report = log
    log = log if jax.process_index() == 0 else silent
    resumes = bool(steps(run / CHECKPOINTS))
    _check(config, run, init, clip, resumes)
    real = tuple(name for name in config.data.manifests if name != SIMULATED)
    simulates = len(real) < len(config.data.manifests)
    if simulates and jax.process_count() > 1:
        raise UserError("--data simulated is for one process; leave it out, or start one process")
    manifest = manifests.read(real) if real or not simulates else None
    config, tokenizer = _choose_tokenizer(config, run, manifest, clip, resumes, simulates)
    net = build(config.model)
    params = net.init(jax.random.key(config.run.seed))
    stored = dict[str, Any]()
    sensors = tuple[str, ...]()
    notes = list[str]()
    if resumes:  # only the shapes of `params` matter
        # `fit` reports a damaged checkpoint
        with suppress(CheckpointError):
            stored = read_metadata(run)
        _check_resume(run, manifest, stored, log, init=init, clip=clip)
    else:
        params, notes, sensors = load_start(params, config, init=init, clip=clip)
    shard = (jax.process_index(), jax.process_count())
    loader: Loader | SimulatedLoader
    if simulates:
        loader = SimulatedLoader(config, manifest, tokenizer=tokenizer, devices=mesh.size, log=log)
    else:
        assert manifest is not None
        loader = Loader(
            manifest, config, tokenizer=tokenizer, devices=mesh.size, shard=shard, log=report
        )
    for note in (*notes, *loader.notes):
        log(note)
    config = _with_warmup(config, run, loader)
    trained = {*loader.trained_sensors, *sensors, *stored.get("seen", ())}
    metadata = {
        "sensors": list(config.model.sensors),
        "seen": [name for name in config.model.sensors if name in trained],
        "preprocessing": {
            "touch": {
                "size": config.model.image_size,
                "mean": IMAGENET_MEAN,
                "std": IMAGENET_STD,
                "channels": "RGB",
            },
            "image": {
                "size": config.model.image_size,
                "mean": CLIP_MEAN,
                "std": CLIP_STD,
                "channels": "RGB",
            },
        },
        "source": stored.get("source", {"init": init and str(init), "clip": clip and str(clip)}),
        "data": _content(manifest),
    }
    loss = objectives.stage1_loss if config.stage == 1 else objectives.stage2_loss
    with alone_in(run) if jax.process_index() == 0 else nullcontext():
        if jax.process_index() == 0 and tokenizer is not None and not resumes:
            tokenizer.save(run / TOKENIZER)
        return fit(
            config,
            params=params,
            loss_fn=partial(loss, net=net, config=config),
            batches=loader.stream,
            run_dir=run,
            trained=partial(objectives.trained_by, config=config),
            stop_after=stop_after,
            metadata=metadata,
            on_report=partial(_draw_reconstructions, run=run, net=net, config=config),
            log=log,
            mesh=mesh,
            curve=curve,
            until=until,
            examples=getattr(loader, "examples", ()),
        )


def _check(config: Config, run: Path, init: Any, clip: Any, resumes: bool) -> None:
    """Raise UserError for settings that this machine or this stage cannot follow, and for missing
    weights.
    """
    model = config.model
    has_x64 = jax.config.read("jax_enable_x64")
    cudnn = model.attention == "cudnn"
    float64 = model.dtype == "float64"
    wide = model.dtype != "bfloat16"
    lacks_x64 = float64 and not has_x64
    linear = model.match_head == "linear" and config.recipe == "paper"
    twice = init is not None and clip is not None
    slots = config.stage == 2 and bool(model.image or model.text)
    has_tokenizer = model.text is None or (run / TOKENIZER).exists()
    lacks_clip = config.towers == "pretrained" and clip is None and not (resumes and has_tokenizer)
    wrong = {
        "--model.attention cudnn needs a GPU of NVIDIA; leave it out here": cudnn
        and jax.default_backend() != "gpu",
        "--model.attention cudnn computes in 16 bits: add --model.dtype bfloat16, or leave it out": cudnn
        and wide,
        "--model.dtype float64 needs JAX_ENABLE_X64=1 in the environment, else jax computes in float32": lacks_x64,
        "JAX_ENABLE_X64 is set, which changes the random numbers and the checkpoints of a run: "
        "unset it, or add "
        "--model.dtype float64": has_x64 and not float64,
        "--optim.accumulate must be 1 in stage 2 with photographs or captions, whose slots belong "
        "to rows of the "
        "whole batch; lower --batch instead": slots and config.optim.accumulate > 1,
        "--model.match-head linear is the head of the release; add --recipe release, or choose mlp": linear,
        "--init and --clip-weights both give stage 1 its touch encoder; leave one out": config.stage
        == 1
        and twice,
        f"{run} is a file, not a folder; choose another --run": run.is_file(),
        "--towers pretrained needs CLIP weights: add --clip-weights <folder or file>, with "
        "tokenizer.json in the same "
        "folder": lacks_clip,
    }
    if sentences := [sentence for sentence, is_so in wrong.items() if is_so]:
        raise UserError(sentences[0])
    if (earlier := begun_with(run)) is not None and earlier.stage != config.stage:
        raise UserError(
            f"{run} has a run of stage {earlier.stage}; choose another --run for stage "
            f"{config.stage}"
        )


def _content(manifest: manifests.Manifest | None) -> str:
    """Return the hash of the rows that a run reads."""
    if manifest is None:
        return SIMULATED
    return manifest.content_hash


def _check_resume(
    run: Path,
    manifest: manifests.Manifest | None,
    stored: Mapping[str, Any],
    log: Log,
    **paths: str | Path | None,
) -> None:
    """Raise UserError if a run resumes on other rows; log weights that differ from those that it
    started from.
    """
    if stored.get("data") not in (None, _content(manifest)):
        raise UserError(
            f"the rows of the manifests have changed since {run} was started; restore them, or "
            "start another run "
            f"with --init {run}, whose touch encoder and decoder it starts from"
        )
    source = stored.get("source") or {}
    for name, path in paths.items():
        before = source.get(name)
        if (
            stored
            and path is not None
            and (before is None or Path(before).resolve() != Path(path).resolve())
        ):
            option = "--clip-weights" if name == "clip" else "--init"
            log(
                f"{run} resumes and was started with {option} {before or '(nothing)'}: {path} is "
                "not read"
            )


def _with_warmup(config: Config, run: Path, loader: Loader | SimulatedLoader) -> Config:
    """Return the config with a warm-up of one epoch (appendix "Implementation details"), or less in
    a short run.
    """
    earlier = begun_with(run)
    if config.optim.warmup is not None or (earlier is not None and earlier.optim.warmup is None):
        return config
    return config.with_settings({"optim.warmup": min(loader.steps_per_epoch, config.warmup)})


def _choose_tokenizer(
    config: Config, run: Path, manifest: Any, clip: Any, resumes: bool, simulates: bool
) -> tuple[Config, Any]:
    """Return the config and the tokenizer of stage 2: the run's, the option's, CLIP's, or one
    trained on captions.
    """
    if config.model.text is None:
        return config, None
    file = None
    if (
        resumes and (run / TOKENIZER).exists()
    ):  # without a checkpoint it is left from a start that failed
        file = run / TOKENIZER
    elif config.data.tokenizer is None and config.towers == "pretrained":
        file = (Path(clip) if Path(clip).is_dir() else Path(clip).parent) / TOKENIZER
    if simulates:
        own = (
            simulated.caption_tokenizer(config, manifest) if file is None else load_tokenizer(file)
        )
        if config.towers == "pretrained":
            return config, own
        return config.with_settings(
            {"model.text": replace(config.model.text, vocab=own.vocab_size)}
        ), own
    rows = manifest.rows_of(config.data.split)
    most = min(SCRATCH_VOCABULARY, config.model.text.vocab)
    tokenizer, _ = pools.choose_tokenizer(manifest, rows, config, file=file, vocabulary=most)
    if tokenizer is None or config.towers == "pretrained":
        return config, tokenizer
    text = replace(config.model.text, vocab=max(tokenizer.vocab_size, 2))
    return config.with_settings({"model.text": text}), tokenizer


def _draw_reconstructions(
    step: int, params: Params, batch: Any, *, run: Path, net: Net, config: Config
) -> None:
    """Draw the first samples of a batch that has touches to reconstruct."""
    if isinstance(batch, Stage2Batch):
        batch = batch.align
        if batch is None or not config.reconstructs:
            return
    clip, sensor = (np.asarray(jax.device_get(x[:6])) for x in (batch.clip, batch.sensor))
    params = {name: params[name] for name in ("touch", "decoder")}
    if jax.process_index():
        return
    image = reconstruction.reconstruction_panels(params, clip, sensor, net=net, config=config)
    atomic_write(run / "figures" / f"reconstruction_{step:06d}.png", encode(image))


class _Callable(ModuleType):
    """A module that is called as its function: an import of this module hides the public name
    `at.pretrain`.
    """

    def __call__(self, *args: Any, **options: Any) -> FitResult:
        return pretrain(*args, **options)


sys.modules[__name__].__class__ = _Callable
