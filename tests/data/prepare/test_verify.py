import json
import os
import shutil

import cv2
import numpy as np
import pytest

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import replace_column, select_rows
from anytouch_jax.data.prepare.licences import NO, UNKNOWN, YES, allows, commercial_only, commercial_use, licences
from anytouch_jax.data.prepare.repair import repair
from anytouch_jax.data.prepare.shards import pack
from anytouch_jax.data.prepare.verify import split_hash, verify
from anytouch_jax.errors import UserError

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8)


def _encoded(suffix, image=IMAGE):
    return cv2.imencode(suffix, image)[1].tobytes()


def _kinds(report):
    return {finding.kind: finding.rows.tolist() for finding in report.findings}


def _clean(count=6, **extra):
    return [{"sequence": f"s{i // 3}", "frame_index": i % 3, "dataset": "d", **extra} for i in range(count)]


# Files ------------------------------------------------------------------------------------------------------------


def test_a_clean_manifest_has_no_findings(make):
    report = verify(make(_clean(license="MIT")))
    assert report.ok and report.findings == () and (report.rows, report.files) == (6, 6)
    assert report.splits == {"train": 6}
    assert report.shares == {"d": dict.fromkeys(report.shares["d"], 0.0) | {"license": 1.0}}
    assert "No fault was found" in report.to_markdown()
    assert json.loads(report.to_json())["ok"] is True


def _png_bomb():
    data = bytearray(_encoded(".png"))
    data[16:24] = (60000).to_bytes(4, "big") * 2
    return bytes(data)


def _harm(path, how):
    """Spoil a file: what is to be found is the first part of `how`."""
    path.unlink()
    data = {
        "empty": b"",
        "truncated jpeg": _encoded(".jpg")[:-40],
        "truncated png": _encoded(".png")[:-400],
        "unreadable bomb": _png_bomb(),
        "unreadable text": b"not a picture",
        "unreadable nan": b"",
    }.get(how)
    if how == "unreadable nan":
        with path.open("wb") as file:
            np.save(file, np.full((4, 4, 3), np.nan))
    elif data is not None:
        path.write_bytes(data)
    elif how == "unreadable folder":
        path.mkdir()
    elif how == "unreadable pipe":
        os.mkfifo(path)
    elif how == "outside link":
        path.symlink_to("/etc/hostname")
    elif how == "unreadable loop":
        path.symlink_to(path.name)


HARMS = [
    "missing", "empty", "truncated jpeg", "truncated png", "unreadable bomb", "unreadable text", "unreadable nan",
    "unreadable folder", "unreadable pipe", "outside link", "unreadable loop",
]  # fmt: skip


@pytest.mark.parametrize("how", HARMS)
@pytest.mark.parametrize("column", ["path", "image_path", "image2_path"])
def test_a_bad_file_is_found_named_and_repaired(make, tmp_path, how, column):
    loose = make(_clean() if column == "path" else _clean(**{column: "photo ü.png"}))
    rows, spoiled = [2] if column == "path" else [0, 1, 2, 3, 4, 5], loose.file(2, column)
    _harm(spoiled, how)
    report = verify(loose, threads=2)
    state = how.split()[0]
    (finding,) = (f for f in report.findings if f.kind == state)
    assert not report.ok and _kinds(report) == {state: rows}
    assert finding.column == column and finding.level == "error"
    assert f"row {rows[0]} of {loose.files[0]}" in finding.examples[0] and spoiled.name in finding.examples[0]
    fixed = repair(loose, report)
    assert len(fixed.done) == 1 and str(len(rows)) in fixed.done[0] and state in fixed.done[0] and not fixed.left
    if column == "path":
        assert fixed.manifest.column("path").to_pylist() == [f"f{i}.png" for i in (0, 1, 3, 4, 5)]
    else:
        assert len(fixed.manifest) == 6 and not fixed.manifest.present(column).any()
    target = tmp_path / "fixed.csv"
    manifests.write(fixed.manifest, target)
    assert verify(manifests.read(target)).ok
    assert not repair(manifests.read(target), verify(manifests.read(target))).done


def test_a_frame_of_a_force_field_sensor_is_an_array_and_no_picture(make):
    loose = make([{}, {}])
    columns = {name: loose.column(name).to_pylist() for name in loose.table.column_names}
    columns |= {"path": ["t.npy", "f1.png"], "field_path": ["t.npy", None], "sensor": ["tac3d", "digit"]}
    manifest = manifests.from_columns(columns, loose.files[0])
    np.save(manifest.file(0), np.zeros((20, 20, 6), np.float32))
    report = verify(manifest)
    assert report.ok and len(repair(manifest, report).manifest) == 2


def test_odd_but_whole_pictures_are_no_fault(make):
    from PIL import Image

    loose = make(_clean(7))
    rgb = IMAGE[..., ::-1]
    cv2.imwrite(str(loose.file(0)), IMAGE[..., 0])
    cv2.imwrite(str(loose.file(1)), IMAGE.astype(np.uint16) * 257)
    cv2.imwrite(str(loose.file(2)), np.dstack([IMAGE, IMAGE[..., 0]]))
    Image.fromarray(rgb).convert("CMYK").save(loose.file(3), "jpeg", quality=95)
    Image.fromarray(rgb).convert("P").save(loose.file(4), "png")
    Image.fromarray(rgb).save(loose.file(5), "jpeg", progressive=True)
    Image.fromarray(rgb).convert("LA").save(loose.file(6), "png")
    report = verify(loose)
    assert report.findings == () and {tuple(size) for size in report.scan.size.tolist()} == {(50, 40)}
    smooth = cv2.resize(rgb[:4, :5], (50, 40))
    Image.fromarray(smooth).convert("CMYK").save(loose.file(3), "jpeg", quality=95)
    assert np.abs(decode(loose.file(3)).astype(int) - smooth).mean() < 12  # not inverted, as Adobe's files are


def test_without_decoding_only_presence_is_seen(make):
    loose = make(_clean())
    _harm(loose.file(1), "truncated png")
    _harm(loose.file(2), "empty")
    _harm(loose.file(3), "missing")
    _harm(loose.file(4), "outside link")
    report = verify(loose, decode=False)
    assert _kinds(report) == {"missing": [3], "empty": [2], "outside": [4]}
    assert not report.decoded and "not decoded" in report.to_markdown()


def test_a_packed_manifest_is_verified_like_a_loose_one(make, tmp_path):
    loose = make(_clean(), "deep")
    again = manifests.read(pack(loose, tmp_path / "out"))
    one, two = verify(loose), verify(again)
    assert two.findings == () and two.split_hash == one.split_hash
    np.testing.assert_array_equal(np.sort(one.scan.digest), np.sort(two.scan.digest))
    data = bytearray((tmp_path / "out" / "touch" / "00000.zip").read_bytes())
    data[data.index(loose.file(3).read_bytes()) + 20] ^= 1
    (tmp_path / "out" / "touch" / "00000.zip").write_bytes(bytes(data))
    for decoded in (True, False):
        report = verify(again, decode=decoded)
        assert _kinds(report) == {"unreadable": [3]}
        assert "row 3 of the shard is damaged" in report.findings[0].examples[0]


def test_a_size_that_is_not_the_sensors_is_found(make):
    rows = [{"dataset": "d", "sensor": "digit" if i < 5 else "gelslim", "path": f"{i}.png"} for i in range(9)]
    loose = make(rows)
    for row, shape in ((2, (20, 20, 3)), (7, (16, 12, 3)), *((row, (40, 50, 3)) for row in (5, 6, 8))):
        cv2.imwrite(str(loose.file(row)), np.full(shape, row, np.uint8))
    report = verify(loose)
    assert _kinds(report) == {"wrong_size": [2, 7]} and report.ok
    assert "20 x 20, where most of its sensor are 16 x 12" in report.findings[0].examples[0]
    assert "12 x 16, where most of its sensor are 50 x 40" in report.findings[0].examples[1]


# Rows -------------------------------------------------------------------------------------------------------------


def test_duplicates_leaks_and_repeated_rows_are_told_apart(make):
    rows = [{"sequence": f"s{i}", "dataset": "d", "label.slip": i % 2} for i in range(9)]
    rows[3] |= {"split": "test", "path": "other.png"}
    rows[5] |= {"sequence": "s4", "label.slip": 0, "path": "copy.png"}
    rows[6] |= {"path": "f8b.png"}
    loose = make(rows)
    for source, target in ((0, 3), (4, 5), (7, 6)):
        shutil.copy(loose.file(source), loose.file(target))
    report = verify(loose)
    assert _kinds(report) == {"leak_file": [0, 3], "repeated_row": [5], "duplicate": [0, 3, 6, 7],
                              "repeated_frame": [5]}  # fmt: skip
    assert "'f0.png' is in train, test" in next(f for f in report.findings if f.kind == "leak_file").examples[0]
    fixed = repair(loose, report)
    assert fixed.manifest.table.equals(select_rows(loose, np.array([0, 1, 2, 3, 4, 6, 7, 8])).table)
    assert len(fixed.left) == 2 and any("test" in sentence for sentence in fixed.left)  # which side is right is a guess


def test_rows_that_differ_in_anything_are_not_repeats(make):
    rows = [{"path": "one.png", "sequence": "s", "frame_index": 4, "text": None} for _ in range(2)]
    assert _kinds(verify(make(rows)))["repeated_row"] == [1]
    for change in ({"text": "soft"}, {"text": "-1"}, {"frame_index": 5}, {"object": "cup"}, {"label.x": 1}):
        report = verify(make([rows[0], rows[1] | change]))
        assert "repeated_row" not in _kinds(report) and _kinds(report)["duplicate"] == [0, 1]


def test_one_picture_as_touch_and_as_photograph(make):
    loose = make(_clean(image_path="v.png"))
    shutil.copy(loose.file(4), loose.file(4, "image_path"))
    assert _kinds(verify(loose)) == {"touch_is_picture": [4]}


@pytest.mark.parametrize("column", ["sequence", "touch", "grasp_group", "object"])
def test_a_split_that_leaks_is_found(make, column):
    rows = [{column: "a" if i < 3 else f"b{i}", "split": ["train", "val", "unused"][i % 3]} for i in range(8)]
    if column != "sequence":
        rows[4][column] = None
    report = verify(make(rows))
    assert _kinds(report) == {f"leak_{column}": [0, 1]}
    assert report.findings[0].examples == (f"{column} 'a' is in train, val",)
    assert report.ok == (column == "object")
    assert not verify(make(rows), objects=True).ok


def test_equal_sequences_of_two_manifests_are_no_leak(make, tmp_path):
    for name, split in (("one", "train"), ("two", "test")):
        manifests.write(make(_clean(split=split), name), tmp_path / name / "m.csv")
    both = manifests.read([tmp_path / "one" / "m.csv", tmp_path / "two" / "m.csv"])
    assert set(_kinds(verify(both))) == {"leak_file", "duplicate"}  # the same colours, but not the same sequences


def test_a_slip_in_the_name_of_a_sensor_is_told(make):
    names = ["digit", "dgit", "dgit", "gelsight_mni", "my_gel", "universal"]
    report = verify(make([{"sensor": name, "sequence": f"s{i}"} for i, name in enumerate(names)]))
    told = [finding for finding in report.findings if finding.kind == "unknown_sensor"]
    assert [(one.level, one.rows.tolist()) for one in told] == [("warning", [1, 2]), ("warning", [3])]
    assert told[0].sentence == "2 rows are of sensor 'dgit', which is not known: did you mean digit?"


def test_another_spelling_of_a_known_sensor_is_an_error(make):
    names = ["DIGIT", "GelSight-Mini", "Tac3D", "digit"]
    report = verify(make([{"sensor": name, "sequence": f"s{i}"} for i, name in enumerate(names)]))
    told = {finding.sentence: finding.level for finding in report.findings if finding.kind == "unknown_sensor"}
    assert set(told.values()) == {"error"} and told.keys() == {
        "1 rows are of sensor 'DIGIT': it is called digit",
        "1 rows are of sensor 'GelSight-Mini': it is called gelsight_mini",
        "1 rows are of sensor 'Tac3D': it is called tac3d",
    }


def test_frames_out_of_order_and_frames_twice(make):
    frames = [0, 2, 1, 3, 3, 0]
    rows = [{"sequence": "s" if i < 5 else "r", "frame_index": frame} for i, frame in enumerate(frames)]
    report = verify(make(rows))
    assert _kinds(report) == {"frame_order": [2], "repeated_frame": [4]}
    assert "frame 1 of sequence 's'" in report.findings[1].examples[0]


def test_shares_of_missing_values_are_told_per_dataset(make):
    rows = [{"dataset": "a" if i < 4 else "b", "text": "t" if i % 4 == 0 else None,
             "image_path": "v.png" if i < 2 else None} for i in range(6)]  # fmt: skip
    report = verify(make(rows))
    assert report.shares["a"]["text"] == 0.25 and report.shares["b"]["text"] == 0.5
    assert report.shares["a"]["image_path"] == 0.5 and report.shares["b"]["image_path"] == 0.0
    assert "| a | 50% | 25% |" in report.to_markdown()


def test_the_report_is_whole_as_json(make):
    loose = make(_clean(1200))
    for row in range(1100):
        loose.file(row).unlink()
    about = json.loads(verify(loose, decode=False).to_json())
    (finding,) = about["findings"]
    assert finding["count"] == 1100 and finding["rows"] == list(range(1000)) and len(finding["examples"]) == 5


# Swapped ----------------------------------------------------------------------------------------------------------


def _pairs(tmp_path, make, *, swap, witness, count=24):
    """Touch: a gel's colours with a faint dent. Vision: anything. Rows where `swap` have the two exchanged."""
    rng = np.random.default_rng(3)
    gel = cv2.resize(rng.integers(60, 190, (3, 4, 3), np.uint8), (32, 24), interpolation=cv2.INTER_CUBIC)
    rows = [{"path": f"touch{i}.png", "image_path": f"see{i}.png", "dataset": "tvl", "sequence": "s", "frame_index": i}
            for i in range(count)]  # fmt: skip
    if witness:
        rows.append({"path": "ground.png", "split": "background", "dataset": "tvl", "sequence": "b"})
    loose = make(rows)
    for i in range(count):
        dent = np.zeros((24, 32), np.int16)
        cv2.circle(dent, (int(rng.integers(32)), int(rng.integers(24))), 5, 40, -1)
        touch = np.clip(gel + dent[..., None] + rng.integers(-3, 4, gel.shape), 0, 255).astype(np.uint8)
        see = cv2.resize(rng.integers(0, 256, (3, 4, 3), np.uint8), (40, 30), interpolation=cv2.INTER_CUBIC)
        first, second = (see, touch) if swap(i) else (touch, see)
        cv2.imwrite(str(tmp_path / f"touch{i}.png"), first)
        cv2.imwrite(str(tmp_path / f"see{i}.png"), second)
    if witness:
        cv2.imwrite(str(tmp_path / "ground.png"), gel)
    return loose


@pytest.mark.parametrize("witness", [True, False])
def test_a_swapped_dataset_is_suspected_and_mended_only_with_a_witness(make, tmp_path, witness):
    loose = _pairs(tmp_path, make, swap=lambda i: True, witness=witness)
    report = verify(loose)
    (finding,) = (f for f in report.findings if f.kind == "swapped")
    assert finding.rows.tolist() == list(range(24)) and finding.level == ("error" if witness else "warning")
    assert ("suspected" in finding.sentence) != witness and "'tvl'" in finding.sentence
    fixed = repair(loose, report)
    if not witness:
        assert not fixed.done and any("swapped" in sentence for sentence in fixed.left)
        fixed = repair(loose, report, swap=["tvl"])
    assert len(fixed.done) == 1 and not any("swapped" in sentence for sentence in fixed.left)
    assert fixed.manifest.column("path").to_pylist()[:2] == ["see0.png", "see1.png"]
    assert fixed.manifest.column("image_path").to_pylist()[:2] == ["touch0.png", "touch1.png"]
    assert "swapped" not in _kinds(verify(fixed.manifest))
    with pytest.raises(UserError, match="no dataset 'tlv' to swap; the manifest has tvl"):
        repair(loose, report, swap=["tlv"])


@pytest.mark.parametrize("witness", [True, False])
def test_some_swapped_rows_are_pointed_at_and_left(make, tmp_path, witness):
    loose = _pairs(tmp_path, make, swap=lambda i: i % 4 == 1, witness=witness)
    report = verify(loose)
    assert _kinds(report)["swapped_rows"] == list(range(1, 24, 4))
    assert not repair(loose, report).done


@pytest.mark.parametrize("witness", [True, False])
def test_what_is_not_swapped_is_not_suspected(make, tmp_path, witness):
    report = verify(_pairs(tmp_path, make, swap=lambda i: False, witness=witness))
    assert {"swapped", "swapped_rows"}.isdisjoint(_kinds(report))


def test_a_photograph_is_no_witness(make, tmp_path):
    loose = _pairs(tmp_path, make, swap=lambda i: False, witness=False)
    loose = replace_column(loose, "background_path", ["see3.png"] * 24)
    assert {"swapped", "swapped_rows"}.isdisjoint(_kinds(verify(loose)))


def test_an_exchanged_row_lives_by_its_new_touch_image(make, tmp_path):
    loose = _pairs(tmp_path, make, swap=lambda i: True, witness=True)
    (tmp_path / "touch3.png").unlink()  # a photograph, in truth
    (tmp_path / "see5.png").write_bytes(b"")  # a touch image, in truth
    fixed = repair(loose, verify(loose), swap=["tvl"])
    kept = fixed.manifest.column("path").to_pylist()
    assert "see5.png" not in kept and kept[3] == "see3.png" and fixed.manifest.value(3, "image_path") is None
    assert len(kept) == 24


# Repair -----------------------------------------------------------------------------------------------------------


def test_repair_says_when_it_cannot_or_may_not(make, tmp_path):
    loose = make(_clean())
    with pytest.raises(UserError, match="of another manifest"):
        repair(select_rows(loose, np.arange(3)), verify(loose))
    manifests.write(loose, tmp_path / "manifest.csv")
    before = (tmp_path / "manifest.csv").read_bytes()
    loose = manifests.read(tmp_path / "manifest.csv")
    loose.file(0).unlink()
    fixed = repair(loose, verify(loose))
    assert (tmp_path / "manifest.csv").read_bytes() == before and len(fixed.manifest) == 5
    for row in range(1, 6):
        loose.file(row).unlink()
    with pytest.raises(UserError, match="are the files really in"):
        repair(loose, verify(loose))


def test_a_row_is_dropped_for_one_reason_only(make):
    loose = make([{"path": "one.png", "sequence": "s"}] * 2 + [{"path": "two.png"}])
    loose.file(0).write_bytes(b"no picture")
    assert repair(loose, verify(loose)).done == ("dropped 2 rows whose touch image cannot be used (2 unreadable)",)


# Splits and licences ----------------------------------------------------------------------------------------------


def test_the_split_hash_sees_splits_and_nothing_else(make):
    loose = make(_clean(unit="u", object="cup"))
    base = split_hash(loose)
    assert split_hash(select_rows(loose, np.array([3, 0, 5, 1, 4, 2]))) == base
    assert split_hash(replace_column(loose, "path", [f"x{i}" for i in range(6)])) == base
    assert split_hash(replace_column(loose, "text", ["a"] * 6)) == base
    for name, values in (
        ("split", ["train"] * 5 + ["test"]), ("frame_index", [0, 1, 2, 0, 1, 3]), ("unit", ["u"] * 5 + ["v"]),
        ("unit", ["u"] * 5 + [None]), ("unit", ["u"] * 5 + ["-"]),
        ("sequence", ["s0"] * 3 + ["s2"] * 3), ("dataset", ["e"] * 6),
    ):  # fmt: skip
        assert split_hash(replace_column(loose, name, values)) != base, name
    assert split_hash(select_rows(loose, np.arange(5))) != base
    without, dash = (replace_column(loose, "unit", ["u"] * 5 + [end]) for end in (None, "-"))
    assert split_hash(without) != split_hash(dash)


@pytest.mark.parametrize(
    ("licence", "use"),
    [
        ("MIT", YES), ("mit license", YES), ("Apache-2.0", YES), ("Apache 2.0 License", YES), ("BSD-3-Clause", YES),
        ("CC-BY-4.0", YES), ("CC BY-SA 4.0", YES), ("CC0", YES), ("CC-BY-NC-4.0", NO), ("CC BY-NC-SA 4.0", NO),
        ("non-commercial", NO), ("for research use only", NO), ("academic only", NO), ("Noncommercial terms", NO),
        ("custom", UNKNOWN), ("", UNKNOWN), (None, UNKNOWN), ("MIT, data under other terms", UNKNOWN),
        ("ncsa", UNKNOWN),
    ],
)  # fmt: skip
def test_licences_by_name(licence, use):
    assert allows(licence) == use


def test_commercial_rows_are_those_that_certainly_are(make):
    cases = [("MIT", None), ("MIT", True), ("MIT", False), ("CC-BY-NC-4.0", True), (None, True), (None, None),
             ("custom", True), ("custom", None)]  # fmt: skip
    rows = [{"license": name, "commercial": flag, "dataset": f"d{i % 2}"} for i, (name, flag) in enumerate(cases)]
    loose = make(rows)
    assert commercial_use(loose).tolist() == [YES, YES, NO, NO, YES, UNKNOWN, YES, UNKNOWN]
    kept = commercial_only(loose)
    assert kept.manifest.column("path").to_pylist() == [f"f{i}.png" for i in (0, 1, 4, 6)]
    assert (kept.non_commercial, kept.unknown) == (2, 2)
    assert kept.manifest.where(3) == loose.where(6)
    report = verify(loose)
    assert _kinds(report) == {"licence_conflict": [3]} and "'CC-BY-NC-4.0'" in report.findings[0].examples[0]
    found = licences(loose)
    assert sum(entry.rows for entry in found) == 8 and found[0] == ("MIT", YES, ("d0", "d1"), 2)
    with pytest.raises(UserError, match=r"2 may not, 2 do not say"):
        commercial_only(select_rows(loose, np.array([2, 3, 5, 7])))


# Manifests that come from elsewhere -------------------------------------------------------------------------------


def test_a_csv_with_bom_quotes_and_strange_names_is_verified(make, tmp_path):
    names = ["plain.png", "with space.png", "grün,kommatisch.png", 'quo"te.png', "日本/語 #1.png", "line\nbreak.png"]
    loose = make([{"path": name} for name in names])
    manifests.write(loose, tmp_path / "m.csv")
    (tmp_path / "m.csv").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "m.csv").read_bytes())
    got = manifests.read(tmp_path / "m.csv")
    assert got.column("path").to_pylist() == names and verify(got).findings == ()
    again = manifests.read(pack(got, tmp_path / "out"))
    assert verify(again).findings == ()


def test_backgrounds_that_changed_places_too_are_no_witness(make, tmp_path):
    """TVL: the frames without contact lie in the same two folders as the others."""
    loose = _pairs(tmp_path, make, swap=lambda i: True, witness=False)
    split = ["background" if i % 4 == 0 else "train" for i in range(24)]
    loose = replace_column(loose, "split", split)
    loose = replace_column(loose, "background_path", ["touch0.png"] * 24)
    report = verify(loose)
    (finding,) = (f for f in report.findings if f.kind == "swapped")
    assert finding.level == "warning" and "suspected" in finding.sentence
    fixed = repair(loose, report, swap=["tvl"])
    assert fixed.manifest.column("path").to_pylist()[:2] == ["see0.png", "see1.png"]
    assert fixed.manifest.column("background_path").null_count == 24


def test_backgrounds_go_with_the_dataset_that_is_exchanged(make, tmp_path):
    loose = _pairs(tmp_path, make, swap=lambda i: True, witness=True)
    split = ["background" if i % 4 == 0 else "train" for i in range(24)] + ["background"]
    loose = replace_column(loose, "split", split)
    fixed = repair(loose, verify(loose))
    assert fixed.manifest.column("path").to_pylist()[:24] == [f"see{i}.png" for i in range(24)]
