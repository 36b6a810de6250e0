"""Vertical edges of a panorama: the pixels on edges, grouped into upright segments.

The paper's steps (III-B.2): the pair of Sobel kernels (7), a threshold, and a check of length and
position. The two kernels are each other's negative, so one filter and its sign serve for both.
"""

from typing import NamedTuple

import cv2
import numpy as np

PAD = 16  # columns repeated beyond the seam: more than any filter here reaches
SMOOTH_ROWS = 9  # rows averaged along an edge to reduce noise
NOISE_STRIDE = 4  # a row's noise is measured in every fourth column


class Edges(NamedTuple):
    """E peaks of the gradient, sorted by segment and row, in columns of the padded panorama.

    `segment` [E] 0..n-1, `row` [E], `column` [E] (a fraction); `gradient` float32 [H, W + 2 PAD,
    C] in grey levels per column, `along` the same averaged over `SMOOTH_ROWS` rows.
    """

    segment: np.ndarray
    row: np.ndarray
    column: np.ndarray
    gradient: np.ndarray
    along: np.ndarray


def find_edges(panorama_image, valid, contrast, significance, length, gap, slope):
    """Find the `Edges` of a panorama uint8 [H, W, C] where the mask `valid` [H, W] is set.

    Least `contrast` [grey levels per column] and `significance` [in units of the row's noise] of a
    peak; least `length`, largest `gap` [rows] and `slope` [columns per row] of a segment.
    """
    padded = _pad(panorama_image)
    channels = panorama_image[0, 0].size  # grey levels are RMS over the channels
    gradient = cv2.Sobel(padded, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8 / np.sqrt(channels))
    along = cv2.blur(gradient, (1, SMOOTH_ROWS), borderType=cv2.BORDER_REPLICATE)
    gradient, along = (part.reshape(*padded.shape[:2], -1) for part in (gradient, along))
    magnitude = np.sqrt(np.einsum("hwc,hwc->hw", along, along))
    magnitude[~_erode_mask(valid)] = 0
    # Few columns are edges, so a row's median is its noise.
    noise = np.median(magnitude[:, PAD:-PAD:NOISE_STRIDE], axis=1)
    threshold = np.maximum(contrast, significance * noise)
    peak = _peaks(magnitude, threshold[:, None].astype(np.float32))
    row, column, segment = _segments(peak, length, gap, slope)
    return Edges(segment, row, _interpolate_columns(magnitude, row, column), gradient, along)


def _pad(image):
    """The panorama [H, W, ...] with `PAD` columns repeated on either side."""
    return np.concatenate([image[:, -PAD:], image, image[:, :PAD]], axis=1)


def _erode_mask(valid):
    """The padded mask without the pixels that the filters mix with the border of the image."""
    padded = _pad(valid).astype(np.uint8)
    if padded.all():
        return padded > 0
    return cv2.erode(padded, np.ones((SMOOTH_ROWS, 5), np.uint8)) > 0


def _peaks(magnitude, threshold):
    """Mask uint8 [H, W] of the pixels above the threshold and above both neighbours in the row."""
    peak = np.zeros(magnitude.shape, np.uint8)
    left, middle, right = magnitude[:, :-2], magnitude[:, 1:-1], magnitude[:, 2:]
    peak[:, 1:-1] = (middle > threshold) & (middle >= left) & (middle > right)
    return peak


def _segments(peak, length, gap, slope):
    """Rows, columns and segment numbers [E] of the peaks that form long upright runs."""
    tall = np.ones((gap | 1, 1), np.uint8)  # odd, since an even kernel shifts the result
    # An upright edge wanders by less than a column, so it fills a band of three columns. A leaning
    # one leaves its band before it is long, and is cut where it crosses another.
    band = cv2.dilate(peak, np.ones((1, 3), np.uint8))
    band = cv2.morphologyEx(band, cv2.MORPH_CLOSE, tall)
    steep = max(3, min(length, int(2 / slope))) | 1
    band = cv2.morphologyEx(band, cv2.MORPH_OPEN, np.ones((steep, 1), np.uint8))
    upright = peak & band
    closed = cv2.morphologyEx(upright, cv2.MORPH_CLOSE, tall)
    _, component = cv2.connectedComponents(closed, connectivity=8)
    row, column = np.nonzero(upright)
    component = component[row, column]
    count = component.max(initial=0) + 1
    first, last = np.full(count, len(peak)), np.zeros(count)
    np.minimum.at(first, component, row)  # ty: ignore[invalid-argument-type]  # integers
    np.maximum.at(last, component, row)  # ty: ignore[invalid-argument-type]
    keep = (last - first + 1 >= length)[component]
    row, column, component = row[keep], column[keep], component[keep]
    order = np.lexsort((row, component))
    return row[order], column[order], np.unique(component[order], return_inverse=True)[1]


def _interpolate_columns(magnitude, row, column):
    """Columns [E] to a fraction, by the parabola through each peak and its neighbours."""
    left, middle, right = (magnitude[row, column + k] for k in (-1, 0, 1))
    return column + (right - left) / (2 * (2 * middle - left - right)).clip(1e-6)
