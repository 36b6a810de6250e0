"""For tests of the map: landmarks, measurements of them, and maps full of them."""

import jax.numpy as jnp
import numpy as np

from jaxslam.filter import landmarks
from jaxslam.parameters import default_params

PARAMS = default_params()._replace(
    landmark_extent=0.02, position_scale=1.3, mount_x=0.2, mount_yaw=0.1, extra_bearing_noise=0.0
)
COV = (0.04, -0.015, 0.02)  # of a position: correlated
SENSOR_POSE = np.array([0.5, -0.3, 0.8])


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def predict(sensor, mean, anchor):
    """What the sensor should read, from the geometry."""
    if sensor == "bearing":
        point = anchor + np.array([np.cos(mean[0]), np.sin(mean[0])]) / mean[1]
    else:
        point = mean
    dx, dy = point - SENSOR_POSE[:2]
    r, bearing = np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - SENSOR_POSE[2])
    if sensor == "position":
        return r * np.array([np.cos(bearing), np.sin(bearing)]), r
    return np.array([bearing] if sensor == "bearing" else [r, bearing]), r


def case(sensor, seed):
    """A landmark (mean, lower factor, anchor) and a measurement of it that is some way off."""
    rng = np.random.default_rng(seed)
    low, high = ((-3, 0.2), (3, 1.0)) if sensor == "bearing" else ((2, 2), (5, 5))
    mean, anchor = rng.uniform(low, high), rng.uniform(-1, 1, 2)
    size = 0.05 if sensor == "bearing" else 0.5
    factor = size * np.array([rng.uniform(0.5, 2), rng.uniform(-1, 1), rng.uniform(0.5, 2)])
    value = predict(sensor, mean, anchor)[0] + rng.normal(0, 0.1, 1 if sensor == "bearing" else 2)
    return mean, factor, anchor, value


def matrix(parts):
    xx, xy, yy = (np.asarray(p) for p in parts)
    return np.array([[xx, xy], [xy, yy]])


def padded(value):
    return tuple(np.append(value, 0.0)[:2])


def world_of(sensor, count, seed=0, forgetting=True):
    """A map with landmarks in the slots where `count` [M, N] is not zero."""
    count = np.asarray(count)
    slots, particles = count.shape
    rng = np.random.default_rng(seed)
    cases = [[case(sensor, rng.integers(1 << 30)) for _ in range(particles)] for _ in range(slots)]

    def stack(i):
        return jnp.asarray(np.moveaxis([[np.asarray(c[i]) for c in row] for row in cases], -1, 0))

    return landmarks.Landmarks(
        mean=stack(0),
        factor=stack(1),
        anchor=stack(2) if sensor == "bearing" else None,
        log_odds=jnp.full(count.shape, 2.0) if forgetting else None,
        count=jnp.asarray(count, jnp.int32),
        landmark_id=jnp.asarray(rng.integers(0, 100, count.shape), jnp.int32),
    )
