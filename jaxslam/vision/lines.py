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

from jaxslam.vision.edges import PAD, find_edges
from jaxslam.vision.panorama import panorama, unwrap

SHARP = 2.0
REACH = 3  # columns on either side of an edge that its place is found from
BLOCK = 6  # rows judged together
BESIDE = (2, 3, 4)  # columns away from the edge whose mean is the colour beside it
PRIOR = 3.0  # blocks' worth of belief in the usual scatter
USUAL = 0.35  # columns: usual scatter of a block
CLIP = 2.5  # robust standard deviations beyond which a block counts less


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
    contrast: float = 0.05
    significance: float = 4.0
    length: float = 0.12
    gap: float = 0.03
    slope: float = 0.08
    merge_bearing: float = 0.006
    merge_gap: float = 0.5
    floor: float = 0.0005
    sharpness: float = 0.5
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
        raise ValueError(f"lines: image of {found} pixels, camera of {camera.width} x {camera.height}")
    view = panorama(camera, settings.columns, settings.elevation)
    return lines_of_panorama(unwrap(image, view), view, settings)


def lines_of_panorama(picture, view, settings):
    """`Lines` of a picture uint8 [H, W, 3] seen as the `Panorama` `view`."""
    seen = picture if settings.colour else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)[..., None]
    spacing = (view.elevation[0] - view.elevation[-1]) / (len(view.elevation) - 1)
    length, gap = (max(2, round(angle / spacing)) for angle in (settings.length, settings.gap))
    level = max(float(np.mean(cv2.mean(seen, view.valid.view(np.uint8))[: seen.shape[2]])), 1.0)
    edges = find_edges(
        seen, view.valid, settings.contrast * level, settings.significance, length, gap, settings.slope
    )
    lines = _lines(edges, picture, view, settings)
    if settings.merge:
        lines = merged(lines, settings.merge_bearing, settings.merge_gap)
    return lines.take(np.argsort(lines.bearing, kind="stable"))


def is_dark(image, level=12.0):
    """Whether an image is too dark to look for lines: its mean is below `level` of 255."""
    return float(np.mean(image)) < level


def _lines(edges, picture, view, settings):
    """`Lines` of the segments that stand upright, each once (the seam's repeat left out)."""
    n = int(edges.segment.max(initial=-1)) + 1
    slope = _slopes(edges, n)
    column, scatter, sign, strength, sharp = _placed(edges, n, columns_per_pixel(view))
    width = picture.shape[1]
    keep = (np.abs(slope) <= settings.slope) & np.isfinite(column)
    if n:
        keep &= sharp >= settings.sharpness * np.median(sharp)
    keep &= (column >= PAD - 0.5) & (column < PAD + width - 0.5)
    first, last = _ends(edges, n)
    half = 0.5 * (view.elevation[0] - view.elevation[-1]) / (len(view.elevation) - 1)
    index = np.flatnonzero(keep)
    return Lines(
        bearing=view.bearing(column[index] - PAD),
        sigma=np.hypot(scatter[index] * view.step, settings.floor),
        low=view.elevation[last[index]] - half,
        high=view.elevation[first[index]] + half,
        polarity=-sign[index].astype(int),
        colour=_colours(edges, picture, column, n)[index],
        strength=strength[index],
    )


def _slopes(edges, n):
    """Slope [n] in columns per row, by least squares."""
    count = np.bincount(edges.segment, minlength=n)
    row = edges.row - (np.bincount(edges.segment, edges.row, n) / count)[edges.segment]
    square = np.bincount(edges.segment, row * row, n)
    return np.bincount(edges.segment, row * edges.column, n) / np.maximum(square, 1e-9)


def _ends(edges, n):
    """First and last row [n] of the segments: their rows are sorted."""
    ends = np.cumsum(np.bincount(edges.segment, minlength=n))
    return edges.row[np.concatenate([[0], ends[:-1]]).astype(int)[:n]], edges.row[ends - 1]


def columns_per_pixel(view, stride=90):
    """How many columns [H] a pixel of the image is wide in each row of a `Panorama`."""
    x, y = (part[:, ::stride].astype(float) for part in (view.map_x, view.map_y))
    nx, ny = (part[:, 1::stride].astype(float) for part in (view.map_x, view.map_y))
    n = min(x.shape[1], nx.shape[1])
    width = np.median(np.hypot(nx[:, :n] - x[:, :n], ny[:, :n] - y[:, :n]), axis=1)
    return 1 / np.maximum(width, 1e-3)


def _placed(edges, n, wide):
    """Column, its standard deviation, sign of the gradient and strength [n] of the segments.

    The gradients of a segment's rows lie along one line in colour space (its principal axis); the
    profiles across it add up, block by block of rows. NaN where there is no peak.
    """
    segment = edges.segment
    centre = np.rint(np.bincount(segment, edges.column, n) / np.bincount(segment, minlength=n))
    centre = np.clip(centre, PAD - 4, edges.along.shape[1] - 1 - (PAD - 4)).astype(int)
    at = edges.along[edges.row, np.rint(edges.column).astype(int)].astype(float)
    axis = _principal(at, segment, n)
    along = np.einsum("ec,ec->e", at, axis[segment])
    reach = np.arange(-REACH, REACH + 1)
    across = edges.gradient[edges.row[:, None], centre[segment][:, None] + reach]
    across = np.einsum("ekc,ec->ek", across, axis[segment] * np.sign(along)[:, None])
    far = np.clip(np.rint(SHARP * wide), 2, PAD - 4).astype(int)[edges.row]
    beyond = [
        np.einsum(
            "ec,ec->e",
            edges.along[edges.row, centre[segment] + sign * far],
            axis[segment] * np.sign(along)[:, None],
        )
        for sign in (-1, 1)
    ]
    sharp = 1 - np.bincount(segment, np.add(*beyond) / 2, n) / np.bincount(
        segment, np.abs(along), n
    )
    first, _ = _ends(edges, n)
    block = (edges.row - first[segment]) // BLOCK
    _, start, block = np.unique(
        segment * 10_000 + block, return_index=True, return_inverse=True
    )
    profile = np.stack([np.bincount(block, across[:, k]) for k in range(len(reach))], -1)
    owner = segment[start]
    whole = np.stack([np.bincount(owner, profile[:, k], n) for k in range(len(reach))], -1)
    top = 1 + np.argmax(whole[:, 1:-1], axis=1)
    offset, scatter = _peak(profile, owner, top, n)
    sign = np.where(np.bincount(segment, along, n) >= 0, 1, -1)
    strength = np.sqrt(np.bincount(segment, along**2, n))
    return centre + top - REACH + offset, scatter, sign, strength, sharp


def _principal(vectors, owner, n):
    """Unit principal axis [n, C] of vectors [E, C] by owner, towards brighter."""
    moment = np.stack(
        [np.bincount(owner, a * b, n) for a in vectors.T for b in vectors.T], -1
    ).reshape(n, vectors.shape[1], vectors.shape[1])
    axis = np.linalg.eigh(moment)[1][:, :, -1]
    return axis * np.where(axis.sum(1, keepdims=True) < 0, -1, 1)


def _peak(profile, owner, top, n):
    """Offset of the peak from its column `top` and its standard deviation [n], robust over blocks.

    Every block's parabola has a centre and a curvature, which is its weight.
    """
    blocks = np.arange(len(owner))
    left, middle, right = (profile[blocks, top[owner] + k] for k in (-1, 0, 1))
    total = [np.bincount(owner, part, n) for part in (left, middle, right)]
    curved = 2 * total[1] - total[0] - total[2]
    offset = (total[2] - total[0]) / 2 / np.where(curved > 0, curved, np.nan)
    weight = np.clip(2 * middle - left - right, 0, None)
    place = np.clip((right - left) / 2 / np.maximum(weight, 1e-6), -1.5, 1.5)
    base = weight
    for _ in range(3):
        away = place - offset[owner]
        spread = _variance(away, base, owner, n)
        ratio = np.abs(away) / np.sqrt(spread[owner] * _mean(base, owner, n)[owner] / np.maximum(base, 1e-9))
        weight = base * np.where(ratio > CLIP, CLIP / np.maximum(ratio, 1e-9), 1.0)
        all_weight = np.bincount(owner, weight, n)
        offset = np.bincount(owner, weight * place, n) / np.where(all_weight > 0, all_weight, np.nan)
    away = place - offset[owner]
    effective = np.bincount(owner, weight, n) / _mean(base, owner, n)
    return offset, np.sqrt(_variance(away, weight, owner, n) / np.maximum(effective, 1e-9))


def _mean(value, owner, n):
    return np.bincount(owner, value, n) / np.maximum(np.bincount(owner, minlength=n), 1)


def _variance(away, weight, owner, n):
    """Variance [n] of a block of mean weight, drawn towards the usual one."""
    count = np.bincount(owner, minlength=n)
    square = np.bincount(owner, weight * away**2, n) / np.maximum(_mean(weight, owner, n), 1e-9)
    return (square + PRIOR * USUAL**2) / (np.maximum(count - 1, 0) + PRIOR)


def _colours(edges, picture, column, n):
    """Mean colour [n, 2, 3] in 0..1 on the left and on the right over a segment's rows."""
    width = picture.shape[1]
    centre = np.rint(np.nan_to_num(column)).astype(int)[edges.segment] - PAD
    sides = []
    for side in (-1, 1):
        beside = (centre[:, None] + side * np.array(BESIDE)) % width
        colour = picture[edges.row[:, None], beside].mean(axis=1)
        sides.append(np.stack([_mean(colour[:, k], edges.segment, n) for k in range(3)], -1))
    return (np.stack(sides, 1) / 255).astype(np.float32)


def merged(lines, bearing, gap):
    """`Lines` with pieces of one line put together: close in `bearing`, at most `gap` apart [rad].

    Pieces of one line have the same polarity and lie above each other.
    """
    n = len(lines.bearing)
    if n < 2:
        return lines
    apart = np.abs((lines.bearing[:, None] - lines.bearing + pi) % (2 * pi) - pi)
    between = np.maximum(lines.low[:, None] - lines.high, lines.low - lines.high[:, None])
    same = (apart <= bearing) & (between <= gap) & (lines.polarity[:, None] == lines.polarity)
    group = np.arange(n)
    for _ in range(n):  # the least index spreads through a group
        least = np.where(same, group, n).min(axis=1)
        if (least == group).all():
            break
        group = least
    return _combined(lines, np.unique(group, return_inverse=True)[1])


def _combined(lines, group):
    n = group.max() + 1
    first = np.unique(group, return_index=True)[1]
    weight = 1 / lines.sigma**2
    share = weight / np.bincount(group, weight)[group]
    away = (lines.bearing - lines.bearing[first][group] + pi) % (2 * pi) - pi
    bearing = lines.bearing[first] + np.bincount(group, share * away)
    length = lines.high - lines.low
    part = length / np.bincount(group, length)[group]
    colour = np.zeros((n, 2, 3), np.float32)
    np.add.at(colour, group, (part[:, None, None] * lines.colour).astype(np.float32))
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, group, lines.low)
    np.maximum.at(high, group, lines.high)
    return Lines(
        bearing=pi - (pi - bearing) % (2 * pi),
        sigma=1 / np.sqrt(np.bincount(group, weight)),
        low=low,
        high=high,
        polarity=lines.polarity[first],
        colour=colour,
        strength=np.sqrt(np.bincount(group, lines.strength**2)),
    )
