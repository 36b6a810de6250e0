"""Vertical lines of an omnidirectional image: bearing, extent, and the colours beside them.

The paper's section III-B.2, on a panorama from the calibrated camera. A vertical line of the world
occupies one column of it, so all its rows together give its bearing, and the scatter of blocks of
rows gives the bearing's standard deviation.
"""

from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.vision.camera import Camera
from jaxslam.vision.edge_localisation import fit_segments, mean
from jaxslam.vision.edges import PAD, find_edges
from jaxslam.vision.images import check_size
from jaxslam.vision.line_merging import merge_pieces, separate_close_pairs
from jaxslam.vision.panorama import panorama, unwrap

BESIDE = (2, 3, 4)  # columns from an edge over which the colour beside it is averaged
STEP = np.sqrt(2 * pi)  # contrast of an edge over (its width x its largest gradient)
WIDEST = 1.5  # columns, width of the softest edge to detect
SOFTER, RAMP = 1.1, 0.5  # an edge wider than most by SOFTER may be off by RAMP of its width


@dataclass(frozen=True)
class LineSettings:
    """What counts as a line. Raises `ValueError` for values out of range.

    `columns` and `elevation` (low, high) [rad] (None: the camera's) of the panorama. Least
    `contrast` of an edge, relative to the image's mean level, RMS over the colours; `significance`
    in units of its row's noise; `evidence`: gradient per column, relative to the mean level, times
    the square root of the rows; `sharpness`, relative to the median line's; and `length` [rad].
    Largest `gap` [rad] in a line and `slope` [columns per row]. `merge` pieces of one line that are
    at most `merge_bearing` and `merge_gap` [rad] apart. `floor` [rad] of a bearing's standard
    deviation. `colour`: use colours, or brightness alone.
    """

    columns: int = 1440
    elevation: tuple[float, float] | None = None
    contrast: float = 0.14
    significance: float = 2.7
    evidence: float = 0.23
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
        for name in ("contrast", "significance", "evidence", "length", "gap", "slope", "floor"):
            value = getattr(self, name)
            if not 0 < value < 1e3:
                raise ValueError(f"lines: {name} {value!r} must be above 0")
        for name in ("merge_bearing", "merge_gap"):
            value = getattr(self, name)
            if not 0 <= value < 2 * pi:
                raise ValueError(f"lines: {name} {value!r} rad must be 0 to 2 pi")


class Lines(NamedTuple):
    """n vertical lines sorted by bearing, in the robot's frame.

    `bearing` [n] rad in (-pi, pi]; `sigma` [n] rad, its standard deviation; `low` and `high` [n]
    rad, elevations of the ends; `polarity` [n] int, 1: brighter on the left (greater azimuth), else
    -1; `colour` float32 [n, 2, 3] 0..1, left and right of it, BGR; `strength` [n]: gradient per
    column relative to the image's mean level, root of the sum of squares over its rows.
    """

    bearing: np.ndarray
    sigma: np.ndarray
    low: np.ndarray
    high: np.ndarray
    polarity: np.ndarray
    colour: np.ndarray
    strength: np.ndarray

    def take(self, index):
        """The lines selected by an index or mask."""
        return Lines(*(field[index] for field in self))


def extract_lines(image: np.ndarray, camera: Camera, settings: LineSettings | None = None) -> Lines:
    """Extract the `Lines` of an image uint8 [H, W, 3]; there may be none.

    Raises `ValueError` if the camera is calibrated for another size.
    """
    settings = settings or LineSettings()
    view, picture = _panorama(image, camera, settings)
    edges, level = _edges(picture, view, settings)
    lines = _lines(edges, picture, view, settings, level)
    if settings.merge:
        lines = merge_pieces(lines, settings.merge_bearing, settings.merge_gap)
    return lines.take(np.argsort(lines.bearing, kind="stable"))


def _panorama(image, camera, settings):
    check_size(image, camera, "lines")
    view = panorama(camera, settings.columns, settings.elevation)
    return view, unwrap(image, view)


def _edges(picture, view, settings):
    """`Edges` of a panorama uint8 [H, W, 3], and its mean level, the unit of contrast."""
    channels = picture if settings.colour else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)[..., None]
    levels = cv2.mean(channels, view.valid.view(np.uint8))
    level = max(float(np.mean(levels[: channels.shape[2]])), 1.0)
    extents = settings.length, settings.gap
    length, gap = (max(2, round(angle / view.row_height)) for angle in extents)
    contrast = settings.contrast * level / STEP / WIDEST
    limits = contrast, settings.significance, length, gap, settings.slope
    return find_edges(channels, view.valid, *limits), level


def is_dark(image, level=12.0):
    """Whether an image is too dark for lines: its mean is below `level` of 255."""
    return float(np.mean(image)) < level


def _lines(edges, picture, view, settings, level):
    """`Lines` of the upright segments, without those that the padding repeats at the seam."""
    fit = fit_segments(edges, _columns_per_pixel(view))
    keep = _upright(fit, view, settings, level)
    usual = np.median(fit.width[keep]) if keep.any() else 1.0
    index = np.flatnonzero(keep)
    blurred = np.clip(fit.width[index] ** 2 - (SOFTER * usual) ** 2, 0, None)
    scatter = np.sqrt(fit.scatter[index] ** 2 + RAMP**2 * blurred)
    half = view.row_height / 2
    lines = Lines(
        bearing=view.bearing(fit.column[index] - PAD),
        sigma=np.hypot(scatter * view.step, settings.floor),
        low=view.elevation[fit.last[index]] - half,
        high=view.elevation[fit.first[index]] + half,
        polarity=-fit.sign[index],
        colour=_colours(edges, picture, fit)[index],
        strength=fit.strength[index] / level,
    )
    return separate_close_pairs(lines, usual * view.step)


def _upright(fit, view, settings, level):
    """Mask [n] of the segments that are lines: upright, strong, sharp, and not in the padding."""
    keep = (np.abs(fit.slope) <= settings.slope) & (fit.strength >= settings.evidence * level)
    keep &= (fit.column >= PAD - 0.5) & (fit.column < PAD + len(view.azimuth) - 0.5)
    if keep.any():  # an edge that is softer than most is a shadow
        step = STEP * np.median(fit.width[keep]) * fit.strength / np.sqrt(fit.rows)
        keep &= fit.sharp >= settings.sharpness * np.median(fit.sharp[keep])
        keep &= step >= settings.contrast * level
    return keep


def _colours(edges, picture, fit):
    """Mean colour [n, 2, 3], 0..1, left and right of each segment over its rows."""
    n, width, segment = len(fit.column), picture.shape[1], edges.segment
    inside = (edges.row >= fit.first[segment]) & (edges.row <= fit.last[segment])
    row, segment = edges.row[inside], segment[inside]
    centre = np.rint(np.nan_to_num(fit.column)).astype(int)[segment] - PAD
    sides = []
    for side in (-1, 1):
        beside = (centre[:, None] + side * np.array(BESIDE)) % width
        colour = picture[row[:, None], beside].mean(axis=1)
        sides.append(np.stack([mean(channel, segment, n) for channel in colour.T], -1))
    return (np.stack(sides, 1) / 255).astype(np.float32)


def _columns_per_pixel(view, stride=90):
    """Width [H] of an image pixel, in columns, in each row of a `Panorama`."""
    maps = view.map_x, view.map_y
    step = [part[:, 1::stride].astype(float) - part[:, :-1:stride] for part in maps]
    return 1 / np.maximum(np.median(np.hypot(*step), axis=1), 1e-3)
