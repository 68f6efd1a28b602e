import os

import pytest
from reader_world import fill, fill_ycb
from refused import refused

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import replace_column
from anytouch_jax.datasets.readers import READERS, IndexOptions, index
from anytouch_jax.errors import UserError


def test_every_reader_says_what_it_is():
    assert "visgel" in READERS and "recordings" in READERS and len(READERS) == 25
    known = set(IndexOptions.__dataclass_fields__)
    for one in READERS.values():
        assert one.license and one.citation and set(one.uses) <= known
    total = sum(one.paper for one in READERS.values() if one.paper)
    # the paper's table sums to 2.9 million, its text says 2,481,703
    assert abs(total - 2_481_703) < 450_000


def test_the_manifest_may_lie_above_the_data_but_not_elsewhere(tmp_path, read):
    fill_ycb(tmp_path / "a b" / "ycb")
    table = read("ycb_slide", tmp_path / "a b" / "ycb", tmp_path / "all.csv")
    assert next(iter(table.rows)) == "a b/ycb/real/mug/dataset_0/frames/frame_0000000.jpg"
    with pytest.raises(UserError, match=r"must lie in .* or in a folder above it"):
        index("ycb_slide", tmp_path / "a b", tmp_path / "c" / "m.parquet")
    refused(r"ends in .csv or .parquet", index, "ycb_slide", tmp_path / "a b", tmp_path / "m.json")
    refused("there is no folder", index, "ycb_slide", tmp_path / "nowhere")


def test_a_failed_write_is_an_error_and_leaves_the_old_file(tmp_path, monkeypatch):
    fill_ycb(tmp_path)
    before = index("ycb_slide", tmp_path).out.read_bytes()
    monkeypatch.setattr(
        os, "replace", lambda *_: (_ for _ in ()).throw(PermissionError(13, "Permission denied"))
    )
    with pytest.raises(
        UserError, match=r"cannot be written: Permission denied; name another file with --out"
    ):
        index("ycb_slide", tmp_path, options=IndexOptions(val=0.5))
    assert (tmp_path / "ycb_slide.parquet").read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ["real", "ycb_slide.parquet"]


def test_folders_that_lead_elsewhere_are_refused(tmp_path):
    fill_ycb(tmp_path / "big")
    fill(tmp_path, ["root/ssvtp/images_tac/image_0_tac.jpg", "images_rgb/image_0_rgb.jpg"])
    (tmp_path / "root" / "real").symlink_to(tmp_path / "big" / "real")
    # of RGB images
    (tmp_path / "root" / "ssvtp" / "images_rgb").symlink_to(tmp_path / "images_rgb")
    for name, folder in (("ycb_slide", "frames"), ("ssvtp", "images_rgb")):
        refused(f"{folder} leads out of", index, name, tmp_path / "root")
    assert not list((tmp_path / "root").glob("*.parquet"))


EMPTY = (
    "visgel cloth objectfolder_real ycb_slide octopi tacquad tvl ssvtp feel objectfolder "
    "real_touch touch_and_go"
)


@pytest.mark.parametrize(
    ("name", "renamed", "says"),
    [
        ("visgel", "images/toch/a/frame0000.jpg", "images/touch"),
        ("cloth", "Data/nothing.txt.png", "no frame of cloth that could be used"),
        (
            "cloth",
            "Daten/11/t/gelsight_frame/0000.png",
            "is ROOT the folder that holds 'Data_ICRA18'",
        ),
        ("objectfolder_real", "tactile/1/0/gelsite/0.png", "gelsight/<n>.png"),
        (
            "ycb_slide",
            "real/mug/dataset_0/frame/frame_0000000.jpg",
            "is ROOT the folder that holds 'real'",
        ),
        ("octopi", "dataset/apple_0.mov.png", "process_dataset.py"),
        *((name, None, "expected .*is ROOT the folder") for name in EMPTY.split()),
    ],
)
def test_a_renamed_or_empty_folder_is_an_error(tmp_path, read, name, renamed, says):
    fill(tmp_path, [renamed] if renamed else [])
    refused(says, read, name)


@pytest.fixture
def edited(tmp_path, read):
    """edited(ending): the manifest of two objects, to which somebody added label.material and
    changed a split.
    """

    def make(ending):
        fill(tmp_path, [f"{name}/{n}.png" for name in ("mug", "ball") for n in range(3)])
        out = tmp_path / f"hand{ending}"
        table = read("recordings", out=out, sensor="digit", val=0, test=0).manifest
        split = [
            "test" if path.startswith("mug") else "train"
            for path in table.column("path").to_pylist()
        ]
        material = [None, *["clay"] * 5]
        manifests.write(
            replace_column(replace_column(table, "split", split), "label.material", material), out
        )
        return out

    return make


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_an_edited_manifest_is_not_replaced_without_keep(tmp_path, read, edited, ending):
    out = edited(ending)
    before = out.read_bytes()
    options = IndexOptions(sensor="digit", val=0, test=0)
    says = (
        rf"hand{ending} has other values of split \(3 rows\), label.material, which index does not "
        "write: .*--keep"
    )
    refused(says, index, "recordings", tmp_path, out, options=options)
    assert out.read_bytes() == before
    fill(tmp_path, ["mug/3.png", "mug/more/0.png", "cup/0.png"])
    (tmp_path / "ball" / "2.png").unlink()
    report = index("recordings", tmp_path, out, options=options, keep=True)
    rows = {row["path"]: row for row in manifests.read(out).table.to_pylist()}
    # New frames and recordings stand where their object does.
    tested = {path for path, row in rows.items() if row["split"] == "test"}
    assert tested == {*(f"mug/{n}.png" for n in range(4)), "mug/more/0.png"}
    assert sum(row["label.material"] == "clay" for row in rows.values()) == 4 and len(rows) == 8
    assert rows["mug/3.png"]["label.material"] is None and "kept from hand" in " ".join(
        report.notes
    )


def test_what_index_wrote_itself_is_replaced(tmp_path, read):
    fill(tmp_path, [f"{name}/{n}.png" for name in ("mug", "ball") for n in range(3)])
    for out in (tmp_path / "a.csv", tmp_path / "a.parquet"):
        read("recordings", out=out, sensor="digit", val=0, test=0)
        (tmp_path / "ball" / "2.png").unlink(missing_ok=True)
        fill(tmp_path, ["cup/0.png"])
        assert "cup/0.png" in read("recordings", out=out, sensor="digit", val=0, test=0).rows
    # Parquet tells
    assert set(read("recordings", out=out, sensor="digit", val=0, test=1)["split"]) == {"test"}
    refused(
        "other values of split",
        read,
        "recordings",
        out=tmp_path / "a.csv",
        sensor="digit",
        val=0,
        test=1,
    )
