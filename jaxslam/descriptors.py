"""What a log's descriptors tell of identity.

A log may describe each measurement by numbers of any kind and unit (`Log.descriptor`: colours, an
edge's ends). Rows of successive frames that can only be of one landmark are linked, and of all
directions in the descriptors those are kept in which a landmark varies least, compared with all
rows (linear discriminants: Rao 1948). There each coordinate has the variance 1 over the log, and
`within` for one landmark; the coordinates are uncorrelated. NumPy.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from jaxslam.odometry import increments

ALONE = 0.06  # rad: a row that no other of its frame is nearer to can be linked,
STEP = 0.03  # rad, to one that is no farther from where the turn takes it
ROWS = 10  # linked rows a column, at least
MOST = 6  # coordinates
USEFUL = 0.5  # variance of a linked landmark's coordinate, at most


class Space(NamedTuple):
    """Where descriptors are compared: `coordinates` [n, J] of all rows, and `within` [J]."""

    coordinates: np.ndarray
    within: np.ndarray


def space(log):
    """`Space` of a log's descriptors; without coordinates where they tell nothing."""
    nothing = Space(np.zeros((len(log.frame), 0)), np.zeros(0))
    if log.descriptor is None or len(log.frame) == 0:
        return nothing
    x = log.descriptor.astype(float)
    spread = x.std(0)
    x = (x - x.mean(0))[:, spread > 1e-6 * (1e-30 + np.abs(x).max(0))]
    x /= x.std(0)
    track = _tracks(log)
    inside = track >= 0
    size = np.bincount(track[inside])
    if x.shape[1] == 0 or inside.sum() < ROWS * x.shape[1]:
        return nothing
    mean = np.stack([np.bincount(track[inside], c) for c in x[inside].T], 1) / size[:, None]
    off = x[inside] - mean[track[inside]]
    own = _products(off.T, off) / (inside.sum() - len(size))
    whole = _products(x.T, x) / len(x)
    value, vector = eigh(own, whole + 1e-9 * np.eye(len(whole)))
    kept = np.flatnonzero(value < USEFUL)[:MOST]
    # Rounded, so that all machines of a run have the same.
    coordinates = np.round(_products(x, vector[:, kept]), 4)
    # Links last a few frames, in which light and background change less than over a log.
    return Space(coordinates, np.round(np.sqrt(np.maximum(value[kept], 1e-4)), 4))


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
        apart = np.abs(_wrap(bearing[b:c] - (bearing[a:b] - turn[f + 1])[:, None]))
        alone = (apart < ALONE).sum(1) == 1, (apart < ALONE).sum(0) == 1
        pair = (apart < STEP) & alone[0][:, None] & alone[1]
        for i, j in zip(*np.nonzero(pair), strict=True):
            if track[a + i] < 0:
                track[a + i], count = count, count + 1
            track[b + j] = track[a + i]
    return track


def _wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi
