"""Hostile inputs of every kind: some at once, thousands in a long run."""

import os

import pytest

from tests.fuzz import arrays, images, json_files, manifests, runs, server, vectors, weights
from tests.fuzz.harness import try_all

# name -> what makes an input, how many are quick, the fraction of all in a long run
KINDS = {
    "arrays": (arrays.make, 40, 0.14),
    "json": (json_files.make, 30, 0.08),
    "manifests": (manifests.make, 25, 0.2),
    "images": (images.make, 25, 0.24),
    "runs": (runs.make, 25, 0.11),
    "server": (server.make, 8, 0.04),
    "vectors": (vectors.make, 60, 0.04),
    "weights": (weights.make, 25, 0.14),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("many", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_hostile(kind, many, tmp_path, things, capfd):
    make, few, fraction = KINDS[kind]
    count = round(fraction * int(os.environ.get("FUZZ_INPUTS", 5000))) if many else few
    lines = try_all(kind, make, count, tmp_path, things, capfd)
    assert not lines, "\n" + "\n".join(lines)
