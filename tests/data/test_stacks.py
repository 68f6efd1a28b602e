import numpy as np
import pytest

from anytouch_jax.data.images import ImageError, decode, image_files, list_images
from anytouch_jax.data.stacks import read_stack, stacked_frames

RNG = np.random.default_rng(0)
FRAMES = RNG.integers(0, 256, (12, 30, 40, 3), np.uint8)


def frames_of(path):
    return list(stacked_frames(read_stack(path), path))


@pytest.mark.parametrize("form", ["u8", "u16", "float32", "grey", "grey with an axis", "alpha"])
def test_every_frame_of_a_stack_is_read(tmp_path, form):
    stacks = {
        "u8": FRAMES,
        "u16": FRAMES.astype(np.uint16) * 257,
        "float32": FRAMES / np.float32(255),
        "grey": FRAMES[..., 0],
        "grey with an axis": FRAMES[..., :1],
        "alpha": np.concatenate([FRAMES, FRAMES[..., :1]], -1),
    }
    wanted = FRAMES if "grey" not in form else np.repeat(FRAMES[..., :1], 3, -1)
    np.save(tmp_path / "s.npy", stacks[form])
    np.savez(tmp_path / "s.npz", frames=stacks[form], time=np.arange(12.0), names=["a"] * 12)
    for name in ("s.npy", "s.npz"):
        np.testing.assert_array_equal(np.stack(frames_of(tmp_path / name)), wanted)


def test_one_image_and_other_files_are_no_stack(tmp_path):
    np.save(tmp_path / "one.npy", FRAMES[0])
    np.save(tmp_path / "grey.npy", FRAMES[0, ..., 0])
    (tmp_path / "video.mp4").write_bytes(b"")
    for name in ("one.npy", "grey.npy", "video.mp4", "gone.npy", "."):
        assert read_stack(tmp_path / name) is None
    np.savez(tmp_path / "one.npz", image=FRAMES[0])
    assert len(frames_of(tmp_path / "one.npz")) == 1


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"left": FRAMES, "right": FRAMES}, "2 arrays of frames.*left.*right"),
        ({"force": np.zeros((12, 3))[:, 0]}, "no array of frames"),
        ({}, "holds nothing"),
        ({"features": np.zeros((3, 4)), "rows": np.arange(3)}, "contains features"),
    ],
)
def test_a_file_without_one_array_of_frames_is_one_sentence(tmp_path, arrays, words):
    np.savez(tmp_path / "s.npz", **arrays)
    with pytest.raises(ImageError, match=words):
        read_stack(tmp_path / "s.npz")


def test_damaged_and_unsafe_files_are_one_sentence(tmp_path):
    np.save(tmp_path / "cut.npy", FRAMES)
    whole = (tmp_path / "cut.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(whole[:-1000])
    np.save(tmp_path / "objects.npy", np.array([{}, {}], object), allow_pickle=True)
    (tmp_path / "none.npz").write_bytes(b"no zip")
    (tmp_path / "lfs.npy").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    for name in ("cut.npy", "objects.npy", "none.npz", "lfs.npy"):
        with pytest.raises(ImageError, match=name):
            read_stack(tmp_path / name)
    np.save(tmp_path / "wide.npy", np.float32([[[[9.0, 0, 0]]]]))
    with pytest.raises(ImageError, match=r"frame 0 of .*wide\.npy"):
        frames_of(tmp_path / "wide.npy")


def test_a_folder_of_stacks_is_a_folder_of_their_frames(tmp_path):
    np.savez(tmp_path / "touch_10.npz", frames=FRAMES[:3])
    np.savez(tmp_path / "touch_2.npz", frames=FRAMES[3:], time=np.arange(9.0))
    np.savez(tmp_path / "features.npz", features=np.zeros((3, 4)), rows=np.arange(3))
    np.save(tmp_path / "background.npy", FRAMES[0])
    files, named = list_images(tmp_path)
    np.testing.assert_array_equal(np.stack([decode(file) for file in files[:9]]), FRAMES[3:])
    np.testing.assert_array_equal(np.stack([decode(file) for file in files[9:]]), FRAMES[:3])
    assert list(named) == ["background"]
    assert image_files(tmp_path / "touch_10.npz") == files[9:]
    np.savez(tmp_path / "two.npz", left=FRAMES, right=FRAMES)
    with pytest.raises(ImageError, match=r"two\.npz has 2 arrays of frames: left, right"):
        list_images(tmp_path)


def test_channels_may_come_first(tmp_path):
    np.save(tmp_path / "s.npy", np.moveaxis(FRAMES, -1, 1))
    np.testing.assert_array_equal(np.stack(frames_of(tmp_path / "s.npy")), FRAMES)
