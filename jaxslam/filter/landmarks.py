"""Map of a particle: score measurements, update landmarks, forget them.

Arrays carry the particles last ([2, M, N] and so on, M slots): rows of many particles are
contiguous, and every function below takes all of them at once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter.xla import ordered_sum
from jaxslam.models import geometry, sensors
from jaxslam.models.geometry import wrap

NODES, BETWEEN = 5, 0.75  # normals a bearing landmark is split into; share of variance between
_node, _weight = np.polynomial.hermite_e.hermegauss(NODES)
SPLIT = BETWEEN**0.5 * _node, np.log(_weight / _weight.sum())


class Landmarks(NamedTuple):
    """M landmark slots of N particles. A slot is occupied while its `count` is positive.

    `mean` [2, M, N]: x, y (m), or for `bearing` direction (rad) and inverse depth (1/m) from the
    `anchor` [2, M, N] (m; else None), see `sensors`. `factor` [3, M, N]: lower factor
    (l11, l21, l22) of the covariance. `log_odds` [M, N] of existence (None: no forgetting). `count`
    [M, N]: times seen. `landmark_id` [M, N]: frame * K + k of the measurement that began it.
    """

    mean: jax.Array
    factor: jax.Array
    anchor: jax.Array | None
    log_odds: jax.Array | None
    count: jax.Array
    landmark_id: jax.Array


class Scorer(NamedTuple):
    """Terms of every landmark's log density, computed once a frame: predicted `value`, inverse
    innovation covariance `matrix` (for `position`: covariance without R), and log normaliser
    `constant`; tuples of [M, N]."""

    value: tuple
    matrix: tuple
    constant: jax.Array


def empty(config, dtype):
    """`Landmarks` without any."""
    shape = (config.landmarks, config.particles)
    return Landmarks(
        mean=jnp.zeros((2, *shape), dtype),
        factor=jnp.zeros((3, *shape), dtype),
        anchor=jnp.zeros((2, *shape), dtype) if config.sensor == "bearing" else None,
        log_odds=jnp.zeros(shape, dtype) if config.forgetting else None,
        count=jnp.zeros(shape, jnp.int32),
        landmark_id=jnp.zeros(shape, jnp.int32),
    )


def make_scorer(sensor, prediction, landmarks, inlier, jacobian=None):
    """`Scorer` of every slot; empty slots score -inf. `inlier`: log probability added to all.

    `prediction`: `sensors.Prediction` of every slot. `jacobian`: its rows by the standard normals
    behind the pose (`proposal.pose_jacobian`), where the pose is not known exactly.
    """
    factor = tuple(landmarks.factor)
    occupied = landmarks.count > 0
    own = [geometry.transpose_times(factor, row) for row in prediction.rows]
    spread = own
    if jacobian is not None:
        spread = [row + more for row, more in zip(own, jacobian, strict=True)]

    def product(i, j):
        return sum(a * b for a, b in zip(spread[i], spread[j], strict=True))

    s00 = product(0, 0)
    if sensor == "bearing":
        shift, extra = turn_factor(own[0], geometry.transpose_times(factor, prediction.stretch))
        s00 = jnp.where(occupied, s00 + extra + prediction.noise[0], 1.0)
        constant = jnp.where(occupied, inlier - 0.5 * (jnp.log(s00) + sensors.LOG_2PI), -jnp.inf)
        return Scorer((prediction.value[0] + shift,), (-0.5 / s00,), constant)
    s01, s11 = product(0, 1), product(1, 1)
    if sensor == "position":
        constant = jnp.where(occupied, inlier - sensors.LOG_2PI, -jnp.inf)
        return Scorer(prediction.value, (s00, s01, s11), constant)
    s00, s11 = s00 + prediction.noise[0], s11 + prediction.noise[1]
    det = jnp.where(occupied, s00 * s11 - s01 * s01, 1.0)
    constant = jnp.where(occupied, inlier - sensors.LOG_2PI - 0.5 * jnp.log(det), -jnp.inf)
    inverse = 1 / det
    matrix = (-0.5 * s11 * inverse, s01 * inverse, -0.5 * s00 * inverse)
    return Scorer(prediction.value, matrix, constant)


def log_likelihoods(sensor, scorer, value, cov, params):
    """Log density of a measurement under a landmark (eq. 3); everything broadcasts."""
    if sensor == "bearing":
        v0 = wrap(value[0] - scorer.value[0])
        return scorer.constant + scorer.matrix[0] * v0 * v0
    v0, v1 = value[0] - scorer.value[0], value[1] - scorer.value[1]
    if sensor == "position":
        scale = params.position_scale**2
        s00, s01, s11 = (p + scale * c for p, c in zip(scorer.matrix, cov, strict=True))
        det = s00 * s11 - s01 * s01
        square = (v0 * v0 * s11 - 2 * v0 * v1 * s01 + v1 * v1 * s00) / det
        return scorer.constant - 0.5 * (square + jnp.log(det))
    v1 = wrap(v1)
    a, b, c = scorer.matrix
    return scorer.constant + v0 * (a * v0 + b * v1) + c * v1 * v1


def update(sensor, sensor_pose, mean, factor, anchor, value, cov, params):
    """Update a landmark by a measurement, with an EKF: mean, factor, log predictive density.

    A 2-D measurement is two whitened scalars, both linearised at the mean before the update.
    """
    if sensor == "bearing":
        return _update_bearing(sensor_pose, mean, factor, anchor, value[0], params)
    prediction = sensors.observe(sensor, sensor_pose, mean, anchor, params)
    if sensor == "position":
        innovations, rows, variances = _whiten(prediction, value, cov, params)
    else:
        innovations = (value[0] - prediction.value[0], wrap(value[1] - prediction.value[1]))
        rows, variances = prediction.rows, prediction.noise
    mean, factor, square, log = geometry.pair_update(mean, factor, rows, innovations, variances)
    return mean, factor, -0.5 * (square + log) - sensors.LOG_2PI


def turn_factor(along, stretch):
    """Mean and variance that the bearing's second derivatives add to its prediction.

    `along`, `stretch`: row and stretch of `sensors.Prediction` times the landmark's factor, u and
    v; the Hessian is then -(u v' + v u').
    """
    (u1, u2), (v1, v2) = along, stretch
    both = u1 * v1 + u2 * v2
    return -both, (u1 * u1 + u2 * u2) * (v1 * v1 + v2 * v2) + both * both


def _update_bearing(sensor_pose, mean, factor, anchor, value, params):
    """Update by a bearing: split the landmark into `NODES` narrower normals along inverse depth,
    update each by a second-order EKF, and merge them to the mixture's mean and covariance.

    One EKF is over-confident where the robot drives towards a landmark and past its estimate; this
    keeps close to the exact posterior (experiments/inverse_depth.py). Gauss-Hermite nodes with
    `BETWEEN` of the variance and normals with the rest have the moments of the whole (Gaussian sum:
    Alspach and Sorenson 1972, doi:10.1109/TAC.1972.1100034).
    """
    l11, l21, l22 = factor
    variance = l21 * l21 + l22 * l22
    per_sd = 1 / jnp.sqrt(variance)
    left = 1 / jnp.sqrt(1 - BETWEEN * l21 * l21 * per_sd * per_sd)
    narrow = (l11 / left, (1 - BETWEEN) * l21 * left, (1 - BETWEEN) ** 0.5 * l22 * left)
    step = (l11 * l21 * per_sd, variance * per_sd)
    # Linear in direction: cosines of every part would take most of the time.
    (dx, dy), (tx, ty), (ax, ay) = sensors.ray(sensor_pose, mean, anchor)

    def update_part(split):
        turn, nearer = split[0] * step[0], split[0] * step[1]
        point = (dx + tx * turn + ax * nearer, dy + ty * turn + ay * nearer)
        part = (mean[0] + turn, mean[1] + nearer)
        prediction = sensors.along_ray(point, (tx, ty), (ax, ay), part[1], sensor_pose[2], params)
        (row,), (noise,) = prediction.rows, prediction.noise
        spread = geometry.transpose_times(narrow, row)
        shift, extra = turn_factor(spread, geometry.transpose_times(narrow, prediction.stretch))
        innovation = wrap(value - prediction.value[0] - shift)
        part, cov, s = geometry.scalar_update(part, narrow, row, innovation, noise + extra)
        square = innovation * innovation / s
        return part, cov, split[1] - 0.5 * (square + jnp.log(s) + sensors.LOG_2PI)

    # A loop returns arrays: else XLA computes everything again for each of the sums.
    split = jax.tree.map(lambda v: jnp.array(v, jnp.result_type(l11)), SPLIT)
    part, cov, share = jax.lax.map(update_part, split)
    top = jax.lax.stop_gradient(share.max(0))
    log_density = top + jnp.log(ordered_sum(jnp.exp(share - top)))
    mean, factor = _merge(part, cov, jnp.exp(share - log_density))
    return (mean[0], jnp.maximum(mean[1], sensors.LEAST_INVERSE_DEPTH)), factor, log_density


def _merge(mean, factor, weight):
    """Merge a mixture of normals along the first axis: mean, factor; sums of squares throughout."""
    l11, l21, l22 = factor
    m0, m1 = (ordered_sum(weight * m) for m in mean)
    d0, d1 = mean[0] - m0, mean[1] - m1
    top = jnp.sqrt(ordered_sum(weight * (l11 * l11 + d0 * d0)))
    side = ordered_sum(weight * (l11 * l21 + d0 * d1)) / top
    slope = side / top
    off, away = l21 - slope * l11, d1 - slope * d0
    low = jnp.sqrt(ordered_sum(weight * (off * off + l22 * l22 + away * away)))
    return (m0, m1), (top, side, low)


def _whiten(prediction, value, cov, params):
    """Split a position into two independent scalars: innovations, rows, variances."""
    xx, xy, yy = (component * params.position_scale**2 for component in cov)
    share = xy / xx
    v0, v1 = value[0] - prediction.value[0], value[1] - prediction.value[1]
    first, second = prediction.rows
    rest = (second[0] - share * first[0], second[1] - share * first[1])
    return (v0, v1 - share * v0), (first, rest), (xx, yy - share * xy)


def in_view(prediction, params):
    """Whether a `sensors.Prediction` lies in the sensor's view."""
    inside = (prediction.bearing >= params.view_min) & (prediction.bearing <= params.view_max)
    return inside & (prediction.range < params.view_range)


def update_existence(world, prediction, params):
    """Raise the log-odds of matched landmarks, lower those of others in view, and free slots below
    zero: the map, and how many were freed [n].

    `world`: the map after `landmark_updates.update_matched`, with its marks. `prediction`: from
    before. The probability of detection falls linearly with range, to zero at `view_range`.
    """
    expected = in_view(prediction, params)
    chance = params.detection * jnp.maximum(0.0, 1 - prediction.range / params.view_range)
    raised = jnp.minimum(world.log_odds + params.existence_seen, params.existence_max)
    lowered = world.log_odds + params.existence_miss * jnp.log1p(-chance)
    missed = jnp.where((world.count > 0) & expected, lowered, world.log_odds)
    log_odds = jnp.where(world.count < 0, raised, missed)
    freed = (world.count != 0) & (log_odds < 0)
    return world._replace(log_odds=log_odds, count=jnp.where(freed, 0, world.count)), freed.sum(0)


def unmark_matched(world):
    """The map without the marks of `landmark_updates.update_matched`."""
    return world._replace(count=jnp.abs(world.count))
