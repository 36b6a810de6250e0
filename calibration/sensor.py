"""Error model of sensor and odometry, from a log whose truth is known.

Residuals against the truth are fitted by maximum likelihood with the filter's models `sensors`
(where the noise of bearings grows at short range) and `motion`. Limits:
- Truth is needed: poses, landmarks and identities. Its errors count as noise.
- Residuals are assumed white, but real ones are not (a tube is seen off its centre as long as the
  robot is on one side of it). Standard errors are then too small, and a filter, which multiplies
  the densities of many frames, needs larger values.
- A controller that reacts to errors of the odometry within an interval biases the gains, since its
  turns cancel noise. Drive by hand, or without feedback.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from calibration.likelihood import maximum_likelihood
from calibration.odometry import GAP, LEAST, fit_odometry, require
from jaxslam.logs.truth import truth_at, wrap

COARSEST = 0.02  # m, coarsest resolution of a truth from which these errors can be found
OUTLIER = 5.0  # robust standard deviations


class RangeBin(NamedTuple):
    """Mean and standard deviation of measured minus true at true ranges `low` to `high` [m], NaN
    without ranges; `count` excludes the `outliers`. `model_sd`: `bearing_sd` by the fit."""

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

    `interval` s of odometry. `drive_yaw` rad (value, standard error): direction in which the robot
    drives, relative to its true heading. The filter assumes zero.
    """

    values: dict[str, float]
    standard_errors: dict[str, float]
    counts: dict[str, int]
    by_range: tuple[RangeBin, ...]
    interval: float
    drive_yaw: tuple[float, float]


def fit(log, interval=1.0):
    """Fit the `ErrorModel` of a log with truth.

    Sensor: `sigma_range` (about zero, if there are ranges), `sigma_bearing`, `landmark_extent`,
    `mount_yaw`, and `outlier`: the share of measurements beyond 5 robust standard deviations of
    their range bin, or of no landmark by the truth. Odometry, in intervals of about `interval`
    seconds: `err_tran`, `err_rot`, `err_drift`, `gain_tran`, `gain_rot` and `bias_drift`; those of
    turns only if there are turns. Floors and the mounting's x and y stay as declared by the log.
    Raises `ValueError` naming what the log lacks.
    """
    if not 0 < interval < np.inf:
        raise ValueError(f"interval: {interval!r} s; must be above 0")
    truth = log.truth
    require(log, truth is not None and truth.time is not None, "true poses")
    fine = f"true poses finer than {COARSEST:g} m (they have {truth.resolution:g} m)"
    require(log, truth.resolution <= COARSEST, fine)
    values, errors, counts, by_range = _fit_sensor(log)
    driven, uncertain, drive_yaw, counts["intervals"] = fit_odometry(log, interval)
    both = values | driven, errors | uncertain
    values, errors = ({k: float(v) for k, v in part.items()} for part in both)
    return ErrorModel(values, errors, counts, by_range, interval, drive_yaw)


def _fit_sensor(log):
    """Fit the measurements: values, standard errors, counts, and residuals by range."""
    r, residual, clutter = _residuals(log)
    edges = np.quantile(r, np.linspace(0, 1, 1 + max(1, min(12, len(r) // 50))))
    range_bin = np.clip(np.searchsorted(edges, r, side="right") - 1, 0, len(edges) - 2)
    far = np.zeros(len(r), bool)
    for i in np.unique(range_bin):
        off = np.abs(residual[range_bin == i] - np.median(residual[range_bin == i], axis=0))
        far[range_bin == i] = (off > OUTLIER * 1.4826 * np.median(off, axis=0)).any(1)
    bearing, off = residual[~far].T
    shape = np.column_stack([np.ones_like(bearing), r[~far] ** -2.0])  # of the bearing's variance
    start = [np.median(bearing), np.var(bearing) / 2, np.var(bearing) / 2 / shape[:, 1].mean()]
    best, error = maximum_likelihood(
        lambda p: ((bearing - p[0])[:, None], (shape @ p[1:])[:, None, None]), start, [1, 2]
    )
    counts = {"measurements": len(r) + clutter, "outliers": int(far.sum()) + clutter}
    share = counts["outliers"] / counts["measurements"]
    names = "mount_yaw", "sigma_bearing", "landmark_extent"
    values = dict(zip(names, best, strict=True), outlier=share)
    values["mount_yaw"] = log.mounting[2] - best[0]  # turned to the left, it reads too little
    errors = dict(zip(names, error, strict=True))
    errors["outlier"] = np.sqrt(share * (1 - share) / counts["measurements"])
    if log.range is not None:
        values["sigma_range"] = np.sqrt(np.mean(off**2))
        errors["sigma_range"] = values["sigma_range"] / np.sqrt(2 * len(off))
    by_range = []
    for i, (low, high) in enumerate(pairwise(edges.tolist())):
        inside = (range_bin == i) & ~far
        numbers = int(inside.sum()), int((far & (range_bin == i)).sum())
        (mean_b, mean_r), (sd_b, sd_r) = residual[inside].mean(0), residual[inside].std(0)
        model = np.sqrt(best[1] ** 2 + best[2] ** 2 * np.mean(r[inside] ** -2.0))
        moments = map(float, (mean_r, sd_r, mean_b, sd_b, model))
        by_range.append(RangeBin(low, high, *numbers, *moments))
    return values, errors, counts, tuple(by_range)


def _residuals(log):
    """Of known landmarks: true ranges [n] m and residuals [n, 2] (bearing, range); and clutter."""
    truth = log.truth
    require(log, truth.landmarks is not None and truth.landmark_id is not None, "true landmarks")
    require(log, log.bearing is not None, "bearings")
    identity = log.identity if truth.identity is None else truth.identity
    require(log, identity is not None, "identities of the measurements")
    slots = {landmark: i for i, landmark in enumerate(truth.landmark_id.tolist())}
    slot = np.array([slots.get(i, -1) for i in identity.tolist()], int)
    pose = truth_at(truth, log.frame_time, GAP)[log.frame]
    has_pose = np.isfinite(pose).all(1)
    known = has_pose & (slot >= 0)
    require(log, known.sum() >= LEAST, f"at least {LEAST} measurements of known landmarks")
    x, y, heading = pose[known].T
    mx, my, yaw = log.mounting
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = truth.landmarks[slot[known]].T - [x + c * mx - s * my, y + s * mx + c * my]
    r = np.maximum(np.hypot(dx, dy), 1e-6)
    bearing = wrap(log.bearing[known] - (np.arctan2(dy, dx) - heading - yaw))
    off = np.full(len(r), np.nan) if log.range is None else log.range[known] - r
    # A measured identity of -1 may be any landmark; a true one is clutter.
    clutter = 0 if truth.identity is None else int((has_pose & (identity < 0)).sum())
    return r, np.column_stack([bearing, off]), clutter
