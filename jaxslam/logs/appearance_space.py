"""The space in which a log's descriptors are compared to tell landmarks apart.

A log may describe each measurement by numbers of any kind and unit (`Log.descriptor`: colours, an
edge's ends). Measurements of successive frames that can only be of one landmark are linked into
tracks. Of all directions in the descriptors those are kept in which a landmark varies least,
compared with all linked measurements (linear discriminants: Rao 1948). Along each direction ranks
become normal scores: each coordinate is standard normal over the log. NumPy and SciPy.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from jaxslam.logs.odometry import increments
from jaxslam.logs.truth import wrap

ISOLATION = 0.06  # rad: a measurement is linked only if no other is a candidate within this,
STEP = 0.03  # rad: and if its partner is within this of where the robot's turn takes it
MAX_GAP = 1.0  # s between linked frames
MIN_LINKS = 20  # per direction: with fewer, noise is mistaken for appearance
MAX_COORDINATES = 6
MAX_WITHIN = 0.5  # variance of one landmark's coordinate; larger ones do not tell landmarks apart
CLIP = 4.0  # standard deviations of a column: outliers beyond it carry no further information
MIN_VARIANCE = 1e-5  # of a direction, relative to the largest: less is rounding


class AppearanceSpace(NamedTuple):
    """Normal scores `coordinates` [n, J] of all measurements, and `within` [J], the variance
    assumed of one landmark's coordinates."""

    coordinates: np.ndarray
    within: np.ndarray


def fit_appearance_space(log):
    """Fit the `AppearanceSpace` of a log; J = 0 if its descriptors tell no landmarks apart."""
    empty = AppearanceSpace(np.zeros((len(log.frame), 0)), np.zeros(0))
    if log.descriptor is None or len(log.frame) == 0:
        return empty
    x = _rescale(log.descriptor.astype(float))
    track = _tracks(log)
    inside = track >= 0
    freedom = inside.sum() - len(np.unique(track[inside]))
    if x.shape[1] == 0 or freedom < MIN_LINKS:
        return empty
    linked, track = x[inside], track[inside]
    within, total = _within(linked, track), np.cov(linked.T).reshape(len(x.T), -1)
    # Columns may repeat each other: keep directions in which linked rows vary at all.
    spread, vector = np.linalg.eigh(total)
    kept = spread > MIN_VARIANCE * max(spread[-1], MIN_VARIANCE)
    if freedom < MIN_LINKS * kept.sum():
        return empty
    white = vector[:, kept] / np.sqrt(spread[kept])
    value, vector = np.linalg.eigh(_products(white.T, _products(within, white)))
    along = _products(white, vector[:, value < MAX_WITHIN][:, :MAX_COORDINATES])
    if along.shape[1] == 0:
        return empty
    along *= np.sign(along[np.abs(along).argmax(0), np.arange(along.shape[1])])
    coordinates = _normal_scores(_products(x, along))
    scores = coordinates[inside]
    value = np.diag(_within(scores, track)) / np.maximum(scores.var(0), MIN_VARIANCE)
    good = value < MAX_WITHIN
    # Links last a few frames, in which light and background change less than over a log: the root
    # of the variance, which is below 1, is a larger one.
    return AppearanceSpace(
        coordinates[:, good], np.round(np.sqrt(np.maximum(value[good], 1e-4)), 4)
    )


def _rescale(x):
    """Scale columns [n, D] to about unit variance, robustly, and drop constant ones."""
    x = x[:, x.std(0) > 1e-6 * np.abs(x).max(0)]
    x = x - np.median(x, 0)
    spread = 1.4826 * np.median(np.abs(x), 0)
    x = np.clip(x / np.where(spread > 0, spread, np.maximum(x.std(0), 1e-300)), -CLIP, CLIP)
    return x - x.mean(0)


def _within(x, track):
    """Covariance [D, D] of rows about the mean of their track."""
    number, track = np.unique(track, return_inverse=True)
    size = np.bincount(track)
    mean = np.stack([np.bincount(track, column) for column in x.T], 1) / size[:, None]
    off = x - mean[track]
    return _products(off.T, off) / (len(x) - len(number))


def _normal_scores(x):
    """Map the ranks in each column [n, J] to quantiles of the standard normal.

    Rounded, so that ranks and scores are the same on all machines of a run.
    """
    scores = []
    for column in np.round(x, 4).T:
        _, index, count = np.unique(column, return_inverse=True, return_counts=True)
        middle = np.cumsum(count) - count / 2  # ties get their mean rank, less a half
        scores.append(ndtri(middle / len(column))[index])
    return np.round(np.column_stack(scores), 4)


def _products(a, b):
    """Matrix product that does not depend on the number of threads, unlike a BLAS's."""
    return np.einsum("ij,jk->ik", a, b)


def _tracks(log):
    """Track number [n] of every measurement, linked from frame to frame; -1: not linked."""
    bearing = log.bearing
    if bearing is None:
        bearing = np.arctan2(log.point[:, 1], log.point[:, 0])
    turn = np.asarray(increments(log).dtheta)
    bounds = np.searchsorted(log.frame, np.arange(len(log.frame_time) + 1))
    track, count = np.full(len(bearing), -1), 0
    for f in range(len(log.frame_time) - 1):
        (a, b, c) = bounds[f : f + 3]
        apart = np.abs(wrap(bearing[b:c] - (bearing[a:b] - turn[f + 1])[:, None]))
        unique = (apart < ISOLATION).sum(1) == 1, (apart < ISOLATION).sum(0) == 1
        near = log.frame_time[f + 1] - log.frame_time[f] <= MAX_GAP * 1e9
        pair = (apart < STEP) & unique[0][:, None] & unique[1] & near
        for i, j in zip(*np.nonzero(pair), strict=True):
            if track[a + i] < 0:
                track[a + i], count = count, count + 1
            track[b + j] = track[a + i]
    return track
