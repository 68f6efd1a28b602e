import os
import signal
import threading
import time
from itertools import pairwise

import cv2
import jax
import numpy as np
import pytest
from faulty_camera import KINDS, FaultyCamera, Video
from videos import write_video

from anytouch_jax.data.images import frames_from_video
from anytouch_jax.data.transforms import touch_evaluation
from anytouch_jax.errors import UserError
from anytouch_jax.live import reader
from anytouch_jax.live import stream as streams

DIGIT = 1


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(reader, "RETRY", 0.05)
    monkeypatch.setattr(reader, "STUCK", 0.004)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    noise = np.random.default_rng(0).integers(0, 30, (8, 32, 40, 3), np.uint8)
    frames = [
        np.full((32, 40, 3), (20, 30 * number, 200), np.uint8) + one
        for number, one in enumerate(noise)
    ]
    return write_video(tmp_path_factory.mktemp("video") / "touch.avi", frames)


class Camera:
    """A camera whose frames come when the test says so: frame i is all of value 10 i, BGR with an
    offset by channel.
    """

    def __init__(self, ready: int = 0) -> None:
        self.allowed = ready
        self.shown = 0
        self.waiting = False
        self.ended = False
        self.released = False
        self.changed = threading.Condition()
        self.seen: list[int] = []

    def grab(self) -> bool:
        with self.changed:
            self.waiting = True
            self.changed.notify_all()
            self.changed.wait_for(lambda: self.shown < self.allowed or self.ended)
            self.waiting = False
            self.shown += not self.ended
            return not self.ended

    def retrieve(self):
        self.seen.append(self.shown - 1)
        return True, self.frame(self.shown - 1)

    @staticmethod
    def frame(number: int) -> np.ndarray:
        return np.full((32, 40, 3), (0, 1, 2), np.uint8) + np.uint8(10 * number)

    def release(self) -> None:
        self.released = True

    def show(self, count: int) -> None:
        """Let `count` more frames come, and wait until the reader asks for the one after them."""
        with self.changed:
            self.allowed += count
            self.changed.notify_all()
            assert self.changed.wait_for(
                lambda: self.waiting and self.shown == self.allowed, timeout=60
            )

    def end(self) -> None:
        with self.changed:
            self.ended = True
            self.changed.notify_all()


def features_of(encoder, frames, numbers):
    """What `embed` gives of clips that end at frame i: frames RGB, numbers of the frames of each
    clip.
    """
    small = touch_evaluation(frames, encoder.config.model.image_size)
    return encoder.encode_touch(np.stack([small[list(one)] for one in numbers]), "digit")


@pytest.mark.parametrize(
    ("frames", "stride", "clips"),
    [
        (1, 1, [(i,) for i in range(8)]),
        (3, 1, [(i - 2, i - 1, i) for i in range(2, 8)]),
        (3, 2, [(i - 4, i - 2, i) for i in range(4, 8)]),
    ],
)
def test_every_frame_of_a_video_in_order(encoder, video, frames, stride, clips):
    source, live = streams.open_source(video)
    assert not live
    outcome = list(
        streams.stream(encoder, source, live=live, sensor=DIGIT, frames=frames, stride=stride)
    )
    assert [one.number for one in outcome] == [clip[-1] for clip in clips]
    wanted = features_of(encoder, list(frames_from_video(video)), clips)
    np.testing.assert_allclose([one.values for one in outcome], wanted, atol=1e-5)
    times = [one.at for one in outcome]
    assert times == sorted(times) and all(min(one.seconds) >= 0 for one in outcome)
    # the parts are all that lies between a frame and its features
    np.testing.assert_allclose([sum(one.seconds) for one in outcome], [one.age for one in outcome])
    assert not source.isOpened()


def test_a_slow_reader_of_a_video_loses_nothing(encoder, video):
    """The mailbox has one slot: the reader waits with its next clip while nobody takes."""
    source, _ = streams.open_source(video)
    received = []
    retrieve = source.retrieve

    class Counted:
        grab = source.grab
        release = source.release
        get = source.get

        def retrieve(self):
            received.append(len(received))
            return retrieve()

    embedded = streams.stream(encoder, Counted(), live=False, sensor=DIGIT)
    first = next(embedded)
    # one embedded, one in the slot, one that waits for the slot
    assert len(received) <= 3
    assert [first.number, *(one.number for one in embedded)] == list(range(8))


def test_a_camera_gives_its_newest_frames_and_the_old_ones_are_dropped(encoder):
    camera = Camera(ready=3)
    embedded = streams.stream(
        encoder, camera, live=True, sensor=DIGIT, frames=3, log=lambda sentence: None
    )
    outcome = [next(embedded)]
    assert outcome[0].number == 2
    # nobody takes meanwhile, and the camera is read all the same
    camera.show(5)
    assert camera.seen == list(range(8))
    outcome.append(next(embedded))
    camera.show(1)
    outcome.append(next(embedded))
    assert [one.number for one in outcome] == [2, 7, 8]
    frames = [camera.frame(i)[..., ::-1] for i in range(9)]
    # consecutive, whatever was dropped
    wanted = features_of(encoder, frames, [(0, 1, 2), (5, 6, 7), (6, 7, 8)])
    np.testing.assert_allclose([one.values for one in outcome], wanted, atol=1e-5)
    camera.end()
    with pytest.raises(streams.CameraError, match="after 9 frames"):
        next(embedded)
    assert camera.released


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_that_misses_a_read_goes_on_and_then_fails(encoder, kind):
    """The image of another shape is a missed read.

    No clip spans it, and the end of a camera is never normal.
    """
    camera = FaultyCamera(kind)
    logged = []
    result = streams.collect(
        streams.stream(encoder, camera, live=True, sensor=DIGIT, log=logged.append)
    )
    assert result.numbers[-1] == 10 and result.missed == 1, "frames after the miss"
    assert (
        isinstance(result.error, streams.CameraError)
        and "after 11 frames" in str(result.error)
        and camera.released
    )
    assert len(logged) == 1 and "after 3 frames" in logged[0]
    assert "1 missed reads" in streams.budget(result)[-1]


def test_no_clip_spans_a_missed_read(encoder):
    mailbox = streams.Mailbox(replace=False)
    clips = []
    frames = [
        reader.Frame(i, np.full((32, 40, 3), i, np.uint8), 0.0, 0.0, missed=int(i > 3))
        for i in range(8)
    ]
    reading = threading.Thread(
        target=reader.read_clips, args=(iter(frames), lambda pixels: pixels, 3, 1, mailbox)
    )
    reading.start()
    while (clip := mailbox.take()) is not None:
        clips.append([int(frame.max()) for frame in clip.frames])
    assert clips == [[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7]]


@pytest.mark.parametrize("kind", ["frozen", "black", "ok"])
def test_a_frozen_and_a_black_image_are_reported_once(encoder, kind):
    logged = []
    outcome = []
    found = streams.stream(
        encoder, FaultyCamera(kind, frames=60), live=True, sensor=DIGIT, log=logged.append
    )
    result = streams.collect(found, outcome.append)
    images = [one.image for one in outcome]
    assert images[0] == "ok" and images[-1] == kind and result.missed == 0
    assert sum(f"is {kind} at frame" in line for line in logged) == (kind != "ok")
    counts = {"frozen": result.frozen, "black": result.black}
    assert counts == {name: images.count(name) for name in counts}
    reused = [one.image for one in outcome if one.reused]
    assert ("frozen" in reused) == (kind == "frozen"), (
        "its features are reused, and it is reported all the same"
    )


def test_a_camera_that_does_not_answer_is_not_waited_for(encoder, monkeypatch):
    monkeypatch.setattr(streams, "HANG", 0.05)
    monkeypatch.setattr(streams, "_PATIENCE", 0.01)
    camera = Camera(ready=1)
    embedded = streams.stream(encoder, camera, live=True, sensor=DIGIT)
    next(embedded)
    with pytest.raises(streams.CameraError, match="not answered"):
        next(embedded)
    camera.end()


@pytest.fixture
def embedded_clips(monkeypatch):
    """The clips that reached the encoder."""
    clips = []
    compile_for_one = streams.compile_for_one

    def watched(*args, **options):
        embed = compile_for_one(*args, **options)
        return lambda clip: (clips.append(np.asarray(clip)[0]), embed(clip))[1]

    monkeypatch.setattr(streams, "compile_for_one", watched)
    return clips


@pytest.mark.parametrize("frames", [1, 3])
def test_reuse_of_equal_clips_changes_no_bit(encoder, embedded_clips, frames):
    """Images stand still, move, and stand still again.

    One changed pixel of the network's input is a new clip.
    """
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (28, 28, 3), np.uint8)
    dotted = image.copy()
    dotted[5, 7, 1] ^= 1
    video = np.stack([image] * 5 + [dotted] * 4 + [image] * 4)
    found = streams.collect(
        streams.stream(encoder, Video(video), live=False, sensor=DIGIT, frames=frames)
    )
    small = touch_evaluation(list(video[..., ::-1]), 28)
    clips = np.stack([small[end - frames : end] for end in range(frames, len(video) + 1)])
    embed = streams.compile_for_one(encoder, DIGIT, frames)
    np.testing.assert_array_equal(
        found.values, [np.asarray(embed(jax.device_put(one[None])))[0] for one in clips]
    )
    new = [True, *(not np.array_equal(a, b) for a, b in pairwise(clips))]
    assert found.reused.tolist() == [not one for one in new] and sum(new) == (
        3 if frames == 1 else 7
    )
    np.testing.assert_array_equal(embedded_clips[: sum(new)], clips[new])
    assert streams.budget(found)[-1].endswith(f"{len(clips) - sum(new)} reused")


def test_noise_is_reused_and_a_small_touch_is_not():
    """The noise is learned first.

    A slow drift adds up, since clips are compared with the one that was embedded.
    """
    rng = np.random.default_rng(0)

    def noisy(level=0.0, touch=0.0):
        clip = rng.normal(100 + level, 2, (1, 112, 112, 3))
        clip[:, :14, 14:28] += touch
        return clip.round().astype(np.uint8)

    reuse = streams.Reuse(1.5)
    assert not any(reuse(noisy()) for _ in range(streams.LEARNED + 1)), (
        "what is noise is not known yet"
    )
    assert all(reuse(noisy()) for _ in range(50))
    assert not reuse(noisy(touch=8)) and reuse(noisy(touch=8)) and not reuse(noisy())
    drifted = [reuse(noisy(level)) for level in np.linspace(0, 20, 40)]
    assert 3 <= drifted.count(False) <= 20
    exact = streams.Reuse(0.0)
    assert not any(exact(noisy()) for _ in range(streams.LEARNED + 20))
    with pytest.raises(UserError, match="must be 0 or more, not -1"):
        streams.Reuse(-1.0)


class RatedCamera:
    """A camera that says it gives 250 frames/s: every second image is new, or `every`th."""

    def __init__(self, every: int, frames: int = 60) -> None:
        self.every = every
        self.left = frames
        self.captured = 0.0

    def grab(self) -> bool:
        time.sleep(0.004)
        self.captured = time.monotonic() - 0.05
        self.left -= 1
        return self.left >= 0

    def retrieve(self):
        return True, np.full((32, 40, 3), 90 + self.left // self.every, np.uint8)

    def get(self, name: int) -> float:
        return {cv2.CAP_PROP_FPS: 250.0, cv2.CAP_PROP_POS_MSEC: 1e3 * self.captured}[name]

    def release(self) -> None:
        pass


@pytest.mark.parametrize("every", [1, 3])
def test_fresh_frames_and_their_age_are_told(encoder, every, monkeypatch):
    """Frames that repeat the one before are not fresh, and few fresh frames are warned about."""
    monkeypatch.setattr(reader, "WINDOW", 0.1)
    logged = []
    # of a busy machine, even a good camera is late: it is judged by what it says
    nominal = 250.0 if every > 1 else 1.0
    monkeypatch.setattr(reader, "nominal_rate", lambda source: nominal)
    camera = RatedCamera(every)
    found = streams.collect(
        streams.stream(encoder, camera, live=True, sensor=DIGIT, log=logged.append)
    )
    rate = found.rate(nominal)
    assert rate.repeated == pytest.approx(1 - 1 / every, abs=0.05)
    assert 0 < rate.fresh < 250 / every + 20 and 0.04 < rate.age < 1
    assert "fresh frames/s of" in str(rate) and "old when it is read" in str(rate)
    assert bool(rate.warning()) == (every > 1)
    # once, while it streams
    assert sum("fresh frames/s, and not 250" in line for line in logged) == (every > 1)


def test_a_wait_for_the_encoder_has_a_name(encoder, monkeypatch):
    """The parts sum up to the time from a frame to its features, on a camera that is faster."""
    compile_for_one = streams.compile_for_one

    def slow(*args, **options):
        embed = compile_for_one(*args, **options)
        return lambda clip: (time.sleep(0.03), embed(clip))[1]

    monkeypatch.setattr(streams, "compile_for_one", slow)
    found = streams.collect(
        streams.stream(encoder, RatedCamera(1), live=True, sensor=DIGIT, log=lambda _: None)
    )
    np.testing.assert_allclose(found.seconds.sum(1), found.age, atol=1e-6)
    wait = found.seconds[1:-1, streams.PARTS.index("wait")]
    # a newer frame takes the place of one that waits
    assert 0 < np.median(wait) < 0.03
    assert any(line.startswith("wait ") for line in streams.budget(found))


def some(count: int):
    for i in range(count):
        yield streams.Embedded(
            i, 0.1 * i, np.full(3, i, np.float32), (0.001, 0.002, 0.0, 0.01, 0.003, 0.004), 0.02
        )


def test_an_interrupt_keeps_what_there_is():
    closed = []

    def interrupted():
        try:
            yield from some(2)
            raise KeyboardInterrupt
        finally:
            closed.append(True)

    result = streams.collect(interrupted())
    assert result.interrupted and closed == [True]
    assert result.values.tolist() == [[0, 0, 0], [1, 1, 1]] and result.numbers.tolist() == [0, 1]
    assert result.seconds.shape == (2, len(streams.PARTS)) and result.age.tolist() == [0.02, 0.02]

    def stop(one):
        if one.number == 3:
            raise KeyboardInterrupt

    result = streams.collect(some(9), stop)
    assert (
        result.interrupted
        and result.numbers.tolist() == [0, 1, 2]
        and result.values.shape == (3, 0)
    )
    assert not streams.collect(some(2)).interrupted


def test_sigterm_keeps_what_there_is_and_a_long_stream_only_its_last_times(monkeypatch):
    def terminated():
        yield from some(2)
        os.kill(os.getpid(), signal.SIGTERM)
        yield from some(1)

    result = streams.collect(terminated())
    assert result.interrupted and len(result.values) >= 2
    monkeypatch.setattr("anytouch_jax.live.stream.KEPT", 3)
    result = streams.collect(some(9), lambda one: None)
    assert result.total == 9 and result.numbers.tolist() == [6, 7, 8]
    assert streams.budget(result)[-1].startswith("9 frames embedded; of the last 3: 0 dropped")
    assert len(streams.collect(some(9)).values) == 9, "features are all kept"
