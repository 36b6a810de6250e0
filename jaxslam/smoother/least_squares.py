"""Robust least squares over path and map, with associations given (bundle adjustment).

The model is the filter's: the motion of `motion.model`, the noise of `sensors`, and clutter with
probability `outlier`, uniform over the view. A measurement's weight is the posterior probability
that it is an inlier (the E step of expectation maximization; the cost is that of the mixture). A
variance that depends on range is fixed at the current estimate in every iteration and contributes
no gradient (iteratively reweighted least squares). Correlated errors (`sensors.correlated_noise`)
raise the density of a measurement to a power below one, its tempering.
NumPy in float64, derivatives by JAX in double precision.
"""

from typing import NamedTuple

import jax
import numpy as np
from scipy.sparse import coo_array
from scipy.special import expit

from jaxslam.logs.odometry import Odometry
from jaxslam.models import sensors
from jaxslam.parameters import Params
from jaxslam.smoother import normal_equations, residuals

LEAST_INFORMATION = 1e-6  # 1/m^2, added to every point: some have no inlier
ITERATIONS = 60
# Squared length of a step at convergence, in posterior standard deviations: at the end, and under a
# wide kernel, which only provides a start.
CLOSE, CLOSE_WIDE = 1e-8, 1e-2
MOST_DAMPING = 1e8
DAMPINGS = (0.0, 1e-9, 1e-6, 1e-3, 1.0)


class Problem(NamedTuple):
    """T intervals and M measurements (without padding), fixed during a refinement.

    `odometry` [T]; `frame` [M]; `value` [M, 2]; `cov` [M, 3]; `tempering` [M]: exponent of a
    measurement's density; `start` [3] and `root` [3, 3], an inverse square root of the start
    pose's covariance.
    """

    sensor: str
    odometry: Odometry
    frame: np.ndarray
    value: np.ndarray
    cov: np.ndarray
    tempering: np.ndarray
    start: np.ndarray
    root: np.ndarray
    params: Params


class Fit(NamedTuple):
    """`path` [T + 1, 3] from the start pose; `points` [L, 2]; `factor` of the normal matrix;
    `weight` [M]: inlier probabilities (0: without a point); `information` [L, 2, 2] of the points
    given the path; `residual`: root mean square of inliers' whitened residuals; `cost` (nats)."""

    path: np.ndarray
    points: np.ndarray
    factor: normal_equations.Factor
    weight: np.ndarray
    information: np.ndarray
    residual: float
    cost: float
    iterations: int
    converged: bool


def make_problem(frames, start_pose, start_cov, params, sensor):
    """Build the `Problem` of `frames.Frames`; also the flat index [M] (frame * K + k) of each
    measurement."""
    params = Params(*(np.float64(np.asarray(value)) for value in params))
    slots = frames.measurements
    count = slots.valid.shape[1]
    flat_index = np.flatnonzero(slots.valid & np.asarray(slots.active)[:, None])
    frame = flat_index // count
    odometry = Odometry(*(np.asarray(part, float) for part in frames.odometry))
    noise = jax.vmap(lambda interval: sensors.correlated_noise(params, interval))(odometry)
    # All standard deviations are enlarged by the same factor.
    tempering = (params.position_scale / np.asarray(noise.position_scale)) ** 2
    value = np.asarray(slots.value, float).reshape(-1, 2)[flat_index]
    if slots.scale is not None:
        gain = 1 + np.asarray(slots.scale, float).ravel()[flat_index] * (params.gain_tran - 1)
        value = value * gain[:, None]
    cov = np.zeros((3, 3)) if start_cov is None else np.asarray(start_cov, float)
    variance, axes = np.linalg.eigh(cov)
    root = (axes / np.sqrt(np.maximum(variance, residuals.LEAST_VARIANCE))).T
    return Problem(
        sensor=sensor,
        odometry=odometry,
        frame=frame,
        value=value,
        cov=np.asarray(slots.cov, float).reshape(-1, 3)[flat_index],
        tempering=np.broadcast_to(tempering, len(odometry.dx))[frame],
        start=np.asarray(start_pose, float),
        root=root,
        params=params,
    ), flat_index


def truncate(problem, flat_index, done):
    """The problem of the first `done` intervals, and the flat indices of its measurements."""
    count = np.searchsorted(problem.frame, done)
    part = {name: getattr(problem, name)[:count] for name in ("frame", "value", "cov", "tempering")}
    odometry = Odometry(*(leaf[:done] for leaf in problem.odometry))
    return problem._replace(odometry=odometry, **part), flat_index[:count]


def solve(problem, path, points, which, widths, progress=None):
    """Compute the `Fit` from an initial path and points [L, 2]; `which` [M]: point measured, or -1.

    `widths`: successive factors on the measurements' standard deviations in their weights; a wide
    kernel makes a poor start converge (graduated non-convexity, Blake and Zisserman 1987).
    """
    total = 0
    for width in widths:
        path, points, count, converged = _descend(problem, path, points, which, width, progress)
        total += count
    linear = _linearise(problem, path, points, which)
    inlier, cost = _weigh(problem, linear, which, 1.0)
    weight = inlier * problem.tempering
    normal, factor = _factorize(problem, linear, weight, which, len(points))
    sure = inlier > 0.5
    square = linear.seen[0][sure] ** 2
    return Fit(
        path=path,
        points=points,
        factor=factor,
        weight=inlier,
        information=normal.corner,
        residual=float(np.sqrt(square.mean())) if sure.any() else 0.0,
        cost=cost,
        iterations=total,
        converged=converged,
    )


def _factorize(problem, linear, weight, which, size):
    """Assemble and factorize the normal equations.

    A point that diverged makes the matrix singular up to rounding: it is then damped as little as
    possible. Such a point has no depth and leaves the map.
    """
    for damping in DAMPINGS:
        normal = _assemble(problem, linear, weight, which, size, damping)
        try:
            return normal, normal_equations.solve(normal)[2]
        except np.linalg.LinAlgError:
            if damping == DAMPINGS[-1]:
                raise


def log_inlier(problem, path, point):
    """log inlier density [M] of all measurements if they were of `point` [2]."""
    pose = path[problem.frame + 1]
    point = np.broadcast_to(point, (len(pose), 2))
    scale = residuals.scales(problem.sensor, pose, point, problem.cov, problem.params)
    rest = residuals.innovations(problem.sensor, pose, point, problem.value, scale, problem.params)
    return _log_density(problem, rest, scale)


def sensor_poses(path, params):
    """The sensor's poses [..., 3] from the robot's."""
    x, y, heading = np.moveaxis(path, -1, 0)
    c, s = np.cos(heading), np.sin(heading)
    mx, my = params.mount_x, params.mount_y
    return np.stack([x + c * mx - s * my, y + s * mx + c * my, heading + params.mount_yaw], -1)


def _descend(problem, path, points, which, width, progress):
    """Levenberg-Marquardt iterations at one width: path, points, their number, whether converged.

    Damping scales the information of the motion and of the points, not its diagonal, so that a bent
    path can still straighten as a whole. A step is taken only if the cost falls.
    """
    damping, close = 0.0, CLOSE if width == 1 else CLOSE_WIDE
    for count in range(1, ITERATIONS + 1):
        linear = _linearise(problem, path, points, which)
        inlier, cost = _weigh(problem, linear, which, width)
        weight = inlier * problem.tempering
        while True:
            normal = _assemble(problem, linear, weight, which, len(points), damping)
            moved, shifted, gained = _step(normal, path, points)
            after = _cost(problem, moved, shifted, which, linear, width)
            # An upper bound of the squared length of the undamped step.
            at_rest = (1 + damping) * gained < close
            if after <= cost or at_rest:
                break
            damping = max(10 * damping, 1e-3)
            if damping > MOST_DAMPING:
                return path, points, count, False
        if after <= cost:
            path, points = moved, shifted
        if progress:
            progress(count, min(after, cost))
        if at_rest:
            return path, points, count, True
        damping = damping / 10 if damping > 1e-3 else 0.0
    return path, points, count, False


def _step(normal, path, points):
    """Path and points after a step, and its squared length; NaN if there is no solution."""
    try:
        turn, shift, _ = normal_equations.solve(normal)
    except np.linalg.LinAlgError:
        return path * np.nan, points, np.nan
    gained = np.sum(normal.pose_gradient * turn) + np.sum(normal.point_gradient * shift)
    return path + turn, points + shift, gained


class _Linear(NamedTuple):
    """Whitened residuals and Jacobians: `start` (r [3], J); `moved` (r [T, 3], J by the pose before
    and after); `seen` (r [M, m], J by pose and point), and the `scales` that whiten them."""

    start: tuple
    moved: tuple
    seen: tuple
    scales: tuple


def _linearise(problem, path, points, which):
    pose, point = path[problem.frame + 1], _measured_points(points, which)
    scales = residuals.scales(problem.sensor, pose, point, problem.cov, problem.params)
    moved = residuals.motion_jacobian(path[:-1], path[1:], problem.odometry, problem.params)
    seen = residuals.jacobian(problem.sensor, pose, point, problem.value, scales, problem.params)
    return _Linear(
        start=(_start_residual(problem, path), problem.root),
        moved=moved,
        seen=seen,
        scales=scales,
    )


def _measured_points(points, which):
    """The point [M, 2] of every measurement; the origin where there is none."""
    return np.vstack([points, np.zeros((1, 2))])[which]


def _start_residual(problem, path):
    off = path[0] - problem.start
    off[2] -= 2 * np.pi * np.round(off[2] / (2 * np.pi))
    return problem.root @ off


def _log_density(problem, rest, scale, width=1.0):
    """log of (1 - outlier) x normal density [M] of whitened residuals [M, m], at this width."""
    m = rest.shape[1]
    normaliser = np.sum(np.log(scale[:, :m]), 1) - m * (np.log(width) + sensors.LOG_2PI / 2)
    square = np.sum(rest**2, 1) / width**2
    return np.log1p(-problem.params.outlier) + normaliser - square / 2


def _mixture(problem, rest, scale, which, width):
    """log odds of being an inlier [M], and the measurements' part of the cost.

    The cost is multiplied by the squared width, so that a certain inlier counts the same at all.
    """
    normal = _log_density(problem, rest, scale, width)
    with np.errstate(divide="ignore"):
        clutter = np.asarray(sensors.log_clutter_density(problem.sensor, problem.params))
    both = np.logaddexp(normal, clutter)
    return normal - clutter, -(width**2) * np.sum((problem.tempering * both)[which >= 0])


def _weigh(problem, linear, which, width):
    """Inlier probabilities [M], and the cost (nats, variances fixed)."""
    odds, cost = _mixture(problem, linear.seen[0], linear.scales, which, width)
    squares = np.sum(linear.start[0] ** 2) + np.sum(linear.moved[0] ** 2)
    return np.where(which >= 0, expit(odds), 0.0), float(cost + squares / 2)


def _cost(problem, path, points, which, linear, width):
    """The cost at another path and points, with the variances of `linear`."""
    pose, point = path[problem.frame + 1], _measured_points(points, which)
    rest = residuals.innovations(
        problem.sensor, pose, point, problem.value, linear.scales, problem.params
    )
    _, cost = _mixture(problem, rest, linear.scales, which, width)
    moved = residuals.motion_residuals(path[:-1], path[1:], problem.odometry, problem.params)
    return float(cost + (np.sum(_start_residual(problem, path) ** 2) + np.sum(moved**2)) / 2)


def _assemble(problem, linear, weight, which, size, damping):
    """`NormalEquations` of the linearised, weighted problem with `size` points."""
    (rest, before, after), more = linear.moved, 1 + damping
    diagonal = np.zeros((len(rest) + 1, 3, 3))
    diagonal[0] = more * linear.start[1].T @ linear.start[1]
    diagonal[:-1] += more * _outer(before, before)
    diagonal[1:] += more * _outer(after, after)
    pose_gradient = np.zeros((len(rest) + 1, 3))
    pose_gradient[0] = -linear.start[1].T @ linear.start[0]
    pose_gradient[:-1] -= np.einsum("tij,ti->tj", before, rest)
    pose_gradient[1:] -= np.einsum("tij,ti->tj", after, rest)

    used = which >= 0
    rest, by_pose, by_point = (part[used] for part in linear.seen)
    which, pose, weight = which[used], problem.frame[used] + 1, weight[used, None, None]
    diagonal += segment_sums(pose, weight * _outer(by_pose, by_pose), len(diagonal))
    drive = -weight[:, 0] * np.einsum("mij,mi->mj", by_pose, rest)
    pose_gradient += segment_sums(pose, drive, len(diagonal))
    corner = more * segment_sums(which, weight * _outer(by_point, by_point), size)
    pull = -weight[:, 0] * np.einsum("mij,mi->mj", by_point, rest)
    block = weight * _outer(by_point, by_pose)
    row = 2 * which[:, None, None] + np.arange(2)[:, None] + np.zeros((1, 3), int)
    column = 3 * pose[:, None, None] + np.arange(3) + np.zeros((2, 1), int)
    border = coo_array(
        (block.ravel(), (row.ravel(), column.ravel())), (2 * size, 3 * len(diagonal))
    )
    return normal_equations.NormalEquations(
        diagonal=diagonal,
        off=more * _outer(before, after),
        border=border.tocsr(),
        corner=corner + LEAST_INFORMATION * np.eye(2),
        pose_gradient=pose_gradient,
        point_gradient=segment_sums(which, pull, size),
    )


def _outer(a, b):
    """A^T B of stacks of matrices."""
    return a.transpose(0, 2, 1) @ b


def segment_sums(index, parts, size):
    """Sum the parts [M, ...] that share an index: [size, ...]."""
    inner = int(np.prod(parts.shape[1:]))
    flat_index = index[:, None] * inner + np.arange(inner)
    total = np.bincount(flat_index.ravel(), parts.ravel(), size * inner)
    return total.reshape(size, *parts.shape[1:])
