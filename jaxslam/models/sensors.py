"""The sensors: `position` (the paper's), `range_bearing` and `bearing`.

All measure in the sensor's frame, whose pose is the robot's composed with the mounting. Functions
are written for one particle and one landmark; components may also be arrays that broadcast, and
the filter passes all at once. A landmark is its mean, the lower factor of its covariance and, for
`bearing`, its anchor: `position` and `range_bearing` keep the point in the world (x, y);
`bearing` keeps (direction, inverse depth) as seen from the anchor, the sensor's position when the
landmark was begun, so that it is a 2-D normal from the first measurement on (Civera, Davison and
Montiel 2008, in the plane; given the particle's path the anchor is known exactly).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.config import Config
from jaxslam.models import geometry
from jaxslam.models.geometry import direction, norm, wrap

LEAST_INVERSE_DEPTH = 1e-3
TURNING = 0.1  # m/rad: driving that changes errors as much as turning does
MOST_INFLATION = 1e4  # of a variance, while the robot stands
LOG_2PI = math.log(2 * math.pi)


class Measurements(NamedTuple):
    """Up to K measurements of one frame, padded (or of T frames, stacked).

    `value` [K, 2], m and rad: (range, bearing), (x, y) or (bearing, 0). `cov` [K, 3]: (xx, xy, yy)
    of a position (m^2), else zero. `identity` [K]: index of a measured identity, -1 if none.
    `valid` [K]: false for padding. `active` []: whether the sensor measured at all. `scale` [K]: 1
    where a position's size rests on odometry, else 0 (None: nowhere). `descriptor` [K, J]:
    appearances, `within` [J]: their variance for one landmark (`logs/appearance_space.py`; None:
    there are none).
    """

    value: jax.Array
    cov: jax.Array
    identity: jax.Array
    valid: jax.Array
    active: jax.Array
    scale: jax.Array | None = None
    descriptor: jax.Array | None = None
    within: jax.Array | None = None

    @classmethod
    def from_values(
        cls,
        values: ArrayLike,
        config: Config,
        cov: ArrayLike | None = None,
        identity: ArrayLike | None = None,
    ) -> "Measurements":
        """`Measurements` of one frame from its n <= K measurements, with padding up to K.

        `values` [n, 2]: (range, bearing) or (x, y); for `bearing` [n]. `cov` [n, 3]: (xx, xy, yy),
        for `position`. `identity` [n]: from 0, for known association. Raises `ValueError` for
        more than `config.measurements` values or arrays of other shapes.
        """
        values = np.asarray(values, float)
        n, size = len(values), config.measurements
        if n > size:
            raise ValueError(f"values: {n} are more than Config.measurements, {size}")
        if config.sensor == "bearing":
            values = np.column_stack([values, np.zeros(n)])
        padded = np.zeros((size, 2)), np.zeros((size, 3)), np.full(size, -1, np.int32)
        for array, given in zip(padded, (values, cov, identity), strict=True):
            if given is not None:
                array[:n] = given
        return cls(*padded, valid=np.arange(size) < n, active=np.array(True))


class Prediction(NamedTuple):
    """Predicted measurement of one landmark: `value`, `rows` of its Jacobian by the landmark,
    `noise` variances; and the landmark's `range` (m) and `bearing` (rad) from the sensor.

    `stretch`: for `bearing`, the derivative by the landmark of the logarithm of `ray`'s length.
    With the bearing's row h, the bearing's Hessian is -(stretch h' + h stretch'), but for the
    curvature of the ray's direction.
    """

    value: tuple
    rows: tuple
    noise: tuple
    range: jax.Array
    bearing: jax.Array
    stretch: tuple = ()


def apply_position_scale(measurements, params):
    """Multiply positions whose size rests on odometry by `gain_tran`, to true metres.

    A triangle over a distance d is as much too small as d is. The covariances stay: the gain is
    within a few per cent of 1.
    """
    if measurements.scale is None:
        return measurements
    gain = 1 + measurements.scale * (params.gain_tran - 1)
    return measurements._replace(value=measurements.value * gain[:, None])


def correlated_noise(params, odometry):
    """Inflate the measurement noise of `Params` for errors that are correlated over frames.

    Errors that follow a first-order autoregression in the travelled path d have correlation
    exp(-d / correlation) from frame to frame; many such frames tell as much as independent ones
    with coth(d / (2 correlation)) times the variance. Turning counts a little (`TURNING`): a lens's
    errors change with it, and a turn in place without measurements would lose the heading, which
    constant errors do not spoil (experiments/correlation.py).
    """
    on = params.correlation > 0
    travel = odometry.distance + TURNING * odometry.turn
    half = travel / (2 * jnp.where(on, params.correlation, 1.0))
    inflation = 1 / jnp.tanh(jnp.clip(half, 1 / MOST_INFLATION, 10.0))
    root = jnp.where(on, jnp.sqrt(inflation), 1.0)
    names = ("sigma_bearing", "landmark_extent", "sigma_range", "position_scale")
    return params._replace(**{name: getattr(params, name) * root for name in names})


def sensor_pose_of(pose, params):
    """Pose of the sensor, from the robot's and the mounting."""
    return geometry.compose(pose, (params.mount_x, params.mount_y, params.mount_yaw))


def bearing_variance(r, params):
    """Variance (rad^2) of a bearing at range `r` (m): landmarks have a size, `landmark_extent`."""
    return params.sigma_bearing**2 + (params.landmark_extent / r) ** 2


def ray(sensor_pose, mean, anchor):
    """Vector (x, y) from the sensor to a `bearing` landmark, in world axes, divided by its depth;
    and its derivatives by direction and by inverse depth, in which it is linear."""
    c, s = jnp.cos(mean[0]), jnp.sin(mean[0])
    ax, ay = anchor[0] - sensor_pose[0], anchor[1] - sensor_pose[1]
    return (mean[1] * ax + c, mean[1] * ay + s), (-s, c), (ax, ay)


def along_ray(point, by_direction, by_depth, depth, heading, params):
    """`Prediction` of a `bearing` landmark, from its `ray` and the derivatives."""
    (dx, dy), (tx, ty), (ax, ay) = point, by_direction, by_depth
    q = norm(dx, dy)
    bearing = wrap(direction(dy, dx) - heading)
    scale = 1 / (q * q)
    row = ((dx * ty - dy * tx) * scale, (dx * ay - dy * ax) * scale)
    stretch = ((dx * tx + dy * ty) * scale, (dx * ax + dy * ay) * scale)
    r = q / jnp.maximum(depth, LEAST_INVERSE_DEPTH)
    variance = params.sigma_bearing**2 + (params.landmark_extent * depth / q) ** 2
    return Prediction((bearing,), (row,), (variance,), r, bearing, stretch)


def observe(sensor, sensor_pose, mean, anchor, params):
    """Predict the measurement of a landmark (eq. 3): `Prediction`; no `noise` for `position`."""
    sx, sy, heading = sensor_pose
    if sensor == "bearing":
        return along_ray(*ray(sensor_pose, mean, anchor), mean[1], heading, params)
    dx, dy = mean[0] - sx, mean[1] - sy
    r = norm(dx, dy)
    bearing = wrap(direction(dy, dx) - heading)
    if sensor == "position":
        c, s = jnp.cos(heading), jnp.sin(heading)
        return Prediction((c * dx + s * dy, c * dy - s * dx), ((c, s), (-s, c)), (), r, bearing)
    inverse = 1 / r  # one division: XLA repeats it in everything that depends on it
    c, s = dx * inverse, dy * inverse
    rows = ((c, s), (-s * inverse, c * inverse))
    noise = (params.sigma_range**2, bearing_variance(r, params))
    return Prediction((r, bearing), rows, noise, r, bearing)


def locate(sensor, sensor_pose, value, cov, params):
    """Locate a new landmark by one measurement: mean, factor, anchor (inverse of `observe`)."""
    sx, sy, heading = sensor_pose
    anchor = (sx, sy)
    if sensor == "bearing":
        variance = params.sigma_bearing**2 + (params.landmark_extent * params.inv_depth_mean) ** 2
        mean = (heading + value[0], params.inv_depth_mean + jnp.zeros_like(sx))
        zero = jnp.zeros_like(sx)
        return mean, (jnp.sqrt(variance) + zero, zero, params.inv_depth_sd + zero), anchor
    if sensor == "position":
        px, py = value
        c, s = jnp.cos(heading), jnp.sin(heading)
        xx, xy, yy = (component * params.position_scale**2 for component in cov)
        top = c * c * xx - 2 * c * s * xy + s * s * yy
        side = c * s * (xx - yy) + (c * c - s * s) * xy
        factor = geometry.cholesky(top, side, xx * yy - xy * xy)
        return (sx + c * px - s * py, sy + s * px + c * py), factor, anchor
    r, b = value
    r = jnp.maximum(r, 1e-6)
    c, s = jnp.cos(heading + b), jnp.sin(heading + b)
    along, across = params.sigma_range**2, r**2 * bearing_variance(r, params)
    factor = geometry.cholesky(
        c * c * along + s * s * across, c * s * (along - across), along * across
    )
    return (sx + r * c, sy + r * s), factor, anchor


def log_new_density(sensor, value, params):
    """Log density of measurements `value` of new landmarks, `density_new` of them per m^2."""
    if sensor == "bearing":
        area = params.view_range**2 / 2 + jnp.zeros_like(value[0])
    elif sensor == "position":
        area = jnp.ones_like(value[0])
    else:
        area = jnp.maximum(value[0], 1e-6)
    return jnp.log1p(-params.outlier) + jnp.log(params.density_new * area)


def cap_new_density(params):
    """Limit `density_new` of `Params` to one new landmark expected per frame, for unknown data
    association by bearings alone.

    A bearing fixes no place. `density_new` over the whole view counts landmarks that are in the map
    already, so that where they are dense everything would be new.
    """
    width = params.view_max - params.view_min
    most = 2 / (width * params.view_range**2)
    return params._replace(density_new=jnp.minimum(params.density_new, most))


def log_clutter_density(sensor, params):
    """Log density of clutter: uniform over the view, with probability `outlier`."""
    width = params.view_max - params.view_min
    volume = {
        "bearing": width,
        "position": width * params.view_range**2 / 2,
        "range_bearing": width * params.view_range,
    }[sensor]
    return jnp.log(params.outlier) - jnp.log(volume)
