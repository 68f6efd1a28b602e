"""An .npz file that takes far more memory than disk is refused before it is unpacked."""

import zipfile

import numpy as np
import pytest

from anytouch_jax.files import read_arrays

GIB = 1 << 30
BLOCK = bytes(1 << 24)


@pytest.fixture(scope="module")
def bomb(tmp_path_factory):
    """A file of 5 MB with a few words, and one byte of zeros more than 1 GiB."""
    path = tmp_path_factory.mktemp("bomb") / "bomb.npz"
    header = {"descr": "|u1", "fortran_order": False, "shape": (GIB + 1,)}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("about.npy", "w") as member:
            np.save(member, np.array("words"))
        with archive.open("zeros.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(member, header)
            for _ in range(GIB // len(BLOCK)):
                member.write(BLOCK)
            member.write(b"\0")
    assert path.stat().st_size < 1 << 23
    return path


def test_more_than_a_gibibyte_in_a_small_file_is_refused(bomb):
    with pytest.raises(ValueError, match=r"arrays take 1,073,741,8\d\d bytes in a file of \d,"):
        read_arrays(bomb)


def test_what_is_not_asked_for_counts_for_nothing(bomb):
    arrays = read_arrays(bomb, only=lambda name: name == "about")
    assert str(arrays["about"]) == "words"
    zeros = arrays["zeros"]
    assert zeros.shape == (GIB + 1,) and zeros.strides == (0,), "it takes no memory"
