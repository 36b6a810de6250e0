"""Refinement of one lineage: least squares over its path and map, alternating with reassociation.

The filter never revises a particle's path, but its associations are usually right. So: solve for
path and map with the associations given (`least_squares`), then merge landmarks that coincide, let
every measurement choose again, drop landmarks with too little evidence (`reassociation`), and
repeat until nothing changes.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxslam.smoother import least_squares, normal_equations, reassociation

ROUNDS, ROUNDS_AGAIN = 10, 3
MISTAKEN = 1e-4  # least probability that a measurement is of another landmark
TRIES = 3  # how often a landmark may enter the map
LARGE = 40_000_000  # frames times landmarks above which those measured once are left out
WIDE, WIDER, NARROW = (8.0, 4.0, 2.0, 1.0), (4.0, 2.0, 1.0), (1.0,)  # kernels


class Refined(NamedTuple):
    """Path and map of one lineage, T frames and L landmarks, in the frame of the log's start pose.

    `pose` [T, 3], `cov` [T, 3, 3]; `id` [L]: frame * K + k of the measurement that began it; `mean`
    [L, 2] m, `landmark_cov` [L, 3] (xx, xy, yy); `n` [L] measurements used; `identity` [L]: index
    of the identity, -1 if hidden. `landmark_id` [T, K] as in `Result`. `cost`: nats. `converged`:
    solution and associations no longer change. `merged`: number of landmarks merged into others;
    `dropped`: of those with too few measurements or no depth. `residual`: root mean square of the
    inliers' whitened residuals. Covariances take the associations as certain.
    """

    pose: np.ndarray
    cov: np.ndarray
    id: np.ndarray
    mean: np.ndarray
    landmark_cov: np.ndarray
    n: np.ndarray
    identity: np.ndarray
    landmark_id: np.ndarray
    rounds: int
    iterations: int
    cost: float
    converged: bool
    merged: int
    dropped: int
    residual: float

    def __repr__(self):
        return f"Refined({len(self.pose)} frames, {len(self.id)} landmarks)"

    @property
    def match(self):
        """`landmark_id` by its name of version 0.1."""
        return self.landmark_id


class Solved(NamedTuple):
    """The `fit` of the last round, with its `groups`; `merged`: pairs of landmark ids (merged, and
    merged into); `converged` as in `Refined`."""

    fit: least_squares.Fit
    groups: reassociation.Groups
    merged: list
    rounds: int
    iterations: int
    converged: bool


def refine(
    frames, pose, landmark_id, start_pose, start_cov, params, sensor, known=False, progress=None
):
    """Refine one lineage, `pose` [T, 3] and `landmark_id` [T, K] (as in `step.Info`): `Refined`.

    `frames`: `Frames` of T frames. `known`: landmarks are those of the log's identities, and
    `landmark_id` is not used. `start_cov` [3, 3]: zero (or None) where the start is known.
    `progress` is called with (iterations done, cost). Raises `ValueError` for arrays of wrong shape
    or with values that are not finite.
    """
    shape = np.shape(frames.measurements.valid)
    _check("pose", pose, (shape[0], 3))
    _check("landmark_id", landmark_id, shape)
    identity = np.asarray(frames.measurements.identity).ravel()
    with jax.enable_x64(True):
        params = params if known else allow_mistakes(params)
        problem, flat_index = least_squares.make_problem(
            frames, start_pose, start_cov, params, sensor
        )
        measured = identity if known else np.asarray(landmark_id).ravel()
        found = solve_and_reassociate(
            problem, flat_index, pose, measured[flat_index], known, progress=progress
        )
    return _to_refined(found, problem, flat_index, shape, identity if known else None)


def allow_mistakes(params):
    """The parameters for unknown data association: a measurement may be of another landmark, even
    if the sensor has no clutter."""
    return params._replace(outlier=max(float(params.outlier), MISTAKEN))


def _check(name, value, shape):
    if np.shape(value) != shape:
        raise ValueError(f"{name}: shape {np.shape(value)}, must be {shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name}: not all finite")


def _group_measurements(measured, flat_index, known):
    """Group the measurements by what is `measured` [M]: identities, or landmark ids (-1: a new
    landmark, whose id is the measurement's flat index)."""
    none = measured < 0 if known else (measured == -2) | (measured == -3)
    measured = np.where(measured == -1, flat_index, measured)
    landmark_id, first, group = np.unique(measured[~none], return_index=True, return_inverse=True)
    assignment = np.full(len(measured), -1)
    assignment[~none] = group
    landmark_id = flat_index[~none][first] if known else landmark_id
    return reassociation.Groups(assignment, landmark_id, np.full((len(landmark_id), 2), np.nan))


def _drop_single_measurements(groups):
    """`Groups` without those of a single measurement, which do not constrain the path: with much
    clutter, or when the map was full, they are so many that the matrices would not fit."""
    again = (
        np.bincount(groups.assignment[groups.assignment >= 0], minlength=len(groups.landmark_id))
        > 1
    )
    number = np.append(np.where(again, np.cumsum(again) - 1, -1), -1)
    return reassociation.Groups(
        number[groups.assignment], groups.landmark_id[again], groups.point[again]
    )


def solve_and_reassociate(problem, flat_index, pose, measured, known, again=False, progress=None):
    """Solve and reassociate until nothing changes: `Solved`.

    `flat_index` [M] as from `make_problem`; `pose` [T, 3]; `measured` [M]: identities if they are
    `known`, else landmark ids. `again`: for rejuvenation, where most of the path was refined before
    and will be again: fewer rounds, and landmarks need not be confirmed yet.
    """
    widths, most = (NARROW, ROUNDS_AGAIN) if again else (WIDE, ROUNDS)
    groups = _group_measurements(measured, flat_index, known)
    if not known and len(pose) * len(groups.landmark_id) > LARGE:
        groups = _drop_single_measurements(groups)
    path = np.vstack([problem.start, pose]).astype(float)
    rounds, iterations, merged = 0, 0, []
    tries = np.full(len(groups.landmark_id), TRIES)
    groups = _locate(problem, path, groups, tries)
    while True:
        mapped, which = reassociation.index_mapped(groups)
        fit = least_squares.solve(problem, path, groups.point[mapped], which, widths, progress)
        path, rounds, iterations = fit.path, rounds + 1, iterations + fit.iterations
        groups.point[mapped] = fit.points
        after, pairs = reassociation.check_groups(problem, fit, groups, known, not again)
        after = _locate(problem, path, after, tries)
        unchanged = np.array_equal(after.assignment, groups.assignment) and np.array_equal(
            np.isfinite(after.point), np.isfinite(groups.point)
        )
        if unchanged or rounds == most:
            converged = bool(unchanged and fit.converged)
            return Solved(fit, groups, merged, rounds, iterations, converged)
        merged += pairs
        widths = WIDER if pairs else NARROW
        groups = after


def _locate(problem, path, groups, tries):
    """`reassociation.locate` for groups with `tries` [G] left, which it counts down: a landmark of
    barely sufficient depth would enter and leave the map forever."""
    after = reassociation.locate(problem, path, groups)
    new = np.isfinite(after.point[:, 0]) & ~np.isfinite(groups.point[:, 0])
    tries[new] -= 1
    return after._replace(point=np.where((new & (tries < 0))[:, None], np.nan, after.point))


def landmark_ids(found, flat_index, shape):
    """Landmark id of each measurement [T, K] (`shape`), as in `Result`, also of landmarks that have
    no depth yet."""
    groups = found.groups
    _, which = reassociation.index_mapped(groups)
    used = (groups.assignment >= 0) & ((which < 0) | (found.fit.weight > 0.5))
    measured = np.where(used, np.append(groups.landmark_id, -2)[groups.assignment], -2)
    landmark_id = np.full(shape, -3).ravel()
    landmark_id[flat_index] = np.where(measured == flat_index, -1, measured)
    return landmark_id.reshape(shape)


def _to_refined(found, problem, flat_index, shape, identities):
    """Build `Refined` from the last round, without points that have no inlier or no depth."""
    fit, groups = found.fit, found.groups
    mapped, which = reassociation.index_mapped(groups)
    sure = fit.weight > 0.5
    n = np.bincount(which[sure], minlength=len(mapped))
    kept = n > 0
    if problem.sensor == "bearing":
        kept &= reassociation.has_depth(problem, fit, which)
    cov = fit.factor.points.reshape(len(mapped), 2, len(mapped), 2)
    every = np.arange(len(mapped))
    own = cov[every, :, every][kept]
    identity = np.full(len(groups.landmark_id), -1)
    if identities is not None:
        identity = identities[groups.landmark_id]
    pose = fit.path[1:].copy()
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return Refined(
        pose=pose,
        cov=normal_equations.pose_covariances(fit.factor)[1:],
        id=groups.landmark_id[mapped][kept],
        mean=fit.points[kept],
        landmark_cov=np.stack([own[:, 0, 0], own[:, 0, 1], own[:, 1, 1]], 1),
        n=n[kept],
        identity=identity[mapped][kept],
        landmark_id=landmark_ids(found, flat_index, shape),
        rounds=found.rounds,
        iterations=found.iterations,
        cost=fit.cost,
        converged=found.converged,
        merged=len(found.merged),
        dropped=len(groups.landmark_id) - len(found.merged) - int(kept.sum()),
        residual=fit.residual,
    )
