import hashlib
import os
import shutil
import zipfile
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from batch_leaves import assert_same
from refused import refused

from anytouch_jax.data.images import decode
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import files as packed
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import select_rows
from anytouch_jax.datasets import shards as packing
from anytouch_jax.datasets.shards import PackError, pack
from anytouch_jax.files import lock


@pytest.fixture(autouse=True)
def _closed():
    yield
    packed.close_shards()


def _rows(sequences=4, length=6):
    """Two sensors at the same places, with images (one shared by a sequence), captions and a
    background each.
    """
    return [
        {
            "path": f"touch {i}/ä{k}.png",
            "sequence": f"s{i}",
            "frame_index": k,
            "sensor": "digit" if i % 2 else "gelslim",
            "touch": f"place{i // 2}.{k}",
            "object": f"o{i // 2}",
            "image_path": f"v{i}.png" if i < 3 else None,
            "image2_path": "w.png" if i == 1 else None,
            "text": f"caption {i}" if i % 2 else None,
            "background_path": f"touch {i}/ä0.png",
            "label.slip": k % 2,
        }
        for i in range(sequences)
        for k in range(length)
    ]


def _shuffled(rows, seed=0):
    return [rows[i] for i in np.random.default_rng(seed).permutation(len(rows))]


def _assert_same_batches(one, two, config, steps=5):
    one = Loader(one, config)
    two = Loader(two, config)
    for (_, a, info), (_, b, other) in zip(one.stream(0, steps), two.stream(0, steps), strict=True):
        assert info == other
        assert_same(a, b)


@pytest.mark.parametrize(
    ("stage", "recipe", "threads"), [(1, "paper", 0), (2, "paper", 3), (2, "release", 2)]
)
@pytest.mark.parametrize("shard_bytes", [1, 1 << 30])
def test_a_packed_manifest_gives_the_same_batches_byte_for_byte(
    make, settings, tmp_path, stage, recipe, threads, shard_bytes
):
    loose = make(_shuffled(_rows()))
    again = manifests.read(pack(loose, tmp_path / "out", shard_bytes=shard_bytes))
    assert again.clips(3).tolist() == loose.clips(3).tolist()
    _assert_same_batches(loose, again, settings(stage, recipe, plain=False, threads=threads))


def test_a_shard_is_a_zip_of_every_file_once_and_unchanged(make, tmp_path):
    loose = make(_shuffled([row | {"license": "MIT"} for row in _rows()]))
    again = manifests.read(pack(loose, tmp_path / "out"))
    for row in range(len(loose)):
        for column in ("path", "image_path", "image2_path", "background_path"):
            if loose.value(row, column) is not None:
                assert (
                    packed.read_file(again.file(row, column))
                    == loose.file(row, column).read_bytes()
                )
    same = [name for name in loose.table.column_names if not name.endswith("path")]
    assert again.table.select(same).equals(loose.table.select(same))
    with zipfile.ZipFile(tmp_path / "out" / "touch" / "00000.zip") as archive:
        assert archive.testzip() is None and {name[6:] for name in archive.namelist()} == {".png"}
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        # a background that is also a row's touch image is not stored again
        assert len(archive.namelist()) == 24
    with zipfile.ZipFile(tmp_path / "out" / "shared" / "00000.zip") as archive:
        assert len(archive.namelist()) == 4
    order = sorted(range(24), key=lambda row: int(again.file(row).name))
    # by sequence, in time
    assert [loose.value(row, "frame_index") for row in order] == list(range(6)) * 4
    assert "| MIT | 24 | " in (tmp_path / "out" / "README.md").read_text()


def test_shards_are_cut_by_size_and_have_their_sums(make, tmp_path):
    loose = make(_rows())
    out = tmp_path / "out"
    sizes = [loose.file(row).stat().st_size for row in range(24)]
    pack(loose, out, shard_bytes=4 * max(sizes))
    counts = [len(packed.read_shard_index(path)) for path in sorted((out / "touch").glob("*.zip"))]
    assert sum(counts) == 24 and max(counts) >= 4
    for number, start in enumerate(np.cumsum([0, *counts[:-1]])):
        assert sum(sizes[start : start + counts[number]]) <= 4 * max(sizes)
    lines = (out / "SHA256SUMS").read_text().splitlines()
    assert {line[66:] for line in lines} == {
        path.relative_to(out).as_posix() for path in out.rglob("*.zip")
    }
    for line in lines:
        assert hashlib.sha256((out / line[66:]).read_bytes()).hexdigest() == line[:64]


def test_arrays_and_field_files_are_packed_too(make, tmp_path):
    loose = make([{"path": f"{i}.png", "field_path": f"{i}.csv"} for i in range(3)])
    pixels = np.random.default_rng(0).random((9, 7, 3)).astype(np.float32)
    # an array under another name is known by its first bytes
    with (tmp_path / "0.png").open("wb") as file:
        np.save(file, np.asfortranarray(pixels))
    for i in range(3):
        (tmp_path / f"{i}.csv").write_text(f"field {i}")
    again = manifests.read(pack(loose, tmp_path / "out"))
    np.testing.assert_array_equal(decode(again.file(0)), np.rint(pixels * 255).astype(np.uint8))
    assert packed.read_file(again.file(2, "field_path")) == b"field 2"


def test_joined_manifests_keep_their_keys_apart(make, settings, tmp_path):
    one = make(_rows(2), "one")
    two = make(_rows(2), "two")
    for name, manifest in (("one", one), ("two", two)):
        manifests.write(manifest, tmp_path / name / "manifest.csv")
    # another image under the same name
    for row in range(12):
        cv2.imwrite(str(two.file(row)), np.full((12, 16, 3), 240 - row, np.uint8))
    both = manifests.read([tmp_path / "one" / "manifest.csv", tmp_path / "two" / "manifest.csv"])
    again = manifests.read(pack(both, tmp_path / "out"))
    assert again.clips(3).tolist() == both.clips(3).tolist()
    assert again.value(0, "touch") != again.value(12, "touch")
    _assert_same_batches(both, again, settings(2))


def test_packed_manifests_go_on_working_when_filtered_moved_or_packed_again(make, tmp_path):
    loose = make(_rows())
    again = manifests.read(pack(loose, tmp_path / "deep" / "out"))
    manifests.write(select_rows(again, np.array([20, 3])), tmp_path / "part.csv")
    part = manifests.read(tmp_path / "part.csv")
    assert part.value(0, "path").startswith("deep/out/touch/00000.zip/")
    for row, old in enumerate((20, 3)):
        assert packed.read_file(part.file(row)) == loose.file(old).read_bytes()
    twice = manifests.read(pack(part, tmp_path / "twice"))
    assert packed.read_file(twice.file(1)) == loose.file(3).read_bytes()


def _bytes_of(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("stop_at", [1, 3])
def test_a_killed_pack_goes_on_behind_the_last_whole_shard(make, tmp_path, monkeypatch, stop_at):
    loose = make(_rows())
    size = 9 * loose.file(0).stat().st_size
    pack(loose, tmp_path / "whole", shard_bytes=size)

    class Killed(BaseException):
        pass

    moves = []
    real = os.replace

    def killing(source, target):
        # pack.json is the first move, then every shard is one.
        moves.append(target)
        if len(moves) == 1 + stop_at:
            raise Killed
        real(source, target)

    monkeypatch.setattr(os, "replace", killing)
    with pytest.raises(Killed):
        pack(loose, tmp_path / "out", shard_bytes=size)
    monkeypatch.setattr(os, "replace", real)
    assert not (tmp_path / "out" / "manifest.parquet").exists()
    # What a kill -9 leaves behind: half of the shard that was being written.
    (tmp_path / "out" / "touch").mkdir(exist_ok=True)
    (tmp_path / "out" / "touch" / f"{stop_at - 1:05d}.part").write_bytes(b"half of it")
    read = []
    fetch = packing.read_file
    monkeypatch.setattr(packing, "read_file", lambda path: read.append(path) or fetch(path))
    pack(loose, tmp_path / "out", shard_bytes=size)
    assert _bytes_of(tmp_path / "out") == _bytes_of(tmp_path / "whole")
    shards = sorted((tmp_path / "whole" / "touch").glob("*.zip"))
    assert len(read) == 28 - sum(
        len(packed.read_shard_index(path)) for path in shards[: stop_at - 1]
    )


def test_a_pack_that_failed_before_its_first_shard_takes_its_folder_again(make, tmp_path):
    loose = make(_rows())
    gone = loose.file(3).read_bytes()
    loose.file(3).unlink()
    refused("--repair", pack, loose, tmp_path / "out")
    # as --repair leaves it
    mended = select_rows(loose, np.delete(np.arange(len(loose)), 3))
    assert pack(mended, tmp_path / "out").is_file()
    loose.file(3).write_bytes(gone)
    refused("another manifest or shard size", pack, loose, tmp_path / "out")


def test_other_folders_are_not_touched(make, tmp_path):
    loose = make(_rows())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("years of work")
    refused("not an empty folder", pack, loose, tmp_path / "full")
    pack(loose, tmp_path / "out")
    refused(
        "another manifest or shard size", pack, select_rows(loose, np.arange(5)), tmp_path / "out"
    )
    refused("another manifest or shard size", pack, loose, tmp_path / "out", shard_bytes=7)
    for spoiled in ('{"version"', "[1]"):
        (tmp_path / "bad").mkdir(exist_ok=True)
        (tmp_path / "bad" / "pack.json").write_text(spoiled)
        refused(r"pack\.json is not of a pack", pack, loose, tmp_path / "bad")
    refused("at least 1 byte", pack, loose, tmp_path / "new", shard_bytes=0)


@pytest.mark.parametrize("harm", ["missing", "empty", "folder", "outside"])
def test_a_file_that_cannot_be_packed_is_named(make, tmp_path, harm):
    loose = make(_rows())
    file = loose.file(7)
    file.unlink()
    if harm == "empty":
        file.touch()
    elif harm == "folder":
        file.mkdir()
    elif harm == "outside":
        file.symlink_to("/etc/hostname")
    words = r"row 7 of .*manifest\.csv, column 'path': 'touch 1/ä1\.png'.*--repair"
    refused(words, pack, loose, tmp_path / "out")
    # reported before the packing
    assert not list((tmp_path / "out").rglob("*.zip")) or harm in ("empty", "folder")
    assert {file.name for file in (tmp_path / "out").rglob("*.part")} | {
        f.name for f in (tmp_path / "out").rglob(".*")
    } <= {".lock"}


def _harm(shard, harm, row):
    at = int(packed.read_shard_index(shard)[row]["offset"])
    data = bytearray(shard.read_bytes())
    if harm in ("short", "compressed"):
        kind, count = (zipfile.ZIP_STORED, row) if harm == "short" else (zipfile.ZIP_DEFLATED, 30)
        with zipfile.ZipFile(shard, "w", kind) as archive:
            for number in range(count):
                archive.writestr(f"{number:06d}.png", bytes(999))
        return
    data[at + 30] ^= harm == "flip"
    shard.write_bytes({"cut": data[: at + 10], "garbage": b"PK garbage"}.get(harm, data))
    if harm == "gone":
        shard.unlink()


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        ("flip", "row 7 of the shard is damaged"),
        ("cut", "is damaged"),
        ("gone", "there is no shard"),
        ("short", "7 rows, no row 7"),
        ("compressed", "is not a shard"),
        ("garbage", "is damaged"),
    ],
)
def test_damage_is_one_sentence_with_shard_and_row(make, settings, tmp_path, harm, words):
    again = manifests.read(pack(make(_rows()), tmp_path / "out"))
    _harm(tmp_path / "out" / "touch" / "00000.zip", harm, 7)
    error = refused(words, decode, again.file(7))
    assert "touch/00000.zip/7" in error
    if harm == "flip":
        assert decode(again.file(6)).shape == (12, 16, 3)
        loader = Loader(again, settings(1, threads=2, batch_size=24, clip_fraction=0.0))
        refused(
            r"row \d+ of .*manifest\.parquet, column 'path': .*00000\.zip/",
            list,
            loader.stream(0, 1),
        )
        loader = Loader(
            again, settings(1, threads=2, batch_size=24, clip_fraction=0.0, on_bad_sample="skip")
        )
        ((_, _, info),) = loader.stream(0, 1)
        assert info["skipped_samples"] >= 1


def test_a_random_file_costs_one_read_of_its_length_and_pieces_are_put_together(
    make, tmp_path, monkeypatch
):
    again = manifests.read(pack(make(_rows()), tmp_path / "out"))
    decode(again.file(0))
    sizes = []
    real = os.pread
    with monkeypatch.context() as changed:
        changed.setattr(
            os, "pread", lambda file, size, offset: sizes.append(size) or real(file, size, offset)
        )
        changed.setattr(os, "open", lambda *_: pytest.fail("a file was opened"))
        data = packed.read_file(again.file(13))
    assert sizes == [len(data)]
    monkeypatch.setattr(os, "pread", lambda file, size, offset: real(file, min(size, 10), offset))
    assert packed.read_file(again.file(13)) == data


def test_few_shards_are_open_at_once_and_threads_do_not_mind(make, tmp_path, monkeypatch):
    loose = make(_rows())
    again = manifests.read(pack(loose, tmp_path / "out", shard_bytes=1))
    monkeypatch.setattr(packed, "_shard", lru_cache(2)(packed._Shard))
    before = len(os.listdir("/proc/self/fd"))
    rows = np.random.default_rng(0).integers(24, size=600)
    with ThreadPoolExecutor(8) as pool:
        got = list(pool.map(lambda row: packed.read_file(again.file(row)), rows.tolist()))
    want = [loose.file(row).read_bytes() for row in range(24)]
    assert all(data == want[row] for data, row in zip(got, rows, strict=True))
    assert (
        packed._shard.cache_info().currsize == 2 and len(os.listdir("/proc/self/fd")) <= before + 2
    )


def test_what_is_a_row_of_a_shard_and_what_is_a_file(tmp_path):
    for name in ("a.zip/x.png", "a/7", "a.zip/7.png", "a.zip/٣", "a.zip", "7"):
        assert packed.split_shard_path(tmp_path / name) is None, name
    for shard in (tmp_path / "a.zip", tmp_path / "a.parquet"):
        assert packed.split_shard_path(shard / "7") == (shard, 7)


def test_what_is_no_regular_file_is_refused_and_never_waited_for(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.png")
    refused("not a regular file", decode, tmp_path / "pipe.png")
    (tmp_path / "loop.png").symlink_to("loop.png")
    refused("cannot be read", decode, tmp_path / "loop.png")
    (tmp_path / "big.png").write_bytes(bytes(11))
    monkeypatch.setattr(packed, "MAX_BYTES", 10)
    refused("11 bytes, more than the limit of 10", decode, tmp_path / "big.png")


def test_a_finished_pack_is_left_alone_and_other_images_are_another_pack(
    make, tmp_path, monkeypatch
):
    loose = make(_rows())
    target = pack(loose, tmp_path / "out")
    with monkeypatch.context() as changed:
        changed.setattr(packing, "read_file", lambda path: pytest.fail("it was packed again"))
        assert pack(loose, tmp_path / "out") == target
    image = loose.file(0)
    image.write_bytes(image.read_bytes() + b"more")
    refused("have changed since", pack, loose, tmp_path / "out")
    for row in range(len(loose)):
        loose.file(row).unlink(missing_ok=True)  # packed and done with
    record = tmp_path / "out" / "pack.json"
    # by 0.1.0
    record.write_text(record.read_text().replace('"version": 2', '"version": 1'))
    assert pack(loose, tmp_path / "out") == target


def test_an_unfinished_pack_is_locked_and_a_damaged_shard_of_it_is_written_again(make, tmp_path):
    source = make(_rows())
    out = tmp_path / "packed"
    pack(source, out)
    (out / "README.md").unlink()  # as if it were still under way
    with (
        lock(out / ".lock"),
        pytest.raises(PackError, match=r"another process packs into .*: wait for it"),
    ):
        pack(source, out)
    shard = out / "touch/00000.zip"
    whole = shard.read_bytes()
    shard.write_bytes(whole[:-9])
    assert pack(source, out).is_file() and shard.read_bytes() == whole
    assert not (out / ".lock").exists()


def test_a_pack_under_way_is_not_taken_over_before_its_first_shard(make, tmp_path, monkeypatch):
    source = make(_rows())
    out = tmp_path / "packed"
    first = []
    other = []

    def fetched(*args):
        first.append(args)
        if len(first) == 1:  # while the first file is read, another plan wants the folder
            refused("another process packs into", pack, source, out, shard_bytes=100)
            other.append(args)
        return packed.read_file(*args)

    monkeypatch.setattr("anytouch_jax.datasets.shards.read_file", fetched)
    pack(source, out, threads=1)
    assert other
    for line in (out / "SHA256SUMS").read_text().splitlines():
        digest, name = line.split("  ")
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest


def test_a_pack_of_version_1_is_still_read(read_back, tmp_path):
    shutil.unpack_archive(Path(__file__).with_name("pack_of_0_1_0.zip"), tmp_path)
    again = manifests.read(tmp_path / "manifest.parquet")
    assert again.file(0).parent.suffix == ".parquet"
    frames = np.stack([decode(again.file(row)) for row in range(len(again))])
    assert read_back(frames[:, None])[:, 0].tolist() == list(range(6))
    index = tmp_path / "touch" / "00000.index"
    whole = index.read_bytes()
    for damage in (b"\x93NUMPY garbage", whole[:-1], b"", None):
        packed.close_shards()
        index.unlink() if damage is None else index.write_bytes(damage)
        with pytest.raises(packed.ShardError, match="index"):
            packed.read_file(again.file(0))
