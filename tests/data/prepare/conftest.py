"""Small worlds whose pictures have a pattern, because pictures of one colour are a finding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from checked_world import patterned


@pytest.fixture
def make(make: Callable[..., Any]) -> Callable[..., Any]:
    """`make` of the rooms above, with a pattern over the colour of every picture."""

    def build(rows: list[dict[str, Any]], folder: str = ".") -> Any:
        manifest = make(rows, folder)
        names = [name for name in ("path", "image_path", "image2_path") if name in manifest.table.column_names]
        for file in {manifest.file(row, name) for name in names for row in np.flatnonzero(manifest.present(name))}:
            cv2.imwrite(str(file), patterned(cv2.imread(str(file))))
        return manifest

    return build
