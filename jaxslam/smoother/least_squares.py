"""Robust least squares over a whole path and map, associations given (bundle adjustment).

The model is the filter's: the motion of `motion.model`, the noise of `sensors`, and measurements
that come from nothing with probability `outlier`, uniformly over the view. A measurement's weight
is the posterior probability that it does not (the E step of expectation maximisation; the cost is
the mixture's). A variance that depends on range is held at the current estimate in every iteration
and is no reason to move (iteratively reweighted least squares). Errors that stay alike along the
path (`sensors.correlated`) raise the whole density of a measurement to a power below one.
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

LEAST_INFORMATION = 1e-6  # 1/m^2 of a point that no measurement holds
ITERATIONS = 60
# Squared length of a step that changes nothing, in posterior standard deviations: at the end, and
# under a wide kernel, which only leads there.
CLOSE, CLOSE_WIDE = 1e-8, 1e-2
MOST_DAMPING = 1e8
DAMPINGS = (0.0, 1e-9, 1e-6, 1e-3, 1.0)


class Problem(NamedTuple):
    """T intervals and M measurements (padding left out), fixed for a whole refinement.

    `odometry` [T]; `frame` [M]; `value` [M, 2]; `cov` [M, 3]; `share` [M]: power of a measurement's
    density; `start` [3] and `root` [3, 3], an inverse square root of the start's covariance.
    """

    sensor: str
    odometry: Odometry
    frame: np.ndarray
    value: np.ndarray
    cov: np.ndarray
    share: np.ndarray
    start: np.ndarray
    root: np.ndarray
    params: Params


class Fit(NamedTuple):
    """Path [T + 1, 3] with the start first, points [L, 2], the normal matrix taken apart, inlier
    probabilities [M] (0: without a point), points' information [L, 2, 2] were the path known, root
    mean square of the inliers' standardised residuals, cost (nats), iterations, `converged`."""

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
    """`Problem` of `frames.Frames`, and where the measurements stand in it: flat indices [M]."""
    params = Params(*(np.float64(np.asarray(value)) for value in params))
    slots = frames.measurements
    count = slots.valid.shape[1]
    place = np.flatnonzero(slots.valid & np.asarray(slots.active)[:, None])
    frame = place // count
    odometry = Odometry(*(np.asarray(part, float) for part in frames.odometry))
    noise = jax.vmap(lambda interval: sensors.correlated_noise(params, interval))(odometry)
    # All standard deviations are enlarged alike.
    share = (params.position_scale / np.asarray(noise.position_scale)) ** 2
    value = np.asarray(slots.value, float).reshape(-1, 2)[place]
    if slots.scale is not None:
        gain = 1 + np.asarray(slots.scale, float).ravel()[place] * (params.gain_tran - 1)
        value = value * gain[:, None]
    cov = np.zeros((3, 3)) if start_cov is None else np.asarray(start_cov, float)
    variance, axes = np.linalg.eigh(cov)
    root = (axes / np.sqrt(np.maximum(variance, residuals.LEAST_VARIANCE))).T
    return Problem(
        sensor=sensor,
        odometry=odometry,
        frame=frame,
        value=value,
        cov=np.asarray(slots.cov, float).reshape(-1, 3)[place],
        share=np.broadcast_to(share, len(odometry.dx))[frame],
        start=np.asarray(start_pose, float),
        root=root,
        params=params,
    ), place


def truncate(given, place, done):
    """The problem of the first `done` intervals, and where its measurements stand."""
    count = np.searchsorted(given.frame, done)
    part = {name: getattr(given, name)[:count] for name in ("frame", "value", "cov", "share")}
    odometry = Odometry(*(leaf[:done] for leaf in given.odometry))
    return given._replace(odometry=odometry, **part), place[:count]


def solve(given, path, points, which, widths, progress=None):
    """`Fit` of the path and of points [L, 2], from a start; `which` [M]: point measured, or -1.

    `widths`: factors on the measurements' standard deviations in their weights, one after the
    other: a wide kernel pulls in a poor start (graduated non-convexity, Blake and Zisserman 1987).
    """
    total = 0
    for width in widths:
        path, points, count, converged = _descend(given, path, points, which, width, progress)
        total += count
    linear = _linearise(given, path, points, which)
    inlier, cost = _weigh(given, linear, which, 1.0)
    weight = inlier * given.share
    normal, factor = _split_unknowns(given, linear, weight, which, len(points))
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


def _split_unknowns(given, linear, weight, which, size):
    """The normal matrix and its `chain.Factor`.

    A point that ran off to where nothing holds it makes the matrix singular to rounding: then it is
    damped, by as little as will do. Such a point has no depth and leaves the map.
    """
    for damping in DAMPINGS:
        normal = _assemble(given, linear, weight, which, size, damping)
        try:
            return normal, normal_equations.solve(normal)[2]
        except np.linalg.LinAlgError:
            if damping == DAMPINGS[-1]:
                raise


def log_inlier(given, path, point):
    """log density [M] of all measurements, were they of `point` [2]: that of an inlier."""
    pose = path[given.frame + 1]
    point = np.broadcast_to(point, (len(pose), 2))
    scale = residuals.scales(given.sensor, pose, point, given.cov, given.params)
    rest = residuals.innovations(given.sensor, pose, point, given.value, scale, given.params)
    return _log_density(given, rest, scale)


def sensor_poses(path, params):
    """The sensor's poses [..., 3] from the robot's."""
    x, y, heading = np.moveaxis(path, -1, 0)
    c, s = np.cos(heading), np.sin(heading)
    mx, my = params.mount_x, params.mount_y
    return np.stack([x + c * mx - s * my, y + s * mx + c * my, heading + params.mount_yaw], -1)


def _descend(given, path, points, which, width, progress):
    """Levenberg and Marquardt's iterations at one width: path, points, how many, whether at rest.

    Damping scales the information of the motion and of the points, not its diagonal: a bent path
    can then still straighten as a whole. A step is taken only if the cost falls.
    """
    damping, close = 0.0, CLOSE if width == 1 else CLOSE_WIDE
    for count in range(1, ITERATIONS + 1):
        linear = _linearise(given, path, points, which)
        inlier, cost = _weigh(given, linear, which, width)
        weight = inlier * given.share
        while True:
            normal = _assemble(given, linear, weight, which, len(points), damping)
            moved, shifted, gained = _step(normal, path, points)
            after = _cost(given, moved, shifted, which, linear, width)
            # No more than this is the squared length of the undamped step.
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
    """The path and the points after a step, and its squared length; NaN where there is none."""
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


def _linearise(given, path, points, which):
    pose, point = path[given.frame + 1], _gather(points, which)
    scales = residuals.scales(given.sensor, pose, point, given.cov, given.params)
    moved = residuals.motion_jacobian(path[:-1], path[1:], given.odometry, given.params)
    seen = residuals.jacobian(given.sensor, pose, point, given.value, scales, given.params)
    return _Linear(
        start=(_start(given, path), given.root),
        moved=moved,
        seen=seen,
        scales=scales,
    )


def _gather(points, which):
    """The point [M, 2] of every measurement; the origin for none."""
    return np.vstack([points, np.zeros((1, 2))])[which]


def _start(given, path):
    off = path[0] - given.start
    off[2] -= 2 * np.pi * np.round(off[2] / (2 * np.pi))
    return given.root @ off


def _log_density(given, rest, scale, width=1.0):
    """log of (1 - outlier) x normal [M] of whitened residuals [M, m], `width` times as wide."""
    m = rest.shape[1]
    normaliser = np.sum(np.log(scale[:, :m]), 1) - m * (np.log(width) + sensors.LOG_2PI / 2)
    square = np.sum(rest**2, 1) / width**2
    return np.log1p(-given.params.outlier) + normaliser - square / 2


def _mixture(given, rest, scale, which, width):
    """log odds of being an inlier [M], and the measurements' part of the cost.

    The cost is times the square of the width: a sure inlier counts the same at every width.
    """
    normal = _log_density(given, rest, scale, width)
    with np.errstate(divide="ignore"):
        clutter = np.asarray(sensors.log_clutter_density(given.sensor, given.params))
    both = np.logaddexp(normal, clutter)
    return normal - clutter, -(width**2) * np.sum((given.share * both)[which >= 0])


def _weigh(given, linear, which, width):
    """Inlier probabilities [M], and the cost (nats, variances held)."""
    odds, cost = _mixture(given, linear.seen[0], linear.scales, which, width)
    squares = np.sum(linear.start[0] ** 2) + np.sum(linear.moved[0] ** 2)
    return np.where(which >= 0, expit(odds), 0.0), float(cost + squares / 2)


def _cost(given, path, points, which, linear, width):
    """The cost elsewhere, with the variances of `linear`."""
    pose, point = path[given.frame + 1], _gather(points, which)
    rest = residuals.innovations(
        given.sensor, pose, point, given.value, linear.scales, given.params
    )
    _, cost = _mixture(given, rest, linear.scales, which, width)
    moved = residuals.motions(path[:-1], path[1:], given.odometry, given.params)
    return float(cost + (np.sum(_start(given, path) ** 2) + np.sum(moved**2)) / 2)


def _assemble(given, linear, weight, which, size, damping):
    """`chain.Normal` of the linearised, weighted problem with `size` points."""
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
    which, pose, weight = which[used], given.frame[used] + 1, weight[used, None, None]
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
    return normal_equations.Normal(
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
    """Sums [size, ...] of the parts [M, ...] that share an index."""
    inner = int(np.prod(parts.shape[1:]))
    place = index[:, None] * inner + np.arange(inner)
    total = np.bincount(place.ravel(), parts.ravel(), size * inner)
    return total.reshape(size, *parts.shape[1:])
