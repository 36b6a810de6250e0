"""Convert a log to frames: odometry since the frame before, and K measurements, padded."""

from typing import NamedTuple

import numpy as np

from jaxslam.config import SENSORS
from jaxslam.logs.odometry import Odometry, increments
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params


class Frames(NamedTuple):
    """T frames of up to K measurements.

    `time`: int64 [T], ns. `odometry`: of the intervals that end there, leaves [T]. `measurements`:
    leaves [T, K, ..], with identities 0 to I - 1. `identities` [I]: these in the log. `row` [T, K]:
    each measurement's row in the log (-1: padding). `dropped`: counts of rows left out, by reason.
    """

    time: np.ndarray
    odometry: Odometry
    measurements: Measurements
    identities: np.ndarray
    row: np.ndarray
    dropped: dict[str, int]


def frames_from_log(log, config, params=None):
    """`Frames` of a log, as a `Config` wants them: sensor, K measurements, identities, descriptors.

    Of a frame with more than K measurements the farthest are dropped, or the last where there is no
    range. Identities are handed over only to association `known`. `params` (None: `default_params`)
    give the noise of positions computed from ranges and bearings. Raises `ValueError` when the log
    lacks the sensor, the identities or the descriptors.
    """
    sensor, known = config.sensor, config.association == "known"
    if not log.has(sensor):
        has = [name for name in SENSORS if log.has(name)]
        raise ValueError(
            f"{log.name}: sensor {sensor!r} is not in this log; it has {' '.join(has)}"
        )
    value, cov, distance = _values(log, sensor, params)
    # A bearing without a point is no position: nothing is lost with it, so it is not counted.
    rows = np.flatnonzero(np.isfinite(value).all(axis=1))
    dropped = {}
    identity, identities = np.full(len(log.frame), -1), np.empty(0, np.int64)
    if known:
        rows = _with_identity(log, rows, dropped)
        identities, identity[rows] = np.unique(log.identity[rows], return_inverse=True)
    rows, column = _place(log, rows, distance, config.measurements, dropped)
    row = np.full((len(log.frame_time), config.measurements), -1)
    row[log.frame[rows], column] = rows
    # Padding (row -1) reads the last row, which is appended here.
    return Frames(
        time=log.frame_time,
        odometry=increments(log),
        measurements=Measurements(
            value=np.vstack([value, np.zeros((1, 2))])[row],
            cov=np.vstack([cov, np.zeros((1, 3))])[row],
            scale=_scale(log, sensor, row),
            identity=np.append(identity, -1)[row].astype(np.int32),
            valid=row >= 0,
            active=np.ones(len(row), bool),
            **_appearance_columns(log, config.descriptors, row),
        ),
        identities=identities,
        row=row,
        dropped=dropped,
    )


def _values(log, sensor, params):
    """Values [n, 2], covariances [n, 3] and distances [n] (None: unknown) of all rows."""
    cov = np.zeros((len(log.frame), 3))
    if sensor == "bearing":
        return np.column_stack([log.bearing, np.zeros(len(log.frame))]), cov, None
    if sensor == "range_bearing":
        return np.column_stack([log.range, log.bearing]), cov, log.range
    if log.has_points():
        return log.point, log.point_cov, np.hypot(*log.point.T)
    params = default_params(sensor, log) if params is None else params
    r, c, s = log.range, np.cos(log.bearing), np.sin(log.bearing)
    along = params.sigma_range**2
    across = r**2 * (params.sigma_bearing**2 + (params.landmark_extent / r) ** 2)
    xy = c * s * (along - across)
    cov = np.column_stack([c**2 * along + s**2 * across, xy, s**2 * along + c**2 * across])
    return np.column_stack([r * c, r * s]), cov, r


def _appearance_columns(log, size, row):
    """`Measurements.descriptor` [T, K, J] and `within` [T, J] of rows [T, K]."""
    if not size:
        return {}
    space = log.appearance_space
    if len(space.within) < size:
        raise ValueError(
            f"{log.name}: {size} descriptors are asked for, but {len(space.within)} tell landmarks "
            "apart in this log (of a part of a log: make its own config, or take 0)"
        )
    coordinates = np.vstack([space.coordinates[:, :size], np.zeros((1, size))])
    return dict(descriptor=coordinates[row], within=np.tile(space.within[:size], (len(row), 1)))


def _scale(log, sensor, row):
    """`Measurements.scale` of rows [T, K]; None where no position rests on odometry."""
    if sensor != "position" or not log.has_points() or log.point_baseline is None:
        return None
    return np.append(np.isfinite(log.point_baseline), False)[row].astype(float)


def _with_identity(log, rows, dropped):
    """The rows with an identity, of each identity in a frame the first."""
    if log.identity is None or (len(log.identity) and (log.identity < 0).all()):
        raise ValueError(f"{log.name}: association 'known' needs identities; this log has none")
    _count(dropped, "no identity", int((log.identity[rows] < 0).sum()))
    rows = rows[log.identity[rows] >= 0]
    pairs = np.column_stack([log.frame[rows], log.identity[rows]])
    first = np.sort(np.unique(pairs, axis=0, return_index=True)[1]) if len(rows) else rows
    _count(dropped, "duplicate identity", len(rows) - len(first))
    return rows[first]


def _place(log, rows, distance, most, dropped):
    """The `most` nearest rows of every frame, in the log's order, and their places in the frame."""
    order = None if distance is None else distance[rows]
    rank = _rank(log.frame[rows], order)
    keep = rank < most
    _count(dropped, "no measurement slot", int((~keep).sum()))
    rows = rows[keep]
    return rows, _rank(log.frame[rows])


def _rank(frame, order=None):
    """Rank of every row within its frame (sorted), by `order` or as they come."""
    first = np.searchsorted(frame, frame)
    place = np.arange(len(frame)) - first
    if order is None:
        return place
    rank = np.empty_like(place)
    rank[np.lexsort((order, frame))] = place
    return rank


def _count(dropped, reason, count):
    if count:
        dropped[reason] = int(count)
