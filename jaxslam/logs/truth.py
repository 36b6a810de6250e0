"""True poses at any stamp, and the wrapping of angles."""

import numpy as np


def wrap(angle):
    """Wrap angles to [-pi, pi); those already there keep their bits."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))


def truth_at(truth, time, gap=1.0, snap=0.02):
    """Interpolate the true pose [T, 3] at `time` (int64 ns) [T]; NaN where there is no truth.

    Linear between neighbouring samples at most `gap` seconds apart, the heading along the shorter
    turn. Elsewhere a single reading (one per stop) holds within `snap` seconds.
    """
    time = np.asarray(time, np.int64)
    pose = np.full((time.size, 3), np.nan)
    if truth is None or truth.time is None or len(truth.time) == 0:
        return pose
    stamp, known = np.asarray(truth.time, np.int64), np.asarray(truth.pose, float)
    after = np.searchsorted(stamp, time).clip(0, stamp.size - 1)
    before = (after - 1).clip(0)
    step = (stamp[after] - stamp[before]).clip(1)
    fraction = (time - stamp[before]) / step
    inside = (fraction >= 0) & (fraction <= 1) & (step <= gap * 1e9)
    move = known[after] - known[before]
    move[:, 2] = wrap(move[:, 2])
    pose[inside] = (known[before] + fraction[:, None] * move)[inside]
    nearest = np.where(np.abs(time - stamp[before]) < np.abs(time - stamp[after]), before, after)
    alone = ~inside & (np.abs(time - stamp[nearest]) <= snap * 1e9)
    pose[alone] = known[nearest[alone]]
    pose[:, 2] = wrap(pose[:, 2])
    return pose
