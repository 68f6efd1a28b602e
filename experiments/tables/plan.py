"""The plan of the matrix: for each question of the paper its runs, as a graph of data, stage 1,
stage 2 and scores.

A `Training` is its configuration, its data and the training that it starts from; two that are equal
are one, so what can be shared is shared. Nothing here computes.

Data: `own` is the data set of each sensor by itself (touches of no other sensor). `fine` and
`coarse` are its TacQuad (four sensors at one place, by one motion or by hand), `other` a data set
never trained on, of other individuals (more than half of its kinds, primitive by texture by
material, occur in `own` as well). Objects held out are held out in `own`, `fine` and `coarse` alike
(`work.check_objects` refuses sizes at which they are not). `own` also has DuraGel, which no run
trains on: it is the unseen sensor, as Taxim and TACTO are in the paper.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

from anytouch_jax.config import UNIVERSAL, Config, Stack, preset, presets
from anytouch_jax.config.parsing import Count

# in the order in which Table 1 adds them
SENSORS = ("gelsight", "gelslim", "digit", "gelsight_mini")
UNSEEN = "duragel"
ALIGNED = ("fine", "coarse")
STACK = Stack(128, 2, 4, 512)
DECODER = Stack(128, 2, 4, 512)
LABELS = ("name", "seeds")  # fields of a size that no single run hangs on
# Versions of how a question is scored, 1 where it is not named. 2: contact frames are those with
# force.
SCORING = dict.fromkeys(("q1", "q3", "ablations"), 2)


@dataclass(frozen=True)
class Size:
    """How large everything is.

    Touches of each data set, objects, frames a touch, pixels; steps and batches; network.

    Preset tiny with less of everything that costs time and teaches nothing here, so that three
    seeds fit in the time: `image` pixels (36 patches instead of 64), `stack` of all three towers
    (in the same time it learns more than the preset's 192 x 6). Stage 1 is long enough to help:
    contrast after 150 steps of it is slower than from scratch.

    Towers from scratch learn nothing in minutes from matching one pair against one other, as the
    paper does on CLIP's weights. So `match_head` is "cosine", each touch against all others of the
    batch, on a fraction `match_keep` of the patches and weighed by `match_weight`, all of a step's
    touches to be found by one sensor (`negatives`), so that the sensor is no clue; only frames in
    contact are drawn, those with a fraction `contact` of the strongest of their recording
    (`anytouch data contact`), as the paper's are contact frames; a row of question q2 has the
    paper's head. The softmax starts mild (`temperature`): a sharp one only punishes untrained
    towers. Touches are background-subtracted, and their colours are not jittered, since colours
    show slopes. `seeds` are those of questions whose sign is claimed; the others take the first.
    """

    name: str = "full"
    own: Count[int] = 400
    fine: Count[int] = 300
    coarse: Count[int] = 400
    other: Count[int] = 300
    objects: Count[int] = 250
    frames: Count[int] = 10
    pixels: Count[int] = 96
    image: Count[int] = 84
    steps1: Count[int] = 400
    batch1: Count[int] = 48
    steps2: Count[int] = 260
    batch2: Count[int] = 64
    rate1: float = 1e-3
    rate2: float = 1e-3
    temperature: float = 0.2
    match_head: Literal["mlp", "cosine", "none"] = "cosine"
    match_weight: float = 4.0
    match_keep: float = 0.5
    negatives: Literal["any", "same_sensor"] = "same_sensor"
    contact: float = 0.6
    background: Literal["keep", "subtract"] = "subtract"
    seeds: tuple[int, ...] = (0, 1, 2)
    refits: Count[int] = 5
    max_rows: Count[int] = 1500
    embed: Count[int] = 128
    stack: Stack = STACK
    decoder: Stack = DECODER


FULL = Size()
QUICK = Size(
    "quick",
    own=48,
    fine=24,
    coarse=24,
    other=36,
    objects=24,
    pixels=64,
    image=56,
    steps1=6,
    batch1=16,
    steps2=4,
    batch2=8,
    seeds=(0,),
    refits=2,
    max_rows=300,
    embed=32,
    stack=Stack(32, 2, 2, 64),
    decoder=Stack(16, 1, 2, 32),
)


@dataclass(frozen=True)
class Scenes:
    """One simulated data set: a folder of that name."""

    name: str
    sensors: tuple[str, ...]
    touches: int
    grade: Literal["fine", "coarse"]
    seed: int
    held_out: float
    first: int = 0


@dataclass(frozen=True)
class Training:
    """One stage of one model.

    `config.data.manifests` are names (see `Work.manifest`), not files.
    """

    config: Config
    init: Training | None = None

    @cached_property
    def key(self) -> str:
        """The name of its run folder: equal trainings have equal keys, and others never."""
        text = repr(chosen(self.config)) + (self.init.key if self.init else "")
        digest = hashlib.sha256(text.encode()).hexdigest()[:10]
        return f"stage{self.config.stage}-seed{self.config.run.seed}-{digest}"

    @property
    def chain(self) -> tuple[Training, ...]:
        """What it starts from, and itself."""
        return (*(self.init.chain if self.init else ()), self)

    @property
    def manifests(self) -> tuple[str, ...]:
        """The names of what it and those before it learn from."""
        return tuple(sorted({name for one in self.chain for name in one.config.data.manifests}))


@dataclass(frozen=True)
class Leaf:
    """One run of a question: the model `name` with a seed, scored.

    What is scored hangs on the question alone.

    `model` None: nothing is trained. `tower`: the image tower of `model` serves as touch encoder.
    """

    question: str
    name: str
    seed: int
    model: Training | None
    size: Size
    tower: bool = False

    @property
    def key(self) -> str:
        """The name of its record in the file of results."""
        return f"{self.question}-{self.name}-{self.seed}"

    @property
    def trainings(self) -> tuple[Training, ...]:
        """In the order in which they must be done."""
        if self.model:
            return self.model.chain
        return ()

    @cached_property
    def identity(self) -> str:
        """What its result hangs on; a JSON with another identity is not this run's."""
        about = (self.question, self.name, self.seed, self.tower, simulator(), settings(self.size))
        parts = [repr(about), *(one.key for one in self.trainings)]
        parts += [f"scoring {scoring(self.question)}"] if self.question in SCORING else []
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def scoring(question: str) -> int:
    """The version of how a question's runs are scored."""
    return SCORING.get(question, 1)


def simulator() -> int:
    """The version of the simulator: what a seed gives hangs on it.

    Imported late, since it brings jax.
    """
    from anytouch_jax.sim.dataset import VERSION

    return VERSION


def settings(size: Size) -> dict[str, Any]:
    """What runs of one table must share: a size without its name and its seeds."""
    return {name: value for name, value in dataclasses.asdict(size).items() if name not in LABELS}


def chosen(config: Any) -> Any:
    """The settings of a configuration that are not the default: a later version's new default is no
    other training.
    """
    if not dataclasses.is_dataclass(config):
        return config
    fields = {
        field.name: (getattr(config, field.name), field) for field in dataclasses.fields(config)
    }
    return {
        name: chosen(value) for name, (value, field) in fields.items() if value != field.default
    }


def scenes(size: Size) -> tuple[Scenes, ...]:
    """The simulated data sets.

    All but `other` share their objects and which of them are held out.
    """
    return (
        Scenes("own", (*SENSORS, UNSEEN), size.own, "fine", 0, 0.25),
        Scenes("fine", SENSORS, size.fine, "fine", 0, 0.25, first=size.own),
        Scenes("coarse", SENSORS, size.coarse, "coarse", 0, 0.25),
        Scenes("other", (SENSORS[0], UNSEEN), size.other, "fine", 1, 0.5),
    )


def training(
    size: Size, recipe: str, seed: int, *, sensors: Sequence[str] = SENSORS, aligned: bool = True
) -> Training:
    """Return the last stage of a recipe (`anytouch_jax.config.presets`) on the data of `sensors`.

    `aligned` adds the touches that several sensors share.
    """
    manifests = (*(f"own/{name}" for name in sensors), *(ALIGNED if aligned else ()))
    last: Training | None = None
    for stage in presets.find_baseline(recipe).stages:
        config = _config(size, stage, seed, sensors, manifests)
        last = Training(presets.apply_baseline(recipe, config), last)
    if last is None:
        raise ValueError(f"{recipe} is not trained")
    return last


def _config(
    size: Size, stage: Any, seed: int, sensors: Sequence[str], manifests: tuple[str, ...]
) -> Config:
    config = preset("tiny", stage=stage)
    steps, batch, rate = (
        (size.steps1, size.batch1, size.rate1)
        if stage == 1
        else (size.steps2, size.batch2, size.rate2)
    )
    model = replace(
        config.model,
        sensors=(*sensors, UNIVERSAL),
        image_size=size.image,
        embed=size.embed,
        touch=size.stack,
        decoder=size.decoder,
    )
    objective = config.objective
    if stage == 2:
        text = model.text and replace(model.text, stack=size.stack)
        model = replace(
            model,
            text=text,
            image=size.stack,
            temperature=size.temperature,
            match_head=size.match_head,
        )
        objective = replace(objective, match_weight=size.match_weight, match_keep=size.match_keep)
    data = replace(
        config.data,
        manifests=manifests,
        batch_size=batch,
        background=size.background,
        jitter=(0, 0, 0, 0),
        contact_only=True,
        negatives=size.negatives if stage == 2 else "any",
    )
    return replace(
        config,
        model=model,
        objective=objective,
        data=data,
        optim=replace(config.optim, learning_rate=rate),
        run=replace(config.run, seed=seed, steps=steps, save_every=100, keep=1, figure_every=0),
    )


def leaves(size: Size) -> list[Leaf]:
    """Every run of the matrix, in order: all questions with one seed, then with the next."""
    return [
        Leaf(question, name, seed, model, size, tower)
        for number, seed in enumerate(size.seeds)
        for question, name, model, tower in _of_seed(size, seed, first=number == 0)
    ]


def _of_seed(
    size: Size, seed: int, *, first: bool
) -> Iterator[tuple[str, str, Training | None, bool]]:
    """(question, name, model, tower) of one seed; what makes no claim is run with the first seed
    alone.
    """

    def own(recipe: str, **settings: Any) -> Training:
        return training(size, recipe, seed, **settings)

    whole = own("anytouch")
    for name, recipe in (
        ("masked", "no_stage2"),
        ("aligned", "no_matching"),
        ("matched", "anytouch"),
    ):
        yield "q2", name, own(recipe), False
    for name in ("unitouch", "tlv_link", "t3", "static_only", "anytouch"):
        yield "q3", name, own(name), False
    yield "q3", "no_pretraining", whole, True
    for question in ("q2", "q3"):
        yield question, "untrained", None, False
        if first:
            yield question, "pixels", None, False  # no seed of theirs
            if question == "q2":
                yield question, "contact", None, False
    for name in ("anytouch", *ABLATIONS):
        yield "ablations", name, own(name), False
    yield "q1", "no_pretraining", whole, True
    for count in range(1, len(SENSORS) + 1):
        name = "+".join(SENSORS[:count])
        yield "q1", name, own("no_matching", sensors=SENSORS[:count], aligned=False), False
    if first:
        # the paper's
        paired = replace(size, match_head="mlp", match_weight=1.0, match_keep=1.0, negatives="any")
        yield "q2", "matched_mlp", training(paired, "anytouch", seed), False


ABLATIONS = (
    "no_text",
    "no_vision",
    "no_text_aligned",
    "no_stage1",
    "no_stage2",
    "no_matching",
    "no_dynamic",
    "no_universal",
)
