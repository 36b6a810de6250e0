"""Vertical edges in a panorama: which pixels lie on one, and which of them belong together.

The paper's steps (III-B.2): Sobel's pair (7), a threshold, and a check of length and position. Its
two kernels are each other's negative, so one filter and its sign serve for both.
"""

from typing import NamedTuple

import cv2
import numpy as np

PAD = 16  # columns repeated beyond the seam: more than any filter here reaches
SMOOTH_ROWS = 9  # noise is averaged along the edge before it is judged
NOISE_STRIDE = 4  # every so many columns tell a row's noise


class Edges(NamedTuple):
    """E peaks of the gradient, sorted by segment and row, in columns of the padded panorama.

    `segment` [E] 0..n-1, `row` [E], `column` [E] to a fraction; `gradient` float32 [H, W + 2 PAD,
    C] grey levels per column, `along` the same averaged over some rows.
    """

    segment: np.ndarray
    row: np.ndarray
    column: np.ndarray
    gradient: np.ndarray
    along: np.ndarray

    def take(self, index):
        """The peaks of an index or mask; their segments keep their numbers."""
        part = (column[index] for column in (self.segment, self.row, self.column))
        return Edges(*part, self.gradient, self.along)


def find_edges(panorama_image, valid, contrast, significance, length, gap, slope):
    """`Edges` of a panorama uint8 [H, W, C] and the mask [H, W] of what is seen.

    `contrast` [grey levels per column] and `significance` [times the row's noise] of a peak;
    `length` and `gap` [rows] of a segment, `slope` [columns per row] it may have.
    """
    padded = np.concatenate(
        [panorama_image[:, -PAD:], panorama_image, panorama_image[:, :PAD]], axis=1
    )
    channels = panorama_image[0, 0].size  # so that grey levels are RMS over them
    gradient = cv2.Sobel(padded, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8 / np.sqrt(channels))
    along = cv2.blur(gradient, (1, SMOOTH_ROWS), borderType=cv2.BORDER_REPLICATE)
    gradient = gradient.reshape(*padded.shape[:2], -1)
    along = along.reshape(gradient.shape)
    magnitude = np.sqrt(np.einsum("hwc,hwc->hw", along, along))
    magnitude[~_erode_mask(valid)] = 0
    noise = _noise(magnitude)
    threshold = np.maximum(contrast, significance * noise)
    peak = _peaks(magnitude, threshold[:, None].astype(np.float32))
    row, column, segment = _segments(peak, length, gap, slope)
    return Edges(segment, row, _interpolate_columns(magnitude, row, column), gradient, along)


def _erode_mask(valid):
    """The padded mask, less what the filters mix with the border of the image."""
    padded = np.concatenate([valid[:, -PAD:], valid, valid[:, :PAD]], axis=1).astype(np.uint8)
    if padded.all():
        return padded > 0
    return cv2.erode(padded, np.ones((SMOOTH_ROWS, 5), np.uint8)) > 0


def _noise(magnitude):
    """Typical gradient of a row where there is no edge: the median over its columns."""
    return np.median(magnitude[:, PAD:-PAD:NOISE_STRIDE], axis=1)


def _peaks(magnitude, threshold):
    """uint8 [H, W]: largest among neighbours in its row and above the threshold."""
    peak = np.zeros(magnitude.shape, np.uint8)
    middle = magnitude[:, 1:-1]
    peak[:, 1:-1] = (
        (middle > threshold) & (middle >= magnitude[:, :-2]) & (middle > magnitude[:, 2:])
    )
    return peak


def _segments(peak, length, gap, slope):
    """Rows, columns and segment numbers of the peaks that form long upright runs."""
    tall = np.ones((gap | 1, 1), np.uint8)  # odd: an even one moves what it closes
    # A straight edge wanders by less than a column, so it fills a band of three; what leans
    # leaves its band before it is long, and is cut where it crosses another.
    band = cv2.dilate(peak, np.ones((1, 3), np.uint8))
    band = cv2.morphologyEx(band, cv2.MORPH_CLOSE, tall)
    steep = max(3, min(length, int(2 / slope))) | 1
    band = cv2.morphologyEx(band, cv2.MORPH_OPEN, np.ones((steep, 1), np.uint8))
    upright = peak & band
    joined = cv2.morphologyEx(upright, cv2.MORPH_CLOSE, tall)
    _, label = cv2.connectedComponents(joined, connectivity=8)
    row, column = np.nonzero(upright)
    label = label[row, column]
    first, last = np.full(label.max(initial=0) + 1, len(peak)), np.zeros(label.max(initial=0) + 1)
    np.minimum.at(first, label, row)
    np.maximum.at(last, label, row)
    keep = (last - first + 1 >= length)[label]
    row, column, label = row[keep], column[keep], label[keep]
    order = np.lexsort((row, label))
    return row[order], column[order], np.unique(label[order], return_inverse=True)[1]


def _interpolate_columns(magnitude, row, column):
    """Columns to a fraction, by the parabola through a peak and its neighbours."""
    left, middle, right = (magnitude[row, column + k] for k in (-1, 0, 1))
    return column + (right - left) / (2 * (2 * middle - left - right)).clip(1e-6)
