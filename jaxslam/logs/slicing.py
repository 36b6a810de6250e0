"""Parts of a log, as logs: a time interval, windows, or fewer frames."""

import dataclasses

import numpy as np

from jaxslam.logs.log import Log
from jaxslam.logs.odometry import held_velocities
from jaxslam.logs.truth import truth_at

PER_ROW = ("bearing", "bearing_sigma", "range", "point", "point_cov", "point_baseline")
PER_ROW += ("identity", "descriptor")
S = 10**9  # ns


def cut(log: Log, start: float = 0.0, end: float | None = None) -> Log:
    """Cut a log to the frames in (start, end], times in s after `log.start`.

    `start` 0 includes a frame at 0; `end` None: the log's end. The cut holds the velocity that was
    held at `start`, or the commands that end within it. It starts in the log's `start_pose` if
    `start` is 0, else exactly in the true pose, or the origin without truth. `skipped` stays that
    of the log.

    Raises `ValueError` if no frame lies between.
    """
    length = _length(log)
    last = length if end is None else end
    if not (np.isfinite(start) and np.isfinite(last) and 0 <= start < last):
        raise ValueError(f"cut from {start} to {last} s; must be 0 or more, and the end later")
    # Rounding must not lose a frame at the very end.
    begin, stop = (log.start + round(t * S) for t in (start, min(last, length)))
    frames = (log.frame_time > begin - (begin == log.start)) & (log.frame_time <= stop)
    if not frames.any():
        raise ValueError(
            f"{log.name}: no frame between {start:g} and {last:g} s; it is {length:g} s long"
        )
    odometry = _velocities if log.odometry_kind == "velocity" else _commands
    odometry_time, values = odometry(log, begin, stop)
    first = begin == log.start
    part = select_frames(log, frames)
    return dataclasses.replace(
        part,
        name=f"{log.name}, {start:g} to {last:g} s",
        odometry_time=odometry_time,
        odometry=values,
        start_pose=log.start_pose if first else _true_pose(log, begin),
        start_cov=log.start_cov if first else np.zeros((3, 3)),
        truth=_cut_poses(part.truth, begin, stop),
    )


def windows(log: Log, seconds: float) -> list[Log]:
    """Cut a log into a list of `Log`s of `seconds` each.

    The rest is a window if it is at least half as long. Windows without frames are left out.
    Raises `ValueError` for a length that is not above 0.
    """
    if not (np.isfinite(seconds) and seconds > 0):
        raise ValueError(f"windows of {seconds} s; must be above 0")
    length, seen = _length(log), (log.frame_time - log.start) / S
    pieces = []
    for index in range(max(1, int(length / seconds + 0.5))):
        start, end = index * seconds, (index + 1) * seconds
        if ((seen > (start or -1)) & (seen <= end)).any():
            pieces.append(cut(log, start, end))
    return pieces


def spaced(log: Log, seconds: float) -> Log:
    """Keep only frames that are at least `seconds` apart (0: all), and all odometry.

    Errors of frames in quick succession are correlated, which a filter, and more so learning, takes
    for precision. Frames left out are not counted in `skipped`.
    """
    if not (np.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"frames {seconds} s apart; must be 0 or more")
    kept, last = np.zeros(len(log.frame_time), bool), None
    for i, stamp in enumerate(log.frame_time.tolist()):
        if last is None or stamp - last >= seconds * S:
            kept[i], last = True, stamp
    return select_frames(log, kept)


def select_frames(log, frames):
    """Keep only these frames (mask [F] or increasing numbers) and their measurements.

    The odometry is kept whole: the log of the same drive with a slower sensor.
    """
    kept = np.zeros(len(log.frame_time), bool)
    kept[frames] = True
    rows = kept[log.frame]
    columns = {name: getattr(log, name) for name in PER_ROW}
    truth = log.truth
    if truth is not None and truth.identity is not None:
        truth = dataclasses.replace(truth, identity=truth.identity[rows])
    return dataclasses.replace(
        log,
        frame_time=log.frame_time[kept],
        frame=(np.cumsum(kept) - 1)[log.frame[rows]],
        truth=truth,
        **{name: value[rows] for name, value in columns.items() if value is not None},
    )


def _length(log):
    """Seconds from the start to the last frame or odometry."""
    return (max(int(log.odometry_time[-1]), int(log.frame_time[-1])) - log.start) / S


def _velocities(log, begin, stop):
    """Odometry between two stamps, with a row at each for the velocity held there."""
    edges, velocity = held_velocities(log)
    at = np.unique(np.concatenate([[begin, stop], edges[(edges > begin) & (edges < stop)]]))
    return at, velocity[np.searchsorted(edges, at, side="right")]


def _commands(log, begin, stop):
    """Commands that end between two stamps, after an empty one that marks the start."""
    time = log.odometry_time
    inside = (time > begin - (begin == log.start)) & (time <= stop)
    if inside.any() and time[inside][0] == begin:
        return time[inside], log.odometry[inside]
    return np.append(begin, time[inside]), np.vstack([[[0.0, 0.0]], log.odometry[inside]])


def _true_pose(log, stamp):
    """True pose [3] at a stamp, beyond the truth's ends the nearest; the origin without truth."""
    if log.truth is None or log.truth.time is None or not len(log.truth.time):
        return np.zeros(3)
    if log.odometry_kind == "command":  # the first command of the cut begins where the last ended
        stamp = max(log.odometry_time[log.odometry_time <= stamp], default=log.start)
    return truth_at(log.truth, np.array([stamp]), gap=np.inf, snap=np.inf)[0]


def _cut_poses(truth, begin, stop):
    """Cut the poses of a `Truth` to those between two stamps and one beyond each."""
    if truth is None or truth.time is None:
        return truth
    low = max(np.searchsorted(truth.time, begin, side="right") - 1, 0)
    part = slice(low, np.searchsorted(truth.time, stop) + 1)
    return dataclasses.replace(truth, time=truth.time[part], pose=truth.pose[part])
