"""Vertical lines of an omnidirectional image, with bearing, extent and the colours beside them.

The paper's section III-B.2, on a panorama that the calibrated camera makes. A line that is vertical
in the world stands in one column there, so its bearing is found from all its rows at once, and how
much blocks of rows differ tells how good it is.
"""

from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.vision.edge_fit import fit_segments, mean
from jaxslam.vision.edges import PAD, find_edges
from jaxslam.vision.line_pairs import merged, separated
from jaxslam.vision.panorama import panorama, unwrap

BESIDE = (2, 3, 4)  # columns away from the edge whose mean is the colour beside it
SOFTER, RAMP = 1.3, 0.5  # an edge so much wider than most may be off by this share of its width


@dataclass(frozen=True)
class LineSettings:
    """What counts as a line; validated when made.

    `columns` of the panorama, `elevation` (low, high) [rad] of it (None: the camera's);
    `contrast` [grey levels per column] and `significance` [times the noise of its row] that an edge
    must have; `length` [rad] of a line at least and `gap` [rad] within it at most; `slope` [columns
    per row] it may lean; `merge_bearing` and `merge_gap` [rad] between pieces of one line; `floor`
    [rad] of the standard deviation of a bearing. `merge` pieces, use `colour`: True or False.
    """

    columns: int = 1440
    elevation: tuple[float, float] | None = None
    contrast: float = 0.07
    significance: float = 2.7
    evidence: float = 0.4
    length: float = 0.13
    gap: float = 0.03
    slope: float = 0.08
    merge_bearing: float = 0.006
    merge_gap: float = 0.5
    floor: float = 0.0005
    sharpness: float = 0.65
    merge: bool = True
    colour: bool = True

    def __post_init__(self):
        for name in ("contrast", "significance", "length", "gap", "slope", "floor"):
            value = getattr(self, name)
            if not 0 < value < 1e3:
                raise ValueError(f"lines: {name} {value!r} must be above 0")
        for name in ("merge_bearing", "merge_gap"):
            value = getattr(self, name)
            if not 0 <= value < 2 * pi:
                raise ValueError(f"lines: {name} {value!r} rad must be 0 to 2 pi")


class Lines(NamedTuple):
    """n vertical lines sorted by bearing, in the robot's frame.

    `bearing` [n] rad in (-pi, pi], `sigma` [n] rad its standard deviation, `low` and `high` [n] rad
    elevations of the ends, `polarity` [n] int, 1: brighter on the left (greater azimuth), else -1,
    `colour` float32 [n, 2, 3] 0..1 left and right of it, BGR, `strength` [n] grey levels per column
    of the gradient, summed in squares over its rows.
    """

    bearing: np.ndarray
    sigma: np.ndarray
    low: np.ndarray
    high: np.ndarray
    polarity: np.ndarray
    colour: np.ndarray
    strength: np.ndarray

    def take(self, index):
        """The lines of an index or mask."""
        return Lines(*(field[index] for field in self))


def extract_lines(image, camera, settings=None):
    """`Lines` of an image uint8 [H, W, 3], maybe none at all.

    Raises `ValueError` when the image is not of the camera's size.
    """
    settings = settings or LineSettings()
    if image.shape[:2] != (camera.height, camera.width):
        found = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(
            f"lines: image of {found} pixels, camera of {camera.width} x {camera.height}"
        )
    view = panorama(camera, settings.columns, settings.elevation)
    return lines_of_panorama(unwrap(image, view), view, settings)


def lines_of_panorama(picture, view, settings):
    """`Lines` of a picture uint8 [H, W, 3] seen as the `Panorama` `view`."""
    seen = picture if settings.colour else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)[..., None]
    spacing = _row_height(view)
    length, gap = (max(2, round(angle / spacing)) for angle in (settings.length, settings.gap))
    level = max(float(np.mean(cv2.mean(seen, view.valid.view(np.uint8))[: seen.shape[2]])), 1.0)
    edges = find_edges(
        seen,
        view.valid,
        settings.contrast * level,
        settings.significance,
        length,
        gap,
        settings.slope,
    )
    lines = _lines(edges, picture, view, settings, level)
    if settings.merge:
        lines = merged(lines, settings.merge_bearing, settings.merge_gap)
    return lines.take(np.argsort(lines.bearing, kind="stable"))


def is_dark(image, level=12.0):
    """Whether an image is too dark to look for lines: its mean is below `level` of 255."""
    return float(np.mean(image)) < level


def _lines(edges, picture, view, settings, level):
    """`Lines` of the segments that stand upright, each once (the seam's repeat left out)."""
    fit = fit_segments(edges, _columns_per_pixel(view))
    keep = (np.abs(fit.slope) <= settings.slope) & (fit.strength >= settings.evidence * level)
    keep &= (fit.column >= PAD - 0.5) & (fit.column < PAD + len(view.azimuth) - 0.5)
    usual = np.median(fit.width[keep]) if keep.any() else 1.0
    if keep.any():  # what is softer than most edges is a shadow
        keep &= fit.sharp >= settings.sharpness * np.median(fit.sharp[keep])
    index = np.flatnonzero(keep)
    blurred = np.clip(fit.width[index] ** 2 - (SOFTER * usual) ** 2, 0, None)
    scatter = np.sqrt(fit.scatter[index] ** 2 + RAMP**2 * blurred)
    half = _row_height(view) / 2
    lines = Lines(
        bearing=view.bearing(fit.column[index] - PAD),
        sigma=np.hypot(scatter * view.step, settings.floor),
        low=view.elevation[fit.last[index]] - half,
        high=view.elevation[fit.first[index]] + half,
        polarity=-fit.sign[index],
        colour=_colours(edges, picture, fit.column)[index],
        strength=fit.strength[index] / level,
    )
    return separated(lines, usual * view.step)


def _colours(edges, picture, column):
    """Mean colour [n, 2, 3] in 0..1 on the left and on the right over a segment's rows."""
    n, width = len(column), picture.shape[1]
    centre = np.rint(np.nan_to_num(column)).astype(int)[edges.segment] - PAD
    sides = []
    for side in (-1, 1):
        beside = (centre[:, None] + side * np.array(BESIDE)) % width
        colour = picture[edges.row[:, None], beside].mean(axis=1)
        sides.append(np.stack([mean(channel, edges.segment, n) for channel in colour.T], -1))
    return (np.stack(sides, 1) / 255).astype(np.float32)


def _row_height(view):
    return (view.elevation[0] - view.elevation[-1]) / (len(view.elevation) - 1)


def _columns_per_pixel(view, stride=90):
    """How many columns [H] a pixel of the image is wide in each row of a `Panorama`."""
    step = [
        part[:, 1::stride].astype(float) - part[:, :-1:stride] for part in (view.map_x, view.map_y)
    ]
    return 1 / np.maximum(np.median(np.hypot(*step), axis=1), 1e-3)
