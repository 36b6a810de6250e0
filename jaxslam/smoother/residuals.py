"""Whitened residuals of one interval and of one measurement, and their derivatives by JAX.

Written for one interval, or one measurement of one point, and mapped over all. Landmarks are points
in the world here, for every sensor: an anchor in the path would couple far poses.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.models import motion, sensors
from jaxslam.models.geometry import wrap

LEAST_VARIANCE = 1e-12  # m^2, rad^2, of noise that is declared to be none
FEWEST = 1024  # intervals or measurements that one compilation serves, at least


def _motion(before, after, odometry, params):
    """Whitened error [3] of one interval: along the chord, heading, and the rest sideways."""
    m = motion.model(odometry, params)
    c, s = jnp.cos(before[2] + m.chord), jnp.sin(before[2] + m.chord)
    dx, dy = after[0] - before[0], after[1] - before[1]
    heading = wrap(after[2] - before[2] - m.turn)
    error = jnp.stack([c * dx + s * dy - m.length, heading, c * dy - s * dx - m.slope * heading])
    variance = jnp.stack([m.var_along, m.var_heading, m.var_rest])
    return error / jnp.sqrt(jnp.maximum(variance, LEAST_VARIANCE))


def _scale(sensor, pose, point, cov, params):
    """What whitens a measurement: factors of the first and second component, and how much of the
    first is taken out of the second (`position`: by Cholesky's factor)."""
    if sensor == "position":
        xx, xy, yy = (params.position_scale**2 * part for part in cov)
        share = xy / xx
        return 1 / jnp.sqrt(xx), 1 / jnp.sqrt(yy - share * xy), share
    place = sensors.sensor_pose_of(tuple(pose), params)
    seen = sensors.observe("range_bearing", place, tuple(point), None, params)
    along, angle = (1 / jnp.sqrt(jnp.maximum(noise, LEAST_VARIANCE)) for noise in seen.noise)
    zero = jnp.zeros_like(along)
    return (angle, zero, zero) if sensor == "bearing" else (along, angle, zero)


def _innovation(sensor, pose, point, value, scale, params):
    """Whitened innovation of one measurement: [1] of a bearing, else [2]."""
    place = sensors.sensor_pose_of(tuple(pose), params)
    # A point has no depth to be uncertain of: its bearing is that of a range and bearing.
    kind = "position" if sensor == "position" else "range_bearing"
    seen = sensors.observe(kind, place, tuple(point), None, params).value
    if sensor == "bearing":
        return jnp.stack([wrap(value[0] - seen[1]) * scale[0]])
    first, second = value[0] - seen[0], value[1] - seen[1]
    second = second if sensor == "position" else wrap(second)
    return jnp.stack([first * scale[0], (second - scale[2] * first) * scale[1]])


def motions(before, after, odometry, params):
    """Residuals [T, 3] of all intervals."""
    return _each(_motions, (before, after, odometry), params)


def motion_jacobian(before, after, odometry, params):
    """The same, with their derivatives [T, 3, 3] by the poses before and after."""
    return _each(_motion_jacobian, (before, after, odometry), params)


def scales(sensor, pose, point, cov, params):
    """What whitens all measurements [M, 3], from poses [M, 3] and points [M, 2]."""
    return _each(_scales, (pose, point, cov), params, sensor)


def innovations(sensor, pose, point, value, scales, params):
    """Whitened innovations [M, 1 or 2] of all measurements."""
    return _each(_innovations, (pose, point, value, scales), params, sensor)


def jacobian(sensor, pose, point, value, scales, params):
    """The same, with their derivatives [M, 1 or 2, 3] by pose and [M, 1 or 2, 2] by point."""
    return _each(_jacobian, (pose, point, value, scales), params, sensor)


def _each(function, arrays, *rest):
    """The function of arrays [n, ...]; it is compiled for few n only, in between they are filled
    up: a log that grows would have it compiled time and again."""
    n = len(jax.tree.leaves(arrays)[0])
    size = max(FEWEST, 1 << (n - 1).bit_length()) if n else FEWEST

    def filled(leaf):
        return np.concatenate([leaf, np.ones((size - n, *np.shape(leaf)[1:]))])

    found = function(*jax.tree.map(filled, arrays), *rest)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:n], found)


@jax.jit
def _motions(before, after, odometry, params):
    return jax.vmap(_motion, (0, 0, 0, None))(before, after, odometry, params)


@jax.jit
def _motion_jacobian(before, after, odometry, params):
    derivative = jax.vmap(jax.jacfwd(_motion, (0, 1)), (0, 0, 0, None))
    rest = _motions(before, after, odometry, params)
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
