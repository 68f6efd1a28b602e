"""Reports: what stands in them, that they are whole, and the demo's report from a manifest and two runs."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from markdown_it import MarkdownIt
from markdown_it.common.utils import escapeHtml
from touch_world import SENSORS, make_touches

from anytouch_jax.config import from_json, to_json
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import plots, report
from anytouch_jax.evaluate.report import (
    LABELS,
    PIXELS,
    RANDOM,
    VECTOR,
    Section,
    demo_report,
    retrieval_section,
    samples_section,
    write_report,
)  # fmt: skip
from anytouch_jax.evaluate.retrieval import MatchScore, cross_sensor_retrieval
from anytouch_jax.evaluate.statistics import as_text, markdown_table
from anytouch_jax.weights import checkpoint

NAMES = (RANDOM, "stage 1", "stage 2")


def pictures_of(report: Path) -> list[Path]:
    """The figures that a report shows; every one must be a readable picture beside it."""
    found = [report.parent / one for one in re.findall(r"!\[[^]]*\]\(([^)]+)\)", report.read_text())]
    assert all(cv2.imread(str(one)) is not None for one in found)
    return found


HOSTILE = (
    'a soft <img src=x onerror="document.title=1"> cup', "<script>alert(1)</script>", "edge a<b && b>a",
    "a &lt;b&gt; c", "[here](javascript:alert(1)) and ![x](figures/secret.png)", "</title><b>x</b>",
    "*a* __b__ `c` ~~d~~ my_cup e\\", "<!-- x -->", "<https://x.org>", "![x](figures/../secret.png)",
    "two\nlines | and a bar",
)  # fmt: skip


@pytest.mark.parametrize("text", HOSTILE)
def test_the_text_of_a_user_is_shown_as_text(text: str, tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(b"of another folder")
    line = " ".join(text.split())
    trusting = MarkdownIt("commonmark", {"html": True}).enable("table")  # as pages of the documentation are made
    assert trusting.render(f"1. {as_text(text)}") == f"<ol>\n<li>{escapeHtml(line)}</li>\n</ol>\n"
    table = trusting.render(markdown_table((text, "b"), [(text, 1)]))
    assert set(re.findall(r"</?([a-z!]+)", table)) <= {
        "table",
        "thead",
        "tbody",
        "tr",
        "th",
        "td",
        "em",
        "strong",
        "code",
    }
    write_report(tmp_path, [Section(text, text, markdown_table((text,), [(text,)]), notes=f"- {text}")], title=text)
    page = (tmp_path / "report.html").read_text()
    assert not re.search(r"<(script|b>|img [^>]*onerror|a [^>]*script|!--)", page) and "of another" not in page
    policy = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]+)">', page)
    assert policy and "default-src 'none'" in policy[1] and "script-src" not in policy[1]


def test_a_report_has_its_parts_in_order(tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "run" / "shot.png"
    for path in (elsewhere, out / "figures" / "mine.png"):
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), np.zeros((4, 4, 3), np.uint8))
    parts = [
        Section("First", "Words.", markdown_table(("a", "b|c"), [("1", "two\nlines")]), elsewhere, "After."),
        Section("Second", figure=out / "figures" / "mine.png"),
    ]
    numbers = {"x": np.float32(0.5), "bad": float("nan"), "list": np.arange(2), "path": Path("a"), "part": parts[1]}
    path = write_report(out, parts, title="Title", numbers=numbers)
    html = (out / "report.html").read_text()
    assert html.count('src="data:image/png;base64,') == 2 and 'src="figures' not in html
    assert "<td>two lines</td>" in html and "<title>Title</title>" in html and "<h2>First</h2>" in html
    assert path.read_text() == (
        "# Title\n\n## First\n\nWords.\n\n![First](figures/shot.png)\n\n"
        "| a | b\\|c |\n| --- | --- |\n| 1 | two lines |\n\nAfter.\n\n## Second\n\n![Second](figures/mine.png)\n"
    )
    assert [one.name for one in pictures_of(path)] == ["shot.png", "mine.png"]
    plain = json.loads((out / "report.json").read_text())
    assert (plain["x"], plain["bad"], plain["list"], plain["path"]) == (0.5, None, [0, 1], "a")
    assert plain["part"]["title"] == "Second"


def test_a_report_is_whole_or_not_there(tmp_path: Path, monkeypatch: Any) -> None:
    with pytest.raises(UserError, match=r"no figure .*gone\.png"):
        write_report(tmp_path / "a", [Section("x", figure=tmp_path / "gone.png")])
    assert not (tmp_path / "a" / "report.md").exists()
    write_report(tmp_path, [Section("old")])

    def full(self: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left .*report\.html"):
        write_report(tmp_path, [Section("new")])
    assert "old" in (tmp_path / "report.md").read_text()
    assert {one.name for one in tmp_path.iterdir()} == {"report.html", "report.md"}


@pytest.fixture(scope="module")
def touched(tmp_path_factory: Any) -> Path:
    counts = {"train": 18, "val": 6, "test": 30}
    return make_touches(tmp_path_factory.mktemp("touched"), touches=counts, frames=4, each=3)


def changed(path: Path, **columns: Any) -> manifests.Manifest:
    manifest = manifests.read(path)
    return manifests.from_columns(manifest.table.to_pydict() | columns, path)


@pytest.fixture
def grids(monkeypatch: Any) -> list[Any]:
    """The arguments of each sample grid that is drawn."""
    seen: list[Any] = []
    draw = plots.sample_grid

    def keep(*args: Any) -> None:
        seen.append(args)
        draw(*args)

    monkeypatch.setattr(plots, "sample_grid", keep)
    return seen


def test_samples_show_one_touch_a_row(touched: Path, tmp_path: Path, grids: list[Any]) -> None:
    manifest = manifests.read(touched)
    coarse, fine = samples_section(manifest, tmp_path)
    assert (coarse.title, fine.title) == ("Samples, coarse", "Samples, fine")
    assert fine.figure == tmp_path / "figures" / "samples_fine.png" and fine.figure.is_file()
    _, images, rows, columns = grids[1]
    assert columns == [*SENSORS, "photograph"] and len(set(rows)) == len(rows) == 5  # five objects
    lines = fine.notes.splitlines()
    assert len(lines) == 5 and lines[0].startswith(f"1. *{rows[0]}*: ")
    assert all(one.shape == (40, 30, 3) for one in (line[3] for line in images))  # fine ones have a photograph
    assert all(line[3] is None for line in grids[0][1])  # coarse ones have none
    texts, touch = manifest.column("text").to_pylist(), manifest.column("touch").to_pylist()
    for line, note in zip(images, lines, strict=True):
        first = next(i for i in range(len(manifest)) if same_frame(manifest, i, line[0]))
        caption = {texts[i] for i in range(len(manifest)) if touch[i] == touch[first]}.pop() or "no caption"
        assert note.endswith(f": {caption}")
        for j in (1, 2):  # the other sensors' frames are of the same touch
            assert any(touch[i] == touch[first] and same_frame(manifest, i, line[j]) for i in range(len(manifest)))


def same_frame(manifest: manifests.Manifest, row: int, image: Any) -> bool:
    return np.array_equal(cv2.imread(str(manifest.file(row)))[..., ::-1], image)


def test_samples_of_a_force_field_and_of_a_missing_sensor(touched: Path, tmp_path: Path, grids: list[Any]) -> None:
    field = np.zeros((20, 20, 6))
    field[3, 4] = (3.0, 0.0, 4.0, 9.0, 9.0, 9.0)  # mm, and the force in N, which is none of the size
    np.save(touched.parent / "field.npy", field)
    table = manifests.read(touched).table
    gelslim = [one == "gelslim" for one in table["sensor"].to_pylist()]
    sensor = ["tac3d" if yes else name for yes, name in zip(gelslim, table["sensor"].to_pylist(), strict=True)]
    touch = [None if name == "digit" else one for name, one in zip(sensor, table["touch"].to_pylist(), strict=True)]
    manifest = changed(
        touched, sensor=sensor, touch=touch, field_path=["field.npy" if yes else None for yes in gelslim]
    )
    samples_section(manifest, tmp_path)
    _, images, _, columns = grids[0]
    assert columns == ["gelsight", "tac3d", "photograph"]
    assert all(line[1].shape == (20, 20) and line[1][3, 4] == 5.0 for line in images)
    (touched.parent / "field.npy").write_bytes(b"no array")
    with pytest.raises(UserError, match=r"column 'field_path', is no field of forces"):
        samples_section(manifest, tmp_path)


def scored(manifest: manifests.Manifest, size: int = 10) -> dict[str, Any]:
    rows = manifest.rows_of("test")
    code = manifest.codes("touch")[rows]
    rng = np.random.default_rng(0)
    features = {"stage 2": rng.normal(size=(900, 8))[code], "random": rng.normal(size=(len(rows), 8))}
    kinds = {"matched": ("label.force",), "by chance": None}
    return {
        kind: cross_sensor_retrieval(manifest, features, rows, gallery_size=size, match=match)
        for kind, match in kinds.items()
    }


def test_the_table_of_retrieval(touched: Path, tmp_path: Path) -> None:
    section, changes = retrieval_section({"fine": scored(manifests.read(touched))}, "stage 2", ["a note"], tmp_path)
    rows = [line for line in section.table.splitlines() if line.startswith("| fine")]
    assert rows[0].startswith("| fine | stage 2 | 100.0 % (100.0 to 100.0) | 100.0 % | 100.0 %")
    assert rows[0].endswith("| 10 | 180 |") and len(rows) == 3
    mean, low, high = changes["fine"]["random"]
    assert list(changes["fine"]) == ["random"] and 0.7 < low <= mean <= high <= 1
    assert rows[2] == f"| fine | random | {100 * mean:+.1f} ({100 * low:+.1f} to {100 * high:+.1f}) |"
    assert "nearest in force" in section.text and section.notes == "- a note"
    lock, _ = retrieval_section(
        {"fine": {"by chance": scored(manifests.read(touched))["by chance"]}}, "x", [], tmp_path
    )
    assert "| fine | random | - | - | - |" in lock.table
    empty, none = retrieval_section({}, "stage 2", ["nothing scored"], tmp_path)
    assert empty.figure is None and not none and "nothing scored" in empty.notes


def test_the_section_of_matching_shows_both_ways(monkeypatch: Any) -> None:
    found = [
        MatchScore("any", 0.8, 0.7, 0.9, 0.85, 0.65, 300, 60),
        MatchScore("same_sensor", 0.6, 0.5, 0.7, 0.7, 0.5, 9, 3),
    ]
    study = SimpleNamespace(test=lambda values: values, classes={"stage 2": None}, rows=None, manifest=None)
    monkeypatch.setattr("anytouch_jax.evaluate.retrieval.score_matching", lambda *_: found)
    section, numbers = report._matching(study, None)  # type: ignore[arg-type]
    lines = section.table.splitlines()
    assert lines[2] == "| of any sensor | 80.0 % (70.0 to 90.0) | 0.850 | 65.0 % | 300 |" and len(lines) == 4
    assert section.notes == "" and section.figure is None and numbers["found"] == found


@pytest.fixture(scope="module")
def later(tiny_run: Path, tmp_path_factory: Any) -> Path:
    """A run that calls itself one of stage 2, with the weights and the log of `tiny_run`."""
    run = tmp_path_factory.mktemp("later") / "stage2"
    params, config, about = checkpoint.load_params(tiny_run)
    told = {"config_json": to_json(replace(from_json(config), stage=2)), "metadata": {"seen": about["seen"]}}
    with contextlib.closing(checkpoint.Checkpoints(run / "checkpoints", keep=1, **told)) as out:
        out.save(2, {"trainable": params}, {"loss": 1.0})
    shutil.copy(tiny_run / "metrics.jsonl", run)
    return run


@pytest.fixture(scope="module")
def demo(touched: Path, tiny_run: Path, later: Path, tmp_path_factory: Any) -> tuple[Path, list[str]]:
    """The report of a tiny run on the small world; its weights stand for both stages."""
    said: list[str] = []
    out = tmp_path_factory.mktemp("report") / "new"
    return demo_report(touched, tiny_run, later, out, said.append, touches=24, gallery_size=10), said


def test_the_demo_report_holds_everything(demo: tuple[Path, list[str]]) -> None:
    path, said = demo
    text = path.read_text()
    titles = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert titles == [
        "Data and runs", "Samples, coarse", "Samples, fine", "Losses", "Reconstructions and next frames",
        "The space of touches", "Cross-sensor retrieval", "Cross-sensor matching", "Probes",
    ]  # fmt: skip
    names = [one.name for one in pictures_of(path)]
    assert names == [
        "samples_coarse.png", "samples_fine.png", "losses.png", "reconstructions.png", "tsne.png", "retrieval.png",
        "probes.png",
    ]  # fmt: skip
    assert "| test | 360 | 30 | 10 | digit, gelsight, gelslim |" in text
    assert re.search(r"^\| hidden patches \| \d\.\d{4} \| \d\.\d{4} \|$", text, re.MULTILINE)
    assert re.search(r"^\| next frame \| \d\.\d{4} \| \d\.\d{4} \|$", text, re.MULTILINE)
    assert str(path) in said[-1] and not any(one.name.startswith(".") for one in path.parent.rglob("*"))
    assert "roughness: the manifest has no column label.roughness" in text
    assert "**Stage 2 started from no run, so this stage 1 is no part of it.**" in text
    assert str(path.parent.parent) not in text  # no path of the machine


def test_the_numbers_of_the_demo_report(demo: tuple[Path, list[str]], touched: Path) -> None:
    path, _ = demo
    numbers = json.loads((path.parent / "report.json").read_text())
    assert numbers["data"] == manifests.read(touched).content_hash and numbers["seconds"] > 0
    assert [one["name"] for one in numbers["space"]] == list(NAMES)
    assert all(one["rows"] == 72 for one in numbers["space"])  # 24 of 30 touches by three sensors
    pixels, text = numbers["pixels"], path.read_text()
    assert pixels["clips"] > 0 and f"error on {pixels['clips']} clips in contact" in text
    assert f"| hidden patches | {pixels['reconstruction']:.4f} | {pixels['plain reconstruction']:.4f} |" in text
    kinds = numbers["retrieval"]["found"]
    assert set(kinds) == {"fine", "coarse"} and set(kinds["fine"]) == {"matched", "by chance"}
    everything = {*NAMES, *(f"{name} (patches)" for name in NAMES), PIXELS, VECTOR}
    for kind in kinds["fine"].values():
        pooled = [one for one in kind if one["query_sensor"] == "all"]
        assert {one["name"] for one in pooled} == everything and len(pooled) == 2 * len(everything)
        assert len(kind) == 7 * len(pooled) and all(one["gallery"] == 10 for one in kind)
        assert all(one["metric"] == ("euclidean" if one["name"] == VECTOR else "cosine") for one in kind)
        assert all(one["low"] <= one["top1"] <= one["high"] for one in pooled)
        best = {one["name"]: one["top1"] for one in pooled if not one["centred"]}
        assert best["stage 1"] == best["stage 2"]  # the same weights in both places
        assert best[PIXELS] > 0.25  # the world's textures are plain to see
    assert numbers["retrieval"]["differences"]["fine"]["stage 1"] == [0, 0, 0]
    (note,) = numbers["matching"]["notes"]
    assert numbers["matching"]["found"] == [] and "no matching head" in note and note in path.read_text()
    probes = numbers["probes"]["found"]
    assert set(probes) == {"hardness", "indenter", "force"} and "indenter" in LABELS
    assert [one["probe"] for one in probes["hardness"]] == [*NAMES, PIXELS]
    assert all(one["n_train"] == 36 and one["test_groups"] <= 10 for one in probes["force"])
    assert all("r2" in one for one in probes["force"]) and all("accuracy" in one for one in probes["indenter"])


def test_the_reconstructions_show_each_sensor(demo: tuple[Path, list[str]]) -> None:
    image = cv2.imread(str(demo[0].parent / "figures" / "reconstructions.png"))
    assert image.shape == (16 + 3 * 32, 11 * 32, 3)


def test_a_report_says_what_it_could_not_score(
    touched: Path, tiny_run: Path, later: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    """No covariates, no forces, too few touches: the report is made and names each."""
    table = manifests.read(touched).table
    gone = ("label.x", "label.y", "label.depth", "label.force", "label.area", "background_path", "grade")
    poor = touched.parent / "poor.parquet"
    manifests.write(manifests.from_columns(table.drop_columns(list(gone)).to_pydict(), poor), poor)
    monkeypatch.setattr("anytouch_jax.evaluate.report.reconstructions_section", lambda *args: (Section("none"), {}))
    path = demo_report(poor, tiny_run, later, tmp_path, lambda _: None, touches=12)
    text = path.read_text()
    for words in (
        f"no baseline by {VECTOR}: the manifest has none",
        "test: a sensor has 12 touches only, so galleries have 12, not 50",
        "test, gallery matched: not scored: The manifest has none of label.x",
        "force: the manifest has no column label.force",
    ):  # fmt: skip
        assert words in text, words
    assert "| test | stage 2 | - | - | - |" in text


def test_mistakes_come_before_any_work(touched: Path, tiny_run: Path, later: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no run folder"):
        demo_report(touched, tmp_path / "none", tiny_run, tmp_path / "out")
    with pytest.raises(UserError, match="there is no manifest"):
        demo_report(tmp_path / "none.csv", tiny_run, tiny_run, tmp_path / "out")
    with pytest.raises(UserError, match=r"--stage2 .*w\.safetensors is a weights file"):
        (tmp_path / "w.safetensors").write_bytes(b"")
        demo_report(touched, tiny_run, tmp_path / "w.safetensors", tmp_path / "out")
    with pytest.raises(UserError, match=r"needs 4 frames .* gives 3 with --touches 1, 90 at most"):
        demo_report(touched, tiny_run, later, tmp_path / "out", lambda _: None, touches=1)
    few = make_touches(tmp_path / "few", touches={"train": 2, "test": 1})
    with pytest.raises(UserError, match=r"needs 4 frames .* gives 3 with --touches 200, 3 at most"):
        demo_report(few, tmp_path / "none", later, tmp_path / "out", lambda _: None)  # before a run is looked at
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("init", "sentence"),
    [
        ("{run}", ""),
        ("elsewhere/{name}", ""),  # moved since
        ("elsewhere/other", "Stage 2 started from another run (other), so this stage 1 is no part of it."),
        (None, "Stage 2 started from no run, so this stage 1 is no part of it."),
    ],
)
def test_runs_that_do_not_belong_together_are_told_of(tiny_run: Path, init: str | None, sentence: str) -> None:
    told = None if init is None else init.format(run=tiny_run, name=tiny_run.name)
    second = replace(load_encoder(tiny_run), metadata={"source": {"init": told}})
    assert report._lineage(tiny_run, second) == sentence


def test_a_run_stands_for_its_own_stage_alone(touched: Path, tiny_run: Path, later: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--stage1 .* is a run of stage 2. Give the stage 1"):
        demo_report(touched, later, later, tmp_path / "never")
    with pytest.raises(UserError, match=r"--stage2 .* is a run of stage 1. Give a stage 2"):
        demo_report(touched, tiny_run, tiny_run, tmp_path / "never")
    assert not (tmp_path / "never").exists()


def test_a_report_that_fails_leaves_the_one_before(
    demo: tuple[Path, list[str]], touched: Path, tiny_run: Path, later: Path, monkeypatch: Any
) -> None:
    folder = demo[0].parent
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def fail(*args: Any) -> None:
        raise UserError("in the midst of it")

    monkeypatch.setattr("anytouch_jax.evaluate.report._probes", fail)
    with pytest.raises(UserError, match="in the midst of it"):
        demo_report(touched, tiny_run, later, folder, lambda _: None, touches=12, gallery_size=10, seed=1)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
