"""Every command and every Python block of the README and the pages runs, in page order, and prints what is shown."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from blank_recorder import BlankRecorder
from chat_server import KEY, serve
from gel_pictures import press
from places import ROOT
from reader_world import fill_ycb
from runs import SIZES
from touch_world import make_touches

from anytouch_jax.cli.app import main
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.sim import dataset
from tests.data.readers import test_bags, test_corpora, test_lerobot
from tests.evaluate.test_probing import MAKERS, paint
from tests.laws.test_readme import PAGES

pytestmark = pytest.mark.slow
PART = re.compile(
    r"^```(python|text)\n(.*?)^```$|^ {4}(anytouch [^\n]*)$|^\|[^\n]*?`(anytouch [^`\n]*)`", re.MULTILINE | re.DOTALL
)
# What a page writes for a large machine or for addresses in a network, and what is typed here.
HERE = {
    "--steps 3000": "--steps 30 --stop-after 3", "--steps 600": "--steps 2", "--batch 4096 --data.parts 64":
    "--batch 4 --data.parts 2", "hf://datasets/yxma/gelsight-mini-pretrain": "memory://far",
    "s3://bucket/touches": "memory://tars", "--data 0": "--data film.avi", "verify FILE": "verify manifest.parquet",
    "only OUT": "only free.parquet", "--touches 400": "--touches 24", "tacquad.parquet": "tacquad.parquet --yes",
    "observation.images.tactile ": f"{test_lerobot.FILM} ",
    "--out report": "--out report --touches 40", " ...": "", "info FILE": "info runs/stage1",
}  # fmt: skip
# Two need files of the size of ViT-L or ViT-B: tests of weights and of `train --init` run them with small ones.
# The viewer serves until it is stopped: it has tests that stop it.
ELSEWHERE = ("--preset large", "--preset base", "anytouch view")
# Lines that need recordings that no test has. Tests of health and of novelty have them in parts.
REAL = re.compile(r"^\S+ \S+: [\d,]+ frames, |^\| (check|orientation|focus) |^31 of 40 frames|^There is no sign")
STAGE1 = {name: value for name, value in SIZES.items() if "clip-share" not in name} | {"batch": 8, "data.threads": 1}
STAGE2 = STAGE1 | {
    f"model.{tower}.{name}": value
    for tower in ("image", "text.stack")
    for name, value in {"width": 16, "depth": 1, "heads": 2, "mlp": 32}.items()
} | {"model.text.vocab": 2048, "model.text.length": 8}  # fmt: skip


def small(words: list[str]) -> list[str]:
    """Return the words of a command, with sizes that compile fast if it trains."""
    if words[0] != "train":
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
    words = small([str(Path(word).expanduser()) if "~" in word else word for word in shlex.split(line)[1:]])
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main(words)
    assert status == 0 or (status == 1 and "--health" in words), f"{line}\n{printed.getvalue()}"  # 1: a fault is found
    return printed.getvalue().replace(f"{Path.cwd()}/", "")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the pages name."""
    folder, rng = tmp_path_factory.mktemp("base"), np.random.default_rng(0)
    with contextlib.chdir(folder):
        make_touches(folder, touches={"train": 12, "val": 10, "test": 51}, sensors=("digit", "gelsight"), frames=4)
        columns: dict[str, Any] = manifests.read("manifest.parquet").table.to_pydict()
        count = len(columns["path"])
        columns["label.material"] = [("steel", "wool")[one == "hard"] for one in columns["label.hardness"]]
        columns["label.roughness"] = columns["label.slip"] = [float(one > 3) for one in columns["label.force"]]
        columns["license"] = ["MIT"] * count
        for name in ("manifest.parquet", "manifest.csv"):
            manifests.write(manifests.from_columns(columns, Path(name)), Path(name))
        columns["object"] = columns["label.indenter"]
        manifests.write(manifests.from_columns(columns, Path("recordings.parquet")), Path("recordings.parquet"))
        columns["sensor"] = ["my_gel" if one == "digit" else one for one in columns["sensor"]]
        manifests.write(manifests.from_columns(columns, Path("mine.csv")), Path("mine.csv"))
        tac = {name: values[:8] for name, values in columns.items() if name not in ("text", "object")}
        tac |= {"sensor": ["gelsight"] * 8, "image_path": ["photo.png"] * 8, "dataset": ["tacquad"] * 8}
        manifests.write(manifests.from_columns(tac, Path("tacquad.parquet")), Path("tacquad.parquet"))
        for place in ("frames", *(f"mine/{thing}/pour_{i}" for thing in ("mug", "sponge") for i in (1, 2, 3))):
            Path(place).mkdir(parents=True)
            for i in range(24 if place == "frames" else 4):  # no two pictures are equal
                cv2.imwrite(
                    f"{place}/{i:03d}.png", press(20 * i % 120) // 2 + rng.integers(0, 9, (48, 48, 3), np.uint8)
                )
        for name, depth in (("gel", 0), ("press", 60), ("mine/mug/background", 0), ("mine/sponge/background", 0)):
            cv2.imwrite(f"{name}.png", press(depth) // 2)
        film = cv2.VideoWriter("film.avi", cv2.VideoWriter_fourcc(*"MJPG"), 10, (48, 48))
        for i in range(40):
            film.write(press(2 * i))
        film.release()
        Path("labels.csv").write_text("object,material,hardness\nmug,ceramic,9\nsponge,foam,2\n")
        Path("notes.md").write_text("Trained on made touches.\n")
        test_lerobot.make(Path("my_data_set"))
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
    return folder


@pytest.fixture
def place(base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The current folder: a copy of `base`, with shards in an object store, a server for captions and no physics."""
    import fsspec

    folder = tmp_path / "here"
    shutil.copytree(base, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(folder / "home"))
    monkeypatch.setenv("ANYTOUCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setattr(dataset, "Recorder", BlankRecorder)
    test_corpora.write_corpus(tmp_path / "far", "gelslam", "train", [{"capture": "a", "frame_idx": 0, "value": 1}])
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


def is_shown(line: str, printed: str) -> bool:
    """Whether a line of a page is the beginning of a printed line, or names a file. Three dots stand for anything."""
    if line.startswith("{"):  # a line of JSON: its keys, without those that only a camera has
        keys = [key for key in re.findall(r'"(\w+)":', line) if key not in ("picture", "missed")]
        return any(re.findall(r'"(\w+)":', one)[: len(keys)] == keys for one in printed.splitlines())
    pattern = re.escape(" ".join(line.split())).replace(re.escape("..."), ".*")
    return Path(line).exists() or any(re.match(pattern, " ".join(one.split())) for one in printed.splitlines())


NAMES = [name for name, text in PAGES.items() if PART.search(text) and "how/equations" not in name]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_page_runs_from_top_to_bottom(name: str, place: Path) -> None:
    shape = (2, 3, 28, 28, 3) if "export" in name else (2, 112, 112, 3)
    names: dict[str, Any] = {"rows": np.zeros(2, np.int32), "frames": np.zeros(shape, np.uint8)}
    names["manifest"] = manifests.read("manifest.parquet")
    if "families" in name:
        return  # its Python runs in test_readme.py, with files of those encoders
    printed, problems = "", []
    for match in PART.finditer(PAGES[name]):
        kind, block, *lines = match.groups()
        if kind == "text":
            block = re.sub(r",\n +", ", ", block)  # JSON on two lines
            problems += [
                one for one in block.splitlines() if one and not REAL.match(one) and not is_shown(one, printed)
            ]
        elif kind == "python":
            if "encoder." in block and "encoder =" not in block:
                import anytouch_jax as at

                names["encoder"] = at.load_encoder("anytouch-tiny")
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(block, names)
            printed += out.getvalue()
        elif not any(size in (line := next(filter(None, lines))) for size in ELSEWHERE):
            if "--run" in line and "--init" not in line:
                shutil.rmtree(re.search(r"--run (\S+)", line)[1], ignore_errors=True)
            printed += run(line)
    assert not problems, f"{name} shows\n{problems}\nand the page printed\n{printed}"


def test_scripts_and_modules_of_the_pages_are_there() -> None:
    """They have tests of their own."""
    text = "\n".join(PAGES.values())
    scripts = re.findall(r"python (integrations/\S+\.py)", text)
    modules = [f"{one.replace('.', '/')}.py" for one in re.findall(r"python -m ((?:experiments|tests)\.\S+)", text)]
    assert len(scripts) > 1 and len(modules) > 2 and all((ROOT / file).is_file() for file in (*scripts, *modules))
