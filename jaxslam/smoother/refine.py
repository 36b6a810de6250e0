"""Refining one lineage: its whole path and map by least squares, its associations checked again.

A particle's past is fixed once its relatives have died out; what it took each measurement for is
usually right all the same. So: solve for path and map with the associations given (`bundle`), then
merge landmarks that turn out to be one, let every measurement choose again, drop landmarks that
too little speaks for (`regroup`), and repeat until nothing changes.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxslam.smoother import least_squares, normal_equations, reassociation

ROUNDS, ROUNDS_AGAIN = 10, 3
MISTAKEN = 1e-4  # probability, at least, that a measurement was taken for the wrong landmark
TRIES = 3  # times that a landmark may enter the map
LARGE = 40_000_000  # frames times landmarks, from which on those seen once are left out
WIDE, WIDER, NARROW = (8.0, 4.0, 2.0, 1.0), (4.0, 2.0, 1.0), (1.0,)  # kernels: `bundle.fit`


class Refined(NamedTuple):
    """Path and map of one lineage, T frames and L landmarks, in the frame of the log's start pose.

    `pose` [T, 3], `cov` [T, 3, 3]; `id` [L]: frame * K + k of the measurement that began it; `mean`
    [L, 2] m, `landmark_cov` [L, 3] (xx, xy, yy); `n` [L] measurements used; `identity` [L]: index
    of the identity, -1 if hidden. `landmark_id` [T, K] as `Result.landmark_id`. `cost`: nats. `converged`: the
    last solution is at rest and its associations are too. `merged`: landmarks that were another
    one; `dropped`: that had too few measurements or no depth. `residual`: root mean square of the
    inliers' standardised residuals. Covariances are those for the associations made.
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

    @property
    def match(self):
        """`landmark_id` by its name of version 0.1."""
        return self.landmark_id


class Solved(NamedTuple):
    """`bundle.Fit` of the last round and the `regroup.Groups` it is of; `merged`: pairs of labels,
    a landmark and what it was merged with; `converged` as in `Refined`."""

    fit: least_squares.Fit
    groups: reassociation.Groups
    merged: list
    rounds: int
    iterations: int
    converged: bool


def refine(
    frames, pose, landmark_id, start_pose, start_cov, params, sensor, known=False, progress=None
):
    """`Refined` of one lineage: `pose` [T, 3] and `landmark_id` [T, K] (as `filter.Info.landmark_id`).

    `frames`: `frames.Frames` of T frames. `known`: identities say which landmark was measured, and
    `landmark_id` is not used. `start_cov` [3, 3]: zero (or None) where the start is known. `progress` is
    called with (iterations done, cost). Raises `ValueError` for arrays that do not fit.
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
        name = identity[flat_index] if known else np.asarray(landmark_id).ravel()[flat_index]
        found = solve_and_reassociate(problem, flat_index, pose, name, known, progress=progress)
    return _to_refined(found, problem, flat_index, shape, identity if known else None)


def allow_mistakes(params):
    """The parameters where identities are hidden: a measurement may be of something else, even of a
    sensor that has no clutter."""
    return params._replace(outlier=max(float(params.outlier), MISTAKEN))


def _check(name, value, shape):
    if np.shape(value) != shape:
        raise ValueError(f"{name}: shape {np.shape(value)}, must be {shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name}: not all finite")


def _group_measurements(name, flat_index, known):
    """`Groups` of measurements at `flat_index` by name: identities, or births (-1: its own place)."""
    none = name < 0 if known else (name == -2) | (name == -3)
    name = np.where(name == -1, flat_index, name)
    label, first, of = np.unique(name[~none], return_index=True, return_inverse=True)
    group = np.full(len(name), -1)
    group[~none] = of
    label = flat_index[~none][first] if known else label
    return reassociation.Groups(group, label, np.full((len(label), 2), np.nan))


def _drop_single_measurements(groups):
    """`Groups` without those of one measurement, which tell nothing of the path: where much is
    clutter, or the map was full, they are far more than the rest, and matrices of all of them would
    not fit."""
    again = (
        np.bincount(groups.assignment[groups.assignment >= 0], minlength=len(groups.landmark_id))
        > 1
    )
    number = np.append(np.where(again, np.cumsum(again) - 1, -1), -1)
    return reassociation.Groups(
        number[groups.assignment], groups.landmark_id[again], groups.point[again]
    )


def solve_and_reassociate(problem, flat_index, pose, name, known, again=False, progress=None):
    """Solve and check again until nothing changes: `Solved`.

    `flat_index` [M]: of the measurements, as `bundle.problem` has it; `pose` [T, 3]; `name` [M]: their
    identities if they are `known`, else their landmarks' births. `again`: most of it was refined
    before and will be again, so fewer rounds will do, and landmarks may yet earn their place.
    """
    widths, most = (NARROW, ROUNDS_AGAIN) if again else (WIDE, ROUNDS)
    groups = _group_measurements(name, flat_index, known)
    if not known and len(pose) * len(groups.landmark_id) > LARGE:
        groups = _drop_single_measurements(groups)
    path = np.vstack([problem.start, pose]).astype(float)
    done, iterations, merged = 0, 0, []
    tries = np.full(len(groups.landmark_id), TRIES)
    groups = _locate(problem, path, groups, tries)
    while True:
        rows, which = reassociation.index_mapped(groups)
        fit = least_squares.solve(problem, path, groups.point[rows], which, widths, progress)
        path, done, iterations = fit.path, done + 1, iterations + fit.iterations
        groups.point[rows] = fit.points
        after, pairs = reassociation.check_groups(problem, fit, groups, known, not again)
        after = _locate(problem, path, after, tries)
        settled = np.array_equal(after.assignment, groups.assignment) and np.array_equal(
            np.isfinite(after.point), np.isfinite(groups.point)
        )
        if settled or done == most:
            converged = bool(settled and fit.converged)
            return Solved(fit, groups, merged, done, iterations, converged)
        merged += pairs
        widths = WIDER if pairs else NARROW
        groups = after


def _locate(problem, path, groups, tries):
    """`regroup.located` of the groups that still have a try: one whose depth is at the limit would
    come and go for ever. Counts `tries` [G] down."""
    after = reassociation.locate(problem, path, groups)
    new = np.isfinite(after.point[:, 0]) & ~np.isfinite(groups.point[:, 0])
    tries[new] -= 1
    return after._replace(point=np.where((new & (tries < 0))[:, None], np.nan, after.point))


def landmark_ids(found, flat_index, shape):
    """What each measurement was taken for [T, K] (`shape`), as `Result.landmark_id`; where the landmark
    has no depth yet, its label all the same."""
    groups = found.groups
    _, which = reassociation.index_mapped(groups)
    used = (groups.assignment >= 0) & ((which < 0) | (found.fit.weight > 0.5))
    label = np.where(used, np.append(groups.landmark_id, -2)[groups.assignment], -2)
    landmark_id = np.full(shape, -3).ravel()
    landmark_id[flat_index] = np.where(label == flat_index, -1, label)
    return landmark_id.reshape(shape)


def _to_refined(found, problem, flat_index, shape, identities):
    """`Refined` from the last round; points without an inlier or a depth are left out."""
    fit, groups = found.fit, found.groups
    rows, which = reassociation.index_mapped(groups)
    sure = fit.weight > 0.5
    n = np.bincount(which[sure], minlength=len(rows))
    kept = n > 0
    if problem.sensor == "bearing":
        kept &= reassociation.has_depth(problem, fit, which)
    cov = fit.factor.points.reshape(len(rows), 2, len(rows), 2)
    every = np.arange(len(rows))
    own = cov[every, :, every][kept]
    identity = np.full(len(groups.landmark_id), -1)
    if identities is not None:
        identity = identities[groups.landmark_id]
    pose = fit.path[1:].copy()
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return Refined(
        pose=pose,
        cov=normal_equations.pose_covariances(fit.factor)[1:],
        id=groups.landmark_id[rows][kept],
        mean=fit.points[kept],
        landmark_cov=np.stack([own[:, 0, 0], own[:, 0, 1], own[:, 1, 1]], 1),
        n=n[kept],
        identity=identity[rows][kept],
        landmark_id=landmark_ids(found, flat_index, shape),
        rounds=found.rounds,
        iterations=found.iterations,
        cost=fit.cost,
        converged=found.converged,
        merged=len(found.merged),
        dropped=len(groups.landmark_id) - len(found.merged) - int(kept.sum()),
        residual=fit.residual,
    )
