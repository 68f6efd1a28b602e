"""Pareto plots: the front, the marks and the numbers of the axes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from experiments.benchmarks import pareto as module
from experiments.benchmarks.pareto import front, pareto


@pytest.fixture
def drawn(monkeypatch: Any) -> list[Any]:
    """The figures that are written."""
    figures: list[Any] = []
    write = module.write_figure

    def keep(path: Path, figure: Any) -> None:
        figures.append(figure)
        write(path, figure)

    monkeypatch.setattr(module, "write_figure", keep)
    return figures


def test_the_front_of_a_pareto_plot(tmp_path: Path, drawn: list[Any]) -> None:
    points = {
        "base": (1.0, 1e-6),
        "half": (0.5, 1e-2),
        "middle": (0.8, 1e-4),
        "beaten": (0.9, 1e-3),
        "tie": (1.0, 1e-6),
    }
    values = np.array(list(points.values()))
    assert [list(points)[i] for i in front(values)] == ["half", "middle", "base"]
    assert front(values[::-1]).tolist() == [3, 2, 0]
    assert front(np.array([[1.0, 1.0], [2.0, 2.0]])).tolist() == [0]
    pareto(tmp_path / "p.png", points)
    axis = drawn[0].axes[0]
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    assert [text.get_text() for text in axis.get_legend().get_texts()] == list(points)
    np.testing.assert_array_equal(axis.lines[0].get_xdata(), [0.5, 0.8, 1.0])
    assert cv2.imread(str(tmp_path / "p.png")) is not None
    for bad in ({"zero": (1.0, 0.0)}, {"nan": (float("nan"), 1.0)}, {}):
        with pytest.raises(UserError, match="positive and finite"):
            pareto(tmp_path / "q.png", bad)


@pytest.mark.parametrize(("most", "between"), [(4.0, True), (2000.0, False)])
def test_numbers_between_powers_of_ten_stand_where_there_is_room(
    tmp_path: Path, drawn: list[Any], most: float, between: bool
) -> None:
    pareto(tmp_path / "p.png", {"quick": (2.0, 1.0), "slow": (most, 0.1)})
    axis = drawn[0].axes[0]
    assert any(tick.label1.get_text() for tick in axis.xaxis.get_minor_ticks()) == between
    assert any(tick.label1.get_text() for tick in axis.xaxis.get_major_ticks())


def test_errors_close_to_each_other_have_plain_numbers(tmp_path: Path, drawn: list[Any]) -> None:
    pareto(tmp_path / "p.png", {"quick": (2.0, 0.33), "slow": (4.0, 0.29)})
    axis = drawn[0].axes[0]
    told = [tick.label1.get_text() for tick in (*axis.yaxis.get_major_ticks(), *axis.yaxis.get_minor_ticks())]
    assert any(told) and all(float(one) for one in told if one)  # 0.3, and no power of ten


def test_each_of_many_points_has_a_mark_of_its_own(tmp_path: Path, drawn: list[Any]) -> None:
    pareto(tmp_path / "p.png", {f"variant {i}": (1.0 + i, 1e-6 * (1 + i)) for i in range(25)})
    axis = drawn[0].axes[0]
    looks = {(*one.get_facecolors()[0], len(one.get_paths()[0].vertices)) for one in axis.collections}
    assert len(looks) == 25 and len(axis.get_legend().get_texts()) == 25
