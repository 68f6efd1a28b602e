"""Versions of jax: names that are refused, errors against float64, and a comparison of this interpreter with itself."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from experiments.benchmarks import versions
from experiments.benchmarks.versions import VersionOptions
from experiments.records import read_records


@pytest.mark.parametrize("wrong", [{"flags": ("one DNN",)}, {"works": ("stage3",)}])
def test_an_unknown_name_is_refused_before_anything_starts(wrong):
    with pytest.raises(UserError, match=r"is none of the .* Choose among"):
        versions.run(VersionOptions(**wrong))


def test_errors_are_relative_and_of_each_kind():
    exact = {"output/0": np.array([3.0, 4.0]), "loss/0": np.array([2.0])}
    values = {"output/0": np.array([3.0, 4.5]), "loss/0": np.array([2.0])}
    assert versions._errors(values, exact) == {"output": pytest.approx(0.1), "loss": 0.0}


@pytest.mark.slow
def test_a_row_is_compared_with_this_interpreter(tmp_path):
    lines = tmp_path / "versions.jsonl"
    options = VersionOptions(
        (Path(sys.executable),), ("no YNNPACK",), ("embed one clip",), ("float32",), rounds=2, out=lines
    )
    assert versions.run(options) == 0
    base, other = read_records(lines).values()
    assert base["ratio"] == 1.0 and other["ratio"] > 0 and other["version"].endswith("no YNNPACK")
    assert max(one["error"]["output"] for one in (base, other)) < 1e-5


def test_a_process_that_fails_is_named(tmp_path):
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\nexit 3\n")
    broken.chmod(0o755)
    with pytest.raises(UserError, match=r"failed\. Its reason is above"):
        versions._Worker(broken, "", "embed one clip", "float32", VersionOptions())
