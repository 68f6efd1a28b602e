"""Images and surfaces of measured fields: depth in colour, an overlay, a mesh."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.background.estimate import without_islands
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.measured import Fields
from anytouch_jax.fields.outputs import LENGTH
from anytouch_jax.files import atomic_write

_EDGE = 4  # pixels, along each side, of one vertex of a surface
_ARROWS = 14  # along the shorter side
_LONGER = 4  # times its length is how a shear is drawn
_OPAQUE = np.float32(0.7)  # the most that the colours of depth cover a frame
_ABOUT = (
    "comment unit: mm (widths of the image, if its width in mm is not known)\n"
    "comment frame: right-handed, x right, y down, z away from the camera (REP 103)\n"
)
_GREEN = (120, 255, 120)
_WHITE = (255, 255, 255)


def depth_levels(depth: Array, width_mm: float | None) -> tuple[Array, float]:
    """Return a map of depth as u8, and the depth of level 255.

    That is the deepest place, but no less than a usual touch, so that noise stays dark.
    """
    deepest = max(float(depth.max()), LENGTH * (width_mm or 1.0))
    return np.clip(255 * depth / deepest, 0, 255).astype(np.uint8), deepest


def overlay(frame: Array, measured: Fields, row: int = 0, *, text: bool = True) -> Array:
    """Return an image u8 (h, w, 3) of a frame with what was measured.

    Depth is in colour, the rim of contact is white, arrows are shear that is longer than its
    deviation, and force and depth are written as `text`.

    Args:
        frame: u8 (h, w, 3), oriented.
        measured: fields of N frames.
        row: of the frame among them.
        text: write force and depth on it.
    """
    height, width = frame.shape[:2]
    one = measured[row].at(height, width)
    level, _ = depth_levels(one.depth[0], one.width_mm)
    colours = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    weight = np.minimum(level, 64) * (_OPAQUE / 64)
    view = cv2.blendLinear(np.ascontiguousarray(frame), colours, 1 - weight, weight)
    inside = without_islands((one.contact[0] > 0.5).astype(np.uint8))
    rims = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    cv2.drawContours(view, rims, -1, _WHITE, 1, cv2.LINE_AA)
    _draw_shear(view, one, inside)
    if text:
        line = _line(one)
        font = cv2.FONT_HERSHEY_SIMPLEX
        size = width / 800 + 0.1
        cv2.putText(view, line, (6, height - 8), font, size, _WHITE, 1, cv2.LINE_AA)
    return view


def _draw_shear(view: Array, one: Fields, inside: Array) -> None:
    """Draw arrows of shear inside the contact, in place."""
    height, width = view.shape[:2]
    step = max(min(height, width) // _ARROWS, 1)
    long = _LONGER * width / (one.width_mm or 1.0)  # pixels a mm
    for y in range(step // 2, height, step):
        for x in range(step // 2, width, step):
            shear = one.shear[0, y, x]
            if inside[y, x] and np.linalg.norm(shear) > one.shear_std[0, y, x]:
                tip = np.rint((x, y) + long * shear).astype(int)
                at = tuple(tip.tolist())
                cv2.arrowedLine(view, (x, y), at, _GREEN, 1, cv2.LINE_AA, tipLength=0.3)


def _line(one: Fields) -> str:
    """Return depth with its deviation and force with its interval of one frame, as text."""
    about = one.summary()
    unit = "" if one.width_mm is None else " mm"
    line = f"{about['depth']:.2f}+-{about['depth_std']:.2f}{unit}"
    if about["force_z"] is not None:
        line += (
            f"  {about['force_z']:.2f} N ({about['force_low']:.1f} to {about['force_high']:.1f})"
        )
    return line


def write_surface(path: Path, frame: Array, measured: Fields, row: int = 0) -> None:
    """Write the surface of the gel as a PLY mesh in mm, coloured by the frame.

    Its frame is the right-handed one of `Fields.points`, which a comment in the file says. Faces
    turn their front away from the camera, to where the object is.

    Args:
        path: of the .ply file.
        frame: u8 (h, w, 3), oriented.
        measured: fields of N frames.
        row: of the frame among them.
    """
    height = max(frame.shape[0] // _EDGE, 2)
    width = max(frame.shape[1] // _EDGE, 2)
    colours = ("red", "green", "blue")
    kinds = [(axis, "<f4") for axis in "xyz"] + [(colour, "u1") for colour in colours]
    points = np.empty((height, width), kinds)
    at = measured[row].at(height, width).points()[0]
    for place, axis in enumerate("xyz"):
        points[axis] = at[..., place]
    small = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
    for place, colour in enumerate(colours):
        points[colour] = small[..., place]
    faces = _triangles(height, width)
    properties = "".join(
        f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in kinds
    )
    header = (
        f"ply\nformat binary_little_endian 1.0\n{_ABOUT}element vertex {points.size}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    atomic_write(path, header.encode() + points.tobytes() + faces.tobytes())


def _triangles(height: int, width: int) -> Array:
    """Return the faces of a grid of vertices, two triangles for each of its cells.

    Their corners turn from x (right) to y (down), so their normals point along z.
    """
    grid = np.arange(height * width, dtype="<i4").reshape(height, width)
    top_left = grid[:-1, :-1]
    top_right = grid[:-1, 1:]
    low_left = grid[1:, :-1]
    low_right = grid[1:, 1:]
    corners = [top_left, top_right, low_left, top_right, low_right, low_left]
    triangles = np.stack(corners, -1).reshape(-1, 3)
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = triangles
    return faces
