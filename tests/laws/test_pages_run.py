"""Every command and every Python block of the README and the pages runs, in page order, and prints
what is shown.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import signal
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from blank_recorder import BlankRecorder
from chat_server import KEY, serve
from gel_images import press
from places import ROOT
from reader_world import fill_ycb
from runs import SIZES
from tiny_models import tiny_config
from touch_world import make_touches, render, tint

import anytouch_jax as at
from anytouch_jax.cli.app import main
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.live import stream as streams
from anytouch_jax.live.stream import Mailbox
from anytouch_jax.sim import dataset
from anytouch_jax.sim.sensing.sensors import SENSORS, bases
from tests.datasets.readers import test_bags, test_containers, test_corpora, test_lerobot
from tests.evaluate.test_probing import MAKERS, paint
from tests.laws.test_readme import PAGES

pytestmark = pytest.mark.slow
PART = re.compile(
    r"^```(python|text)\n(.*?)^```$|^ {4}(anytouch [^\n]*)$|^\|[^\n]*?`(anytouch [^`\n]*)`",
    re.MULTILINE | re.DOTALL,
)
# What a page writes for a large machine or for addresses in a network, and what is typed here.
HERE = {
    "--steps 3000": "--steps 2",
    "--steps 600": "--steps 2",
    "--batch 4096 --data.parts 64": "--batch 4 --data.parts 2",
    "hf://datasets/yxma/gelsight-mini-pretrain": "memory://far",
    "s3://bucket/touches": "memory://tars",
    "verify FILE": "verify manifest.parquet",
    "only OUT": "only free.parquet",
    "tacquad.parquet": "tacquad.parquet --yes",
    "observation.images.tactile ": f"{test_lerobot.VIDEO} ",
    "--out report": "--out report --touches 40",
    " ...": "",
    "info FILE": "info runs/stage1",
}
# Two need files of the size of ViT-L or ViT-B: tests of weights and of `train --init` run them with
# small ones. The viewer serves until it is stopped: it has tests that stop it. So has a user's own
# sensor.
ELSEWHERE = ("--preset large", "--preset base", "anytouch view", "mine.sensor", "--sensor mine ")
# Numbers that no two runs share: times, rates, and the last digits of a float32.
FREE = re.compile(
    r"(?<=\"time\": )[\d.]+|[\d.]+(?= (?:samples|frames)/s)|[\d.e-]+(?= of the largest feature)"
    r"|(?<=^decode )[\d. ]+$|(?<=^resize )[\d. ]+$|(?<=^copy )[\d. ]+$|(?<=^encoder )[\d. ]+$"
    r"|(?<=^frame to features )[\d. ]+$|\d+(?= frames embedded)"
)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?")
STAGE1 = {name: value for name, value in SIZES.items() if "clip-fraction" not in name} | {
    "batch": 8,
    "data.threads": 1,
}
STAGE2 = (
    STAGE1
    | {
        f"model.{tower}.{name}": value
        for tower in ("image", "text.stack")
        for name, value in {"width": 16, "depth": 1, "heads": 2, "mlp": 32}.items()
    }
    | {"model.text.vocab": 2048, "model.text.length": 8}
)


def small(words: list[str]) -> list[str]:
    """Return the words of a command, with sizes that compile fast if it trains."""
    if words[0] == "finetune":
        # Time for the linear head and a few steps.
        return [
            *words[: words.index("--minutes")],
            "--minutes",
            "0.3",
            *words[words.index("--minutes") + 2 :],
        ]
    if words[0] != "train" or "runs/try" in words:  # that one is typed word for word
        return words
    stage = STAGE2 if words[words.index("--stage") + 1] == "2" else STAGE1
    sizes = {name: value for name, value in stage.items() if f"--{name}" not in words}
    if "--steps" not in words:
        sizes["steps"] = 2
    return [*words, *(str(word) for name, value in sizes.items() for word in (f"--{name}", value))]


def run(line: str) -> str:
    """Run a command of a page in this process, and return what it prints."""
    for shown, typed in HERE.items():
        line = line.replace(shown, typed)
    line = line.partition(" | ")[0]  # the other program is the user's
    words = small(
        [str(Path(word).expanduser()) if "~" in word else word for word in shlex.split(line)[1:]]
    )
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main(words)
    # 1: a fault is found
    assert status == 0 or (status == 1 and "--health" in words), f"{line}\n{printed.getvalue()}"
    return re.sub(
        r"(?<=\"features\": )\[[^]]*\]", "[...]", printed.getvalue().replace(f"{Path.cwd()}/", "")
    )


def make_recordings(file: Path) -> None:
    """Three objects of different textures, pressed ever deeper by two sensors, twelve times
    each.
    """
    rng = np.random.default_rng(0)
    rows = []
    for thing in ("coin", "cup", "key"):
        texture = rng.uniform(-1, 1, (8, 8))
        for number in range(12):
            place = rng.uniform(-1, 1, 2)
            split = "train" if number < 7 else "val" if number < 9 else "test"
            for sensor in ("digit", "gelsight"):
                for frame in range(4):
                    pixels = render(
                        texture, place, 2 + 2 * frame, tint(("digit", "gelsight"), sensor), 32
                    )
                    path = f"{thing}{number}_{sensor}_{frame}.png"
                    cv2.imwrite(path, pixels + rng.integers(0, 5, pixels.shape, np.uint8))
                    name = f"{thing} {number}"
                    rows.append(
                        (
                            path,
                            sensor,
                            f"{name} {sensor}",
                            frame,
                            split,
                            name,
                            thing,
                            f"{sensor}.png",
                        )
                    )
    names = (
        "path",
        "sensor",
        "sequence",
        "frame_index",
        "split",
        "touch",
        "object",
        "background_path",
    )
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    manifests.write(manifests.from_columns(columns, file), file)


def make_units(folder: Path) -> None:
    """Two DIGIT, pressed at changing places: the right one upright, the left one upside down."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    rows = []
    (y, x) = np.mgrid[:160, :120]
    looks = bases(SENSORS["digit"])
    for unit, look in (("left", looks[0]), ("right", looks[1])):
        gel = cv2.resize(255 * look[..., ::-1], (120, 160))  # OpenCV writes BGR
        for recording in range(9):
            cy, cx = rng.uniform((30, 30), (130, 90))
            dent = np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 160)[..., None] * (60, -40, 30)
            for frame in range(6):
                pixels = np.clip(
                    gel + frame / 5 * dent + rng.normal(0, 1.5, gel.shape), 0, 255
                ).astype(np.uint8)
                file = f"{unit}_{recording}_{frame}.png"
                cv2.imwrite(str(folder / file), pixels[::-1, ::-1] if unit == "left" else pixels)
                rows.append(
                    (file, "digit", f"{unit} {recording}", frame, "train", unit, f"{unit}.png")
                )
        pixels = np.clip(gel, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{unit}.png"), pixels[::-1, ::-1] if unit == "left" else pixels)
    names = ("path", "sensor", "sequence", "frame_index", "split", "unit", "background_path")
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    manifests.write(
        manifests.from_columns(columns, folder / "manifest.parquet"), folder / "manifest.parquet"
    )


class Camera:
    """A camera that sees the frames of some touches. Then the program is stopped."""

    def __init__(self) -> None:
        self.frames = [
            cv2.imread(f"cup{touch}_digit_{frame}.png") for touch in range(10) for frame in range(4)
        ]
        self.count = 0

    def grab(self) -> bool:
        if self.count == len(self.frames):
            time.sleep(0.5)  # the last frame is taken
            signal.pthread_kill(threading.main_thread().ident, signal.SIGTERM)
            time.sleep(0.5)
            return False
        self.count += 1
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, self.frames[self.count - 1]

    def release(self) -> None:
        pass


@pytest.fixture(scope="module", autouse=True)
def optimised() -> Any:
    """Encoders of full size run here: ten times faster with the optimisations that conftest.py
    turns off.
    """
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the pages name."""
    folder = tmp_path_factory.mktemp("base")
    rng = np.random.default_rng(0)
    with contextlib.chdir(folder):
        make_touches(
            folder,
            touches={"train": 12, "val": 10, "test": 51},
            sensors=("digit", "gelsight"),
            frames=4,
        )
        columns: dict[str, Any] = manifests.read("manifest.parquet").table.to_pydict()
        count = len(columns["path"])
        columns["label.material"] = [
            ("steel", "wool")[one == "hard"] for one in columns["label.hardness"]
        ]
        columns["label.roughness"] = columns["label.slip"] = [
            float(one > 3) for one in columns["label.force"]
        ]
        columns["license"] = ["MIT"] * count
        for name in ("manifest.parquet", "manifest.csv", "mine.parquet"):
            manifests.write(manifests.from_columns(columns, Path(name)), Path(name))
        make_recordings(Path("recordings.parquet"))
        columns["sensor"] = ["my_gel" if one == "digit" else one for one in columns["sensor"]]
        manifests.write(manifests.from_columns(columns, Path("mine.csv")), Path("mine.csv"))
        tac = {
            name: values[:8] for name, values in columns.items() if name not in ("text", "object")
        }
        tac |= {
            "sensor": ["gelsight"] * 8,
            "image_path": ["photo.png"] * 8,
            "dataset": ["tacquad"] * 8,
        }
        manifests.write(
            manifests.from_columns(tac, Path("tacquad.parquet")), Path("tacquad.parquet")
        )
        for place in (f"mine/{thing}/pour_{i}" for thing in ("mug", "sponge") for i in (1, 2, 3)):
            Path(place).mkdir(parents=True)
            # no two images are equal
            for i in range(4):
                pixels = press(20 * i % 120) // 2 + rng.integers(0, 9, (48, 48, 3), np.uint8)
                cv2.imwrite(f"{place}/{i:03d}.png", pixels)
        for parent in "classes/a", "classes/b", "data/train/a", "data/valid/a", "data/Test_Set/b":
            Path(parent).mkdir(parents=True)
            for i in range(8):
                cv2.imwrite(f"{parent}/p{i}_0.png", rng.integers(0, 255, (48, 48, 3), np.uint8))
        for name in ("mine/mug/background", "mine/sponge/background"):
            cv2.imwrite(f"{name}.png", press(0) // 2)
        for folder_of, sensor in (("frames", "digit"), ("trust", "gelsight")):
            Path(folder_of).mkdir()
            for i in range(24):
                shutil.copy(f"cup{i // 4}_{sensor}_{i % 4}.png", f"{folder_of}/{i:03d}.png")
        shutil.copy("digit.png", "gel.png")
        video = cv2.VideoWriter(
            "press.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 25, cv2.imread("gel.png").shape[1::-1]
        )
        for i in range(4):
            video.write(cv2.imread(f"cup0_digit_{i}.png"))
        video.release()
        shutil.copy("test0_digit_3.png", "press.png")
        make_units(Path("units"))
        golden = ROOT / "tests" / "parity" / "golden_others"
        shutil.copy(golden / "sparsh_vjepa_learned.safetensors", "sparsh_vjepa.safetensors")
        shutil.copy(golden / "anytouch2_checkpoint-4frames.pth", "anytouch2.pth")
        shutil.copytree(golden / "dinov2_registers_hf", "dinov2")
        Path("labels.csv").write_text("object,material,hardness\nmug,ceramic,9\nsponge,foam,2\n")
        Path("notes.md").write_text("Trained on made touches.\n")
        test_lerobot.make(Path("my_data_set"))
        test_containers.make_robomimic(Path("demo.hdf5"))
        test_containers.make_replay(Path("replay.zarr"))
        Path("recordings").mkdir()
        test_bags.write_ros(Path("recordings"), 2)
        fill_ycb(Path("home/data/YCB-Slide"))
        paint(Path("home/data/YCB-Slide"))
        Path("corpus").mkdir()
        MAKERS["touch_and_go"][0](Path("tag"))
        paint(Path("tag"))
        run("anytouch data index touch_and_go tag")
        shutil.copytree("tag", ".", dirs_exist_ok=True)
        shutil.move("touch_and_go.parquet", "tag.parquet")
        run("anytouch data index recordings mine --sensor digit")
        run("anytouch train --stage 1 --data manifest.parquet --run runs/stage1")
        run("anytouch train --stage 2 --data manifest.parquet --run runs/stage2 --init runs/stage1")
        run("anytouch embed --data manifest.parquet --out mine.npz")
        run(
            "anytouch probe label --data recordings.parquet --label object --save "
            "recordings/head.npz"
        )
    return folder


@pytest.fixture
def place(base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The current folder: a copy of `base`, with shards in an object store, a server for captions
    and no physics.
    """
    import fsspec

    folder = tmp_path / "here"
    shutil.copytree(base, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(folder / "home"))
    monkeypatch.setenv("ANYTOUCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setattr(dataset, "Recorder", BlankRecorder)
    monkeypatch.setattr(streams, "open_source", lambda *_: (Camera(), True))
    # the encoder keeps up
    monkeypatch.setattr(streams, "Mailbox", lambda replace: Mailbox(replace=False))
    test_corpora.write_corpus(
        tmp_path / "far", "gelslam", "train", [{"capture": "a", "frame_idx": 0, "value": 1}]
    )
    for number in range(4):
        samples = {f"{number}-{i}": (i, {"contact": i}) for i in range(4)}
        test_corpora.write_tar(tmp_path / "tars" / "train" / f"{number}.tar", samples)
    system = fsspec.filesystem("memory")
    for name in ("far", "tars"):
        system.put(str(tmp_path / name), f"/{name}", recursive=True)
    with serve() as server:
        monkeypatch.setitem(HERE, "--limit 20", f"--limit 2 --url {server.url}")
        yield folder
    for name in ("far", "tars"):
        system.rm(f"/{name}", recursive=True)


def line_of(text: str) -> str:
    """Return a line with single spaces. What no two runs share is left out."""
    return FREE.sub("#", " ".join(text.split()))


def is_equal(shown: str, printed: str) -> bool:
    """Whether two lines agree. A number with decimals may differ by one in its last shown digit."""
    a = line_of(shown)
    b = line_of(printed)
    pairs = [*zip(NUMBER.findall(a), NUMBER.findall(b), strict=False)]
    return NUMBER.sub("0", a) == NUMBER.sub("0", b) and all(
        x == y or ("." in x and abs(float(x) - float(y)) < 1.01 * 10.0 ** -len(x.partition(".")[2]))
        for x, y in pairs
    )


def missing(block: str, printed: str) -> list[str]:
    """Return the lines of a block that were not printed one below the other.

    A line of dots leaves some out.

    A list of files that are there is fine too.
    """
    if all(Path(line).is_file() for line in block.splitlines()):
        return []
    lines = printed.splitlines()
    start = 0
    lost = list[str]()
    for part in re.split(r"^\.\.\.\n", block, flags=re.MULTILINE):
        wanted = part.splitlines()
        ends = [
            at + len(wanted)
            for at in range(start, len(lines) - len(wanted) + 1)
            if all(map(is_equal, wanted, lines[at : at + len(wanted)]))
        ]
        start = ends[0] if ends else start
        lost += [] if ends else wanted
    return lost


def measured(block: str, printed: str) -> str:
    """Return a block whose numbers are those of the printed lines of the same form."""
    lines = printed.splitlines()

    def form(line: str) -> str:
        return NUMBER.sub("0", line_of(line))

    pairs = [
        (line, next((one for one in lines if form(one) == form(line)), line))
        for line in block.splitlines()
    ]
    return "".join(f"{line if is_equal(line, one) else one}\n" for line, one in pairs)


NAMES = [name for name, text in PAGES.items() if PART.search(text)]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_page_runs_and_prints_what_it_shows(
    name: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With WRITE_PAGES=1 the numbers of the page become those that are printed."""
    if "health" in name:
        shutil.copytree("units", ".", dirs_exist_ok=True)
    if "trust" in name:  # the user names the wrong sensor
        shutil.copytree("trust", "frames", dirs_exist_ok=True)
    if "families" in name:
        Path("config.json").write_text('{"num_attention_heads": 3}')
    if "equations" in name:  # the same step on a network that compiles fast
        monkeypatch.setattr("anytouch_jax.config.preset", lambda *_, **__: tiny_config(1))
    names: dict[str, Any] = {
        "rows": np.zeros(2, np.int32),
        "manifest": manifests.read("manifest.parquet"),
    }
    names["clips"] = np.zeros((2, 4, 28, 28, 3), np.uint8)
    names["frames"] = np.zeros(
        (2, 3, 112, 112, 3) if "export" in name else (2, 112, 112, 3), np.uint8
    )
    text = PAGES[name]
    earlier = ""
    printed = ""
    problems = []
    is_shown = False
    for match in PART.finditer(PAGES[name]):
        kind, block, *lines = match.groups()
        if kind == "text":
            wanted = re.sub(r",\n +", ", ", block)  # a line of JSON on two
            if lost := missing(wanted, printed):
                problems += lost
                text = text.replace(block, measured(wanted, printed), 1)
            is_shown = True
            continue
        if is_shown:  # blocks show what was printed since the blocks before
            earlier = earlier + printed
            printed = ""
            is_shown = False
        if kind == "python":
            if "encoder." in block and "encoder =" not in block:
                names["encoder"] = at.load_encoder("anytouch-tiny")
            with contextlib.redirect_stdout(out := io.StringIO()):
                exec(block, names)
            printed += out.getvalue()
        elif (
            not any(size in (line := next(filter(None, lines), "")) for size in ELSEWHERE) and line
        ):
            if "--run" in line:
                shutil.rmtree(re.search(r"--run (\S+)", line)[1], ignore_errors=True)
            printed += run(line)
    if os.environ.get("WRITE_PAGES"):
        (ROOT / name).write_text(text)
    else:
        assert not problems, f"{name} shows\n{problems}\nand the page printed\n{earlier + printed}"


def test_scripts_and_modules_that_are_named_are_there() -> None:
    """They have tests of their own. Pages, the Makefile and the scripts themselves name them."""
    paths = [
        ROOT / "Makefile",
        *(ROOT / "experiments").rglob("*.md"),
        *(ROOT / "experiments").rglob("*.py"),
    ]
    text = "\n".join([*PAGES.values(), *(path.read_text() for path in paths)])
    scripts = set(re.findall(r"python (integrations/\S+\.py)", text))
    modules = set(re.findall(r" -m ((?:experiments|tests)\.[\w.]*\w)", text))
    assert len(scripts) > 1
    assert len(modules) > 30
    for script in scripts:
        assert (ROOT / script).is_file(), script
    for module in modules:
        path = ROOT / module.replace(".", "/")
        runs = path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()
        assert runs, f"nothing runs as python -m {module}"
