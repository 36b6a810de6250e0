"""What a log's descriptors tell of identity.

A log may describe each measurement by numbers of any kind and unit (`Log.descriptor`: colours, an
edge's ends). Rows of successive frames that can only be of one landmark are linked, and of all
directions in the descriptors those are kept in which a landmark varies least, compared with all
such rows (linear discriminants: Rao 1948). Of what lies along them the ranks count, as normal
scores: each coordinate is standard normal over the log, whatever the columns were. NumPy, SciPy.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from jaxslam.logs.odometry import increments
from jaxslam.logs.truth import wrap

ALONE = 0.06  # rad: a row that no other of its frame is nearer to can be linked,
STEP = 0.03  # rad, to one that is no farther from where the turn takes it,
APART = 1.0  # s later at most
ROWS = 20  # links a direction, at least: of fewer, noise passes for looks
MOST = 6  # coordinates
USEFUL = 0.5  # variance of a linked landmark's coordinate, at most
BEYOND = 4.0  # standard deviations of a column: what is farther off tells no more
VARIED = 1e-5  # variance of a direction relative to the largest: less is rounding


class AppearanceSpace(NamedTuple):
    """Where descriptors are compared: `coordinates` [n, J] of all rows, normal scores; and `within`
    [J], the variance of one landmark's that is reckoned with."""

    coordinates: np.ndarray
    within: np.ndarray


def fit_appearance_space(log):
    """`Space` of a log's descriptors; without coordinates where they tell nothing."""
    nothing = AppearanceSpace(np.zeros((len(log.frame), 0)), np.zeros(0))
    if log.descriptor is None or len(log.frame) == 0:
        return nothing
    x = _rescale(log.descriptor.astype(float))
    track = _tracks(log)
    inside = track >= 0
    freedom = inside.sum() - len(np.unique(track[inside]))
    if x.shape[1] == 0 or freedom < ROWS:
        return nothing
    linked, track = x[inside], track[inside]
    own, whole = _within(linked, track), np.cov(linked.T).reshape(len(x.T), -1)
    # Columns may repeat each other: only directions in which linked rows vary at all.
    spread, vector = np.linalg.eigh(whole)
    kept = spread > VARIED * max(spread[-1], VARIED)
    if freedom < ROWS * kept.sum():
        return nothing
    white = vector[:, kept] / np.sqrt(spread[kept])
    value, vector = np.linalg.eigh(_products(white.T, _products(own, white)))
    along = _products(white, vector[:, value < USEFUL][:, :MOST])
    if along.shape[1] == 0:
        return nothing
    along *= np.sign(along[np.abs(along).argmax(0), np.arange(along.shape[1])])
    coordinates = _normal_scores(_products(x, along))
    scores = coordinates[inside]
    value = np.diag(_within(scores, track)) / np.maximum(scores.var(0), VARIED)
    good = value < USEFUL
    # Links last a few frames, in which light and background change less than over a log.
    return AppearanceSpace(
        coordinates[:, good], np.round(np.sqrt(np.maximum(value[good], 1e-4)), 4)
    )


def _rescale(x):
    """Columns [n, D] of about unit variance, without those that are constant; few rows far off
    decide nothing."""
    x = x[:, x.std(0) > 1e-6 * np.abs(x).max(0)]
    x = x - np.median(x, 0)
    usual = 1.4826 * np.median(np.abs(x), 0)
    x = np.clip(x / np.where(usual > 0, usual, np.maximum(x.std(0), 1e-300)), -BEYOND, BEYOND)
    return x - x.mean(0)


def _within(x, track):
    """Covariance [D, D] of the rows of one track about their mean."""
    number, track = np.unique(track, return_inverse=True)
    size = np.bincount(track)
    mean = np.stack([np.bincount(track, column) for column in x.T], 1) / size[:, None]
    off = x - mean[track]
    return _products(off.T, off) / (len(x) - len(number))


def _normal_scores(x):
    """Every column's ranks [n, J] as quantiles of the standard normal; rounded, so that ranks and
    scores are the same on all machines of a run."""
    found = []
    for column in np.round(x, 4).T:
        _, place, count = np.unique(column, return_inverse=True, return_counts=True)
        middle = np.cumsum(count) - count / 2  # of equals: their mean rank, less a half
        found.append(ndtri(middle / len(column))[place])
    return np.round(np.column_stack(found), 4)


def _products(a, b):
    """Matrix product that does not depend on the number of threads, as that of a BLAS does."""
    return np.einsum("ij,jk->ik", a, b)


def _tracks(log):
    """Of every row the number of its track [n], rows linked from frame to frame; -1: alone."""
    bearing = log.bearing
    if bearing is None:
        bearing = np.arctan2(log.point[:, 1], log.point[:, 0])
    turn = np.asarray(increments(log).dtheta)
    bounds = np.searchsorted(log.frame, np.arange(len(log.frame_time) + 1))
    track, count = np.full(len(bearing), -1), 0
    for f in range(len(log.frame_time) - 1):
        (a, b, c) = bounds[f : f + 3]
        apart = np.abs(wrap(bearing[b:c] - (bearing[a:b] - turn[f + 1])[:, None]))
        alone = (apart < ALONE).sum(1) == 1, (apart < ALONE).sum(0) == 1
        near = log.frame_time[f + 1] - log.frame_time[f] <= APART * 1e9
        pair = (apart < STEP) & alone[0][:, None] & alone[1] & near
        for i, j in zip(*np.nonzero(pair), strict=True):
            if track[a + i] < 0:
                track[a + i], count = count, count + 1
            track[b + j] = track[a + i]
    return track
