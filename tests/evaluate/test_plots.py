import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from anytouch_jax.evaluate import plots
from anytouch_jax.evaluate.plots import FractionBar, smoothed


def read(path: Path) -> Any:
    image = cv2.imread(str(path))
    assert image is not None and (image == 255).all(-1).mean() > 0.2
    return image[..., ::-1].astype(int)


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
        {"step": i, "loss": 3.0, "reconstruction": 1.0 / (i + 1)}
        | ({"next_frame": 0.5} if i % 2 else {})
        for i in range(60)
    ]
    steps[7]["reconstruction"] = None  # a skipped step
    short = [{"step": i, "loss": 2.0} for i in range(3)]
    one = lines_of(tmp_path / "one", *steps)
    two = lines_of(tmp_path / "two", *short)
    plots.loss_curves(tmp_path / "f" / "loss.png", {"stage 1": one, "other": two / "metrics.jsonl"})
    left, right = drawn[0].axes
    assert [t.get_text() for t in left.get_legend().get_texts()] == ["reconstruction", "next frame"]
    assert [t.get_text() for t in right.get_legend().get_texts()] == ["loss"]
    x, y = left.lines[0].get_data()
    assert 7 not in x and len(x) == 59 and y[0] == 1.0
    np.testing.assert_allclose(left.lines[1].get_ydata(), smoothed(y))
    # no half steps
    assert all(float(tick).is_integer() for tick in right.get_xticks())
    assert list(left.lines[2].get_xdata()) == list(range(1, 60, 2))
    assert read(tmp_path / "f" / "loss.png").shape[1] > 600


def test_bars_with_intervals_and_chance(tmp_path: Path, drawn: list[Any]) -> None:
    series = {
        "fine": {"a": FractionBar(0.2, 0.1, 0.35, 0.02), "b": FractionBar(0.6)},
        "coarse": {"b": FractionBar(0.5, 0.4, 0.9)},
    }
    plots.bars(tmp_path / "b.png", series)
    left, right = drawn[0].axes
    assert [patch.get_width() for patch in left.patches] == [20, 60] and [
        p.get_width() for p in right.patches
    ] == [50]
    assert left.lines[0].get_xdata() == pytest.approx([10, 35]) and left.lines[
        1
    ].get_xdata() == pytest.approx([2, 2])
    # one place for a name in all panels
    assert right.patches[0].get_y() == left.patches[1].get_y()
    assert left.get_xlim() == right.get_xlim() and left.yaxis_inverted()
    # the interval of the last panel is inside
    assert left.get_xlim()[0] == 0 and left.get_xlim()[1] >= 90
    read(tmp_path / "b.png")
