import subprocess

import numpy as np
import pytest

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import close_shards


@pytest.fixture(autouse=True)
def _closed():
    yield
    close_shards()


def test_a_pack_reads_like_the_files_and_lies_next_to_the_manifest(anytouch, pressed):
    folder = pressed.with_name("touch_packed")
    done = anytouch("data", "pack", pressed)
    assert done.status == 0 and f"{folder / 'manifest.parquet'}: 10 rows" in done.out
    loose, packed = manifests.read(pressed), manifests.read(folder / "manifest.parquet")
    for row in range(10):
        np.testing.assert_array_equal(decode(packed.file(row)), decode(loose.file(row)))
    subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=folder, check=True)


def test_mistakes_are_one_sentence(mistake, pressed, tmp_path):
    assert mistake("data", "pack")
    assert str(tmp_path) in mistake("data", "pack", pressed, "--out", tmp_path)
    assert "shard" in mistake("data", "pack", pressed, "--shard-mb", 0)
    (tmp_path / "3.png").unlink()
    named = mistake("data", "pack", pressed)
    assert f"row 3 of {pressed}" in named and "--repair" in named
