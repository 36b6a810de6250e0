"""From a log to what the filter eats: one odometry increment and one padded row per frame.

Odometry comes faster than frames, or slower; it is integrated exactly between them, so that a log
thinned to fewer frames describes the same motion.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.config import default_params
from jaxslam.motion import Odometry
from jaxslam.sensors import Measurements


class Frames(NamedTuple):
    """T frames in K slots each: `time` int64 [T] ns, `odometry` of the interval that ends there,
    `measurements`, log identities of the dense ones [I], each slot's row in the log [T, K] (-1:
    padding), and how many rows were dropped, by reason."""

    time: np.ndarray
    odometry: Odometry
    measurements: Measurements
    identities: np.ndarray
    row: np.ndarray
    dropped: dict[str, int]


def frames(log, sensor, measurements=None, params=None, known=False):
    """`Frames` of a log for one sensor.

    `measurements`: slots per frame (None: as many as the fullest frame needs); beyond them the
    farthest are dropped, or the last where there is no range. `params` gives the noise when
    positions are made of ranges and bearings. `known`: hand over the measured identities; otherwise
    they are hidden. Raises `ValueError` when the log can't supply what is asked.
    """
    if not log.has(sensor):
        has = [name for name in ("position", "range_bearing", "bearing") if log.has(name)]
        raise ValueError(
            f"{log.name}: sensor {sensor!r} is not in this log; it has {' '.join(has)}"
        )
    value, cov, reach = _values(log, sensor, params)
    rows = np.arange(len(log.frame))
    dropped = {}
    identity, identities = np.full(len(rows), -1), np.empty(0, np.int64)
    if known:
        rows = _identified(log, dropped)
        identities, identity[rows] = np.unique(log.identity[rows], return_inverse=True)
    rows, slot, slots = _slots(log, rows, reach, measurements, dropped)
    row = np.full((len(log.frame_time), slots), -1)
    row[log.frame[rows], slot] = rows
    # Padding, row -1, reads the last row, which is appended here.
    return Frames(
        time=log.frame_time,
        odometry=increments(log),
        measurements=Measurements(
            value=np.vstack([value, np.zeros((1, 2))])[row],
            cov=np.vstack([cov, np.zeros((1, 3))])[row],
            identity=np.append(identity, -1)[row].astype(np.int32),
            valid=row >= 0,
            active=np.ones(len(row), bool),
        ),
        identities=identities,
        row=row,
        dropped=dropped,
    )


def _values(log, sensor, params):
    """Values [n, 2], covariances [n, 3] (xx, xy, yy) and distances (None: unknown) of all rows."""
    cov = np.zeros((len(log.frame), 3))
    if sensor == "bearing":
        return np.column_stack([log.bearing, np.zeros(len(log.frame))]), cov, None
    if sensor == "range_bearing":
        return np.column_stack([log.range, log.bearing]), cov, log.range
    if log.point is not None:
        return log.point, log.point_cov, np.hypot(*log.point.T)
    params = default_params(sensor, log) if params is None else params
    r, c, s = log.range, np.cos(log.bearing), np.sin(log.bearing)
    along = params.sigma_range**2
    across = r**2 * (params.sigma_bearing**2 + (params.growth / r) ** 2)
    xy = c * s * (along - across)
    cov = np.column_stack([c**2 * along + s**2 * across, xy, s**2 * along + c**2 * across])
    return np.column_stack([r * c, r * s]), cov, r


def _identified(log, dropped):
    """Rows that carry an identity, the first of each identity in a frame."""
    if log.identity is None or (len(log.identity) and (log.identity < 0).all()):
        raise ValueError(f"{log.name}: association 'known' needs identities; this log has none")
    rows = np.flatnonzero(log.identity >= 0)
    _count(dropped, "no identity", len(log.identity) - len(rows))
    pairs = np.column_stack([log.frame[rows], log.identity[rows]])
    first = np.sort(np.unique(pairs, axis=0, return_index=True)[1]) if len(rows) else rows
    _count(dropped, "duplicate identity", len(rows) - len(first))
    return rows[first]


def _slots(log, rows, reach, slots, dropped):
    """The rows that find a slot, in the log's order, their slots, and the number of slots."""
    if slots is None:
        slots = max(1, np.bincount(log.frame[rows], minlength=1).max())
    rank = _rank(log.frame[rows]) if reach is None else _rank(log.frame[rows], reach[rows])
    keep = rank < slots
    _count(dropped, "no measurement slot", int((~keep).sum()))
    rows = rows[keep]
    return rows, _rank(log.frame[rows]), int(slots)


def _rank(frame, order=None):
    """Place of every row among those of its frame, by `order` or as they come; frames sorted."""
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


def increments(log):
    """`Odometry` [T] of the intervals that end at the frames; the first begins at `log.start`.

    Steps of constant velocity are arcs, commands are translations with a turn at their end. Sums
    over the steps of an interval are exact, as are the lever's mean and variance: the fraction of
    the path still ahead is uniform within an arc and a constant at a command's turn.
    """
    bounds = np.concatenate([[log.start], log.frame_time])
    arc = log.odometry_kind == "velocity"
    frame, travel, turn = _arcs(log, bounds) if arc else _commands(log)

    def total(weights):
        return np.bincount(frame, weights, minlength=len(log.frame_time))

    dtheta = total(turn)
    since_start = np.cumsum(turn) - turn - (np.cumsum(dtheta) - dtheta)[frame]
    chord = since_start + turn / 2 if arc else since_start
    length = travel * np.sinc(turn / (2 * np.pi)) if arc else travel
    distance, turned = total(np.abs(travel)), total(np.abs(turn))
    path = np.cumsum(np.abs(travel))
    last = np.searchsorted(frame, frame, side="right") - 1
    whole = np.maximum(distance[frame], 1e-300)
    end = np.clip((path[last] - path) / whole, 0.0, 1.0)
    begin = np.clip(end + np.abs(travel) / whole, 0.0, 1.0) if arc else end
    moving = (distance > 0) & (turned > 0)
    share = np.maximum(turned, 1e-300)
    lever = total(np.abs(turn) * (begin + end) / 2) / share
    square = total(np.abs(turn) * (begin**2 + begin * end + end**2) / 3) / share
    return Odometry(
        dx=total(length * np.cos(chord)),
        dy=total(length * np.sin(chord)),
        dtheta=dtheta,
        distance=distance,
        turn=turned,
        duration=np.diff(bounds) / 1e9,
        lever=np.where(moving, lever, 0.5),
        lever_var=np.where(moving, np.maximum(square - lever**2, 0.0), 1 / 12),
    )


def _arcs(log, bounds):
    """Frame, path [m] and turn [rad] of every step between stamps of odometry or frames."""
    time = log.odometry_time
    period = int(np.median(np.diff(time))) if len(time) > 1 else 0
    edges = np.append(time, time[-1] + period)  # the last velocity is held for a usual period
    cuts = np.union1d(edges, bounds)
    cuts = cuts[(cuts >= bounds[0]) & (cuts <= bounds[-1])]
    piece = np.searchsorted(edges, cuts[:-1], side="right")  # 0 and the last: the robot stands
    velocity = np.vstack([[0.0, 0.0], log.odometry, [0.0, 0.0]])[piece]
    travel, turn = (velocity * (np.diff(cuts) / 1e9)[:, None]).T
    return np.searchsorted(bounds[1:], cuts[1:]), travel, turn


def _commands(log):
    """Frame, path [m] and turn [rad] of every command: the frame at its end, or the next one."""
    frame = np.searchsorted(log.frame_time, log.odometry_time)
    used = frame < len(log.frame_time)
    travel, turn = log.odometry[used].T
    return frame[used], travel, turn


def dead_reckoning(odometry, start_pose):
    """Poses [T, 3] at the frames by odometry alone, heading in [-pi, pi); no gains applied."""
    before = start_pose[2] + np.cumsum(odometry.dtheta) - odometry.dtheta
    c, s = np.cos(before), np.sin(before)
    x = start_pose[0] + np.cumsum(c * odometry.dx - s * odometry.dy)
    y = start_pose[1] + np.cumsum(s * odometry.dx + c * odometry.dy)
    heading = before + odometry.dtheta
    return np.column_stack([x, y, (heading + np.pi) % (2 * np.pi) - np.pi])
