import os

import pytest
from reader_world import fill

from anytouch_jax.cli.output import check_folder, check_home
from anytouch_jax.errors import UserError

WORK = {
    "contact": "anytouch_jax.data.background.contact.contact_scores",
    "verify": "anytouch_jax.datasets.verify.verify",
    "export": "anytouch_jax.encoder.encoder.load_encoder",
    "label": "anytouch_jax.evaluate.probing.probe_label",
    "retrieve": "anytouch_jax.data.manifest.manifest.read",
    "annotate": "anytouch_jax.datasets.captions.annotate",
    "report": "anytouch_jax.evaluate.report.demo_report",
    "adapt": "anytouch_jax.data.manifest.manifest.read",
}


@pytest.fixture
def no_work(monkeypatch, pressed):
    """no_work(command): the long work of that command must not begin; the folder is that of
    `pressed`.
    """
    monkeypatch.chdir(pressed.parent)
    (pressed.parent / "afile").write_text("")

    def guard(words):
        work = next(WORK[word] for word in words[:2] if word in WORK)
        monkeypatch.setattr(work, lambda *args, **options: pytest.fail("the work began"))

    return guard


def test_a_file_that_is_read_is_not_written_over(tmp_path):
    path = tmp_path / "m.csv"
    other = tmp_path / "other.csv"
    path.write_text("mine")
    check_folder(other, read=(path,))
    check_folder(path, read=(other,))  # an older result is replaced
    (tmp_path / "link").symlink_to(tmp_path)
    for same in (path, tmp_path / "link" / "m.csv"):
        with pytest.raises(UserError, match=r"m\.csv .*--out"):
            check_folder(same, read=(other, path))
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="pipe"):
        check_folder(tmp_path / "pipe")


def test_the_folder_of_an_output_is_made_where_it_can_be(tmp_path, monkeypatch):
    check_folder(tmp_path / "a" / "b" / "c.json")
    check_home(tmp_path / "c" / "d")
    check_home(tmp_path / "c")
    assert (
        (tmp_path / "a" / "b").is_dir()
        and (tmp_path / "c").is_dir()
        and not (tmp_path / "c" / "d").exists()
    )
    (tmp_path / "file").write_text("")
    for check, path, more, words in (
        (check_folder, "a/b", (), r"b is a folder.*--out"),
        (check_home, "file", ("--cache",), r"file .*--cache"),
        (check_folder, f"{'x' * 300}/c.json", ("--sheet",), "--sheet"),
    ):
        with pytest.raises(UserError, match=words):
            check(tmp_path / path, *more)
    # as for a folder of another user
    monkeypatch.setattr(os, "access", lambda *_: False)
    for check, path in ((check_folder, "c/c.json"), (check_home, "c/c.json"), (check_home, "c")):
        with pytest.raises(UserError, match="--out"):
            check(tmp_path / path)


@pytest.mark.parametrize(
    ("typed", "named"),
    [
        ("data contact touch.parquet --image c.parquet --out c.parquet", ["--out", "--image"]),
        ("data contact touch.parquet --image c.jpg", ["--image", ".png"]),
        ("data contact touch.parquet --image afile/c.png", ["afile", "--image"]),
        ("data contact touch.parquet --image 5.png", ["5.png", "--image"]),
        ("data verify touch.parquet --repair r.csv --out r.csv", ["--repair", "--out"]),
        (
            "data verify touch.parquet --commercial-only r.csv --out r.csv",
            ["--commercial-only", "--out"],
        ),
        (
            "data verify touch.parquet --repair o.csv --commercial-only o.csv",
            ["--repair", "--commercial-only"],
        ),
        ("data verify touch.parquet --out afile/report.json", ["afile", "--out"]),
        ("data annotate touch.parquet --sheet x.csv --out x.csv --yes", ["--sheet", "--out"]),
        ("data annotate touch.parquet --yes --sheet afile/look.html", ["afile", "--sheet"]),
        ("export --model nowhere --out afile/e.bin", ["afile", "--out"]),
        ("probe label --data touch.parquet --out afile/deep/p.json", ["afile", "--out"]),
        ("probe label --data touch.parquet --out touch.parquet", ["touch.parquet", "--out"]),
        (
            "probe label --model run --data touch.parquet --out run/config.json",
            ["config.json", "--out"],
        ),
        ("retrieve --data touch.parquet --out afile/r.json", ["afile", "--out"]),
        ("retrieve --data touch.parquet --out touch.parquet", ["touch.parquet", "--out"]),
        ("report --data touch.parquet --stage1 a --stage2 b --out afile/r", ["afile", "--out"]),
        ("adapt --model a --data touch.parquet --sensor digit --out afile/r", ["afile", "--out"]),
        (
            "adapt --model a --data touch.parquet --sensor digit --out r --frames 0 --labels x",
            ["--labels"],
        ),
    ],
)
def test_an_output_that_cannot_be_written_is_named_before_the_work(
    mistake, no_work, pressed, tiny_run, typed, named
):
    (pressed.parent / "run").symlink_to(tiny_run)
    no_work(typed.split())
    before = {path: path.is_file() and path.read_bytes() for path in pressed.parent.iterdir()}
    sentence = mistake(*typed.split())
    assert all(name in sentence for name in named), sentence
    assert {
        path: path.is_file() and path.read_bytes() for path in pressed.parent.iterdir()
    } == before


def test_a_manifest_is_not_written_over_another_table(anytouch, mistake, tmp_path):
    fill(
        tmp_path,
        [f"real/mug/dataset_{k}/frames/frame_{i:07d}.jpg" for k in range(2) for i in range(3)],
    )
    words = ("data", "index", "ycb_slide", tmp_path, "--out")
    table = tmp_path / "labels.csv"
    table.write_text("name,hardness\nmug,hard\n")
    assert "labels.csv" in mistake(*words, table)
    assert table.read_text().startswith("name,hardness")
    # a manifest may be made again
    for _ in range(2):
        assert anytouch(*words, tmp_path / "m.csv").status == 0
    (tmp_path / "broken.parquet").write_bytes(b"no parquet")
    assert "broken.parquet" in mistake(*words, tmp_path / "broken.parquet")


def test_a_table_with_semicolons_is_named(mistake, tmp_path):
    (tmp_path / "semi.csv").write_text(
        "path;sensor;sequence;frame_index;split\na.png;digit;s;0;train\n"
    )
    assert "semicolons" in mistake("info", tmp_path / "semi.csv")
