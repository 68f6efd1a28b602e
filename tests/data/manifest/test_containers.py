import io
import os
import tarfile

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from PIL import Image
from refused import refused

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import files
from anytouch_jax.data.manifest import manifest as manifests


def png(value: int) -> bytes:
    data = io.BytesIO()
    Image.fromarray(np.full((8, 8, 3), value, np.uint8)).save(data, "PNG")
    return data.getvalue()


def write_tar(file, values) -> None:
    """A WebDataset shard: an image and a text for each key."""
    with tarfile.open(file, "w") as archive:
        for value in values:
            for name, data in ((f"key{value}.png", png(value)), (f"key{value}.json", b"{}")):
                info = tarfile.TarInfo(name)
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))


def write_parquet(file, values, *, nested: bool = False, rows: int = 2) -> None:
    cells = [png(value) for value in values]
    column = [{"bytes": cell, "path": None} for cell in cells] if nested else cells
    table = pa.table({"image": column, "source": ["a"] * len(values)})
    pa.parquet.write_table(table, file, row_group_size=rows)


def test_a_file_in_a_tar_is_its_bytes_and_a_cut_tar_is_an_error(tmp_path):
    file = tmp_path / "data-000000.tar"
    write_tar(file, range(5))
    assert files.read_file(file / "4") == png(2)
    assert decode(file / "8")[0, 0, 0] == 4
    assert [name for name, *_ in files.tar_members(file)][:2] == ["key0.png", "key0.json"]
    with pytest.raises(files.ShardError, match="no row 10"):
        files.read_file(file / "10")
    files.close_shards()
    file.write_bytes(file.read_bytes()[: files.tar_members(file)[-2][1] + 3])
    refused(r"cut short|no whole tar", decode, file / "8")


@pytest.mark.parametrize("nested", [False, True])
def test_a_cell_of_a_parquet_column_is_read_by_row_group(tmp_path, nested, monkeypatch):
    monkeypatch.setattr(files, "_HELD", 1)
    file = tmp_path / "train-00000.parquet"
    write_parquet(file, range(7), nested=nested)
    for row in (6, 0, 3, 3):
        assert decode(file / "image" / str(row))[0, 0, 0] == row
    refused("no row 7", decode, file / "image" / "7")
    refused("no column 'depth'", decode, file / "depth" / "0")
    refused("no bytes in column", decode, file / "source" / "0")


@pytest.fixture
def store(tmp_path, monkeypatch):
    """An object store in memory, and a cache of 3 shards."""
    system = fsspec.filesystem("memory")
    write_parquet(tmp_path / "one.parquet", range(6))
    size = (tmp_path / "one.parquet").stat().st_size
    monkeypatch.setenv("ANYTOUCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("ANYTOUCH_CACHE_GB", str(3.5 * size / 1e9))
    for shard in range(8):
        write_parquet(tmp_path / "one.parquet", range(6 * shard, 6 * shard + 6))
        system.put_file(str(tmp_path / "one.parquet"), f"/corpus/{shard}.parquet")
    yield "memory://corpus"
    system.rm("/corpus", recursive=True)


def test_addresses_are_copied_by_shard_once_and_the_oldest_leave(store, tmp_path, monkeypatch):
    paths = [f"{store}/{shard}.parquet/image/{row}" for shard in range(8) for row in range(6)]
    count = len(paths)
    columns = {"path": paths, "sensor": ["digit"] * count, "sequence": list(map(str, range(count)))}
    columns |= {"frame_index": [0] * count, "split": ["train"] * count}
    manifests.write(manifests.from_columns(columns, tmp_path / "m.parquet"), tmp_path / "m.parquet")
    manifest = manifests.read(tmp_path / "m.parquet")
    fetched = []
    fetch = files._fetch
    monkeypatch.setattr(
        files, "_fetch", lambda file, target: (fetched.append(file), fetch(file, target))
    )
    for row in range(count):
        assert decode(manifest.file(row))[0, 0, 0] == row
    assert fetched == [f"{store}/{shard}.parquet" for shard in range(8)]
    kept = sorted((tmp_path / "cache").glob("*/*"), key=os.path.getmtime)
    assert [file.name for file in kept] == ["5.parquet", "6.parquet", "7.parquet"]


def test_a_missing_object_a_broken_store_and_a_foreign_address_are_one_sentence(store, monkeypatch):
    refused(
        r"there is no memory://corpus/9\.parquet", files.local_copy, f"{store}/9.parquet/image/0"
    )
    # the error is none of a file
    monkeypatch.setattr(fsspec.filesystem("memory"), "size", lambda path: [][0])
    refused(
        r"0\.parquet cannot be copied .*list index", files.local_copy, f"{store}/0.parquet/image/0"
    )
    for address in ("file:///etc/passwd", "s3://bucket/../x.png", "local://x"):
        refused("is none of", files.local_copy, address)
