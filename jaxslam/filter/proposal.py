"""The informed proposal of FastSLAM 2.0: the pose is drawn from motion times measurements.

(Montemerlo, Thrun, Koller and Wegbreit 2003.) The motion model turns three standard normals u into
a pose (`motion.sample`). So the pose's uncertainty is here that of u: N(0, I) before the frame, and
every matched measurement is one linear update of it, in square-root form: nothing has to be
inverted, whatever the noise, and a direction without noise stays fixed. The linearised posterior is
only a proposal; the weights correct for its error.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter import landmarks
from jaxslam.models import geometry, motion, sensors
from jaxslam.models.geometry import wrap


class Whitened(NamedTuple):
    """Normal density of u: `mean` (3), `root` (3 rows of 3, not triangular), `log_det` of root."""

    mean: tuple
    root: tuple
    log_det: jax.Array


def motion_axes(before, predicted, sensor_pose, odometry, params):
    """Derivatives of the sensor's predicted pose by u: three (x, y, heading).

    `before`, `predicted`: the robot's poses, of which the second is `motion.sample`'s at u = 0.
    """
    swing = predicted[1] - sensor_pose[1], sensor_pose[0] - predicted[0]  # by the robot's turning
    return [
        (x + swing[0] * turn, y + swing[1] * turn, turn)
        for x, y, turn in motion.axes(before, odometry, params)
    ]


def pose_jacobian(sensor, sensor_pose, axes, mean, anchor, value):
    """Derivatives by u of a landmark's predicted measurement: a row (3) for each component.

    `value`: that prediction. As in `sensors.observe`, everything broadcasts.
    """
    sx, sy, heading = sensor_pose
    if sensor == "bearing":
        (dx, dy), _, _ = sensors.ray(sensor_pose, mean, anchor)
        scale = mean[1] / (dx * dx + dy * dy)
        by_pose = [(dy * scale, -dx * scale, -1.0)]
    elif sensor == "range_bearing":
        dx, dy = mean[0] - sx, mean[1] - sy
        inverse = 1 / geometry.norm(dx, dy)
        c, s = dx * inverse, dy * inverse
        by_pose = [(-c, -s, 0.0), (s * inverse, -c * inverse, -1.0)]
    else:
        c, s = jnp.cos(heading), jnp.sin(heading)
        by_pose = [(-c, -s, value[1]), (s, -c, -value[0])]
    return [tuple(hx * x + hy * y + ht * turn for x, y, turn in axes) for hx, hy, ht in by_pose]


def inform(sensor, sensor_pose, axes, world, match, measurements, params):
    """Update N(0, I) of u by the matched measurements [K, n], in their order: `Whitened`.

    `world`: the map before the frame. `params`: with the noise of updates. A landmark's uncertainty
    counts as noise of its measurement.
    """
    particle, one = jnp.arange(match.shape[1]), jnp.ones_like(sensor_pose[0])
    zero = jnp.zeros_like(one)
    start = Whitened((zero,) * 3, ((one, zero, zero), (zero, one, zero), (zero, zero, one)), zero)

    def step(k, whitened):
        matched = match[k] >= 0
        slot = jnp.where(matched, match[k], 0)
        mean, factor = tuple(world.mean[:, slot, particle]), tuple(world.factor[:, slot, particle])
        anchor = None if world.anchor is None else tuple(world.anchor[:, slot, particle])
        prediction = sensors.observe(sensor, sensor_pose, mean, anchor, params)
        jacobian = pose_jacobian(sensor, sensor_pose, axes, mean, anchor, prediction.value)
        value, cov = measurements.value[k], measurements.cov[k]
        for h, innovation, variance in _independent(
            sensor, prediction, factor, jacobian, value, cov, params
        ):
            whitened = _update(whitened, h, innovation, variance, matched)
        return whitened

    return jax.lax.fori_loop(0, match.shape[0], step, start)


def _independent(sensor, prediction, factor, jacobian, value, cov, params):
    """Split a measurement into independent scalars: (row by u, innovation, variance) of each."""
    spread = [geometry.transpose_times(factor, row) for row in prediction.rows]
    v0 = value[0] - prediction.value[0]
    if sensor == "bearing":
        shift, extra = landmarks.turn_factor(
            spread[0], geometry.transpose_times(factor, prediction.stretch)
        )
        s00 = spread[0][0] ** 2 + spread[0][1] ** 2 + extra + prediction.noise[0]
        return [(jacobian[0], wrap(v0 - shift), s00)]
    v1 = value[1] - prediction.value[1]
    if sensor == "position":
        xx, xy, yy = (component * params.position_scale**2 for component in cov)
    else:
        (xx, yy), xy, v1 = prediction.noise, 0.0, wrap(v1)
    s00 = spread[0][0] ** 2 + spread[0][1] ** 2 + xx
    s01 = spread[0][0] * spread[1][0] + spread[0][1] * spread[1][1] + xy
    s11 = spread[1][0] ** 2 + spread[1][1] ** 2 + yy
    share = s01 / s00
    rest = tuple(b - share * a for a, b in zip(*jacobian, strict=True))
    return [(jacobian[0], v0, s00), (rest, v1 - share * v0, s11 - share * s01)]


def _update(whitened, h, innovation, variance, matched):
    """Potter's square-root update of N(mean, root root^T) by one scalar, where `matched`.

    `innovation` is the measurement's, minus its prediction at u = 0.
    """
    mean, root, log_det = whitened
    h = [jnp.where(matched, component, 0.0) for component in h]
    innovation = jnp.where(matched, innovation, 0.0)
    variance = jnp.where(matched, variance, 1.0)
    f = [sum(h[i] * root[i][j] for i in range(3)) for j in range(3)]
    s = variance + f[0] * f[0] + f[1] * f[1] + f[2] * f[2]
    spread = [sum(row[j] * f[j] for j in range(3)) for row in root]
    gain = (innovation - h[0] * mean[0] - h[1] * mean[1] - h[2] * mean[2]) / s
    shrink = 1 / (s + jnp.sqrt(variance * s))
    return Whitened(
        tuple(m + gain * p for m, p in zip(mean, spread, strict=True)),
        tuple(
            tuple(row[j] - shrink * p * f[j] for j in range(3))
            for row, p in zip(root, spread, strict=True)
        ),
        log_det + 0.5 * jnp.log(variance / s),
    )


def draw(whitened, normals):
    """Draw u [3, n] with standard normals [3, n]; also the log of motion over proposal there.

    u = mean + root n has log density -|n|^2 / 2 - log det root; the motion's is -|u|^2 / 2.
    """
    mean, root, log_det = whitened
    u = [
        m + sum(c * n for c, n in zip(row, normals, strict=True))
        for m, row in zip(mean, root, strict=True)
    ]
    ratio = 0.5 * (sum(n * n for n in normals) - sum(v * v for v in u)) + log_det
    return jnp.stack(u), ratio
