import io
import json
import os
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pyarrow as pa
import pytest
from checked_world import finding_rows, image_pairs, patterned, plain_rows, with_patterns
from refused import refused

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import replace_column, select_rows
from anytouch_jax.datasets.shards import pack
from anytouch_jax.datasets.verify import (
    NO,
    UNKNOWN,
    YES,
    allows,
    commercial_only,
    commercial_use,
    licences,
    repair,
    split_hash,
    verify,
)


@pytest.fixture
def make(make):
    return with_patterns(make)


IMAGE = cv2.resize(np.random.default_rng(0).integers(0, 256, (4, 5, 3), np.uint8), (50, 40))


def _encoded(suffix, image=IMAGE):
    return cv2.imencode(suffix, image)[1].tobytes()


def test_a_clean_manifest_has_no_findings(make):
    report = verify(make(plain_rows(license="MIT")))
    assert report.ok and report.findings == () and (report.rows, report.files) == (6, 6)
    assert report.splits == {"train": 6}
    assert report.fractions == {"d": dict.fromkeys(report.fractions["d"], 0.0) | {"license": 1.0}}
    assert "No fault was found" in report.to_markdown()
    assert json.loads(report.to_json())["ok"] is True


BOMB = _encoded(".png")[:16] + (60000).to_bytes(4, "big") * 2 + _encoded(".png")[24:]
np.save(NAN := io.BytesIO(), np.full((4, 4, 3), np.nan))
# What is to be found is the first word.
HARMS = {
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b""),
    "truncated jpeg": lambda path: path.write_bytes(_encoded(".jpg")[:-40]),
    "truncated png": lambda path: path.write_bytes(_encoded(".png")[:-400]),
    "unreadable bomb": lambda path: path.write_bytes(BOMB),
    "unreadable text": lambda path: path.write_bytes(b"not a picture"),
    "unreadable nan": lambda path: path.write_bytes(NAN.getvalue()),
    "unreadable folder": lambda path: path.mkdir(),
    "unreadable pipe": os.mkfifo,
    "outside link": lambda path: path.symlink_to("/etc/hostname"),
    "unreadable loop": lambda path: path.symlink_to(path.name),
}


def _harm(path, how):
    path.unlink()
    HARMS[how](path)


@pytest.mark.parametrize("how", HARMS)
@pytest.mark.parametrize("column", ["path", "image2_path"])
def test_a_bad_file_is_found_named_and_repaired(make, tmp_path, how, column):
    loose = make(plain_rows() if column == "path" else plain_rows(**{column: "photo ü.png"}))
    rows = [2] if column == "path" else [0, 1, 2, 3, 4, 5]
    spoiled = loose.file(2, column)
    _harm(spoiled, how)
    report = verify(loose, threads=2)
    state = how.split()[0]
    (finding,) = (f for f in report.findings if f.kind == state)
    assert not report.ok and finding_rows(report) == {state: rows}
    assert finding.column == column and finding.level == "error"
    assert (
        f"row {rows[0]} of {loose.files[0]}" in finding.examples[0]
        and spoiled.name in finding.examples[0]
    )
    fixed = repair(loose, report)
    assert (
        len(fixed.done) == 1
        and str(len(rows)) in fixed.done[0]
        and state in fixed.done[0]
        and not fixed.left
    )
    if column == "path":
        assert fixed.manifest.column("path").to_pylist() == [f"f{i}.png" for i in (0, 1, 3, 4, 5)]
    else:
        assert len(fixed.manifest) == 6 and not fixed.manifest.present(column).any()
    target = tmp_path / "fixed.csv"
    manifests.write(fixed.manifest, target)
    assert verify(manifests.read(target)).ok
    assert not repair(manifests.read(target), verify(manifests.read(target))).done


def test_a_frame_of_a_force_field_sensor_is_an_array_and_no_image(make):
    loose = make([{}, {}])
    columns = {name: loose.column(name).to_pylist() for name in loose.table.column_names}
    columns |= {
        "path": ["t.npy", "f1.png"],
        "field_path": ["t.npy", None],
        "sensor": ["tac3d", "digit"],
    }
    manifest = manifests.from_columns(columns, loose.files[0])
    np.save(manifest.file(0), np.zeros((20, 20, 6), np.float32))
    report = verify(manifest)
    assert report.ok and len(repair(manifest, report).manifest) == 2


def test_odd_but_whole_images_are_no_fault(make):
    from PIL import Image

    loose = make(plain_rows(7))
    rgb = IMAGE[..., ::-1]
    cv2.imwrite(str(loose.file(0)), IMAGE[..., 0])
    cv2.imwrite(str(loose.file(1)), IMAGE.astype(np.uint16) * 257)
    cv2.imwrite(str(loose.file(2)), np.dstack([IMAGE, IMAGE[..., 0]]))
    Image.fromarray(rgb).convert("CMYK").save(loose.file(3), "jpeg", quality=95)
    Image.fromarray(rgb).convert("P").save(loose.file(4), "png")
    Image.fromarray(rgb).save(loose.file(5), "jpeg", progressive=True)
    Image.fromarray(rgb).convert("LA").save(loose.file(6), "png")
    report = verify(loose)
    assert report.findings == () and {tuple(size) for size in report.scan.size.tolist()} == {
        (50, 40)
    }
    smooth = cv2.resize(rgb[:4, :5], (50, 40))
    Image.fromarray(smooth).convert("CMYK").save(loose.file(3), "jpeg", quality=95)
    # not inverted, as Adobe's files are
    assert np.abs(decode(loose.file(3)).astype(int) - smooth).mean() < 12


def test_without_decoding_only_presence_is_seen(make):
    loose = make(plain_rows())
    _harm(loose.file(1), "truncated png")
    _harm(loose.file(2), "empty")
    _harm(loose.file(3), "missing")
    _harm(loose.file(4), "outside link")
    report = verify(loose, decode=False)
    assert finding_rows(report) == {"missing": [3], "empty": [2], "outside": [4]}
    assert not report.decoded and "not decoded" in report.to_markdown()


def test_a_packed_manifest_is_verified_like_a_loose_one(make, tmp_path):
    loose = make(plain_rows(), "deep")
    again = manifests.read(pack(loose, tmp_path / "out"))
    one = verify(loose)
    two = verify(again)
    assert two.findings == () and two.split_hash == one.split_hash
    np.testing.assert_array_equal(np.sort(one.scan.digest), np.sort(two.scan.digest))
    data = bytearray((tmp_path / "out" / "touch" / "00000.zip").read_bytes())
    data[data.index(loose.file(3).read_bytes()) + 20] ^= 1
    (tmp_path / "out" / "touch" / "00000.zip").write_bytes(bytes(data))
    for decoded in (True, False):
        report = verify(again, decode=decoded)
        assert finding_rows(report) == {"unreadable": [3]}
        assert "row 3 of the shard is damaged" in report.findings[0].examples[0]


def test_a_size_that_is_not_the_sensors_is_found(make):
    rows = [
        {"dataset": "d", "sensor": "digit" if i < 5 else "gelslim", "path": f"{i}.png"}
        for i in range(9)
    ]
    loose = make(rows)
    for row, shape in (
        (2, (20, 20, 3)),
        (7, (16, 12, 3)),
        *((row, (40, 50, 3)) for row in (5, 6, 8)),
    ):
        cv2.imwrite(str(loose.file(row)), patterned(np.full(shape, row, np.uint8)))
    report = verify(loose)
    assert finding_rows(report) == {"wrong_size": [2, 7]} and report.ok
    assert (
        "20 x 20, where most of its sensor or sequence are 16 x 12"
        in report.findings[0].examples[0]
    )
    assert (
        "12 x 16, where most of its sensor or sequence are 50 x 40"
        in report.findings[0].examples[1]
    )


def test_duplicates_leaks_and_repeated_rows_are_told_apart(make):
    rows = [{"sequence": f"s{i}", "dataset": "d", "label.slip": i % 2} for i in range(9)]
    rows[3] |= {"split": "test", "path": "other.png"}
    rows[5] |= {"sequence": "s4", "label.slip": 0, "path": "copy.png"}
    rows[6] |= {"path": "f8b.png"}
    loose = make(rows)
    for source, target in ((0, 3), (4, 5), (7, 6)):
        shutil.copy(loose.file(source), loose.file(target))
    report = verify(loose)
    assert finding_rows(report) == {
        "leak_file": [0, 3],
        "repeated_row": [5],
        "duplicate": [0, 3, 6, 7],
        "repeated_frame": [5],
    }
    assert (
        "'f0.png' is in train, test"
        in next(f for f in report.findings if f.kind == "leak_file").examples[0]
    )
    fixed = repair(loose, report)
    assert fixed.manifest.table.equals(select_rows(loose, np.array([0, 1, 2, 3, 4, 6, 7, 8])).table)
    # which side is right is a guess
    assert len(fixed.left) == 2 and any("test" in sentence for sentence in fixed.left)


def test_rows_that_differ_in_anything_are_not_repeats(make):
    rows = [{"path": "one.png", "sequence": "s", "frame_index": 4, "text": None} for _ in range(2)]
    assert finding_rows(verify(make(rows)))["repeated_row"] == [1]
    for change in (
        {"text": "soft"},
        {"text": "-1"},
        {"frame_index": 5},
        {"object": "cup"},
        {"label.x": 1},
    ):
        report = verify(make([rows[0], rows[1] | change]))
        assert "repeated_row" not in finding_rows(report) and finding_rows(report)["duplicate"] == [
            0,
            1,
        ]


def test_one_image_as_touch_and_as_photograph(make):
    loose = make(plain_rows(image_path="v.png"))
    shutil.copy(loose.file(4), loose.file(4, "image_path"))
    assert finding_rows(verify(loose)) == {"touch_is_image": [4]}


@pytest.mark.parametrize("column", ["sequence", "touch", "grasp_group", "object"])
def test_a_split_that_leaks_is_found(make, column):
    rows = [
        {column: "a" if i < 3 else f"b{i}", "split": ["train", "val", "unused"][i % 3]}
        for i in range(8)
    ]
    if column != "sequence":
        rows[4][column] = None
    report = verify(make(rows))
    assert finding_rows(report) == {f"leak_{column}": [0, 1]}
    assert report.findings[0].examples == (f"{column} 'a' is in train, val",)
    assert report.ok == (column == "object")
    assert not verify(make(rows), objects=True).ok


def test_equal_sequences_of_two_manifests_are_no_leak(make, tmp_path):
    for name, split in (("one", "train"), ("two", "test")):
        manifests.write(make(plain_rows(split=split), name), tmp_path / name / "m.csv")
    both = manifests.read([tmp_path / "one" / "m.csv", tmp_path / "two" / "m.csv"])
    # the same colours, but not the same sequences
    assert set(finding_rows(verify(both))) == {"leak_file", "duplicate"}


def test_a_name_of_a_sensor_within_two_letters_of_a_known_one_is_an_error(make):
    names = [
        "digit",
        "dgit",
        "dgit",
        "gelsight_mni",
        "GelSight-Mini",
        "Tac3D",
        "my_gel",
        "universal",
        "digit_2",
    ]
    report = verify(make([{"sensor": name, "sequence": f"s{i}"} for i, name in enumerate(names)]))
    told = {
        tuple(one.rows.tolist()): one for one in report.findings if one.kind == "unknown_sensor"
    }
    assert told.keys() == {(1, 2), (3,), (4,), (5,)} and {one.level for one in told.values()} == {
        "error"
    }
    for rows, meant in {
        (1, 2): "digit",
        (3,): "gelsight_mini",
        (4,): "gelsight_mini",
        (5,): "tac3d",
    }.items():
        assert (
            f"did you mean {meant}?" in told[rows].sentence
            and names[rows[0]] in told[rows].sentence
        )


@pytest.mark.parametrize(
    ("bits", "suffix"), [(8, ".png"), (12, ".png"), (12, ".tiff"), (14, ".png"), (16, ".png")]
)
def test_images_that_use_fewer_bits_than_their_files_are_named_with_the_factor(make, bits, suffix):
    manifest = make([{"path": f"{i}{suffix}", "sequence": "s", "frame_index": i} for i in range(4)])
    rng = np.random.default_rng(0)
    # the last is darker, as the largest of all images counts
    for row in range(4):
        most = 2**bits >> (row == 3)
        noise = cv2.resize(rng.random((6, 8, 3)), (40, 30), interpolation=cv2.INTER_CUBIC).clip(
            0, 1
        )
        noise[0, 0] = 1
        cv2.imwrite(str(manifest.file(row)), (noise * (most - 1)).astype(np.uint16))
    found = {one.kind: one for one in verify(manifest).findings}
    assert ("bits" in found) == (bits < 16) and not found.keys() & {
        "flat",
        "cut",
        "border",
        "noise",
    }
    if bits < 16:
        assert (
            f"use {bits} of 16 bits" in found["bits"].sentence
            and f"* {2 ** (16 - bits)})" in found["bits"].sentence
        )
        for row in range(4):
            cv2.imwrite(
                str(manifest.file(row)), cv2.imread(str(manifest.file(row)), -1) * 2 ** (16 - bits)
            )
        assert "bits" not in {one.kind for one in verify(manifest).findings}


def test_one_class_in_several_spellings_and_words_among_numbers_are_named(make):
    values = ["Wood", "wood", "wood ", "caf\u00e9", "cafe\u0301", "clay"]
    numbers = ["1", "2.5", "N/K", "4", "5", "6"]
    sizes = ["1", "XL"] * 3
    rows = zip(values, numbers, sizes, strict=True)
    columns = ("label.kind", "label.force", "label.size")
    report = verify(
        make(
            [
                {"sequence": f"s{i}", **dict(zip(columns, row, strict=True))}
                for i, row in enumerate(rows)
            ]
        )
    )
    found = [finding for finding in report.findings if finding.kind == "spelling"]
    assert report.ok and [finding.rows.tolist() for finding in found] == [[0, 1, 2], [3, 4]]
    assert found[0].column == "label.kind" and "'wood ' (1 rows)" in found[0].sentence
    (found,) = [one for one in report.findings if one.kind == "words_among_numbers"]
    assert (
        found.rows.tolist() == [2]
        and found.column == "label.force"
        and "'N/K'" in found.examples[0]
    )


def test_frames_out_of_order_and_frames_twice(make):
    frames = [0, 2, 1, 3, 3, 0]
    rows = [
        {"sequence": "s" if i < 5 else "r", "frame_index": frame} for i, frame in enumerate(frames)
    ]
    report = verify(make(rows))
    assert finding_rows(report) == {"frame_order": [2], "repeated_frame": [4]}
    assert ": 1, 's'" in report.findings[1].examples[0]


def test_values_are_counted_by_data_set_and_lists_are_named(make):
    rows = [
        {
            "dataset": "a" if i < 4 else "b",
            "text": "t" if i % 4 == 0 else None,
            "sequence": f"s{i}",
            "image_path": "v.png" if i < 2 else None,
            "label.force": [None, 2.5][i % 2],
        }
        for i in range(6)
    ]
    manifest = make(rows)
    window = pa.array([[1.0], None, [2.0, 3.0], [4.0], None, None])
    report = verify(replace(manifest, table=manifest.table.append_column("label.window", window)))
    assert report.fractions["a"]["text"] == 0.25 and report.fractions["b"]["text"] == 0.5
    assert report.fractions["a"]["image_path"] == 0.5 and report.fractions["b"]["image_path"] == 0.0
    assert report.labels == {"label.force": 3, "label.window": 3}
    page = report.to_markdown()
    assert "| a | 50% | 25% |" in page and "label.force 3, label.window 3" in page
    (found,) = [one for one in report.findings if one.kind == "list_label"]
    assert found.rows.tolist() == [0, 2, 3] and "label.window" in found.sentence


def test_the_report_is_whole_as_json(make):
    loose = make(plain_rows(1200))
    for row in range(1100):
        loose.file(row).unlink()
    report = verify(loose, decode=False)
    (finding,) = json.loads(report.to_json())["findings"]
    assert (
        finding["files"] == [f"f{row}.png" for row in range(1000)]
        and "and more: `--out`" in report.to_markdown()
    )
    assert (
        finding["count"] == 1100
        and finding["rows"] == list(range(1000))
        and len(finding["examples"]) == 5
    )


@pytest.mark.parametrize("witness", [True, False])
def test_some_swapped_rows_are_pointed_at_and_what_is_not_swapped_is_not_suspected(
    make, tmp_path, witness
):
    loose = image_pairs(tmp_path, make, swap=lambda i: i % 4 == 1, witness=witness)
    report = verify(loose)
    assert finding_rows(report)["swapped_rows"] == list(range(1, 24, 4))
    assert not repair(loose, report).done
    loose = image_pairs(tmp_path, make, swap=lambda i: False, witness=witness)
    if not witness:  # an RGB image is none
        loose = replace_column(loose, "background_path", ["see3.png"] * 24)
    assert {"swapped", "swapped_rows"}.isdisjoint(finding_rows(verify(loose)))


def test_the_split_hash_sees_splits_and_nothing_else(make):
    loose = make(plain_rows(unit="u", object="cup"))
    base = split_hash(loose)
    assert split_hash(select_rows(loose, np.array([3, 0, 5, 1, 4, 2]))) == base
    assert split_hash(replace_column(loose, "path", [f"x{i}" for i in range(6)])) == base
    assert split_hash(replace_column(loose, "text", ["a"] * 6)) == base
    for name, values in (
        ("split", ["train"] * 5 + ["test"]),
        ("frame_index", [0, 1, 2, 0, 1, 3]),
        ("unit", ["u"] * 5 + ["v"]),
        ("unit", ["u"] * 5 + [None]),
        ("unit", ["u"] * 5 + ["-"]),
        ("sequence", ["s0"] * 3 + ["s2"] * 3),
        ("dataset", ["e"] * 6),
    ):
        assert split_hash(replace_column(loose, name, values)) != base, name
    assert split_hash(select_rows(loose, np.arange(5))) != base
    without, dash = (replace_column(loose, "unit", ["u"] * 5 + [end]) for end in (None, "-"))
    assert split_hash(without) != split_hash(dash)


@pytest.mark.parametrize("witness", [True, False])
def test_a_swapped_dataset_is_suspected_and_mended_only_with_a_witness(make, tmp_path, witness):
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=witness)
    report = verify(loose)
    (finding,) = (f for f in report.findings if f.kind == "swapped")
    assert finding.rows.tolist() == list(range(24)) and finding.level == (
        "error" if witness else "warning"
    )
    assert ("suspected" in finding.sentence) != witness and "'tvl'" in finding.sentence
    fixed = repair(loose, report)
    if not witness:
        assert not fixed.done and any("swapped" in sentence for sentence in fixed.left)
        fixed = repair(loose, report, swap=["tvl"])
    assert len(fixed.done) == 1 and not any("swapped" in sentence for sentence in fixed.left)
    assert fixed.manifest.column("path").to_pylist()[:2] == ["see0.png", "see1.png"]
    assert fixed.manifest.column("image_path").to_pylist()[:2] == ["touch0.png", "touch1.png"]
    assert "swapped" not in finding_rows(verify(fixed.manifest))
    refused("no dataset 'tlv' to swap; the manifest has tvl", repair, loose, report, swap=["tlv"])


def test_an_exchanged_row_lives_by_its_new_touch_image(make, tmp_path):
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=True)
    (tmp_path / "touch3.png").unlink()  # an RGB image, in truth
    (tmp_path / "see5.png").write_bytes(b"")  # a touch image, in truth
    fixed = repair(loose, verify(loose), swap=["tvl"])
    kept = fixed.manifest.column("path").to_pylist()
    assert (
        "see5.png" not in kept
        and kept[3] == "see3.png"
        and fixed.manifest.value(3, "image_path") is None
    )
    assert len(kept) == 24


def test_repair_says_when_it_cannot_or_may_not(make, tmp_path):
    loose = make(plain_rows())
    refused("of another manifest", repair, select_rows(loose, np.arange(3)), verify(loose))
    manifests.write(loose, tmp_path / "manifest.csv")
    before = (tmp_path / "manifest.csv").read_bytes()
    loose = manifests.read(tmp_path / "manifest.csv")
    loose.file(0).unlink()
    fixed = repair(loose, verify(loose))
    assert (tmp_path / "manifest.csv").read_bytes() == before and len(fixed.manifest) == 5
    for row in range(1, 6):
        loose.file(row).unlink()
    refused("are the files really in", repair, loose, verify(loose))


def test_a_row_is_dropped_for_one_reason_only(make):
    loose = make([{"path": "one.png", "sequence": "s"}] * 2 + [{"path": "two.png"}])
    loose.file(0).write_bytes(b"no picture")
    assert repair(loose, verify(loose)).done == (
        "dropped 2 rows whose touch image cannot be used (2 unreadable)",
    )


def test_backgrounds_that_changed_places_too_are_no_witness(make, tmp_path):
    """TVL: the frames without contact lie in the same two folders as the others."""
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=False)
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
    loose = image_pairs(tmp_path, make, swap=lambda i: True, witness=True)
    split = ["background" if i % 4 == 0 else "train" for i in range(24)] + ["background"]
    loose = replace_column(loose, "split", split)
    fixed = repair(loose, verify(loose))
    assert fixed.manifest.column("path").to_pylist()[:24] == [f"see{i}.png" for i in range(24)]


@pytest.mark.parametrize(
    ("licence", "use"),
    [
        ("MIT", YES),
        ("mit license", YES),
        ("Apache-2.0", YES),
        ("Apache 2.0 License", YES),
        ("BSD-3-Clause", YES),
        ("CC-BY-4.0", YES),
        ("CC BY-SA 4.0", YES),
        ("CC0", YES),
        ("CC-BY-NC-4.0", NO),
        ("CC BY-NC-SA 4.0", NO),
        ("non-commercial", NO),
        ("for research use only", NO),
        ("academic only", NO),
        ("Noncommercial terms", NO),
        ("custom", UNKNOWN),
        ("", UNKNOWN),
        (None, UNKNOWN),
        ("MIT, data under other terms", UNKNOWN),
        ("ncsa", UNKNOWN),
    ],
)
def test_licences_by_name(licence, use):
    assert allows(licence) == use


def test_commercial_rows_are_those_that_certainly_are(make):
    cases = [
        ("MIT", None),
        ("MIT", True),
        ("MIT", False),
        ("CC-BY-NC-4.0", True),
        (None, True),
        (None, None),
        ("custom", True),
        ("custom", None),
    ]
    rows = [
        {"license": name, "commercial": flag, "dataset": f"d{i % 2}"}
        for i, (name, flag) in enumerate(cases)
    ]
    loose = make(rows)
    assert commercial_use(loose).tolist() == [YES, YES, NO, NO, YES, UNKNOWN, YES, UNKNOWN]
    kept = commercial_only(loose)
    assert kept.manifest.column("path").to_pylist() == [f"f{i}.png" for i in (0, 1, 4, 6)]
    assert (kept.non_commercial, kept.unknown) == (2, 2)
    assert kept.manifest.where(3) == loose.where(6)
    report = verify(loose)
    assert (
        finding_rows(report) == {"licence_conflict": [3]}
        and "'CC-BY-NC-4.0'" in report.findings[0].examples[0]
    )
    result = licences(loose)
    assert sum(entry.rows for entry in result) == 8 and result[0] == ("MIT", YES, ("d0", "d1"), 2)
    refused(r"2 may not, 2 do not say", commercial_only, select_rows(loose, np.array([2, 3, 5, 7])))
