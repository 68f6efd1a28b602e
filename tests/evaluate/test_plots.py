"""Charts: what is drawn where, read back from the picture, and files that are whole or not there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import plots
from anytouch_jax.evaluate.plots import ShareBar, smoothed

RNG = np.random.default_rng(0)


def read(path: Path) -> Any:
    image = cv2.imread(str(path))
    assert image is not None and (image == 255).all(-1).mean() > 0.2
    return image[..., ::-1].astype(int)


def share_of(image: Any, colour: tuple[int, int, int]) -> float:
    return float((np.abs(image - np.array(colour)).max(-1) < 12).mean())


@pytest.fixture
def drawn(monkeypatch: Any) -> list[Any]:
    """The figures as matplotlib holds them, beside what is written."""
    figures: list[Any] = []
    write = plots.write_figure

    def keep(path: Path, figure: Any) -> None:
        figures.append(figure)
        write(path, figure)

    monkeypatch.setattr(plots, "write_figure", keep)
    return figures


def lines_of(run: Path, *lines: dict[str, Any]) -> Path:
    run.mkdir(exist_ok=True)
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return run


def test_loss_curves_hold_every_term(tmp_path: Path, drawn: list[Any]) -> None:
    steps = [
        {"step": i, "loss": 3.0, "reconstruction": 1.0 / (i + 1)} | ({"next_frame": 0.5} if i % 2 else {})
        for i in range(60)
    ]
    steps[7]["reconstruction"] = None  # a skipped step
    short = [{"step": i, "loss": 2.0} for i in range(3)]
    one, two = lines_of(tmp_path / "one", *steps), lines_of(tmp_path / "two", *short)
    plots.loss_curves(tmp_path / "f" / "loss.png", {"stage 1": one, "other": two / "metrics.jsonl"})
    left, right = drawn[0].axes
    assert [t.get_text() for t in left.get_legend().get_texts()] == ["reconstruction", "next frame"]
    assert [t.get_text() for t in right.get_legend().get_texts()] == ["loss"]
    x, y = left.lines[0].get_data()
    assert 7 not in x and len(x) == 59 and y[0] == 1.0
    np.testing.assert_allclose(left.lines[1].get_ydata(), smoothed(y))
    assert all(float(tick).is_integer() for tick in right.get_xticks())  # no half steps
    assert list(left.lines[2].get_xdata()) == list(range(1, 60, 2))
    assert read(tmp_path / "f" / "loss.png").shape[1] > 600


@pytest.mark.parametrize("text", [None, "", "{not json\n"])
def test_metrics_that_cannot_be_read(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "metrics.jsonl").write_text(text)
    with pytest.raises(UserError, match=r"metrics\.jsonl"):
        plots.loss_curves(tmp_path / "a.png", {"x": tmp_path})
    assert not (tmp_path / "a.png").exists()


def test_a_running_mean_keeps_lines_and_ends() -> None:
    assert smoothed(np.array([3.0, 1.0])).tolist() == [3.0, 1.0]
    np.testing.assert_allclose(smoothed(np.full(200, 4.0)), 4.0)
    rough = RNG.normal(size=400)
    assert smoothed(rough).std() < 0.4 * rough.std() and len(smoothed(rough)) == 400
    assert smoothed(np.arange(100.0))[50] == pytest.approx(50, abs=1)


def test_tsne_panels_colour_by_sensor_and_by_object(tmp_path: Path, drawn: list[Any]) -> None:
    sensors, objects = np.repeat(["digit", "gelslim"], 30), [f"thing {i % 20}" for i in range(60)]
    spaces = {name: RNG.normal(size=(60, 2)) for name in ("random", "stage 1")}
    plots.tsne_panels(tmp_path / "t.png", spaces, sensors, objects)
    assert [axis.get_title() for axis in drawn[0].axes] == [
        "random, by sensor", "stage 1, by sensor", "random, by object", "stage 1, by object",
    ]  # fmt: skip
    above, below = drawn[0].axes[1], drawn[0].axes[3]
    np.testing.assert_array_equal(above.collections[0].get_offsets(), spaces["stage 1"])
    for axis, count in ((above, 2), (below, 20)):
        assert len(np.unique(axis.collections[0].get_facecolors(), axis=0)) == count
    assert [t.get_text() for t in above.get_legend().get_texts()] == ["digit", "gelslim"]
    assert below.get_legend() is None and below.get_xlabel() == "20 objects"
    assert share_of(read(tmp_path / "t.png"), (31, 119, 180)) > 1e-4  # the first colour is there


def test_a_sample_grid_shows_what_it_is_given(tmp_path: Path) -> None:
    red, green = (np.broadcast_to(np.array(c, np.uint8), (30, 40, 3)) for c in ((250, 0, 0), (0, 250, 0)))
    plots.sample_grid(tmp_path / "g.png", [[red, None], [green, np.eye(20)]], ["one", "two"], ["digit", "photograph"])
    image = read(tmp_path / "g.png")
    for colour in ((250, 0, 0), (0, 250, 0), (242, 242, 242), (68, 1, 84), (253, 231, 37)):
        assert share_of(image, colour) > 0.005, colour  # two pictures, an empty cell, both ends of the colour map
    place = [np.argwhere((image == c).all(-1)).mean(0) for c in ((250, 0, 0), (0, 250, 0), (242, 242, 242))]
    assert place[0][0] < place[1][0] and place[0][1] < place[2][1]
    with pytest.raises(ValueError, match="zip"):
        plots.sample_grid(tmp_path / "h.png", [[red]], ["one", "two"], ["digit"])


def test_bars_with_intervals_and_chance(tmp_path: Path, drawn: list[Any]) -> None:
    series = {
        "fine": {"a": ShareBar(0.2, 0.1, 0.35, 0.02), "b": ShareBar(0.6)},
        "coarse": {"b": ShareBar(0.5, 0.4, 0.9)},
    }
    plots.bars(tmp_path / "b.png", series)
    left, right = drawn[0].axes
    assert [patch.get_width() for patch in left.patches] == [20, 60] and [p.get_width() for p in right.patches] == [50]
    assert left.lines[0].get_xdata() == pytest.approx([10, 35]) and left.lines[1].get_xdata() == pytest.approx([2, 2])
    assert right.patches[0].get_y() == left.patches[1].get_y()  # one place for a name in all panels
    assert left.get_xlim() == right.get_xlim() and left.yaxis_inverted()
    assert left.get_xlim()[0] == 0 and left.get_xlim()[1] >= 90  # the interval of the last panel is inside
    read(tmp_path / "b.png")


def test_the_same_figure_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        plots.bars(tmp_path / name, {"x": {"a": ShareBar(0.2)}})
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with pytest.raises(UserError, match="nothing to draw"):
        plots.tsne_panels(tmp_path / "c.png", {}, [], [])


def test_pyplot_is_never_loaded() -> None:
    import subprocess
    import sys

    code = (
        "import sys, pathlib, tempfile; from anytouch_jax.evaluate import plots; before = 'matplotlib' in sys.modules\n"
        "plots.bars(pathlib.Path(tempfile.mkdtemp()) / 'a.png', {'x': {'a': plots.ShareBar(0.2)}})\n"
        "print(before, 'matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
