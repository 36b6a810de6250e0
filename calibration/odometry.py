"""Error model of the odometry, from increments and true poses."""

from dataclasses import replace

import numpy as np

from calibration.likelihood import maximum_likelihood
from jaxslam.logs.odometry import increments
from jaxslam.logs.truth import truth_at, wrap
from jaxslam.parameters import default_params

LEAST = 30  # least number of measurements, and of intervals of odometry, for an estimate
GAP = 0.25  # s, longest time between two true poses to interpolate across
ODOMETRY = ("gain_tran", "gain_rot", "bias_drift", "err_tran", "err_rot", "err_drift")


def require(log, met, what):
    """Raise `ValueError` naming `what` the log lacks, unless the condition is `met`."""
    if not met:
        raise ValueError(f"{log.name}: calibration needs {what}; this log lacks them")


def fit_odometry(log, interval):
    """Fit the odometry in intervals of `interval` s: values and standard errors by name, yaw of the
    drive (value, standard error) [rad], number of intervals.

    `gain_rot` and `err_rot` are left out for a straight drive, which says nothing about turns.
    Raises `ValueError` naming what the log lacks.
    """
    o, before, after = _intervals(log, interval)
    require(log, o.distance.sum() >= 1, "odometry with at least 1 m driven between true poses")
    declared = default_params("bearing", log)
    floors = declared.floor_tran**2 * o.duration, declared.floor_rot**2 * o.duration
    start = np.array([1, 1, 0, 0.02**2, 0.02**2, 0.02**2, 0])
    turns = o.turn.sum() >= 1
    free = [i for i in range(7) if turns or i not in (1, 4)]

    def moments(p):
        params = start.copy()
        params[free] = p
        return motion_residuals(params, o, before, after, floors)

    squares = [free.index(i) for i in (3, 4, 5) if i in free]
    best, error = maximum_likelihood(moments, start[free], squares)
    names = [ODOMETRY[i] for i in free[:-1]]
    values, errors = (dict(zip(names, part.tolist(), strict=False)) for part in (best, error))
    return values, errors, (float(best[-1]), float(error[-1])), len(o.dx)


def _intervals(log, interval):
    """`Odometry` of n intervals between true poses, and the poses [n, 3] at both ends."""
    driven = log.odometry_time
    # A command acts at its stamp: between stamps its progress is unknown.
    stamps = log.truth.time if log.odometry_kind == "velocity" else driven
    pose = truth_at(log.truth, stamps, GAP)
    usable = np.isfinite(pose).all(1) & (stamps >= driven[0]) & (stamps <= driven[-1])
    stamps, pose, ends, end = stamps[usable], pose[usable], [], 0
    while end < len(stamps):
        ends.append(end)
        end = max(end + 1, np.searchsorted(stamps, stamps[end] + int(interval * 1e9)))
    require(log, len(ends) > LEAST, f"over {LEAST} s of odometry and true poses together")
    stamps, pose = stamps[ends], pose[ends]
    columns = ("range", "point", "point_cov", "point_baseline", "bearing_sigma", "identity")
    bare = dict.fromkeys((*columns, "descriptor", "truth"))
    bare |= {"frame": np.empty(0, int), "bearing": np.empty(0)}
    odometry = increments(replace(log, frame_time=stamps, **bare))
    length = np.diff(stamps)
    kept = length <= 2 * max(interval * 1e9, np.median(length))  # not across gaps of the truth
    return type(odometry)(*(leaf[1:][kept] for leaf in odometry)), pose[:-1][kept], pose[1:][kept]


def motion_residuals(p, o, before, after, floors):
    """Errors [n, 3] along, across and in heading, and covariances [n, 3, 3], as `motion.model`.

    `p` [7]: gains (translation, rotation), bias of the drift, squares of err_tran, err_rot and
    err_drift, and the yaw of the drive.
    """
    gain_tran, gain_rot, bias, tran, rot, drift, yaw = p
    length = gain_tran * np.hypot(o.dx, o.dy)
    bend = o.lever * (gain_rot - 1) * o.dtheta + bias * o.distance / 2
    chord = before[:, 2] + yaw + np.arctan2(o.dy, o.dx) + bend
    dx, dy = (after - before)[:, :2].T
    c, s = np.cos(chord), np.sin(chord)
    turned = wrap(after[:, 2] - before[:, 2] - gain_rot * o.dtheta - bias * o.distance)
    drifted, spun = drift * o.distance + floors[1], rot * o.turn
    cov = np.zeros((len(dx), 3, 3))
    cov[:, 0, 0] = tran * o.distance + floors[0]
    cov[:, 1, 1] = length**2 * (drifted / 3 + (o.lever**2 + o.lever_var) * spun) + floors[0]
    cov[:, 1, 2] = cov[:, 2, 1] = length * (drifted / 2 + o.lever * spun)
    cov[:, 2, 2] = drifted + spun
    return np.column_stack([c * dx + s * dy - length, c * dy - s * dx, turned]), cov
