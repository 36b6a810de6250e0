"""Refining one lineage: its whole path and map by least squares, its associations checked again.

A particle's past is fixed once its relatives have died out; what it took each measurement for is
usually right all the same. So: solve for path and map with the associations given (`bundle`), then
merge landmarks that turn out to be one, let every measurement choose again, drop landmarks that
too little speaks for (`regroup`), and repeat until nothing changes.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxslam import bundle, chain, regroup

ROUNDS = 10
TRIES = 3  # times that a landmark may enter the map
WIDE, WIDER, NARROW = (8.0, 4.0, 2.0, 1.0), (4.0, 2.0, 1.0), (1.0,)  # kernels: `bundle.fit`


class Refined(NamedTuple):
    """Path and map of one lineage, T frames and L landmarks, in the frame of the log's start pose.

    `pose` [T, 3], `cov` [T, 3, 3]; `id` [L]: frame * K + k of the measurement that began it; `mean`
    [L, 2] m, `landmark_cov` [L, 3] (xx, xy, yy); `n` [L] measurements used; `identity` [L]: index
    of the identity, -1 if hidden. `match` [T, K] as `Result.match`. `cost`: nats. `converged`: the
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
    match: np.ndarray
    rounds: int
    iterations: int
    cost: float
    converged: bool
    merged: int
    dropped: int
    residual: float


def refine(frames, pose, birth, start_pose, start_cov, params, sensor, known=False, progress=None):
    """`Refined` of one lineage: `pose` [T, 3] and `birth` [T, K] (as `filter.Info.birth`).

    `frames`: `frames.Frames` of T frames. `known`: identities say which landmark was measured, and
    `birth` is not used. `start_cov` [3, 3]: zero (or None) where the start is known. `progress` is
    called with (iterations done, cost). Raises `ValueError` for arrays that do not fit.
    """
    shape = np.shape(frames.measurements.valid)
    _check("pose", pose, (shape[0], 3))
    _check("birth", birth, shape)
    with jax.enable_x64(True):
        given, place = bundle.problem(frames, start_pose, start_cov, params, sensor)
        name = frames.measurements.identity if known else birth
        groups = _groups(np.asarray(name).ravel()[place], place, known)
        path = np.vstack([given.start, pose]).astype(float)
        fit, groups, counts = _rounds(given, path, groups, known, progress)
    return _refined(frames, given, fit, groups, place, counts, known)


def _check(name, value, shape):
    if np.shape(value) != shape:
        raise ValueError(f"{name}: shape {np.shape(value)}, must be {shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name}: not all finite")


def _groups(name, place, known):
    """`Groups` of measurements at `place` by name: identities, or births (-1: its own place)."""
    none = name < 0 if known else (name == -2) | (name == -3)
    name = np.where(name == -1, place, name)
    label, first, of = np.unique(name[~none], return_index=True, return_inverse=True)
    group = np.full(len(name), -1)
    group[~none] = of
    label = place[~none][first] if known else label
    return regroup.Groups(group, label, np.full((len(label), 2), np.nan))


def _rounds(given, path, groups, known, progress):
    """Solve and check again until nothing changes: `Fit`, the `Groups` solved for, and counts."""
    widths, done, iterations, merged = WIDE, 0, 0, 0
    tries = np.full(len(groups.label), TRIES)
    groups = _located(given, path, groups, tries)
    while True:
        rows, which = regroup.inside(groups)
        fit = bundle.fit(given, path, groups.point[rows], which, widths, progress)
        path, done, iterations = fit.path, done + 1, iterations + fit.iterations
        groups.point[rows] = fit.points
        after, count = regroup.checked(given, fit, groups, known)
        after = _located(given, path, after, tries)
        settled = np.array_equal(after.of, groups.of) and np.array_equal(
            np.isfinite(after.point), np.isfinite(groups.point)
        )
        if settled or done == ROUNDS:
            counts = dict(rounds=done, iterations=iterations, merged=merged)
            return fit, groups, counts | {"converged": settled and fit.converged}
        merged += count
        widths = WIDER if count else NARROW
        groups = after


def _located(given, path, groups, tries):
    """`regroup.located` of the groups that still have a try: one whose depth is at the limit would
    come and go for ever. Counts `tries` [G] down."""
    after = regroup.located(given, path, groups)
    new = np.isfinite(after.point[:, 0]) & ~np.isfinite(groups.point[:, 0])
    tries[new] -= 1
    return after._replace(point=np.where((new & (tries < 0))[:, None], np.nan, after.point))


def _refined(frames, given, fit, groups, place, counts, known):
    """`Refined` from the last round; points without an inlier or a depth are left out."""
    rows, which = regroup.inside(groups)
    sure = fit.weight > 0.5
    n = np.bincount(which[sure], minlength=len(rows))
    kept = n > 0
    if given.sensor == "bearing":
        kept &= regroup.ripe(given, fit, which)
    cov = fit.factor.points.reshape(len(rows), 2, len(rows), 2)
    every = np.arange(len(rows))
    own = cov[every, :, every][kept]
    identity = np.full(len(groups.label), -1)
    if known:
        identity = np.asarray(frames.measurements.identity).ravel()[groups.label]
    used = (groups.of >= 0) & ((which < 0) | sure)
    label = np.where(used, np.append(groups.label, -2)[groups.of], -2)
    match = np.full(frames.measurements.valid.size, -3)
    match[place] = np.where(label == place, -1, label)
    pose = fit.path[1:].copy()
    pose[:, 2] = (pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return Refined(
        pose=pose,
        cov=chain.pose_covariances(fit.factor)[1:],
        id=groups.label[rows][kept],
        mean=fit.points[kept],
        landmark_cov=np.stack([own[:, 0, 0], own[:, 0, 1], own[:, 1, 1]], 1),
        n=n[kept],
        identity=identity[rows][kept],
        match=match.reshape(frames.measurements.valid.shape),
        cost=fit.cost,
        dropped=len(groups.label) - counts["merged"] - int(kept.sum()),
        residual=fit.residual,
        **counts,
    )
