from pathlib import Path

import cv2
import pytest

from anytouch_jax.data.manifest import manifest as manifests


def contacts(path):
    return manifests.read(path).column("label.contact").to_pylist()


def test_every_frame_is_marked_next_to_the_manifest(anytouch, pressed):
    done = anytouch("data", "contact", pressed)
    assert done.status == 0
    target = pressed.with_name("touch_contact.parquet")
    assert contacts(target) == [0] * 6 + [1] * 4
    assert "10 rows: contact 4, no contact 6, unknown 0; dropped 0" in done.out and str(target) in done.out
    assert manifests.read(pressed).table.column_names.count("label.contact") == 0  # the one that was read is as it was


def test_drop_keeps_the_background_and_what_is_unknown(anytouch, pressed, tmp_path):
    (tmp_path / "5.png").unlink()
    done = anytouch("data", "contact", pressed, "--drop", "--out", tmp_path / "kept.csv")
    assert done.status == 0 and "unknown 1; dropped 3" in done.out
    kept = manifests.read(tmp_path / "kept.csv")
    assert kept.column("path").to_pylist() == [f"{i}.png" for i in (0, 1, 5, 6, 7, 8, 9)]
    assert contacts(tmp_path / "kept.csv") == [0, 0, None, 1, 1, 1, 1]


def test_a_threshold_moves_the_border_in_marks_check_and_picture(anytouch, pressed, tmp_path):
    scores = (anytouch("data", "contact", pressed), manifests.read(pressed.with_name("touch_contact.parquet")))[1]
    deep = scores.column("label.contact_score").to_pylist()
    limit = (deep[7] + deep[8]) / 2
    done = anytouch(
        "data", "contact", pressed, "--threshold", "digit", limit, "--check", "--picture", tmp_path / "p.png"
    )
    assert done.status == 0 and "contact 2, no contact 8" in done.out
    assert "precision 1.000, recall 0.500" in done.out
    assert cv2.imread(str(tmp_path / "p.png")).shape[1] == 1200
    assert "'gelsight'" in anytouch("data", "contact", pressed, "--threshold", "gelsight", "5").err


def test_check_writes_nothing_without_out(anytouch, pressed, tmp_path):
    done = anytouch("data", "contact", pressed, "--check")
    assert done.status == 0 and "precision 1.000, recall 1.000" in done.out
    assert sorted(path.name for path in tmp_path.glob("*.parquet")) == ["touch.parquet"]
    assert anytouch("data", "contact", pressed, "--check", "--out", tmp_path / "m.parquet").status == 0
    assert contacts(tmp_path / "m.parquet") == [0] * 6 + [1] * 4
    strict = anytouch("data", "contact", pressed, "--check", "--reference", "label.force", "--above", "6")
    assert "contact by label.force > 6 on 2 of 8 rows" in strict.out


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--out", "touch.parquet"], "touch.parquet"), (["--out", "m.json"], "m.json"),
        (["--out", "mine.csv"], "mine.csv"), (["--threads", "0"], "--threads"),
        (["--drop", "--threshold", "digit", "999"], "contact"),
        (["--check", "--reference", "label.depth"], "label.depth"), (["--reference", "label.force"], "--reference"),
        (["--check", "--reference", "label.force", "--above", "nan"], "--above"), (["--check", "--drop"], "--drop"),
        (["--share", "60"], "--share"), (["--threshold", "gelsigth", "5"], "gelsigth"),
    ],
)  # fmt: skip
def test_mistakes_are_one_sentence(mistake, pressed, monkeypatch, words, named):
    monkeypatch.chdir(pressed.parent)
    Path("mine.csv").write_text("place,contact\na,1\n")  # a table of the user's
    before = pressed.read_bytes()
    if "999" in words:  # nothing but frames that the filter judges
        table = manifests.read(pressed).table.slice(2)
        manifests.write(manifests.from_columns({n: table[n].to_pylist() for n in table.column_names}, pressed), pressed)
        before = pressed.read_bytes()
    assert named in mistake("data", "contact", "touch.parquet", *words)
    assert pressed.read_bytes() == before


def test_known_contact_may_be_true_or_false_and_nothing_else(anytouch, mistake, pressed, tmp_path):
    table = manifests.read(pressed).table
    columns = {name: table[name].to_pylist() for name in table.column_names}
    columns["label.contact"] = ["False", "True", None, *["0"] * 7]
    manifests.write(manifests.from_columns(columns, tmp_path / "words.csv"), tmp_path / "words.csv")
    assert anytouch("data", "contact", tmp_path / "words.csv", "--out", tmp_path / "m.parquet").status == 0
    assert contacts(tmp_path / "m.parquet") == [0, 1, 0, *[0] * 7]
    columns["label.contact"][4] = "yes"
    manifests.write(manifests.from_columns(columns, tmp_path / "words.csv"), tmp_path / "words.csv")
    named = mistake("data", "contact", tmp_path / "words.csv")
    assert "line 6 of" in named and "'yes'" in named


def test_marks_that_are_kept_are_reported_and_cannot_be_moved(anytouch, mistake, pressed, monkeypatch):
    anytouch("data", "contact", pressed)
    marked = pressed.with_name("touch_contact.parquet")
    monkeypatch.setattr(
        "anytouch_jax.data.prepare.contact.contact_scores", lambda *_, **__: pytest.fail("scored in vain")
    )
    assert "--share" in mistake("data", "contact", marked, "--share", 0.6)
    monkeypatch.undo()
    done = anytouch("data", "contact", marked)
    assert done.status == 0 and "10 rows keep the label.contact that they had" in done.out


def test_backgrounds_are_named_on_the_command_line(anytouch, mistake, pressed, tmp_path):
    table = manifests.read(pressed).table.slice(6)  # pressed frames only, without any background
    columns = {name: table[name].to_pylist() for name in table.column_names if name != "background_path"}
    manifests.write(manifests.from_columns({**columns, "unit": ["u"] * 4}, pressed), pressed)
    done = anytouch("data", "contact", pressed, "--drop")
    assert done.status == 0 and "0 of 1 recordings" in done.out and "--background" in done.out
    assert contacts(pressed.with_name("touch_contact.parquet")) == [None] * 4
    for words in (["0.png"], [f"u={tmp_path / '0.png'}"]):
        words = [str(tmp_path / words[0])] if "=" not in words[0] else words
        assert anytouch("data", "contact", pressed, "--out", tmp_path / "m.csv", "--background", *words).status == 0
        assert contacts(tmp_path / "m.csv") == [1] * 4
        (tmp_path / "m.csv").unlink()
    cv2.imwrite(str(tmp_path / "wide.png"), cv2.imread(str(tmp_path / "0.png"))[:40])
    assert "wide.png" in mistake("data", "contact", pressed, "--background", tmp_path / "wide.png")
