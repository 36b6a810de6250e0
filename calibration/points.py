"""Error of triangulated points: the paper's procedure, and a comparison of error models.

Drive straight past surveyed lines with images at known distances, triangulate, and compare the
points with the lines (paper, section III-B3 and fig. 6). Models are fitted to one half of the drive
and scored on the other, and vice versa, by their log density per point. They can also be compared
in the filter: `apply_model` writes a model's covariances into any log of points.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from calibration.odometry import GAP, LEAST, require
from jaxslam.logs.truth import truth_at, wrap

NEAR = np.radians(1.0)  # largest difference of bearing from that of the same surveyed line
GROSS = 100.0  # squared Mahalanobis distance beyond which a point is a gross error


class PointErrors(NamedTuple):
    """Of n points: `row` in the log, `frame`, `point` and `true` [n, 2] m in the sensor's frame,
    `cov` [n, 2, 2] as propagated, `baseline` [n] m, and `counts` of points by kind."""

    row: np.ndarray
    frame: np.ndarray
    point: np.ndarray
    true: np.ndarray
    cov: np.ndarray
    baseline: np.ndarray
    counts: dict[str, int]

    def part(self, chosen):
        """The points selected by an index or mask."""
        return self._replace(**{k: getattr(self, k)[chosen] for k in self._fields[:-1]})


class Model(NamedTuple):
    """A fitted error model: parameters, nats per held-out point, coverage of the 95 % ellipses."""

    name: str
    values: dict[str, float]
    held_out: float
    coverage: float


def point_errors(log, gain=1.0):
    """`PointErrors` of a log with points, true poses and surveyed lines.

    `gain`: true over measured distance, by which the points are scaled. The line of a point is that
    of its true identity, or else the most likely within a degree of its bearing from the true pose.
    Raises `ValueError` naming what the log lacks.
    """
    truth = _require_lines(log)
    require(log, log.point is not None, "triangulated points")
    rows = np.flatnonzero(np.isfinite(log.point).all(1))
    pose = truth_at(truth, log.frame_time, GAP)[log.frame[rows]]
    rows, pose = rows[np.isfinite(pose).all(1)], pose[np.isfinite(pose).all(1)]
    require(log, len(rows) >= LEAST, f"at least {LEAST} points where there are true poses")
    point, cov = gain * log.point[rows], gain**2 * _to_matrices(log.point_cov[rows])
    lines = in_sensor(log, pose, truth.landmarks)
    off = point[:, None] - lines
    distance = np.einsum("nli,nij,nlj->nl", off, np.linalg.inv(cov), off)
    turn = np.arctan2(lines[..., 1], lines[..., 0]) - np.arctan2(point[:, 1], point[:, 0])[:, None]
    possible = np.abs(wrap(turn)) < NEAR
    if truth.identity is not None and truth.landmark_id is not None:
        possible = truth.identity[rows][:, None] == truth.landmark_id
    distance = np.where(possible, distance, np.inf)
    nearest, least = distance.argmin(1), distance.min(1)
    kept = least < GROSS
    counts = {"points": len(rows), "of no surveyed line": int(np.isinf(least).sum())}
    counts["gross errors"] = int((np.isfinite(least) & ~kept).sum())
    require(log, kept.sum() >= LEAST, f"at least {LEAST} points near surveyed lines")
    base = np.full(len(rows), np.nan) if log.point_baseline is None else log.point_baseline[rows]
    true = lines[np.arange(len(rows)), nearest]
    errors = PointErrors(rows, log.frame[rows], point, true, cov, gain * base, counts)
    return errors.part(kept)


def identify_lines(log):
    """Add true identities to a log: of each bearing, the surveyed line nearest to it.

    Bearings are from the true pose; -1 (clutter) if no line is within a degree. For lines from
    images, which have no identities. Raises `ValueError` naming what the log lacks.
    """
    truth = _require_lines(log)
    require(log, log.bearing is not None, "bearings")
    lines = in_sensor(log, truth_at(truth, log.frame_time, GAP)[log.frame], truth.landmarks)
    off = np.abs(wrap(log.bearing[:, None] - np.arctan2(lines[..., 1], lines[..., 0])))
    off = np.where(np.isfinite(off), off, np.inf)
    ids = np.arange(len(truth.landmarks)) if truth.landmark_id is None else truth.landmark_id
    identity = np.where(off.min(axis=1) < NEAR, ids[off.argmin(axis=1)], -1)
    return replace(log, truth=replace(truth, landmark_id=ids, identity=identity))


def _require_lines(log):
    """The truth of a log, which must have poses and surveyed lines."""
    truth = log.truth
    require(log, truth is not None and truth.time is not None, "true poses")
    require(log, truth.landmarks is not None and len(truth.landmarks), "surveyed lines")
    return truth


def coverage(errors):
    """Share of the points within the 95 % ellipse of their propagated covariance."""
    return float((_squared_distance("propagated normal", (1.0,), errors) < _bound95(np.inf)).mean())


def compare(errors):
    """Compare all candidates: `Model`s fitted to all points, best held-out log density first.

    Scores are by two-fold cross-validation between the first and the second half of the frames,
    since errors of neighbouring frames are correlated. Raises `ValueError` for too few points.
    """
    if len(errors.row) < 2 * LEAST:
        raise ValueError(f"error model: {len(errors.row)} points; at least {2 * LEAST} are needed")
    late = errors.frame > np.median(errors.frame)
    models = []
    for name in CANDIDATES:
        if name == "bearing normal" and not np.isfinite(errors.baseline).all():
            continue
        halves = [(errors.part(~half), errors.part(half)) for half in (late, ~late)]
        scores = [_log_density(name, _fit(name, fitted), other) for fitted, other in halves]
        values = _fit(name, errors)
        dof = _moments(name, values, errors)[2]
        covered = _squared_distance(name, values, errors) < _bound95(dof)
        by_name = dict(zip(CANDIDATES[name][0], values.tolist(), strict=True))
        models.append(Model(name, by_name, float(np.concatenate(scores).mean()), covered.mean()))
    return sorted(models, key=lambda model: -model.held_out)


def apply_model(model, log):
    """Replace the covariances of a log's points by a model's, and subtract a fitted mean."""
    rows = np.flatnonzero(np.isfinite(log.point).all(1))
    point, base = log.point[rows], log.point_baseline
    base = np.full(len(rows), np.nan) if base is None else base[rows]
    propagated = _to_matrices(log.point_cov[rows])
    empty = PointErrors(rows, log.frame[rows], point, point, propagated, base, {})
    mean, cov, dof = _moments(model.name, np.array(list(model.values.values())), empty)
    if np.isfinite(dof):  # the filter assumes a normal: use the variance of Student's t
        cov = cov * dof / max(dof - 2, 0.5)
    points, covs = log.point.copy(), log.point_cov.copy()
    points[rows] = point - mean
    covs[rows] = np.column_stack([cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]])
    return replace(log, point=points, point_cov=covs)


def in_sensor(log, pose, landmarks):
    """Landmarks [L, 2] in the sensor's frame at true robot poses [n, 3]: [n, L, 2]."""
    mx, my, yaw = log.mounting
    x, y, heading = pose.T
    c, s = np.cos(heading), np.sin(heading)
    dx = landmarks[:, 0] - (x + c * mx - s * my)[:, None]
    dy = landmarks[:, 1] - (y + s * mx + c * my)[:, None]
    c, s = np.cos(heading + yaw)[:, None], np.sin(heading + yaw)[:, None]
    return np.stack([c * dx + s * dy, c * dy - s * dx], -1)


def _to_matrices(cov):
    """Covariances [n, 2, 2] from (xx, xy, yy) [n, 3]."""
    xx, xy, yy = cov.T
    return np.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2)


def _sight_axes(point):
    """Unit vectors along and across the line of sight, as columns [n, 2, 2]."""
    along = point / np.linalg.norm(point, axis=1, keepdims=True)
    return np.stack([along, np.stack([-along[:, 1], along[:, 0]], 1)], -1)


def _along_across(point, along, across, both=0.0):
    """Covariances [n, 2, 2] from variances along and across the line of sight."""
    frame = _sight_axes(point)
    inner = np.zeros((len(point), 2, 2))
    inner[:, 0, 0], inner[:, 1, 1] = along, across
    inner[:, 0, 1] = inner[:, 1, 0] = both
    return frame @ inner @ frame.transpose(0, 2, 1)


def _parallax(errors):
    """Covariance [n, 2, 2] for a bearing noise of 1 rad on both rays of a straight drive.

    The second sensor is at the origin, the first one baseline behind. An error of a bearing moves
    the point along the other ray, by range / sin(parallax) per radian.
    """
    first = errors.true + np.column_stack([errors.baseline, np.zeros(len(errors.true))])
    r1, r2 = np.linalg.norm(first, axis=1), np.linalg.norm(errors.true, axis=1)
    u1, u2 = first / r1[:, None], errors.true / r2[:, None]
    sine = u1[:, 0] * u2[:, 1] - u1[:, 1] * u2[:, 0]
    sine = np.where(np.abs(sine) < 1e-4, 1e-4, sine)
    by_b2, by_b1 = (r2 / sine)[:, None] * u1, (r1 / sine)[:, None] * u2
    return by_b2[:, :, None] * by_b2[:, None] + by_b1[:, :, None] * by_b1[:, None]


def _moments(name, values, errors):
    """Mean [n, 2], covariance (or scale) [n, 2, 2] and degrees of freedom of a candidate.

    Geometry is taken at the true points: measured ones too near to the robot would seem sharper.
    """
    zero, at = np.zeros_like(errors.true), errors.true
    if name == "one fitted normal":
        mean_along, mean_across, along, across, slope = values
        mean = (_sight_axes(at) @ np.array([mean_along, mean_across])[:, None])[..., 0]
        both = slope * along
        cov = _along_across(at, along**2, across**2 + slope**2 * along**2, both * along)
        return mean, cov, np.inf
    if name == "propagated normal":
        return zero, values[0] ** 2 * errors.cov, np.inf
    if name == "heavy-tailed":
        return zero, values[0] ** 2 * errors.cov, values[1]
    if name == "bearing normal":
        return zero, values[0] ** 2 * _parallax(errors), np.inf
    square = (at**2).sum(1)  # range-dependent: parallax falls with range
    return zero, _along_across(at, (values[0] * square) ** 2, values[1] ** 2 * square), np.inf


# name: parameters, start values, which of them are positive
CANDIDATES = {
    "one fitted normal": (
        ("mean_along_m", "mean_across_m", "sd_along_m", "sd_across_m", "slope"),
        (0.0, 0.0, 0.1, 0.02, 0.0),
        (False, False, True, True, False),
    ),
    "propagated normal": (("position_scale",), (1.0,), (True,)),
    "bearing normal": (("sigma_bearing_rad",), (0.003,), (True,)),
    "heavy-tailed": (("position_scale", "degrees_of_freedom"), (0.8, 5.0), (True, True)),
    "range-dependent": (("along_per_m", "across_rad"), (0.02, 0.003), (True, True)),
}


def _fit(name, errors):
    """Fit the parameters [p] of a candidate by maximum likelihood."""
    start, positive = map(np.array, CANDIDATES[name][1:])

    def values(free):
        return np.where(positive, np.exp(np.clip(free, -20, 20)), free)

    start = np.where(positive, np.log(np.where(positive, start, 1.0)), start)

    def cost(free):
        return -_log_density(name, values(free), errors).mean()

    limits = {"maxiter": 2000, "xatol": 1e-5, "fatol": 1e-8}
    return values(minimize(cost, start, method="Nelder-Mead", options=limits).x)


def _squared_distance(name, values, errors):
    """Squared distance [n] of the errors in units of a candidate's covariance."""
    mean, cov, _ = _moments(name, values, errors)
    off = errors.point - errors.true - mean
    return (off * np.linalg.solve(cov, off[..., None])[..., 0]).sum(1)


def _log_density(name, values, errors):
    """Log density [n] of the errors: normal, or Student's t with `dof` degrees of freedom."""
    _, cov, dof = _moments(name, values, errors)
    square = _squared_distance(name, values, errors)
    half = -np.linalg.slogdet(cov)[1] / 2 - np.log(2 * np.pi)
    if np.isinf(dof):
        return half - square / 2
    constant = gammaln(dof / 2 + 1) - gammaln(dof / 2) - np.log(dof / 2)
    return half + constant - (dof / 2 + 1) * np.log1p(square / dof)


def _bound95(dof):
    """95 % quantile of the squared distance in two dimensions."""
    return -2 * np.log(0.05) if np.isinf(dof) else dof * (0.05 ** (-2 / dof) - 1)
