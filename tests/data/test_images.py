import sys

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from refused import refused
from videos import write_video

from anytouch_jax.data import images
from anytouch_jax.data.images import ImageError, decode, decode_bytes, encode
from anytouch_jax.data.names import frame_numbers, frame_order, split_series
from anytouch_jax.errors import UserError

RNG = np.random.default_rng(0)


RGB = RNG.integers(0, 256, (9, 13, 3), np.uint8)


def _encoded(suffix, image=RGB):
    there, data = cv2.imencode(
        suffix, image[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else image
    )
    assert there
    return data.tobytes()


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".jpg", ".webp"])
def test_every_format_gives_rgb(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    is_lossy = suffix in (".jpg", ".webp")
    image = np.full((40, 60, 3), (200, 100, 50), np.uint8) if is_lossy else RGB
    path.write_bytes(_encoded(suffix, image))
    got = decode(path)
    assert got.dtype == np.uint8 and got.flags.c_contiguous
    np.testing.assert_allclose(got, image, atol=4 * is_lossy)
    np.testing.assert_allclose(decode_bytes(encode(image, suffix), "p"), image, atol=4 * is_lossy)
    fine, coarse = (encode(RGB, ".jpg", cv2.IMWRITE_JPEG_QUALITY, quality) for quality in (90, 10))
    assert len(coarse) < len(fine)


def test_grey_alpha_sixteen_bits_and_floats(tmp_path):
    grey = RGB[..., 0]
    (tmp_path / "grey.png").write_bytes(_encoded(".png", grey))
    np.testing.assert_array_equal(decode(tmp_path / "grey.png"), np.stack([grey] * 3, -1))
    alpha = np.concatenate([RGB[..., ::-1], grey[..., None]], -1)
    (tmp_path / "alpha.png").write_bytes(cv2.imencode(".png", alpha)[1].tobytes())
    np.testing.assert_array_equal(decode(tmp_path / "alpha.png"), RGB)
    (tmp_path / "deep.png").write_bytes(_encoded(".png", RGB.astype(np.uint16) * 257))
    np.testing.assert_array_equal(decode(tmp_path / "deep.png"), RGB)
    floats = RGB.astype(np.float32) / 255
    (tmp_path / "float.tiff").write_bytes(_encoded(".tiff", floats))
    np.testing.assert_array_equal(decode(tmp_path / "float.tiff"), RGB)
    big = (RGB.astype(np.uint16) * 257).astype(">u2")
    for name, array in (
        ("b", big),
        ("f", floats.astype(np.float64)),
        ("u", RGB),
        ("g", grey),
        ("d", RGB.astype(np.uint16) * 257),
    ):
        np.save(tmp_path / f"{name}.npy", array)
        wanted = RGB if name != "g" else np.stack([grey] * 3, -1)
        np.testing.assert_array_equal(decode(tmp_path / f"{name}.npy"), wanted)


def test_a_jpeg_with_a_trailer_or_a_thumbnail_is_whole(tmp_path):
    whole = _encoded(".jpg")
    # phones append videos; markers stand in them by chance
    for seed in range(5):
        path = tmp_path / f"{seed}.jpg"
        path.write_bytes(whole + np.random.default_rng(seed).bytes(200_000) + b"\xff\xda")
        np.testing.assert_array_equal(decode(path), decode_bytes(whole, "whole"))
    # an EXIF segment with an image in it
    thumbnail = b"\xff\xe1" + (len(whole) + 2).to_bytes(2) + whole
    path.write_bytes(whole[:2] + thumbnail + whole[2 : len(whole) * 2 // 3])
    refused("cut short", decode, path)


def test_files_that_are_no_images_are_named(tmp_path):
    page = b"\n<!DOCTYPE html>"
    pointer = b"version https://git-lfs.github.com/spec/v1\noid"
    corrupt = _encoded(".png")
    corrupt = corrupt[: len(corrupt) // 2] + b"??" + corrupt[len(corrupt) // 2 + 2 :]
    for name, data, words in (
        ("0.png", page, "is a web page"),
        ("0.mp4", page, "is a web page"),
        ("1.mp4", pointer, "is a Git LFS pointer"),
        ("0.jpg", pointer, "is a Git LFS pointer"),
        ("1.jpg", b"no image", "not a PNG"),
        ("2.png", corrupt, "corrupt"),
        ("3.png", None, "there is no file"),
        ("2.mp4", b"no film", "not a video"),
        ("3.mp4", None, "there is no video"),
    ):
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(ImageError, match=rf"(?s){name}.*{words}|{words}.*{name}") as error:
            decode(tmp_path / name) if name[2:] != "mp4" else list(
                images.frames_from_video(tmp_path / name)
            )
        assert isinstance(error.value, UserError)
    refused("cannot be read", decode, tmp_path)


def test_a_folder_comes_in_natural_order(tmp_path):
    for number in (10, 9, 1):
        image = np.full((4, 4, 3), number, np.uint8)
        cv2.imwrite(str(tmp_path / f"img{number}.png"), image)
    (tmp_path / "notes.txt").write_text("no image")
    assert [decode(file)[0, 0, 0] for file in images.list_images(tmp_path)[0]] == [1, 9, 10]
    for name in ("background.jpg", "Photo.png"):
        assert cv2.imwrite(str(tmp_path / name), np.zeros((4, 4, 3), np.uint8))
    np.save(tmp_path / "000.npy", np.zeros((20, 20, 6), np.float32))
    frames, other = images.list_images(tmp_path)
    assert len(frames) == 3 and {name: file.name for name, file in other.items()} == {
        "background": "background.jpg",
        "photo": "Photo.png",
    }
    stamps = [
        "0.8.bmp",
        "0.9.bmp",
        "1.bmp",
        "1.1.bmp",
        "2.bmp",
        "1690000000000000001.bmp",
        "1690000000000000002.bmp",
    ]
    # whole seconds are written without a point
    assert frame_order(stamps[::-1]) == (stamps, True)
    assert frame_order(["b.png", "img10.png", "3.png"]) == (["b.png", "img10.png", "3.png"], False)
    (tmp_path / "empty").mkdir()
    for folder, words in (
        (tmp_path / "empty", "no images"),
        (tmp_path / "none", "there is no folder"),
    ):
        refused(words, images.list_images, folder)


def test_a_video_gives_its_frames_in_rgb(tmp_path, monkeypatch):
    path = tmp_path / "v.avi"
    write_video(path, (np.full((24, 32, 3), (0, 0, level), np.uint8) for level in (0, 100, 200)))
    frames = list(images.frames_from_video(path))
    assert [frame.shape for frame in frames] == [(24, 32, 3)] * 3
    assert [round(float(frame[..., 0].mean()) / 100) for frame in frames] == [0, 1, 2]
    assert max(frame[..., 2].mean() for frame in frames) < 10
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "10:30.mp4", (np.zeros((24, 32, 3), np.uint8) for _ in range(3)))
    # no protocol
    assert len(list(images.frames_from_video("10:30.mp4"))) == images.count_frames("10:30.mp4") == 3


@pytest.mark.parametrize("kind", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_image_is_turned_as_its_tag_says(tmp_path, kind, orientation):
    stored = Image.fromarray(
        np.add.outer(np.arange(40) * 2, np.arange(60)).astype(np.uint8)
    ).convert("RGB")
    tags = Image.Exif()
    tags[274] = orientation
    path = tmp_path / f"x.{kind}"
    stored.save(path, exif=tags, **{"lossless": True} if kind == "webp" else {})
    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB")).astype(int)
    got = decode(path)
    assert got.shape == shown.shape == ((60, 40, 3) if orientation > 4 else (40, 60, 3))
    assert np.abs(got - shown).max() < 3


ODD = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x63\0\0\0\0\0\0"  # orientation 99


@pytest.mark.parametrize("tags", [b"Exif\0\0", ODD])
def test_an_odd_orientation_tag_leaves_the_image(tmp_path, tags):
    whole = _encoded(".jpg")
    data = whole[:2] + b"\xff\xe1" + (len(tags) + 2).to_bytes(2) + tags + whole[2:]
    np.testing.assert_array_equal(decode_bytes(data, "x"), decode_bytes(whole, "x"))


def test_a_video_is_turned_as_its_tag_says(tmp_path):
    path = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 48))
    image = np.zeros((48, 64, 3), np.uint8)
    image[:24, :32] = 255  # white at the upper left
    for _ in range(3):
        writer.write(image)
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44  # its matrix: by 90 degrees clockwise
    matrix = (0, 1 << 16, 0, -(1 << 16), 0, 0, 48 << 16, 0, 1 << 30)
    data[at : at + 36] = b"".join((number % 2**32).to_bytes(4) for number in matrix)
    path.write_bytes(data)
    frame = next(images.frames_from_video(path))
    assert frame.shape == (64, 48, 3) and frame[5, 40].min() > 200 and frame[5, 5].max() < 50


@pytest.mark.parametrize("kind", [np.float64, np.int32, np.int16, np.int8])
def test_a_tiff_of_an_unusual_type_is_a_image_or_a_sentence(tmp_path, kind):
    path = tmp_path / "odd.tiff"
    values = np.zeros((6, 8, 3), kind)
    values[..., 0] = 1  # blue, as OpenCV writes it
    path.write_bytes(cv2.imencode(".tiff", values)[1].tobytes())
    if kind is np.float64:
        assert decode(path)[0, 0].tolist() == [0, 0, 255]
    else:
        refused(r"odd\.tiff has pixels of type", decode, path)


def test_strips_and_tiffs_that_opencv_would_read_wrong_are_refused(tmp_path):
    plain = Image.fromarray(RGB)
    clear = Image.fromarray(np.dstack([RGB, np.full(RGB.shape[:2], 128, np.uint8)]))
    plain.save(tmp_path / "one.tif")
    np.testing.assert_array_equal(decode(tmp_path / "one.tif"), RGB)
    plain.save(tmp_path / "several.tif", save_all=True, append_images=[plain, plain])
    clear.save(tmp_path / "clear.tif")
    Image.fromarray(np.zeros((1, 2000, 3), np.uint8)).save(tmp_path / "strip.tif")
    for name, sentence in (
        ("several", "several images"),
        ("clear", "would be multiplied"),
        ("strip", "is a strip"),
    ):
        refused(rf"{name}\.tif .*{sentence}", decode, tmp_path / f"{name}.tif")


def test_frames_are_numbered_by_what_counts_them():
    assert frame_numbers(["a3.png", "a4.png", "a9.png"]) == [3, 4, 9]
    # no neighbours: they do not count frames
    assert frame_numbers(["a10.png", "a20.png"]) == [0, 1]
    assert frame_numbers(["a.png", "b2.png"]) == [0, 1] and frame_numbers([]) == []
    # a third of the steps
    assert frame_numbers(["1.png", "2.png", "4.png", "6.png"]) == [1, 2, 4, 6]
    for form in ("{}_left.png", "{:05d}_D20012.png", "img_{:04d}_left_raw.png", "{}_320x240.png"):
        assert frame_numbers([form.format(number) for number in (3, 4, 9)]) == [3, 4, 9], form
    # milliseconds, one frame early
    stamps = [1700000000000 + 33 * i - 32 * (i == 13) for i in range(30)]
    assert frame_numbers([f"{stamp}.png" for stamp in stamps]) == list(range(30))


_TIMES = [1731000000.0 + i / 30 for i in range(20)]


@pytest.mark.parametrize(
    "names",
    [
        *(
            [form.format(time) for time in _TIMES]
            for form in ("{}.png", "gel_{}.png", "D20012_{}_raw.png", "a.{}.png")
        ),
        [f"2024-01-05_gel_{time - _TIMES[0]}.png" for time in _TIMES],  # 0.0, 0.0333..., 0.1
        [f"{time / 1e5 - 17310}.png" for time in _TIMES],  # 3.3e-07
        [f"{('free', 'contact')[i % 3 == 0]}_{time}.png" for i, time in enumerate(_TIMES)],
        [f"{('free', 'contact')[i % 3 == 0]}_{i}.png" for i in range(12)],
        [f"{i * 7919 % 1013}_{i}.png" for i in range(12)],  # a value, then a counter
        [f"{i * 7919 % 4096:x}x_{i:03d}.png" for i in range(12)],  # a hash, then a counter
        [f"gel_{time}.png".replace(".", ",", 1) for time in _TIMES],
        [
            f"24-1-5_{10 + (i > 7)}-{59 * (i < 8):02d}-{(52 + i) % 60:02d}.png" for i in range(16)
        ],  # seconds begin again
        [f"1.{i}.png" for i in range(1, 13)],  # frame 10 of touch 1
        [f"2024.5.{i}.png" for i in range(1, 13)],
        [f"take{i // 3}_frame{i % 3}.png" for i in range(12)],
    ],
)
def test_frames_come_in_the_order_of_the_numbers_in_their_names(names):
    assert frame_order(sorted(names, key=lambda name: name[::-1])) == (names, True)


@pytest.mark.parametrize(
    ("names", "series"),
    [
        (
            ["left_0.png", "left_1.png", "right_0.png"],
            {"left": ["left_0.png", "left_1.png"], "right": ["right_0.png"]},
        ),
        (["0.png", "right 0.png"], {"": ["0.png"], "right": ["right 0.png"]}),
        (["left_0.png", "right_1.png"], None),  # no number twice: it may be one series
        (["1.5.png", "2.5.png", "10.5.png"], None),  # seconds
        (["2024_05.png", "2025_05.png"], None),
        (["1.png", "1.jpg"], None),
        (["0_left.png", "0_right.png", "1_left.png", "1_right.png"], ("left", "right")),
        (["L0001.png", "L0002.png", "R0001.png", "R0002.png"], ("L", "L", "R", "R")),
        (["D20012_00000.png", "D20345_00000.png"], ("D20012", "D20345")),
        (
            ["00000_D20012.png", "00000_D20345.png", "00001_D20012.png"],
            ("D20012", "D20345", "D20012"),
        ),
        (
            ["frame0_cam0.png", "frame0_cam1.png", "frame1_cam0.png", "frame1_cam1.png"],
            ("frame_cam0", "frame_cam1"),
        ),
        (["img_0000_left_raw.png", "img_0000_right_raw.png"], ("img_left_raw", "img_right_raw")),
        ([f"1_touch{i}_{side}.png" for i in range(6) for side in "LR"], ("touch_L", "touch_R")),
        (
            [f"{side}_17000000{i}.{i}5.png" for i in range(4) for side in ("left", "right")],
            ("left", "right"),
        ),
        ([f"{'LR'[i % 2]}_{i}.png" for i in range(8)], ("L", "R")),  # one counter of two cameras
        ([f"{'LR'[i % 2]}_170.{i}.png" for i in range(8)], ("L", "R")),
        (
            [f"{i}_{('contact', 'free')[i % 2]}.png" for i in range(8)],
            None,
        ),  # one recording with labels in its names
        ([f"2024-05-01T1{i}-00-05.png" for i in range(8)], None),
        ([f"{i}_t{33 * i}.png" for i in range(9)], None),
        (["a3f9.png", "b3c1.png", "3d3e.png", "c9f9.png", "7f3.png", "e1.png"], None),
    ],
)
def test_series_that_fraction_numbers_are_apart(names, series):
    if isinstance(series, tuple):  # the series of each name, in turn
        keys = [series[i % len(series)] for i in range(len(names))]
        series = {
            key: [name for name, of in zip(names, keys, strict=True) if of == key] for key in series
        }
    assert split_series(names) == (series or {"": names})


@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_a_video_that_opencv_cannot_decode_is_read_or_its_codec_is_named(
    tmp_path, monkeypatch, ending
):
    av = pytest.importorskip("av")
    codec = next(
        (name for name in ("libsvtav1", "libaom-av1") if name in av.codecs_available), None
    )
    if codec is None:
        pytest.skip("this build of PyAV writes no AV1")
    path = tmp_path / f"film.{ending}"
    greys = [60 + 20 * i for i in range(6)]
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=10)
        stream.width = 64
        stream.height = 64
        stream.pix_fmt = "yuv420p"
        for grey in greys:
            image = av.VideoFrame.from_ndarray(np.full((64, 64, 3), grey, np.uint8), format="rgb24")
            out.mux(stream.encode(image))
        out.mux(stream.encode())
    frames = list(images.timed_frames(path))
    assert [round(time, 2) for time, _ in frames] == pytest.approx(
        [i / 10 for i in range(6)], abs=0.01
    )
    np.testing.assert_allclose([frame.mean() for _, frame in frames], greys, atol=3)
    video = images.open_video(path)
    for frame, grey in ((4, 140), (1, 80)):
        assert video.set(cv2.CAP_PROP_POS_FRAMES, frame) and video.read()[
            1
        ].mean() == pytest.approx(grey, abs=3)
    monkeypatch.setitem(sys.modules, "av", None)
    refused(r"of the codec AV01: pip install 'anytouch_jax\[lerobot\]'", images.open_video, path)
