"""Whether frames and odometry are stamped by the same clock, from the log alone.

Landmarks' bearings turn against the robot. The offset is that by which frames have to be moved so
that, from frame to frame, bearings are nearest to where the odometry's turning takes them; nothing
needs to be known of identities. Driving moves bearings, too, but alike for all offsets. NumPy.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxslam.logs.truth import wrap

APART = 1.0  # s between two frames that are compared, at most
MOST = 0.6  # s, an offset
COARSE, FINE = 0.06, 0.01  # s between offsets tried
FAR = 0.05  # rad: what is farther off than that may be another landmark
PARTS = 6  # of the log, in each of which the offset is found
LEAST = 200  # bearings compared in each of them
ENOUGH = 300_000  # differences of bearings; of more, only every so many frames are looked at
TURNED = 1.0  # rad turned in each of them


class ClockOffset(NamedTuple):
    """Seconds by which frames are to be moved; the `least` and `most` of parts of the log."""

    seconds: float
    least: float
    most: float


def estimate_clock_offset(log):
    """`Offset` of a log's frames against its odometry; None where it can't be told: no velocities,
    too few bearings or turns, or the parts of the log do not agree."""
    if log.odometry_kind != "velocity" or log.bearing is None or len(log.frame) == 0:
        return None
    pairs = _pairs(log)
    if pairs is None:
        return None
    found = [_best(log, part) for part in pairs]
    if any(one is None for one in found):
        return None
    least, middle, most = np.min(found), np.median(found), np.max(found)
    if max(abs(least), abs(most)) > MOST - COARSE or most - least > max(0.1, abs(middle)):
        return None
    return ClockOffset(float(middle), float(least), float(most))


def shift_frames(log, seconds):
    """The log with its frames' stamps moved by so many seconds."""
    if not abs(seconds) < 1e6:
        raise ValueError(f"time offset {seconds} s; must be a number of seconds")
    time = log.frame_time + round(seconds * 1e9)
    return replace(log, frame_time=time, time_offset=log.time_offset + seconds)


class _Pairs(NamedTuple):
    """Times [p] of pairs of successive frames that have bearings, s after the log's start, and
    `apart`: every bearing of the second less every one of the first, with the `pair` of each, and
    where those of the next bearing of a first frame begin (`first`)."""

    begin: np.ndarray
    end: np.ndarray
    apart: np.ndarray
    pair: np.ndarray
    first: np.ndarray


def _pairs(log):
    """`_Pairs` of every part of the log; None: there are too few."""
    frames, size = np.unique(log.frame, return_counts=True)
    row = np.cumsum(size) - size
    seen = np.split(-log.bearing, row[1:])
    time = (log.frame_time[frames] - log.start) / 1e9
    near = np.flatnonzero(np.diff(time) <= APART)
    parts = []
    for some in np.array_split(near, PARTS):
        some = some[:: 1 + int((size[some] * size[some + 1]).sum()) // ENOUGH]
        apart = [np.subtract.outer(seen[i], seen[i + 1]).ravel() for i in some]
        if size[some].sum() < LEAST:
            return None
        count = size[some] * size[some + 1]
        every = np.repeat(size[some + 1], size[some])
        pair, first = np.repeat(np.arange(len(some)), count), np.cumsum(every) - every
        parts.append(_Pairs(time[some], time[some + 1], np.concatenate(apart), pair, first))
    return parts


def _best(log, pairs):
    """The offset at which bearings fit the turning best; None if the robot turns too little."""
    time = (log.odometry_time - log.start) / 1e9
    heading = np.append(0.0, np.cumsum(log.odometry[:-1, 1] * np.diff(time)))

    def turns(seconds):
        begin, end = (np.interp(at + seconds, time, heading) for at in (pairs.begin, pairs.end))
        return end - begin

    def cost(seconds):
        off = np.abs(wrap(pairs.apart + turns(seconds)[pairs.pair]))
        nearest = np.minimum.reduceat(off, pairs.first)
        return np.square(np.minimum(nearest / FAR, 1)).sum()

    if np.abs(turns(0.0)).sum() < TURNED:
        return None
    best = 0.0
    for step, reach in ((COARSE, MOST), (FINE, COARSE)):
        tried = best + np.arange(-round(reach / step), round(reach / step) + 1) * step
        best = tried[np.argmin([cost(seconds) for seconds in tried])]
    return best
