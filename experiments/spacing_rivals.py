"""The rivals of experiments/spacing.py: one EKF for path and map, bearings alone; NumPy, float64.

The state is the robot's pose and all points together (Smith, Self and Cheeseman, "Estimating
uncertain spatial relationships in robotics", 1990). A point is (x, y, direction, inverse depth):
seen from (x, y), where the robot was when it first saw it; so it is usable from the first glimpse
(Civera, Davison and Montiel, "Inverse depth parametrization for monocular SLAM", IEEE T-RO 24(5),
2008; here in the plane). One hypothesis: what was associated wrongly stays so. Association is by

- `nearest`: gated nearest neighbour, one measurement after the other;
- `joint`: joint compatibility branch and bound (Neira and Tardós, "Data association in stochastic
  mapping using the joint compatibility test", IEEE T-RA 17(6), 2001);
- identities that are known, to see what the EKF itself costs.

Motion and sensor noise are those of `jaxslam.Params`, the motion's moments are
`jaxslam.odometry.moments`. The sensor is taken to be where the robot is (no mounting).
Poses are (x, y, heading); metres, radians.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from jaxslam import config_for
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.odometry import moments

GATE = 0.95  # of chi-squared: what is compatible
NO_OTHER = 0.9999  # so far from all points that are still free must a new one's bearing be
NODES = 20_000  # of a frame's search; beyond, the best hypothesis so far is taken
LEAST_INVERSE_DEPTH = 1e-3
ROUNDS, SETTLED = 5, 1e-5  # of Gauss-Newton, at most; the change at which it is done
DEPTHS = 4.0  # standard deviations above the mean that inverse depth is allowed
LEAST_DETECTION = 0.05  # a sensor's range is no wall: what was seen can't have been impossible
GIVEN_UP, SCORE_MOST = -0.7, 10.0  # log-odds at which a point is dropped, and that it can have
CONFIRMED, SIGHTINGS = 3.0, 3  # log-odds and measurements of what counts as a landmark at the end
LIMITS = chi2.ppf(GATE, np.arange(1, 200)).tolist()  # by degrees of freedom, from 1 on
FAR = chi2.ppf(NO_OTHER, 1)


class Estimate(NamedTuple):
    """What a rival found, T frames of K slots, L landmarks.

    `pose` [T, 3], `cov` [T, 3, 3]: filtered. `row`, `landmark_id` [T, K] and `identity` [L] as
    those of `jaxslam.Result`; `mean` [L, 2] m. `cut`: frames whose search met the limit of nodes.
    """

    pose: np.ndarray
    cov: np.ndarray
    row: np.ndarray
    landmark_id: np.ndarray
    mean: np.ndarray
    identity: np.ndarray
    cut: int


@dataclass
class State:
    """`mean` [3 + 4 M] and `cov` of pose and M points. Of every point: `label` (frame * K + k of
    its first measurement), `name` (identity, -1 hidden), `score` (log-odds), `count` (seen)."""

    mean: np.ndarray
    cov: np.ndarray
    label: list
    name: list
    score: np.ndarray
    count: np.ndarray


class Predicted(NamedTuple):
    """`bearing` [M], its `rows` [M, 3 + 4 M] of the Jacobian, `far` [M] m: how far the points are,
    `near` [M] m: how near they may be."""

    bearing: np.ndarray
    rows: np.ndarray
    far: np.ndarray
    near: np.ndarray


def run(log, params, rule):
    """`Estimate` of a whole log; `rule`: "nearest", "joint" or "known"."""
    association = "known" if rule == "known" else "maximum_likelihood"
    data = frames_from_log(log, config_for(log, "bearing", association, descriptors=0), params)
    z, valid = np.asarray(data.measurements.value)[:, :, 0], np.asarray(data.measurements.valid)
    moves, move_covs = moments(data.odometry, params)
    moves[:, :2] *= params.gain_tran
    cov = np.array(log.start_cov, float)
    state = State(np.array(log.start_pose, float), cov, [], [], np.zeros(0), np.zeros(0, int))
    match, cut = np.full(valid.shape, -3), 0
    poses, covs = [], []
    for t, there in enumerate(valid):
        drive(state, moves[t], move_covs[t])
        k = np.flatnonzero(there)
        place = t * valid.shape[1] + k
        names = data.measurements.identity[t, k]
        known = names if rule == "known" else None
        match[t, k], stopped = step(state, z[t, k], place, params, rule, known)
        cut += stopped
        poses.append(state.mean[:3].copy())
        covs.append(state.cov[:3, :3].copy())
    mean, identity = landmarks(state, known=rule == "known")
    identity = np.append(data.identities, -1)[identity]
    return Estimate(np.array(poses), np.array(covs), data.row, match, mean, identity, cut)


def step(state, z, place, params, rule, names=None):
    """One frame's bearings `z` [k] taken in; gives their match [k], and whether a search was cut.

    `place` [k]: their labels, should they be new. `names` [k]: identities, where known.
    """
    seen = predicted(state)
    within = seen.rows @ state.cov @ seen.rows.T + params.sigma_bearing**2 * np.eye(len(seen.far))
    off = wrap(z[:, None] - seen.bearing)
    if names is not None:
        at = {name: j for j, name in enumerate(state.name)}
        choice, cut = np.array([at.get(name, -1) for name in names], int), False
        fresh = choice < 0
    else:
        off[:, seen.near > params.view_range] = np.inf  # out of the sensor's reach
        choice, cut = nearest(off, within), False
        if rule == "joint":
            choice, cut = joint(off, within)
        fresh = (choice < 0) & ~_another(off, within, choice)
    match = np.where(fresh, -1, -2)
    used = choice >= 0
    match[used] = np.array(state.label, int)[choice[used]]
    if names is None:
        _rate(state, seen, off, within, choice, params)
    state.count[choice[used]] += 1
    most = params.inv_depth_mean + DEPTHS * params.inv_depth_sd
    update(state, z[used], choice[used], params.sigma_bearing, most)
    if names is None:
        drop(state, state.score < GIVEN_UP)
    for k in np.flatnonzero(fresh):
        add(state, z[k], place[k], -1 if names is None else names[k], params)
    return match, cut


def nearest(off, within, gate=GATE):
    """The point [K] of every measurement, -1: none. The first takes the nearest that is within the
    gate, the second the nearest of the others, and so on.

    Nearest is meant by -2 log likelihood: by Mahalanobis distance alone a point of open depth,
    which is near to everything, would win against an exact one (Bar-Shalom and Fortmann, "Tracking
    and Data Association", 1988). `off` [K, M]: innovation of measurement k if it is of point j.
    `within` [M, M]: covariance of the points' innovations.
    """
    variance = np.diag(within)
    distance = off**2 / variance
    unlikely = np.where(distance <= chi2.ppf(gate, 1), distance + np.log(variance), np.inf)
    choice = np.full(len(off), -1)
    for k, row in enumerate(unlikely):
        if row.min(initial=np.inf) < np.inf:
            choice[k] = row.argmin()
            unlikely[:, choice[k]] = np.inf
    return choice


def joint(off, within, nodes=NODES):
    """The point [K] of every measurement, -1: none, and whether the search was cut short.

    Of the sets of pairings that are jointly compatible, one of the largest, and of these the one of
    least Mahalanobis distance. As in Neira and Tardós, pairings are added measurement by
    measurement, each set on the way must be compatible, nearest first, and branches that can't
    become larger are left out; those of the same size, once they are farther. Measurements of few
    candidates come first, which decides little and saves most. Arguments as those of `nearest`.
    """
    distance = off**2 / np.diag(within)
    can = [[j for j in np.argsort(row) if row[j] <= LIMITS[0]] for row in distance]
    order = sorted((k for k in range(len(off)) if can[k]), key=lambda k: len(can[k]))
    search = _Search(off.tolist(), within.tolist(), can, order, nodes)
    search.go(0, [], [], [], 0.0)
    choice = np.full(len(off), -1)
    for k, j in zip(order, search.best, strict=False):
        choice[k] = j
    return choice, search.left < 0


class _Search:
    """Depth first over the measurements in `order`. Plain lists: the matrices are tiny, and NumPy
    would take ten times as long over them."""

    def __init__(self, off, within, can, order, nodes):
        self.off, self.within, self.can, self.order, self.left = off, within, can, order, nodes
        self.best, self.size, self.least = [], 0, math.inf

    def go(self, depth, chosen, rows, white, square):
        """`chosen`: points (-1: none) of the measurements up to `depth`; `rows`: of the Cholesky
        factor of their innovations' covariance; `white`: innovations divided by it, whose sum of
        squares is `square`, the joint Mahalanobis distance: it can only grow."""
        size = len(white)
        if size > self.size or (size == self.size and square < self.least):
            self.best, self.size, self.least = list(chosen), size, square
        if depth == len(self.order):
            return
        most = size + len(self.order) - depth
        paired = [j for j in chosen if j >= 0]
        k = self.order[depth]
        for j in self.can[k]:
            if most < self.size or (most == self.size and square >= self.least) or self.left < 0:
                return
            if j in paired:
                continue
            self.left -= 1
            row, last = self._added(paired, rows, white, self.off[k][j], j)
            longer = square + last * last
            if longer <= LIMITS[size]:
                self.go(depth + 1, [*chosen, j], [*rows, row], [*white, last], longer)
        if most - 1 > self.size or (most - 1 == self.size and square < self.least):
            self.go(depth + 1, [*chosen, -1], rows, white, square)

    def _added(self, paired, rows, white, off, j):
        """One more row of the Cholesky factor, and its innovation divided by it."""
        row, rest = [], self.within[j][j]
        for i, other in enumerate(paired):
            inner = self.within[j][other] - sum(map(float.__mul__, row, rows[i]))
            row.append(inner / rows[i][i])
            rest -= row[i] ** 2
            off -= row[i] * white[i]
        row.append(math.sqrt(max(rest, 1e-18)))
        return row, off / row[-1]


def _another(off, within, choice):
    """Which measurements [K] may be of a point that no measurement was given: nothing new, then."""
    free = ~np.isin(np.arange(len(within)), choice)
    return ((off**2 / np.diag(within) < FAR) & free).any(1)


def _rate(state, seen, off, within, choice, params):
    """Log-odds of being there, as a track's score (Blackman 1986): a sighting against clutter,
    or no sighting where one was likely. Without it every outlier would stay a landmark."""
    variance, used = np.diag(within), choice >= 0
    chance = params.detection * np.maximum(0, 1 - seen.far / params.view_range)
    state.score += np.log1p(-GATE * np.where(np.isin(np.arange(len(chance)), choice), 0, chance))
    j, nu = choice[used], off[used, choice[used]]
    width = params.view_max - params.view_min
    clutter = max(params.outlier, 1e-4) * len(choice) / width
    told = np.log(np.maximum(chance[j], LEAST_DETECTION) / clutter)
    told -= 0.5 * (nu**2 / variance[j] + np.log(2 * np.pi * variance[j]))
    state.score[j] = np.minimum(state.score[j] + told, SCORE_MOST)


def drive(state, move, move_cov):
    """The pose after `move` [3], in its own frame, with `move_cov` [3, 3]."""
    x, y, heading = state.mean[:3]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    ahead, side, _ = turn @ move
    by_pose = np.array([[1, 0, -side], [0, 1, ahead], [0, 0, 1]])
    state.mean[:3] = x + ahead, y + side, wrap(heading + move[2])
    state.cov[:3] = by_pose @ state.cov[:3]
    state.cov[:, :3] = state.cov[:, :3] @ by_pose.T
    state.cov[:3, :3] += turn @ move_cov @ turn.T


def predicted(state):
    """`Predicted` of all points: bearing of rho (anchor - robot) + (cos, sin)(direction)."""
    points = state.mean[3:].reshape(-1, 4)
    count = len(points)
    x, y, phi, rho = points.T
    away = np.column_stack([x, y]) - state.mean[:2]
    tangent = np.column_stack([-np.sin(phi), np.cos(phi)])
    ray = rho[:, None] * away + np.column_stack([np.cos(phi), np.sin(phi)])
    square = (ray**2).sum(1)
    across = np.column_stack([-ray[:, 1], ray[:, 0]]) / square[:, None]  # d bearing / d ray
    rows = np.zeros((count, 3 + 4 * count))
    rows[:, :2], rows[:, 2] = -rho[:, None] * across, -1
    at, first = np.arange(count), 3 + 4 * np.arange(count)
    rows[at, first], rows[at, first + 1] = (rho[:, None] * across).T
    rows[at, first + 2], rows[at, first + 3] = (across * tangent).sum(1), (across * away).sum(1)
    sd = np.sqrt(np.maximum(state.cov[first + 3, first + 3], 0))
    length = np.sqrt(square)
    bearing = np.arctan2(ray[:, 1], ray[:, 0]) - state.mean[2]
    return Predicted(wrap(bearing), rows, length / rho, length / (rho + 2 * sd))


def update(state, z, which, sigma, most):
    """The bearings `z` [k] of the points `which` [k] taken in.

    Linearised again where Kalman's update ends (Bell and Cathey, "The iterated Kalman filter update
    as a Gauss-Newton method", IEEE T-AC 38(2), 1993): once was not enough, one drive in ten went
    astray though identities were known. So it did with points that were taken to be at infinity or
    on top of the robot, one of the two ways that a bearing near the driving direction can be had
    (Parsley and Julier, "Avoiding negative depth in inverse depth bearing-only SLAM", IROS 2008):
    a point that leaves (0, `most`) is dropped, and its bearing is not used.
    """
    if not len(z):
        return
    mean, cov = _mode(state, z, which, sigma)
    depth = mean[6::4]
    out = (depth <= LEAST_INVERSE_DEPTH) | (depth > most)
    if out.any():
        place, kept = np.cumsum(~out) - 1, ~out[which]
        drop(state, out)
        return update(state, z[kept], place[which[kept]], sigma, most)
    state.mean, state.cov = mean, (cov + cov.T) / 2


def _mode(state, z, which, sigma):
    """Mean and covariance after `z`, linearised at that mean."""
    at = State(state.mean.copy(), state.cov, state.label, state.name, state.score, state.count)
    for _ in range(ROUNDS):
        seen = predicted(at)
        rows = seen.rows[which]
        off = wrap(z - seen.bearing[which]) - rows @ (state.mean - at.mean)
        cross = state.cov @ rows.T
        within = rows @ cross + sigma**2 * np.eye(len(z))
        gain = np.linalg.solve(within, cross.T).T
        before, at.mean = at.mean, state.mean + gain @ off
        at.mean[6::4] = np.maximum(at.mean[6::4], LEAST_INVERSE_DEPTH)
        if np.abs(at.mean - before).max() < SETTLED:
            break
    at.mean[2] = wrap(at.mean[2])
    return at.mean, state.cov - gain @ cross.T


def add(state, z, label, name, params):
    """A point first seen at bearing `z` from where the robot is now."""
    size = len(state.mean)
    by_state = np.zeros((4, size))
    by_state[:3, :3] = np.eye(3)
    own = np.diag([0, 0, params.sigma_bearing**2, params.inv_depth_sd**2])
    side = by_state @ state.cov
    state.cov = np.block([[state.cov, side.T], [side, side @ by_state.T + own]])
    x, y, heading = state.mean[:3]
    state.mean = np.append(state.mean, [x, y, heading + z, params.inv_depth_mean])
    state.label.append(int(label))
    state.name.append(int(name))
    state.score, state.count = np.append(state.score, 0.0), np.append(state.count, 1)


def drop(state, gone):
    """Without the points `gone` [M]."""
    if not gone.any():
        return
    kept = np.append([True] * 3, np.repeat(~gone, 4))
    state.mean, state.cov = state.mean[kept], state.cov[np.ix_(kept, kept)]
    stay = np.flatnonzero(~gone)
    state.label, state.name = ([old[i] for i in stay] for old in (state.label, state.name))
    state.score, state.count = state.score[stay], state.count[stay]


def landmarks(state, known):
    """Points [L, 2] whose depth is known and (identities hidden) that are confirmed; names [L]."""
    x, y, phi, rho = state.mean[3:].reshape(-1, 4).T
    sure = rho > 3 * np.sqrt(np.diag(state.cov)[6::4])
    if not known:
        sure &= (state.score > CONFIRMED) & (state.count >= SIGHTINGS)
    mean = np.column_stack([x + np.cos(phi) / rho, y + np.sin(phi) / rho])
    return mean[sure], np.array(state.name, int)[sure]


def wrap(angle):
    """The angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
