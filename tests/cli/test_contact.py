from pathlib import Path

import cv2
import pytest
from checked_world import edit

from anytouch_jax.data.manifest import manifest as manifests


def contacts(path):
    return manifests.read(path).column("label.contact").to_pylist()


def test_frames_are_marked_next_to_the_manifest_or_dropped(anytouch, pressed, tmp_path):
    done = anytouch("data", "contact", pressed)
    target = pressed.with_name("touch_contact.parquet")
    assert done.status == 0 and contacts(target) == [0] * 6 + [1] * 4
    assert (
        "10 rows: contact 4, no contact 6, unknown 0; dropped 0" in done.out
        and str(target) in done.out
    )
    # the one that was read is as it was
    assert manifests.read(pressed).table.column_names.count("label.contact") == 0
    (tmp_path / "5.png").unlink()
    done = anytouch("data", "contact", pressed, "--drop", "--out", tmp_path / "kept.csv")
    assert done.status == 0 and "unknown 1; dropped 3" in done.out
    kept = manifests.read(tmp_path / "kept.csv")
    assert kept.column("path").to_pylist() == [f"{i}.png" for i in (0, 1, 5, 6, 7, 8, 9)]
    assert contacts(tmp_path / "kept.csv") == [0, 0, None, 1, 1, 1, 1]


def test_a_threshold_moves_the_border_in_marks_check_and_image(anytouch, pressed, tmp_path):
    done = anytouch("data", "contact", pressed, "--check")
    assert done.status == 0 and "precision 1.000, recall 1.000" in done.out
    # nothing without --out
    assert sorted(path.name for path in tmp_path.glob("*.parquet")) == ["touch.parquet"]
    strict = anytouch(
        "data", "contact", pressed, "--check", "--reference", "label.force", "--above", "6"
    )
    assert "contact by label.force > 6 on 2 of 8 rows" in strict.out
    anytouch("data", "contact", pressed, "--out", tmp_path / "m.parquet")
    deep = manifests.read(tmp_path / "m.parquet").column("label.contact_score").to_pylist()
    words = [
        "--threshold",
        "digit",
        (deep[7] + deep[8]) / 2,
        "--check",
        "--image",
        tmp_path / "p.png",
    ]
    done = anytouch("data", "contact", pressed, *words)
    assert done.status == 0 and "contact 2, no contact 8" in done.out
    assert "precision 1.000, recall 0.500" in done.out
    assert cv2.imread(str(tmp_path / "p.png")).shape[1] == 1200


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--out", "touch.parquet"], "touch.parquet"),
        (["--out", "m.json"], "m.json"),
        (["--out", "mine.csv"], "mine.csv"),
        (["--drop", "--threshold", "digit", "999"], "contact"),
        (["--check", "--reference", "label.depth"], "label.depth"),
        (["--reference", "label.force"], "--reference"),
        (["--check", "--reference", "label.force", "--above", "nan"], "--above"),
        (["--check", "--drop"], "--drop"),
        (["--threshold", "gelsigth", "5"], "gelsigth"),
        (["--background", "wide.png"], "wide.png"),
    ],
)
def test_mistakes_are_one_sentence(mistake, pressed, monkeypatch, words, named):
    monkeypatch.chdir(pressed.parent)
    # a table of the user's
    Path("mine.csv").write_text("place,contact\na,1\n")
    cv2.imwrite("wide.png", cv2.imread("0.png")[:40])
    # nothing but frames that the filter judges
    edit(pressed, pressed, slice(2, None))
    before = pressed.read_bytes()
    assert named in mistake("data", "contact", "touch.parquet", *words)
    assert pressed.read_bytes() == before


def test_marks_that_are_known_are_kept_reported_and_cannot_be_moved(
    anytouch, mistake, pressed, tmp_path, monkeypatch
):
    known = ["False", "True", *["0"] * 8]
    words = edit(tmp_path / "words.csv", pressed, **{"label.contact": known})
    done = anytouch("data", "contact", words, "--out", tmp_path / "m.parquet")
    assert done.status == 0 and "10 rows keep the label.contact that they had" in done.out
    assert contacts(tmp_path / "m.parquet") == [0, 1, *[0] * 8]
    named = mistake(
        "data",
        "contact",
        edit(words, pressed, **{"label.contact": [*known[:4], "yes", *known[5:]]}),
    )
    assert "line 6 of" in named and "'yes'" in named
    scores = "anytouch_jax.data.background.contact.contact_scores"
    monkeypatch.setattr(scores, lambda *_, **__: pytest.fail("scored in vain"))
    assert "--fraction" in mistake("data", "contact", tmp_path / "m.parquet", "--fraction", 0.6)


def test_backgrounds_are_named_on_the_command_line(anytouch, pressed, tmp_path):
    # pressed frames only
    edit(pressed, pressed, slice(6, None), ("background_path",), unit=["u"] * 4)
    done = anytouch("data", "contact", pressed, "--drop")
    assert done.status == 0 and "0 of 1 recordings" in done.out and "--background" in done.out
    assert contacts(pressed.with_name("touch_contact.parquet")) == [None] * 4
    for number, unit in enumerate(("", "u=")):
        out = tmp_path / f"{number}.csv"
        done = anytouch(
            "data", "contact", pressed, "--out", out, "--background", f"{unit}{tmp_path / '0.png'}"
        )
        assert done.status == 0 and contacts(out) == [1] * 4
