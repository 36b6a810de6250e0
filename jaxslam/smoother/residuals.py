"""Whitened residuals of intervals and of measurements, and their derivatives by JAX.

Each residual is written for one interval, or one measurement of one point, and mapped over all.
Landmarks are world points for every sensor: an anchor in the path would couple distant poses.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.models import motion, sensors
from jaxslam.models.geometry import wrap

LEAST_VARIANCE = 1e-12  # m^2, rad^2: stands for a noise of zero
LEAST_SIZE = 1024  # intervals or measurements to which shorter arrays are padded


def _motion_residual(before, after, odometry, params):
    """Whitened error [3] of one interval: along the chord, heading, remaining lateral error."""
    m = motion.model(odometry, params)
    c, s = jnp.cos(before[2] + m.chord), jnp.sin(before[2] + m.chord)
    dx, dy = after[0] - before[0], after[1] - before[1]
    heading = wrap(after[2] - before[2] - m.turn)
    error = jnp.stack([c * dx + s * dy - m.length, heading, c * dy - s * dx - m.slope * heading])
    variance = jnp.stack([m.var_along, m.var_heading, m.var_rest])
    return error / jnp.sqrt(jnp.maximum(variance, LEAST_VARIANCE))


def _scale(sensor, pose, point, cov, params):
    """Whitening of a measurement: factors of the first and second component, and the part of the
    first that is subtracted from the second (`position`: by the Cholesky factor)."""
    if sensor == "position":
        xx, xy, yy = (params.position_scale**2 * part for part in cov)
        ratio = xy / xx
        return 1 / jnp.sqrt(xx), 1 / jnp.sqrt(yy - ratio * xy), ratio
    sensor_pose = sensors.sensor_pose_of(tuple(pose), params)
    seen = sensors.observe("range_bearing", sensor_pose, tuple(point), None, params)
    along, angle = (1 / jnp.sqrt(jnp.maximum(noise, LEAST_VARIANCE)) for noise in seen.noise)
    zero = jnp.zeros_like(along)
    return (angle, zero, zero) if sensor == "bearing" else (along, angle, zero)


def _innovation(sensor, pose, point, value, scale, params):
    """Whitened innovation of one measurement: [1] of a bearing, else [2]."""
    sensor_pose = sensors.sensor_pose_of(tuple(pose), params)
    # A point has no depth to be uncertain of: its bearing is that of a range and bearing.
    kind = "position" if sensor == "position" else "range_bearing"
    seen = sensors.observe(kind, sensor_pose, tuple(point), None, params).value
    if sensor == "bearing":
        return jnp.stack([wrap(value[0] - seen[1]) * scale[0]])
    first, second = value[0] - seen[0], value[1] - seen[1]
    second = second if sensor == "position" else wrap(second)
    return jnp.stack([first * scale[0], (second - scale[2] * first) * scale[1]])


def motion_residuals(before, after, odometry, params):
    """Compute the residuals [T, 3] of all intervals."""
    return _map_padded(_motion_residuals, (before, after, odometry), params)


def motion_jacobian(before, after, odometry, params):
    """`motion_residuals`, and their derivatives [T, 3, 3] by the poses before and after."""
    return _map_padded(_motion_jacobian, (before, after, odometry), params)


def scales(sensor, pose, point, cov, params):
    """Compute the whitening [M, 3] of all measurements at poses [M, 3] of points [M, 2]."""
    return _map_padded(_scales, (pose, point, cov), params, sensor)


def innovations(sensor, pose, point, value, scales, params):
    """Compute the whitened innovations [M, 1 or 2] of all measurements."""
    return _map_padded(_innovations, (pose, point, value, scales), params, sensor)


def jacobian(sensor, pose, point, value, scales, params):
    """`innovations`, and their derivatives [M, 1 or 2, 3] by pose and [M, 1 or 2, 2] by point."""
    return _map_padded(_jacobian, (pose, point, value, scales), params, sensor)


def _map_padded(function, arrays, *rest):
    """Apply the function to arrays [n, ...] padded to a power of two: a growing log would otherwise
    have it compiled again and again."""
    n = len(jax.tree.leaves(arrays)[0])
    size = max(LEAST_SIZE, 1 << (n - 1).bit_length()) if n else LEAST_SIZE

    def pad(leaf):
        return np.concatenate([leaf, np.ones((size - n, *np.shape(leaf)[1:]))])

    found = function(*jax.tree.map(pad, arrays), *rest)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:n], found)


@jax.jit
def _motion_residuals(before, after, odometry, params):
    return jax.vmap(_motion_residual, (0, 0, 0, None))(before, after, odometry, params)


@jax.jit
def _motion_jacobian(before, after, odometry, params):
    derivative = jax.vmap(jax.jacfwd(_motion_residual, (0, 1)), (0, 0, 0, None))
    rest = _motion_residuals(before, after, odometry, params)
    return rest, *derivative(before, after, odometry, params)


@partial(jax.jit, static_argnames="sensor")
def _scales(pose, point, cov, params, sensor):
    one = partial(_scale, sensor)
    return jnp.stack(jax.vmap(one, (0, 0, 0, None))(pose, point, cov, params), 1)


@partial(jax.jit, static_argnames="sensor")
def _innovations(pose, point, value, scales, params, sensor):
    one = partial(_innovation, sensor)
    return jax.vmap(one, (0, 0, 0, 0, None))(pose, point, value, scales, params)


@partial(jax.jit, static_argnames="sensor")
def _jacobian(pose, point, value, scales, params, sensor):
    one = partial(_innovation, sensor)
    derivative = jax.vmap(jax.jacfwd(one, (0, 1)), (0, 0, 0, 0, None))
    rest = _innovations(pose, point, value, scales, params, sensor)
    return rest, *derivative(pose, point, value, scales, params)
