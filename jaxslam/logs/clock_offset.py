"""The clock offset between frames and odometry, estimated from the log alone.

When the robot turns, bearings turn the other way. The offset is the time by which frames have to be
moved so that, from frame to frame, bearings are nearest to where the odometry's turn takes them.
Identities are not needed. Translation moves bearings, too, but alike for all offsets. NumPy.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxslam.logs.truth import wrap

MAX_GAP = 1.0  # s between two frames that are compared
MAX_OFFSET = 0.6  # s
COARSE, FINE = 0.06, 0.01  # s between offsets tried
CAP = 0.05  # rad: a bearing farther off may be of another landmark, and costs no more
PARTS = 6  # of the log, in each of which the offset is estimated
MIN_BEARINGS = 200  # compared in each part
MAX_DIFFERENCES = 300_000  # of bearings in a part; beyond, only every so many frames are used
MIN_TURN = 1.0  # rad, sum over each part


class ClockOffset(NamedTuple):
    """Seconds to add to the frames' stamps, with the `least` and `most` of the log's parts."""

    seconds: float
    least: float
    most: float


def estimate_clock_offset(log):
    """Estimate the `ClockOffset` of a log's frames against its odometry.

    None if it can't be determined: the odometry has no velocities, there are too few bearings or
    turns, or the parts of the log disagree.
    """
    if log.odometry_kind != "velocity" or log.bearing is None or len(log.frame) == 0:
        return None
    pairs = _pairs(log)
    if pairs is None:
        return None
    offsets = [_best_offset(log, part) for part in pairs]
    if any(offset is None for offset in offsets):
        return None
    least, middle, most = np.min(offsets), np.median(offsets), np.max(offsets)
    if max(abs(least), abs(most)) > MAX_OFFSET - COARSE or most - least > max(0.1, abs(middle)):
        return None
    return ClockOffset(float(middle), float(least), float(most))


def shift_frames(log, seconds):
    """Add `seconds` to the stamps of the log's frames. Raises `ValueError` if it is no number."""
    if not abs(seconds) < 1e6:
        raise ValueError(f"time offset {seconds} s; must be a number of seconds")
    time = log.frame_time + round(seconds * 1e9)
    return replace(log, frame_time=time, time_offset=log.time_offset + seconds)


class _Pairs(NamedTuple):
    """Pairs of successive frames with bearings: their times `begin` and `end` [p], s after the
    log's start; `difference`, every bearing of the second less every bearing of the first, with
    the `pair` of each; and `first`, where those of each bearing of the first frame begin."""

    begin: np.ndarray
    end: np.ndarray
    difference: np.ndarray
    pair: np.ndarray
    first: np.ndarray


def _pairs(log):
    """`_Pairs` of every part of the log; None if there are too few."""
    frames, size = np.unique(log.frame, return_counts=True)
    row = np.cumsum(size) - size
    seen = np.split(-log.bearing, row[1:])
    time = (log.frame_time[frames] - log.start) / 1e9
    near = np.flatnonzero(np.diff(time) <= MAX_GAP)
    parts = []
    for frame in np.array_split(near, PARTS):
        frame = frame[:: 1 + int((size[frame] * size[frame + 1]).sum()) // MAX_DIFFERENCES]
        difference = [np.subtract.outer(seen[i], seen[i + 1]).ravel() for i in frame]
        if size[frame].sum() < MIN_BEARINGS:
            return None
        count = size[frame] * size[frame + 1]
        every = np.repeat(size[frame + 1], size[frame])
        pair, first = np.repeat(np.arange(len(frame)), count), np.cumsum(every) - every
        parts.append(_Pairs(time[frame], time[frame + 1], np.concatenate(difference), pair, first))
    return parts


def _best_offset(log, pairs):
    """The offset at which bearings fit the odometry's turns best; None if there are too few."""
    time = (log.odometry_time - log.start) / 1e9
    heading = np.append(0.0, np.cumsum(log.odometry[:-1, 1] * np.diff(time)))

    def turns(seconds):
        begin, end = (np.interp(at + seconds, time, heading) for at in (pairs.begin, pairs.end))
        return end - begin

    def cost(seconds):
        off = np.abs(wrap(pairs.difference + turns(seconds)[pairs.pair]))
        nearest = np.minimum.reduceat(off, pairs.first)
        return np.square(np.minimum(nearest / CAP, 1)).sum()

    if np.abs(turns(0.0)).sum() < MIN_TURN:
        return None
    best = 0.0
    for step, reach in ((COARSE, MAX_OFFSET), (FINE, COARSE)):
        tried = best + np.arange(-round(reach / step), round(reach / step) + 1) * step
        best = tried[np.argmin([cost(seconds) for seconds in tried])]
    return best
