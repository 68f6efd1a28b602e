"""The topics of one recording show one touch, so they are in one split."""

from tests.datasets.readers.test_bags import image, write_topics

RECORDINGS = 30
TOPICS = ("/gel/left", "/gel/right")


def test_the_topics_of_one_recording_are_in_one_split(read, tmp_path):
    """Each topic is a sequence, and a split by sequence would train on the touches of the test."""
    frames = [(number / 30, image(10 * number)) for number in range(2)]
    topics = [(topic, "foxglove.CompressedImage", frames) for topic in TOPICS]
    for number in range(RECORDINGS):
        write_topics(tmp_path / f"{number:02d}.mcap", topics)
    table = read("bags", sensor="digit", export=True, val=0.3, test=0.3)
    assert len(table.rows) == RECORDINGS * len(TOPICS) * len(frames)
    splits = {}
    for path, unit, split in zip(table["path"], table["unit"], table["split"], strict=True):
        recording = path.partition("/")[0]
        splits.setdefault(recording, {}).setdefault(split, set()).add(unit)
    assert len(splits) == RECORDINGS
    for recording, units in splits.items():
        assert list(units.values()) == [set(TOPICS)], (recording, units)
    used = {split for units in splits.values() for split in units}
    assert used == {"train", "val", "test"}, "the law is tried on every split"
