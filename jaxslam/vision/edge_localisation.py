"""Localise segments of edge pixels: column, standard deviation and width, from all rows.

The gradients of a segment's rows lie along its principal axis in colour space. The profiles across
the edge are summed in blocks of rows, and a parabola is fitted to each block: its peak is weighted
by its curvature. The scatter of the blocks' peaks gives the standard deviation of their mean.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.vision.edges import PAD

REACH = 3  # columns of the profile on either side of an edge
BLOCK = 6  # rows summed into one profile
PRIOR, USUAL = 3.0, 0.3  # a prior as strong as 3 blocks that scatter by 0.3 columns
CLIP = 2.5  # standard deviations beyond which a block's weight falls
FADED = 0.5  # a line ends at this share of its mean gradient: averaging rows reaches beyond it
SOFT = 2.0  # pixels from a sharp edge at which its gradient has faded


class Fit(NamedTuple):
    """Of n segments: `column` (NaN: no peak), its standard deviation `scatter`, and `width`
    (standard deviation of the gradient's profile), in columns of the padded panorama; `slope`
    [columns per row]; `sign` of the gradient to the right; `strength`, its root sum of squares over
    the `rows`; `sharp`, 1 - gradient beside / at the edge; `first` and `last` row."""

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
    """`Fit` of all segments of `Edges`; `columns_per_pixel` [H]: width of an image pixel."""
    segment, n = edges.segment, int(edges.segment.max(initial=-1)) + 1
    centre = np.rint(mean(edges.column, segment, n)).astype(int)
    centre = np.clip(centre, PAD - 4, edges.along.shape[1] - 1 - (PAD - 4))[segment]
    at = edges.along[edges.row, np.rint(edges.column).astype(int)].astype(float)
    axis = _principal(at, segment, n)[segment]
    along = np.einsum("ec,ec->e", at, axis)
    # The background of an edge may change from brighter to darker than its foreground.
    axis *= np.sign(along)[:, None]

    def gradient(of, column):
        return np.einsum("ekc,ec->ek", of[edges.row[:, None], column], axis)

    far = np.clip(np.rint(SOFT * columns_per_pixel), 2, PAD - 4).astype(int)[edges.row]
    beside = gradient(edges.along, centre[:, None] + far[:, None] * [-1, 1]).mean(1)
    across = gradient(edges.gradient, centre[:, None] + np.arange(-REACH, REACH + 1))
    size = np.bincount(segment, np.abs(along), n)
    first, last = _ends(edges, np.abs(along) >= FADED * mean(np.abs(along), segment, n)[segment], n)
    blocks = segment * len(edges.along) + edges.row // BLOCK
    start, block = np.unique(blocks, return_index=True, return_inverse=True)[1:]
    profile = np.stack([np.bincount(block, part) for part in across.T], -1)
    peak, scatter, width = _peak(profile, segment[start], n)
    return Fit(
        column=centre[np.searchsorted(segment, np.arange(n))] + peak, scatter=scatter, width=width,
        slope=_slope(edges, n), sign=np.where(np.bincount(segment, along, n) >= 0, 1, -1),
        strength=np.sqrt(np.bincount(segment, along**2, n)),
        rows=np.bincount(segment, minlength=n), first=first, last=last,
        sharp=1 - np.bincount(segment, beside, n) / np.maximum(size, 1e-9),
    )  # fmt: skip


def mean(value, owner, n):
    """Mean [n] of values [E] by owner; 0 where there are none."""
    return np.bincount(owner, value, n) / np.maximum(np.bincount(owner, minlength=n), 1)


def _ends(edges, clear, n):
    """First and last row [n] of each segment among the `clear` [E] peaks, which are sorted."""
    segment, row, each = edges.segment[clear], edges.row[clear], np.arange(n)
    first, beyond = (np.searchsorted(segment, each, side) for side in ("left", "right"))
    return row[first], row[beyond - 1]


def _slope(edges, n):
    """Slope [n] in columns per row, by least squares."""
    row = edges.row - mean(edges.row, edges.segment, n)[edges.segment]
    square = np.bincount(edges.segment, row * row, n)
    return np.bincount(edges.segment, row * edges.column, n) / np.maximum(square, 1e-9)


def _principal(vectors, owner, n):
    """Unit principal axis [n, C] of vectors [E, C] by owner, pointing to brighter colours."""
    products = [np.bincount(owner, a * b, n) for a in vectors.T for b in vectors.T]
    moment = np.stack(products, -1).reshape(n, vectors.shape[1], vectors.shape[1])
    axis = np.linalg.eigh(moment)[1][:, :, -1]
    return axis * np.where(axis.sum(1, keepdims=True) < 0, -1, 1)


def _peak(profile, owner, n):
    """Robust offset [n] of the peak from the middle column, its standard deviation and width.

    `profile` [blocks, 2 REACH + 1] of the blocks of segment `owner` [blocks].
    """
    summed = np.stack([np.bincount(owner, part, n) for part in profile.T], -1)
    top = 1 + np.argmax(summed[:, 1:-1], axis=1)
    left, middle, right = (profile[np.arange(len(owner)), top[owner] + k] for k in (-1, 0, 1))
    curvature = np.clip(2 * middle - left - right, 0, None)
    peak = np.clip((right - left) / 2 / np.maximum(curvature, 1e-6), -1.5, 1.5)
    share = curvature / np.maximum(mean(curvature, owner, n), 1e-9)[owner]
    weight = share
    for _ in range(3):
        total = np.maximum(np.bincount(owner, weight, n), 1e-9)
        offset = np.bincount(owner, weight * peak, n) / total
        deviation = np.abs(peak - offset[owner])
        square = np.bincount(owner, weight * deviation**2, n) + PRIOR * USUAL**2
        variance = square / (np.maximum(np.bincount(owner, minlength=n) - 1, 0) + PRIOR)
        ratio = deviation * np.sqrt(share / variance[owner])
        weight = share * CLIP / np.maximum(ratio, CLIP)
    left, middle, right = (summed[np.arange(n), top + k] for k in (-1, 0, 1))
    is_peak = middle * 2 > left + right
    left, middle, right = (np.maximum(part, 1e-9) for part in (left, middle, right))
    log_curvature = np.maximum(2 * np.log(middle) - np.log(left) - np.log(right), 0.05)
    column = np.where(is_peak, top - REACH + offset, np.nan)
    return column, np.sqrt(variance / total), np.sqrt(1 / log_curvature)
