"""Where a segment of edge pixels stands: column, standard deviation, width; from all its rows.

The gradients of a segment's rows lie along one line in colour space, its principal axis. The
profiles across the edge are added up in blocks of rows; every block's parabola has a peak, and its
curvature is the peak's weight. How the blocks differ tells how good their mean is.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.vision.edges import PAD

REACH = 3  # columns on either side of an edge that its place is found from
BLOCK = 6  # rows judged together
PRIOR, USUAL = 3.0, 0.3  # as many blocks' worth of belief in this scatter [columns] of a block
CLIP = 2.5  # standard deviations beyond which a block counts less
FADED = 0.5  # of the mean gradient, where a line ends: averaging over rows reaches beyond it
SOFT = 2.0  # pixels beside an edge where a sharp one's gradient has faded


class Fit(NamedTuple):
    """All [n]: `column` (NaN: no peak), `scatter` its standard deviation, `width` of the edge
    (standard deviation of its gradient), all in columns of the padded panorama; `slope` [columns
    per row]; `sign` of the gradient to the right; `strength`, root of the summed squares of the
    gradient over its `rows`; `sharp`, 1 - gradient nearby / at the edge; `first`, `last` row."""

    column: np.ndarray
    scatter: np.ndarray
    width: np.ndarray
    slope: np.ndarray
    sign: np.ndarray
    strength: np.ndarray
    rows: np.ndarray
    sharp: np.ndarray
    first: np.ndarray
    last: np.ndarray


def fit_segments(edges, columns_per_pixel):
    """`Fit` of all segments of `Edges`; `columns_per_pixel` [H]: how wide an image pixel is."""
    segment, n = edges.segment, int(edges.segment.max(initial=-1)) + 1
    centre = np.rint(mean(edges.column, segment, n)).astype(int)
    centre = np.clip(centre, PAD - 4, edges.along.shape[1] - 1 - (PAD - 4))[segment]
    at = edges.along[edges.row, np.rint(edges.column).astype(int)].astype(float)
    axis = _principal(at, segment, n)[segment]
    along = np.einsum("ec,ec->e", at, axis)
    axis *= np.sign(along)[
        :, None
    ]  # one edge, though what is behind it may change from bright to dark

    def gradient(of, column):
        return np.einsum("ekc,ec->ek", of[edges.row[:, None], column], axis)

    far = np.clip(np.rint(SOFT * columns_per_pixel), 2, PAD - 4).astype(int)[edges.row]
    beside = gradient(edges.along, centre[:, None] + far[:, None] * [-1, 1]).mean(1)
    across = gradient(edges.gradient, centre[:, None] + np.arange(-REACH, REACH + 1))
    size = np.bincount(segment, np.abs(along), n)
    first, last = _ends(edges, np.abs(along) >= FADED * mean(np.abs(along), segment, n)[segment], n)
    start, block = np.unique(
        segment * len(edges.along) + edges.row // BLOCK,
        return_index=True,
        return_inverse=True,
    )[1:]
    profile = np.stack([np.bincount(block, part) for part in across.T], -1)
    peak, scatter, width = _peak(profile, segment[start], n)
    return Fit(
        column=centre[np.searchsorted(segment, np.arange(n))] + peak,
        scatter=scatter,
        width=width,
        slope=_slope(edges, n),
        sign=np.where(np.bincount(segment, along, n) >= 0, 1, -1),
        strength=np.sqrt(np.bincount(segment, along**2, n)),
        rows=np.bincount(segment, minlength=n),
        sharp=1 - np.bincount(segment, beside, n) / np.maximum(size, 1e-9),
        first=first,
        last=last,
    )


def mean(value, owner, n):
    """Mean [n] of values [E] by owner; 0 where there are none."""
    return np.bincount(owner, value, n) / np.maximum(np.bincount(owner, minlength=n), 1)


def _ends(edges, clear, n):
    """First and last row [n] of the segments where `clear` [E]: rows are sorted in segments."""
    segment, row, each = edges.segment[clear], edges.row[clear], np.arange(n)
    first, beyond = (np.searchsorted(segment, each, side) for side in ("left", "right"))
    return row[first], row[beyond - 1]


def _slope(edges, n):
    """Slope [n] in columns per row, by least squares."""
    row = edges.row - mean(edges.row, edges.segment, n)[edges.segment]
    square = np.bincount(edges.segment, row * row, n)
    return np.bincount(edges.segment, row * edges.column, n) / np.maximum(square, 1e-9)


def _principal(vectors, owner, n):
    """Unit principal axis [n, C] of vectors [E, C] by owner, towards brighter."""
    products = [np.bincount(owner, a * b, n) for a in vectors.T for b in vectors.T]
    moment = np.stack(products, -1).reshape(n, vectors.shape[1], vectors.shape[1])
    axis = np.linalg.eigh(moment)[1][:, :, -1]
    return axis * np.where(axis.sum(1, keepdims=True) < 0, -1, 1)


def _peak(profile, owner, n):
    """Column of the peak from the middle one, its standard deviation, its width [n]; robust.

    `profile` [blocks, 2 REACH + 1] of blocks that belong to segment `owner` [blocks].
    """
    whole = np.stack([np.bincount(owner, part, n) for part in profile.T], -1)
    top = 1 + np.argmax(whole[:, 1:-1], axis=1)
    left, middle, right = (profile[np.arange(len(owner)), top[owner] + k] for k in (-1, 0, 1))
    base = np.clip(2 * middle - left - right, 0, None)
    place = np.clip((right - left) / 2 / np.maximum(base, 1e-6), -1.5, 1.5)
    average = np.maximum(mean(base, owner, n), 1e-9)
    share = base / average[owner]
    weight = share
    for _ in range(3):
        total = np.maximum(np.bincount(owner, weight, n), 1e-9)
        offset = np.bincount(owner, weight * place, n) / total
        away = np.abs(place - offset[owner])
        square = np.bincount(owner, weight * away**2, n) + PRIOR * USUAL**2
        variance = square / (np.maximum(np.bincount(owner, minlength=n) - 1, 0) + PRIOR)
        ratio = away * np.sqrt(share / variance[owner])
        weight = share * CLIP / np.maximum(ratio, CLIP)
    found = (
        whole[np.arange(n), top] * 2 > whole[np.arange(n), top - 1] + whole[np.arange(n), top + 1]
    )
    left, middle, right = (np.maximum(whole[np.arange(n), top + k], 1e-9) for k in (-1, 0, 1))
    curved = np.maximum(2 * np.log(middle) - np.log(left) - np.log(right), 0.05)
    column = np.where(found, top - REACH + offset, np.nan)
    return column, np.sqrt(variance / total), np.sqrt(1 / curved)
