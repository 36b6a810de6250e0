"""Errors of a run against the log's truth: path, map, pose consistency and data association.

NumPy, float64. Poses are (x, y, heading) in the world frame, metres and radians. The filter starts
at the log's start pose, so unaligned errors are meaningful; aligned ones are reported as well.
"""

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from jaxslam.logs.log import Log
from jaxslam.logs.truth import truth_at, wrap

if TYPE_CHECKING:
    from jaxslam.results.result import Result

GATE = 0.5  # m: largest distance at which an estimated landmark may count as a true one


def align_se2(estimate, truth):
    """Return the motion (x, y, yaw) from `estimate` [T, 2] to `truth` [T, 2] by least squares.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns"
    (PAMI 1991), without scale; in the plane its rotation is a single arctangent.
    """
    centre_e, centre_t = estimate.mean(0), truth.mean(0)
    e, t = estimate - centre_e, truth - centre_t
    yaw = np.arctan2((e[:, 0] * t[:, 1] - e[:, 1] * t[:, 0]).sum(), (e * t).sum())
    shift = centre_t - apply_se2((0.0, 0.0, yaw), centre_e)
    return np.array([*shift, yaw])


def apply_se2(motion, points):
    """Move points [..., 2] by the motion (x, y, yaw)."""
    x, y, yaw = motion
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points) @ np.array([[c, s], [-s, c]]) + np.array([x, y])


def has_truth(truth):
    """Tell which rows [T] of a true path [T, 2 or 3] have a position."""
    return np.isfinite(truth[:, :2]).all(1)


def ate(estimate, truth, align=True):
    """Return the absolute trajectory error (RMSE, maximum), m, over the rows that have truth.

    `estimate`, `truth`: [T, 2 or 3]. `align`: after the best rigid motion, which needs three
    different positions. (NaN, NaN) if it can't be computed.
    """
    have = has_truth(truth)
    estimate, truth = estimate[have, :2], truth[have, :2]
    if not have.any() or (align and not alignable(truth)):
        return np.nan, np.nan
    if align:
        estimate = apply_se2(align_se2(estimate, truth), estimate)
    distance = np.hypot(*(estimate - truth).T)
    return float(np.sqrt(np.mean(distance**2))), float(distance.max())


def alignable(points):
    """Tell whether points [T, 2] overdetermine a rigid motion."""
    return len(points) >= 3 and bool(np.ptp(points, 0).max() > 1e-6)


def rpe(estimate, truth, distance=1.0, time=None, seconds=None):
    """Return the relative pose error (m, rad), RMSE over pieces of the path [T, 3] of one length.

    Pieces are `distance` metres along the true path or, with `time` (int64 ns) and `seconds`, of
    that duration. They start every tenth of it, so that a standing robot does not count more.
    Pieces more than a fifth too long (truth was missing) are left out. (NaN, NaN) without pieces.
    """
    have = np.isfinite(truth).all(1)
    estimate, truth = estimate[have, :3], truth[have]
    if have.sum() < 2:
        return np.nan, np.nan
    if seconds is None:
        length = distance
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T)))
    else:
        length, along = seconds, (time[have] - time[have][0]) / 1e9
    start = np.unique(np.searchsorted(along, np.arange(0.0, along[-1], length / 10)))
    end = np.searchsorted(along, along[start] + length * (1 - 1e-9))
    start, end = start[end < along.size], end[end < along.size]
    good = along[end] - along[start] <= 1.2 * length
    start, end = start[good], end[good]
    if start.size == 0:
        return np.nan, np.nan
    error = relative_pose(estimate[start], estimate[end]) - relative_pose(truth[start], truth[end])
    squares = (error[:, :2] ** 2).sum(1), wrap(error[:, 2]) ** 2
    return float(np.sqrt(np.mean(squares[0]))), float(np.sqrt(np.mean(squares[1])))


def relative_pose(a, b):
    """Return poses b [T, 3] in the frames of poses a [T, 3]."""
    dx, dy = (b - a)[:, 0], (b - a)[:, 1]
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrap(b[:, 2] - a[:, 2])], 1)


def nees(pose, cov, truth, resolution=0.0):
    """Return the normalised estimation error squared [T] of poses [T, 3], covariances [T, 3, 3].

    Chi-squared with 3 degrees of freedom if the filter is consistent. NaN where there is no truth
    or the covariance is singular. `resolution` of the truth, m, adds its variance of rounding.
    """
    cov = np.asarray(cov, float) + np.diag([resolution**2 / 12, resolution**2 / 12, 0.0])
    error = pose - truth
    error[:, 2] = wrap(error[:, 2])
    sd = np.sqrt(np.einsum("tii->ti", cov))
    result = np.full(len(pose), np.nan)
    # Scaled to correlations, so that "singular" does not depend on units.
    good = np.isfinite(error).all(1) & np.isfinite(cov).all((1, 2)) & (sd > 0).all(1)
    z = error[good] / sd[good]
    correlation = cov[good] / (sd[good][:, :, None] * sd[good][:, None, :])
    regular = np.linalg.det(correlation) > 1e-9
    solved = np.linalg.solve(correlation[regular], z[regular][:, :, None])[:, :, 0]
    result[np.flatnonzero(good)[regular]] = (z[regular] * solved).sum(1)
    return result


def landmark_gate(landmarks):
    """Return min(0.5 m, half the smallest distance of the true landmarks [L, 2])."""
    gap = np.hypot(*(landmarks[:, None] - landmarks[None]).transpose(2, 0, 1))
    return float(min(GATE, np.where(gap > 0, gap, np.inf).min(initial=np.inf) / 2))


def pair_by_identity(identity, landmark_id):
    """Return rows (estimated, true) of equal identity, the first estimate of each."""
    first = {int(i): row for row, i in reversed(list(enumerate(identity))) if i >= 0}
    pairs = [(first[int(i)], row) for row, i in enumerate(landmark_id) if int(i) in first]
    return np.array(pairs, int).reshape(-1, 2)


def pair_by_distance(mean, landmarks, gate):
    """Return rows (estimated, true) of the best one-to-one pairs of points within `gate` metres."""
    if len(mean) == 0 or len(landmarks) == 0:
        return np.zeros((0, 2), int)
    gap = np.hypot(*(mean[:, None] - landmarks[None]).transpose(2, 0, 1))
    near = gap <= gate
    # A pair outside the gate costs more than all pairs inside it.
    cost = np.where(near, gap**2, (1 + min(gap.shape)) * max(gate, 1e-9) ** 2)
    rows, columns = linear_sum_assignment(cost)
    return np.stack([rows, columns], 1)[near[rows, columns]]


def map_error(mean, identity, truth, motion=None):
    """Return errors of a map [L, 2]: rmse_m, matched, missed, spurious, gate_m.

    Known identities (any >= 0, and in the truth) pair by identity, without gate_m; unknown ones
    one-to-one within the gate. `motion`: an alignment (x, y, yaw) applied first.
    """
    landmarks = np.asarray(truth.landmarks, float)
    mean = np.asarray(mean, float).reshape(-1, 2)
    if motion is not None:
        mean = apply_se2(motion, mean)
    known = truth.landmark_id is not None and (np.asarray(identity) >= 0).any()
    gate = None if known else landmark_gate(landmarks)
    if known:
        pairs = pair_by_identity(identity, truth.landmark_id)
    else:
        pairs = pair_by_distance(mean, landmarks, gate)
    n = len(pairs)
    errors: dict = dict(matched=n, missed=len(landmarks) - n, spurious=len(mean) - n)
    if n:
        error = mean[pairs[:, 0]] - landmarks[pairs[:, 1]]
        errors["rmse_m"] = float(np.sqrt(np.mean((error**2).sum(1))))
    return errors if known else errors | {"gate_m": gate}


def association_accuracy(result, log=None, landmark_id=None):
    """Return the share of correct matches of measurements of known origin; NaN if there are none.

    A match with a landmark is correct if the measurement that began it was of the same true
    landmark; "new" if that was not called new before; "clutter" if the true identity is -1. Without
    true identities the measured ones serve, and -1 does not count. `landmark_id` [T, K]: None for
    the filter's.
    """
    log = result.log if log is None else log
    identity = None if log.truth is None else log.truth.identity
    clutter_known = identity is not None
    identity = log.identity if identity is None else identity
    if identity is None or len(identity) == 0:
        return np.nan
    row = np.asarray(result.row).ravel()
    landmark_id = result.landmark_id if landmark_id is None else landmark_id
    landmark_id = np.asarray(landmark_id).ravel()
    true = np.where(row >= 0, np.asarray(identity)[row.clip(0)], -1)
    counted = (landmark_id >= -2) & (row >= 0) & ((true >= 0) | clutter_known)
    # A landmark's id is the flat index (frame * K + k) of the measurement that began it.
    correct = (landmark_id >= 0) & (true >= 0) & (true[landmark_id.clip(0)] == true)
    new = np.flatnonzero((landmark_id == -1) & (row >= 0) & (true >= 0))
    correct[new[np.unique(true[new], return_index=True)[1]]] = True
    correct |= (landmark_id == -2) & (true < 0)
    return float(correct[counted].mean()) if counted.any() else np.nan


def compute_errors(result: "Result", log: Log | None = None) -> dict[str, float | int]:
    """Compute the errors of a run for `summary.json`, as far as the log has truth for them.

    `log`: the log with the truth, if that is not the result's.
    """
    log = result.log if log is None else log
    errors = {"association_accuracy": association_accuracy(result, log)}
    if result.refined is not None:
        refined_accuracy = association_accuracy(result, log, result.refined.landmark_id)
        errors["association_accuracy_refined"] = refined_accuracy
    if log.truth is not None:
        true = truth_at(log.truth, result.time)
        if has_truth(true).any():
            errors |= path_errors(result, true, log.truth.resolution)
        if log.truth.landmarks is not None and len(log.truth.landmarks):
            errors |= landmark_errors(result, log.truth, true)
    return {key: value for key, value in errors.items() if np.isfinite(value)}


def path_estimates(result):
    """Return the paths [T, 3] of a run by name: filtered, ancestral, refined, dead_reckoning."""
    smoothed = {"ancestral": result.ancestral, "refined": result.refined}
    smoothed = {name: table.pose for name, table in smoothed.items() if table is not None}
    return {"filtered": result.pose, **smoothed, "dead_reckoning": result.dead_reckoning}


def path_errors(result, true, resolution):
    """Compute the errors that need true poses [T, 3]."""
    errors = {"truth_frames": int(has_truth(true).sum())}
    if resolution > 0.1:  # too coarse for errors per metre
        errors["truth_resolution_m"] = float(resolution)
    for name, path in path_estimates(result).items():
        errors |= _path_errors(name, path, true, resolution)
    errors |= _consistency("nees", result, true, resolution)
    return errors | _consistency("nees_refined", result.refined, true, resolution)


def _path_errors(name, path, true, resolution):
    """Compute errors of one path [T, 3], by their names in summary.json."""
    estimated = name != "dead_reckoning"
    start, rmse = (f"ate_{name}", "rmse_m") if estimated else (f"{name}_ate", "m")
    errors = dict(zip((f"{start}_{rmse}", f"{start}_max_m"), ate(path, true), strict=True))
    rmse, most = ate(path, true, align=False)
    errors |= {f"{start}_unaligned_rmse_m": rmse, f"{start}_unaligned_max_m": most}
    last = np.flatnonzero(has_truth(true))[-1]
    errors[f"{name}_end_m"] = float(np.hypot(*(path - true)[last, :2]))
    heading = wrap(path[:, 2] - true[:, 2])
    if estimated and np.isfinite(heading).any():
        errors[f"heading_{name}_rmse_rad"] = float(np.sqrt(np.nanmean(heading**2)))
    if resolution <= 0.1:
        start = "" if name == "filtered" else f"{name}_"
        errors[f"{start}rpe_1m_m"], errors[f"{start}rpe_1m_rad"] = rpe(path, true)
    return errors


def _consistency(name, estimate, true, resolution):
    """Compute median NEES and share of frames in the 99 % region, if there are any."""
    squared = np.zeros(0)
    if estimate is not None:
        squared = nees(estimate.pose, estimate.cov, true, resolution)
        squared = squared[np.isfinite(squared)]
    if not squared.size:
        return {}
    within = float(np.mean(squared <= chi2.ppf(0.99, 3)))
    return {f"{name}_median": float(np.median(squared)), f"{name}_within_99": within}


def landmark_errors(result, truth, true):
    """Compute the errors that need true landmarks; each map is aligned as its path [T, 3] is."""
    maps = [("filtered", "landmarks", result.pose, result.landmarks)]
    if result.refined is not None:
        maps += [("refined", "landmarks_refined", result.refined.pose, result.landmarks_refined)]
    have, errors = has_truth(true), {}
    for name, counts, path, landmarks in maps:
        motions = {"_unaligned": None}
        if alignable(true[have, :2]):
            motions[""] = align_se2(path[have, :2], true[have, :2])
        for kind, motion in motions.items():
            error = map_error(landmarks.mean, landmarks.identity, truth, motion)
            errors[f"landmark_{name}{kind}_rmse_m"] = error.get("rmse_m", np.nan)
            errors["landmark_gate_m"] = error.get("gate_m", np.nan)
            for count in ("matched", "missed", "spurious"):
                errors[f"{counts}{kind}_{count}"] = error[count]
    return errors
