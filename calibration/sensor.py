"""Drives -> error model: sensor and odometry noise from a log whose truth is known.

Residuals against the truth are fitted by maximum likelihood with the filter's own models: `sensors`
(a bearing's noise grows at short range) and `motion`. Read the result for what it is:
- Truth is needed: poses, landmarks, which measurement saw which. Its own error counts as noise.
- Residuals are taken for white noise. Real ones are not (a tube is seen off its centre as long as
  the robot stands on one side of it): the standard errors are then too small, and a filter, which
  multiplies the densities of many frames, needs wider values than these.
- A controller that answers to the odometry's errors within an interval biases the gains (the turns
  it commands undo the noise): drive by hand, or blindly.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from jaxslam.config import default_params
from jaxslam.evaluate import truth_at, wrap
from jaxslam.frames import increments

LEAST = 30  # measurements, and intervals of odometry, below which nothing is estimated
COARSEST = 0.02  # m; truth read off anything coarser tells nothing of these errors
GAP = 0.25  # s between two true poses, across which a pose may be interpolated
OUTLIER = 5.0  # robust standard deviations
ODOMETRY = ("gain_tran", "gain_rot", "bias_drift", "err_tran", "err_rot", "err_drift")


class RangeBin(NamedTuple):
    """Measured minus true, at true ranges `low` to `high` [m], outliers (but for `outliers`, their
    number) left out. `model_sd`: what the fit says of `bearing_sd`. NaN without ranges."""

    low: float
    high: float
    count: int
    outliers: int
    range_mean: float
    range_sd: float
    bearing_mean: float
    bearing_sd: float
    model_sd: float


@dataclass(frozen=True)
class ErrorModel:
    """`values` of `Params` with `standard_errors`, by name; `counts` by kind; residuals `by_range`.

    `interval`: s of odometry at a time. `drive_yaw` (value, standard error): direction in which the
    robot drives, in the frame of its true headings. The filter takes it for zero: see `turn_frame`.
    """

    values: dict[str, float]
    standard_errors: dict[str, float]
    counts: dict[str, int]
    by_range: tuple[RangeBin, ...]
    interval: float
    drive_yaw: tuple[float, float]


def fit(log, interval=1.0):
    """`ErrorModel` of a log with truth.

    Sensor: `sigma_range` (about zero; where there are ranges), `sigma_bearing`, `growth`,
    `mount_yaw`, and `outlier`: the share beyond 5 robust standard deviations of their range bin, or
    of no landmark by the truth. Odometry, in intervals of about `interval` seconds: `err_tran`,
    `err_rot`, `err_drift`, `gain_tran`, `gain_rot`, `bias_drift`; the floors and the mounting's x
    and y stay as the log declares them. Raises `ValueError` naming what the log lacks.
    """
    truth = log.truth
    _require(log, truth is not None and truth.time is not None, "true poses")
    fine = f"true poses finer than {COARSEST:g} m (they have {truth.resolution:g} m)"
    _require(log, truth.resolution <= COARSEST, fine)
    values, errors, counts, by_range = _fit_sensor(log)
    (*best, drive_yaw), (*error, yaw_error), counts["intervals"] = _fit_odometry(log, interval)
    values |= zip(ODOMETRY, best, strict=True)
    errors |= zip(ODOMETRY, error, strict=True)
    values, errors = ({k: float(v) for k, v in part.items()} for part in (values, errors))
    return ErrorModel(values, errors, counts, by_range, interval, (drive_yaw, yaw_error))


def turn_frame(log, yaw):
    """The log with the robot's frame turned by `yaw`: by `drive_yaw`, it drives along its x."""
    (x, y, heading), c, s = log.mounting, np.cos(yaw), np.sin(yaw)
    turn, truth = np.array([0, 0, yaw]), log.truth
    if truth is not None and truth.pose is not None:
        truth = replace(truth, pose=truth.pose + turn)
    mounting = c * x + s * y, c * y - s * x, heading - yaw
    return replace(log, mounting=mounting, start_pose=log.start_pose + turn, truth=truth)


def _require(log, met, what):
    if not met:
        raise ValueError(f"{log.name}: calibration needs {what}; this log lacks them")


def _fit_sensor(log):
    """Values, standard errors, counts and bins of the measurements' residuals."""
    r, residual, clutter = _residuals(log)
    edges = np.quantile(r, np.linspace(0, 1, 1 + max(1, min(12, len(r) // 50))))
    place = np.clip(np.searchsorted(edges, r, side="right") - 1, 0, len(edges) - 2)
    far = np.zeros(len(r), bool)
    for i in np.unique(place):
        off = np.abs(residual[place == i] - np.median(residual[place == i], axis=0))
        far[place == i] = (off > OUTLIER * 1.4826 * np.median(off, axis=0)).any(1)
    bearing, off = residual[~far].T
    shape = np.column_stack([np.ones_like(bearing), r[~far] ** -2.0])  # of the bearing's variance
    start = [np.median(bearing), np.var(bearing) / 2, np.var(bearing) / 2 / shape[:, 1].mean()]
    best, error = _maximum_likelihood(
        lambda p: ((bearing - p[0])[:, None], (shape @ p[1:])[:, None, None]), start, [1, 2]
    )
    counts = {"measurements": len(r) + clutter, "outliers": int(far.sum()) + clutter}
    share = counts["outliers"] / counts["measurements"]
    values = dict(zip(("mount_yaw", "sigma_bearing", "growth"), best, strict=True), outlier=share)
    values["mount_yaw"] += log.mounting[2]
    errors = dict(zip(("mount_yaw", "sigma_bearing", "growth"), error, strict=True))
    errors["outlier"] = np.sqrt(share * (1 - share) / counts["measurements"])
    if log.range is not None:
        values["sigma_range"] = np.sqrt(np.mean(off**2))
        errors["sigma_range"] = values["sigma_range"] / np.sqrt(2 * len(off))
    by_range = []
    for i, (low, high) in enumerate(pairwise(edges.tolist())):
        inside = (place == i) & ~far
        numbers = int(inside.sum()), int((far & (place == i)).sum())
        (mean_b, mean_r), (sd_b, sd_r) = residual[inside].mean(0), residual[inside].std(0)
        model = np.sqrt(best[1] ** 2 + best[2] ** 2 * np.mean(r[inside] ** -2.0))
        by_range.append(
            RangeBin(low, high, *numbers, *map(float, (mean_r, sd_r, mean_b, sd_b, model)))
        )
    return values, errors, counts, tuple(by_range)


def _residuals(log):
    """True ranges [n], residuals [n, 2] (bearing, range) of known landmarks, number of clutter."""
    truth = log.truth
    _require(log, truth.landmarks is not None and truth.landmark_id is not None, "true landmarks")
    _require(log, log.bearing is not None, "bearings")
    identity = log.identity if truth.identity is None else truth.identity
    _require(log, identity is not None, "identities of the measurements")
    slots = {landmark: i for i, landmark in enumerate(truth.landmark_id.tolist())}
    slot = np.array([slots.get(i, -1) for i in identity.tolist()], int)
    pose = truth_at(truth, log.frame_time, GAP)[log.frame]
    posed = np.isfinite(pose).all(1)
    known = posed & (slot >= 0)
    _require(log, known.sum() >= LEAST, f"at least {LEAST} measurements of known landmarks")
    x, y, heading = pose[known].T
    mx, my, yaw = log.mounting
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = truth.landmarks[slot[known]].T - [x + c * mx - s * my, y + s * mx + c * my]
    r = np.maximum(np.hypot(dx, dy), 1e-6)
    bearing = wrap(log.bearing[known] - (np.arctan2(dy, dx) - heading - yaw))
    off = np.full(len(r), np.nan) if log.range is None else log.range[known] - r
    # A measured identity of -1 may be anything; a true one is clutter.
    clutter = 0 if truth.identity is None else int((posed & (identity < 0)).sum())
    return r, np.column_stack([bearing, off]), clutter


def _fit_odometry(log, interval):
    """Values and standard errors of `ODOMETRY` and of the drive's yaw; the number of intervals."""
    o, before, after = _intervals(log, interval)
    enough = o.distance.sum() >= 1 and o.turn.sum() >= 1
    _require(log, enough, "odometry with at least 1 m driven and 1 rad turned, where truth is")
    declared = default_params("bearing", log)
    floors = declared.floor_tran**2 * o.duration, declared.floor_rot**2 * o.duration
    best, error = _maximum_likelihood(
        lambda p: motion_residuals(p, o, before, after, floors),
        [1, 1, 0, 0.02**2, 0.02**2, 0.02**2, 0],
        [3, 4, 5],
    )
    return best.tolist(), error.tolist(), len(o.dx)


def _intervals(log, interval):
    """`Odometry` of intervals between true poses [n], and the poses [n, 3] at their two ends."""
    moving = log.odometry_time
    # A command is executed at its stamp: in between there is no saying how far it got.
    stamps = log.truth.time if log.odometry_kind == "velocity" else moving
    pose = truth_at(log.truth, stamps, GAP)
    usable = np.isfinite(pose).all(1) & (stamps >= moving[0]) & (stamps <= moving[-1])
    stamps, pose, ends, end = stamps[usable], pose[usable], [], 0
    while end < len(stamps):
        ends.append(end)
        end = np.searchsorted(stamps, stamps[end] + int(interval * 1e9))
    _require(log, len(ends) > LEAST, f"over {LEAST} s of odometry and true poses together")
    stamps, pose = stamps[ends], pose[ends]
    bare = dict.fromkeys(("range", "point", "point_cov", "identity", "descriptor", "truth"))
    bare |= {"frame": np.empty(0, int), "bearing": np.empty(0)}
    odometry = increments(replace(log, frame_time=stamps, **bare))
    length = np.diff(stamps)
    kept = length <= 2 * max(interval * 1e9, np.median(length))  # not across a hole in the truth
    return type(odometry)(*(leaf[1:][kept] for leaf in odometry)), pose[:-1][kept], pose[1:][kept]


def motion_residuals(p, o, before, after, floors):
    """Errors [n, 3] along, across and in heading, and covariances [n, 3, 3], as `motion.model`.

    `p`: gains (translation, rotation), drift's bias, squares of err_tran, err_rot and err_drift,
    and the drive's yaw.
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


def _maximum_likelihood(moments, start, squares):
    """Parameters and standard errors that fit normal residuals of mean zero best.

    `moments(p)`: residuals [n, d] and covariances [n, d, d]. Of the variances among the parameters,
    listed in `squares`, the roots come back. Errors are by Fisher's information.
    """
    scale = np.full(len(start), 0.01)
    scale[squares] = np.array(start)[squares]
    bounds = [(1e-8 if i in squares else None, None) for i in range(len(start))]

    def cost(q):
        e, cov = moments(q * scale)
        white = np.linalg.solve(cov, e[..., None])[..., 0]
        return (np.sum(e * white) + np.linalg.slogdet(cov)[1].sum()) / (2 * len(e))

    best = minimize(cost, np.array(start) / scale, method="L-BFGS-B", bounds=bounds).x * scale
    inverse, slopes = np.linalg.inv(moments(best)[1]), []
    for step in np.diag(1e-4 * scale):
        ends = zip(moments(best + step), moments(best - step), strict=True)
        slopes.append([(a - b) / (2 * step.sum()) for a, b in ends])
    means, covs = zip(*slopes, strict=True)
    white = [inverse @ cov for cov in covs]
    information = np.array([[np.einsum("na,nab,nb", d, inverse, e) for e in means] for d in means])
    information += [[np.einsum("nab,nba", a, b) / 2 for b in white] for a in white]
    error = np.sqrt(np.diag(np.linalg.pinv(information)))
    best[squares] = np.sqrt(best[squares])
    # Next to zero the root is no straight line: what is known is how far up it may go.
    error[squares] = np.minimum(error[squares] / (2 * best[squares]), np.sqrt(error[squares]))
    return best, error
