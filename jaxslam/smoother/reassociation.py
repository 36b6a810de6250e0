"""Reassociation: which measurements are of one landmark, checked against a refined path and map.

The refined path and map are taken as given, except that two halves of one landmark, measured at
different times, are compared under their joint covariance.
"""

from typing import NamedTuple

import numpy as np

from jaxslam.models import sensors
from jaxslam.smoother import least_squares

MOST_DISTANCE = 9.2  # squared Mahalanobis, between two halves (0.99, chi-squared of 2)
STAY = 1.0  # nats by which another landmark must be better: near ties would alternate
NEAR = 0.5  # m between two halves of one landmark
MOST_TOGETHER = 0.02  # fraction of the rarer half's frames that may show both halves
LEAST_DEPTH = 3.0  # distance of a bearing-only landmark, in standard deviations of its position
SWEEPS = 10  # of reweighting in triangulation
BEYOND = 1.5  # times the declared view range, the limit of a measurement: depths err
CAUCHY = 4.0  # scale, in standard deviations, of a bearing's density in triangulation


class Groups(NamedTuple):
    """G landmarks with M measurements: `assignment` [M], the group of each measurement (-1: none);
    `landmark_id` [G]; world `point` [G, 2], NaN while it is not in the map."""

    assignment: np.ndarray
    landmark_id: np.ndarray
    point: np.ndarray


def index_mapped(groups):
    """Index the map: its groups [L], and the index in the map [M] of every measurement's landmark
    (-1: none)."""
    mapped = np.flatnonzero(np.isfinite(groups.point[:, 0]))
    index = np.full(len(groups.landmark_id) + 1, -1)
    index[mapped] = np.arange(len(mapped))
    return mapped, index[groups.assignment]


def locate(problem, path, groups):
    """Triangulate the groups without a point, where possible."""
    missing = ~np.isfinite(groups.point[:, 0])
    if not missing.any():
        return groups
    locate_all = _from_bearings if problem.sensor == "bearing" else _from_points
    point = locate_all(problem, _sensor_poses(problem, path), groups)
    return groups._replace(point=np.where(missing[:, None], point, groups.point))


def check_groups(problem, fit, groups, known, confirmed=True):
    """Merge, drop and choose landmarks by the refined map: the groups, and pairs of landmark ids
    (merged, and merged into).

    With known identities only landmarks of uncertain depth are dropped. `confirmed`: landmarks need
    the log-odds of existence of a final map, else only above 0.
    """
    mapped, which = index_mapped(groups)
    keep = np.ones(len(mapped), bool)
    merged = []
    if not known:
        seen = frames_seen(problem, fit, which)
        into = _merge_halves(problem, fit, which, seen)
        less = np.flatnonzero(into != np.arange(len(mapped)))
        pairs = groups.landmark_id[mapped[less]], groups.landmark_id[mapped[into[less]]]
        merged = [(int(a), int(b)) for a, b in zip(*pairs, strict=True)]
        if merged:  # solve again before anything is judged by their points, each of one half
            which = np.where(which >= 0, into[which], -1)
            keep = into == np.arange(len(mapped))
        else:
            keep = existence(problem, fit, seen) >= (
                problem.params.existence_confirm if confirmed else 0
            )
            which = np.where(groups.assignment == -1, -1, which)
            which = _choose_landmarks(
                problem, fit, which, keep, free=(which >= 0) | (groups.assignment == -1)
            )
    if problem.sensor == "bearing":
        keep &= has_depth(problem, fit, which) | bool(merged)
    waiting = (groups.assignment >= 0) & (index_mapped(groups)[1] < 0)
    point = groups.point.copy()
    point[mapped[~keep]] = np.nan
    assignment = groups.assignment
    if not known:
        assignment = np.where(waiting, assignment, np.append(mapped, -1)[which])
    return Groups(assignment, groups.landmark_id, point), merged


def has_depth(problem, fit, which):
    """Test which points [L] have a depth: large against their uncertainty given the path."""
    used = which >= 0
    away = _sensor_poses(problem, fit.path)[used, :2] - fit.points[which[used]]
    count = np.maximum(np.bincount(which[used], minlength=len(fit.points)), 1)
    distance = np.bincount(which[used], np.hypot(*away.T), len(fit.points)) / count
    least = np.linalg.eigvalsh(fit.information)[:, 0]
    return np.sqrt(np.maximum(least, 0)) * distance > LEAST_DEPTH


def _sensor_poses(problem, path):
    """The sensor's pose [M, 3] at each measurement."""
    return least_squares.sensor_poses(path[problem.frame + 1], problem.params)


def _from_points(problem, sensor_pose, groups):
    """Medians [G, 2] of the points that the measurements of a group give."""
    x, y, heading = sensor_pose.T
    c, s = np.cos(heading), np.sin(heading)
    if problem.sensor == "position":
        px, py = problem.value.T
    else:
        px, py = problem.value[:, 0] * np.array(
            [np.cos(problem.value[:, 1]), np.sin(problem.value[:, 1])]
        )
    world = np.stack([x + c * px - s * py, y + s * px + c * py], 1)
    order = np.argsort(groups.assignment, kind="stable")
    first = np.searchsorted(groups.assignment[order], np.arange(len(groups.landmark_id) + 1))
    point = np.full((len(groups.landmark_id), 2), np.nan)
    for i in np.flatnonzero(np.diff(first)):
        point[i] = np.median(world[order[first[i] : first[i + 1]]], axis=0)
    return point


def _from_bearings(problem, sensor_pose, groups):
    """Points [G, 2] closest in angle to their lines of sight; NaN without a depth.

    Linear least squares of the distances from the lines, reweighted by range and, for robustness,
    as for a Cauchy density.
    """
    used, size = groups.assignment >= 0, len(groups.landmark_id)
    group, sensor = groups.assignment[used], sensor_pose[used, :2]
    angle = sensor_pose[used, 2] + problem.value[used, 0]
    along = np.stack([np.cos(angle), np.sin(angle)], 1)
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    offset = np.sum(across * sensor, 1)
    weight = problem.tempering[used]
    for _ in range(SWEEPS):
        matrix = least_squares.segment_sums(
            group, weight[:, None, None] * across[:, :, None] * across[:, None], size
        )
        right = least_squares.segment_sums(group, (weight * offset)[:, None] * across, size)
        least, total = np.linalg.eigvalsh(matrix)[:, 0], np.trace(matrix, axis1=1, axis2=2)
        open_ = least < 1e-9 * np.maximum(total, 1e-300)
        point = np.linalg.solve(matrix + open_[:, None, None] * np.eye(2), right[:, :, None])[
            ..., 0
        ]
        away = point[group] - sensor
        ahead, aside = np.sum(along * away, 1), np.sum(across * away, 1)
        range_ = np.maximum(np.hypot(ahead, aside), 0.05)
        variance = sensors.bearing_variance(range_, problem.params)
        square = np.arctan2(aside, ahead) ** 2 / variance
        weight = problem.tempering[used] / (range_**2 * variance * (1 + square / CAUCHY**2))
    count = np.maximum(np.bincount(group, minlength=size), 1)
    distance = np.bincount(group, range_, size) / count
    front = np.bincount(group, ahead > 0, size) > count / 2
    good = ~open_ & front & (np.sqrt(np.maximum(least, 0)) * distance > LEAST_DEPTH)
    return np.where(good[:, None], point, np.nan)


def frames_seen(problem, fit, which):
    """Frames in which each point was measured [T, L]."""
    sure = fit.weight > 0.5
    seen = np.zeros((len(fit.path) - 1, len(fit.points)), bool)
    seen[problem.frame[sure], which[sure]] = True
    return seen


def _merge_halves(problem, fit, which, seen):
    """The point that each point [L] becomes: itself, or its other half, measured more often.

    The noise of one measurement is added to the joint covariance: halves that one measurement could
    not distinguish are not kept apart by errors that are correlated.
    """
    size = len(fit.points)
    into = np.arange(size)
    off = fit.points[:, None] - fit.points[None]
    cov = fit.factor.points.reshape(size, 2, size, 2).transpose(0, 2, 1, 3)
    own = cov[into, into]
    number = np.bincount(which[which >= 0], (fit.weight * problem.tempering)[which >= 0], size)
    each = fit.information / np.maximum(number, 1e-12)[:, None, None]
    once = 2 * np.linalg.inv(each[:, None] + each[None])
    spread = own[:, None] + own[None] - cov - cov.transpose(0, 1, 3, 2) + once
    square = np.einsum("ija,ija->ij", off, np.linalg.solve(spread, off[..., None])[..., 0])
    count = seen.sum(0)
    both = seen.T.astype(float) @ seen
    rare = both <= MOST_TOGETHER * np.minimum(count[:, None], count[None])
    pair = rare & (square < MOST_DISTANCE) & (np.hypot(*off.transpose(2, 0, 1)) < NEAR)
    i, j = np.nonzero(np.triu(pair, 1))
    merged = np.zeros(size, bool)
    for k in np.argsort(square[i, j], kind="stable"):
        a, b = i[k], j[k]
        if not (merged[a] or merged[b]):
            merged[[a, b]] = True
            less, more = (a, b) if count[a] < count[b] else (b, a)
            into[less] = more
    return into


def existence(problem, fit, seen):
    """The filter's log-odds of existence [L] of the points, over the whole path."""
    p = problem.params
    x, y, heading = least_squares.sensor_poses(fit.path[1:], p).T
    dx, dy = fit.points[:, 0] - x[:, None], fit.points[:, 1] - y[:, None]
    bearing = np.arctan2(dy, dx) - heading[:, None]
    bearing -= 2 * np.pi * np.round(bearing / (2 * np.pi))
    visible = (bearing >= p.view_min) & (bearing <= p.view_max) & ~seen
    chance = p.detection * np.maximum(0, 1 - np.hypot(dx, dy) / p.view_range)
    missed = np.sum(np.where(visible, np.log1p(-np.minimum(chance, 0.999)), 0), 0)
    return p.existence_new + p.existence_seen * (seen.sum(0) - 1) + p.existence_miss * missed


def _choose_landmarks(problem, fit, which, keep, free):
    """Choose the points [M] of the measurements (-1: clutter), greedily, the best pair of a frame
    first.

    A point is measured at most once in a frame, and not from far beyond the declared view, or else
    near-parallel rays of clutter would make points at any distance. Measurements that are not
    `free` keep their points.
    """
    with np.errstate(divide="ignore"):
        clutter = float(sensors.log_clutter_density(problem.sensor, problem.params))
    pairs, sensor = [], _sensor_poses(problem, fit.path)[:, :2]
    for i in np.flatnonzero(keep):
        density = least_squares.log_inlier(problem, fit.path, fit.points[i])
        density += STAY * (which == i)
        near = np.hypot(*(sensor - fit.points[i]).T) < BEYOND * problem.params.view_range
        good = np.flatnonzero(free & near & (density > clutter))
        pairs.append((good, np.full(len(good), i), density[good]))
    m, point, density = (np.concatenate(part) for part in zip(*pairs, strict=True)) if pairs else (
        np.zeros(0, int), np.zeros(0, int), np.zeros(0))  # fmt: skip
    order = np.argsort(-density, kind="stable")
    m, point = m[order], point[order]
    chosen = np.where(free, -1, which)
    taken = np.zeros((len(fit.path), len(fit.points)), bool)
    while len(m):
        best = np.unique(problem.frame[m], return_index=True)[1]
        chosen[m[best]] = point[best]
        taken[problem.frame[m[best]], point[best]] = True
        left = (chosen[m] < 0) & ~taken[problem.frame[m], point]
        m, point = m[left], point[left]
    return chosen
