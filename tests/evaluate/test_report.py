import contextlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from markdown_it import MarkdownIt
from markdown_it.common.utils import escapeHtml
from touch_world import make_touches

from anytouch_jax.config import from_json, to_json
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.report import (
    LABELS,
    PIXELS,
    VECTOR,
    Section,
    demo_report,
    write_report,
)
from anytouch_jax.evaluate.report_words import Claim, opening
from anytouch_jax.evaluate.statistics import RANDOM
from anytouch_jax.evaluate.tables import as_text, markdown_table
from anytouch_jax.weights import checkpoint

NAMES = (RANDOM, "stage 1", "stage 2")


def images_of(report: Path) -> list[Path]:
    """The figures that a report shows; every one must be a readable image beside it."""
    found = [
        report.parent / one for one in re.findall(r"!\[[^]]*\]\(([^)]+)\)", report.read_text())
    ]
    assert all(cv2.imread(str(one)) is not None for one in found)
    return found


HOSTILE = (
    'a soft <img src=x onerror="document.title=1"> cup',
    "<script>alert(1)</script>",
    "edge a<b && b>a",
    "a &lt;b&gt; c",
    "[here](javascript:alert(1)) and ![x](figures/secret.png)",
    "</title><b>x</b>",
    "*a* __b__ `c` ~~d~~ my_cup e\\",
    "<!-- x -->",
    "<https://x.org>",
    "![x](figures/../secret.png)",
    "two\nlines | and a bar",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_the_text_of_a_user_is_shown_as_text(text: str, tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(b"of another folder")
    line = " ".join(text.split())
    # as pages of the documentation are made
    trusting = MarkdownIt("commonmark", {"html": True}).enable("table")
    assert trusting.render(f"1. {as_text(text)}") == f"<ol>\n<li>{escapeHtml(line)}</li>\n</ol>\n"
    table = trusting.render(markdown_table((text, "b"), [(text, 1)]))
    allowed = {"table", "thead", "tbody", "tr", "th", "td", "em", "strong", "code"}
    assert set(re.findall(r"</?([a-z!]+)", table)) <= allowed
    write_report(
        tmp_path,
        [Section(text, text, markdown_table((text,), [(text,)]), notes=f"- {text}")],
        title=text,
    )
    page = (tmp_path / "report.html").read_text()
    assert (
        not re.search(r"<(script|b>|img [^>]*onerror|a [^>]*script|!--)", page)
        and "of another" not in page
    )
    policy = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]+)">', page)
    assert policy and "default-src 'none'" in policy[1] and "script-src" not in policy[1]


def test_a_report_has_its_parts_in_order(tmp_path: Path) -> None:
    out = tmp_path / "out"
    elsewhere = tmp_path / "run" / "shot.png"
    for path in (elsewhere, out / "figures" / "mine.png"):
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), np.zeros((4, 4, 3), np.uint8))
    parts = [
        Section(
            "First",
            "Words.",
            markdown_table(("a", "b|c"), [("1", "two\nlines")]),
            elsewhere,
            "After.",
        ),
        Section("Second", figure=out / "figures" / "mine.png"),
    ]
    numbers = {
        "x": np.float32(0.5),
        "bad": float("nan"),
        "list": np.arange(2),
        "path": Path("a"),
        "part": parts[1],
    }
    path = write_report(out, parts, title="Title", numbers=numbers)
    html = (out / "report.html").read_text()
    assert (
        html.count('src="data:image/png;base64,') == 2
        and html.count('class="card"') == 2
        and 'src="figures' not in html
    )
    assert (
        "<td>two lines</td>" in html and "<title>Title</title>" in html and "<h2>First</h2>" in html
    )
    assert path.read_text() == (
        "# Title\n\n## First\n\nWords.\n\n![First](figures/shot.png)\n\n"
        "| a | b\\|c |\n| --- | --- |\n| 1 | two lines |\n\nAfter.\n\n## "
        "Second\n\n![Second](figures/mine.png)\n"
    )
    assert [one.name for one in images_of(path)] == ["shot.png", "mine.png"]
    assert html.count('<p class="figure" tabindex="0">') == 2 and "refresh" not in html
    write_report(out, parts, reload=10)
    assert '<meta http-equiv="refresh" content="10">' in (out / "report.html").read_text()
    plain = json.loads((out / "report.json").read_text())
    assert (plain["x"], plain["bad"], plain["list"], plain["path"]) == (0.5, None, [0, 1], "a")
    assert plain["part"]["title"] == "Second"


def test_a_report_without_its_figure_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no figure .*gone\.png"):
        write_report(tmp_path / "a", [Section("x", figure=tmp_path / "gone.png")])
    assert not (tmp_path / "a" / "report.md").exists()


def test_the_first_sentences_sort_claims_by_their_intervals(tmp_path: Path) -> None:
    """A gain counts as learned if its whole interval is above 0, and a loss falls likewise."""
    claims = [
        Claim("a is", "9", "b is 5", 0.1, 0.2),
        Claim("c is", "9", "d is 5", -0.1, 0.2),
        Claim("e is", "9", "f is 5", None, None),
    ]
    rng = np.random.default_rng(0)
    levels = {"falling": np.linspace(3, 1, 50), "flat": np.full(50, 2.0), "short": np.ones(9)}
    runs = {}
    for name, values in levels.items():
        runs[name] = tmp_path / name
        runs[name].mkdir()
        noisy = values + 0.01 * rng.normal(size=len(values))
        lines = [json.dumps({"step": i, "loss": loss}) for i, loss in enumerate(noisy)]
        (runs[name] / "metrics.jsonl").write_text("\n".join(lines))
    learned, not_learned, more = opening(claims, runs)
    assert learned == "Learned: a is 9, where b is 5."
    assert not_learned == "Not shown to be learned: c is 9, where d is 5; e is 9, where f is 5."
    assert "falling falls" in more and "flat is not shown to fall" in more and "short" not in more
    assert opening([], {})[0].startswith("Learned: nothing")


@pytest.fixture(scope="module")
def touched(tmp_path_factory: Any) -> Path:
    counts = {"train": 18, "val": 6, "test": 30}
    return make_touches(tmp_path_factory.mktemp("touched"), touches=counts, frames=4, each=3)


@pytest.fixture(scope="module")
def later(tiny_run: Path, tmp_path_factory: Any) -> Path:
    """A run that calls itself one of stage 2, with the weights and the log of `tiny_run`."""
    run = tmp_path_factory.mktemp("later") / "stage2"
    params, config, about = checkpoint.load_params(tiny_run)
    told = {
        "config_json": to_json(replace(from_json(config), stage=2)),
        "metadata": {"seen": about["seen"]},
    }
    with contextlib.closing(checkpoint.Checkpoints(run / "checkpoints", keep=1, **told)) as out:
        out.save(2, {"trainable": params}, {"loss": 1.0})
    shutil.copy(tiny_run / "metrics.jsonl", run)
    return run


@pytest.fixture(scope="module")
def demo(
    touched: Path, tiny_run: Path, later: Path, tmp_path_factory: Any
) -> tuple[Path, list[str]]:
    """The report of a tiny run on the small world; its weights stand for both stages."""
    said: list[str] = []
    out = tmp_path_factory.mktemp("report") / "new"
    return demo_report(
        touched, tiny_run, later, out, said.append, touches=24, gallery_size=10
    ), said


def test_a_report_holds_what_there_is_to_say(demo: tuple[Path, list[str]]) -> None:
    path, said = demo
    text = path.read_text()
    titles = re.findall(r"^## (.+)$", text, re.MULTILINE)
    # there is no matching head, so there is no section on matching
    assert titles == [
        "Hidden patches and the next frame",
        "The same touch by another sensor",
        "Probes",
        "Data and runs",
    ]
    names = [one.name for one in images_of(path)]
    assert names == ["reconstructions.png", "retrieval.png", "probes.png", "losses.png"]
    opening = text.split("\n\n")[1:4]
    beginnings = ("Learned: ", "Not shown to be learned: ", "More steps: ")
    assert all(map(str.startswith, opening, beginnings))
    # an untrained decoder is worse than its guesses, and that is said
    assert (
        "the error of hidden patches is" in opening[1] and "a copy of the last frame" in opening[1]
    )
    assert "too short to tell" in opening[2]
    assert "| test | 360 | 30 | 10 | digit, gelsight, gelslim |" in text
    assert re.search(r"^\| next frame \| \d\.\d{4} \| \d\.\d{4} \|$", text, re.MULTILINE)
    assert str(path) in said[-1] and not any(
        one.name.startswith(".") for one in path.parent.rglob("*")
    )
    assert any("roughness: the manifest has no column label.roughness" in line for line in said)
    assert "**Stage 2 started from no run, so this stage 1 is no part of it.**" in text
    assert str(path.parent.parent) not in text  # no path of the machine


def test_the_numbers_of_a_report(demo: tuple[Path, list[str]], touched: Path) -> None:
    path, said = demo
    numbers = json.loads((path.parent / "report.json").read_text())
    assert numbers["data"] == manifests.read(touched).content_hash and numbers["seconds"] > 0
    pixels = numbers["pixels"]
    text = path.read_text()
    assert pixels["clips"] > 0 and f"error on {pixels['clips']} clips in contact" in text
    assert (
        f"| hidden patches | {pixels['reconstruction']:.4f} | {pixels['plain reconstruction']:.4f} "
        "|" in text
    )
    kinds = numbers["retrieval"]["found"]
    assert set(kinds) == {"fine", "coarse"} and set(kinds["fine"]) == {"matched", "by chance"}
    everything = {*NAMES, *(f"{name} (patches)" for name in NAMES), PIXELS, VECTOR}
    for kind in kinds["fine"].values():
        pooled = [one for one in kind if one["query_sensor"] == "all"]
        assert {one["name"] for one in pooled} == everything and len(pooled) == 2 * len(everything)
        assert len(kind) == 7 * len(pooled) and all(one["gallery"] == 10 for one in kind)
        best = {one["name"]: one["top1"] for one in pooled if not one["centred"]}
        # the same weights in both places
        assert best["stage 1"] == best["stage 2"]
        assert best[PIXELS] > 0.25  # the world's textures are plain to see
    assert numbers["retrieval"]["differences"]["fine"]["stage 1"] == [0, 0, 0]
    (note,) = numbers["matching"]["notes"]
    assert (
        numbers["matching"]["found"] == []
        and "no matching head" in note
        and any(note in line for line in said)
    )
    probes = numbers["probes"]["found"]
    assert set(probes) == {"hardness", "indenter", "force"} and "indenter" in LABELS
    assert [one["probe"] for one in probes["hardness"]] == [*NAMES, PIXELS]
    assert all(one["n_train"] == 36 and one["test_groups"] <= 10 for one in probes["force"])
    assert all("r2" in one for one in probes["force"]) and all(
        "accuracy" in one for one in probes["indenter"]
    )


def test_a_report_that_fails_leaves_the_one_before(
    demo: tuple[Path, list[str]], touched: Path, tiny_run: Path, later: Path, monkeypatch: Any
) -> None:
    folder = demo[0].parent
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def fail(*args: Any) -> None:
        raise UserError("in the midst of it")

    monkeypatch.setattr("anytouch_jax.evaluate.report_features.probes_section", fail)
    with pytest.raises(UserError, match="in the midst of it"):
        demo_report(
            touched, tiny_run, later, folder, lambda _: None, touches=12, gallery_size=10, seed=1
        )
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
