"""The baseline's landmarks: one 2 x 2 EKF each, for the three sensors, in plain NumPy.

A landmark is a point (x, y) in the world; for the sensor `bearing` it is (direction phi, inverse
depth rho) seen from `anchor`, where the sensor stood when it first saw it. Textbook equations in
covariance form, float64, importing nothing of the filter: see `baseline`. `s` is the sensor's pose
in the world [3], `model` the filter's `Params` and `Config` in one record.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

MIN_RANGE = 1e-6  # m; a landmark under the sensor has no bearing
MIN_INV_DEPTH = 1e-3  # 1/m; an update must not push a landmark through infinity


@dataclass(eq=False)
class Landmark:
    """One landmark's EKF, a factor of the paper's eq. 6; an empty slot holds None instead."""

    mean: np.ndarray  # [2]
    cov: np.ndarray  # [2, 2]
    anchor: np.ndarray  # [2] world, m
    count: int  # times matched, the birth included
    log_odds: float  # of its existence
    birth: int  # frame * K + measurement


class Prediction(NamedTuple):
    value: np.ndarray  # [d] what the sensor should read
    jacobian: np.ndarray  # [d, 2] its derivative by the landmark
    bearing: float  # sensor frame
    range: float  # m


def wrap(angle):
    """The angle in [-pi, pi)."""
    return angle - 2 * math.pi * np.floor((angle + math.pi) / (2 * math.pi))


def rotation(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def sensor_pose(pose, model):
    """Where the sensor is in the world [3], from the robot's pose and the mounting."""
    xy = pose[:2] + rotation(pose[2]) @ [model.mount_x, model.mount_y]
    return np.append(xy, pose[2] + model.mount_yaw)


def predict(landmark, s, model):
    """The measurement expected at s (paper, eq. 3), linearised at the landmark's mean."""
    if model.sensor == "bearing":
        phi, rho = landmark.mean
        shift = landmark.anchor - s[:2]
        dx, dy = rho * shift + [math.cos(phi), math.sin(phi)]
        q = math.hypot(dx, dy)
        by_phi = dy * math.sin(phi) + dx * math.cos(phi)
        jacobian = np.array([[by_phi, dx * shift[1] - dy * shift[0]]]) / q**2
        bearing = wrap(math.atan2(dy, dx) - s[2])
        return Prediction(np.array([bearing]), jacobian, bearing, q / rho)
    dx, dy = landmark.mean - s[:2]
    r = max(math.hypot(dx, dy), MIN_RANGE)
    bearing = wrap(math.atan2(dy, dx) - s[2])
    if model.sensor == "range_bearing":
        jacobian = np.array([[dx / r, dy / r], [-dy / r**2, dx / r**2]])
        return Prediction(np.array([r, bearing]), jacobian, bearing, r)
    return Prediction(rotation(s[2]).T @ [dx, dy], rotation(s[2]).T, bearing, r)


def noise(r, measurement, model):
    """R [d, d] at range r. `position` has the paper's 2-D normal error (section III-B.3)."""
    if model.sensor == "position":
        return model.position_scale**2 * measurement.cov
    var_bearing = model.sigma_bearing**2 + (model.growth / max(r, MIN_RANGE)) ** 2
    if model.sensor == "bearing":
        return np.array([[var_bearing]])
    return np.diag([model.sigma_range**2, var_bearing])


def innovation(landmark, measurement, expected, model):
    """Measured minus predicted nu [d], its covariance S = H P H' + R and log N(nu; 0, S).

    The density is p(z | x, M) of the paper's eq. 3 with the landmark integrated out.
    """
    h = expected.jacobian
    s = h @ landmark.cov @ h.T + noise(expected.range, measurement, model)
    nu = measurement.value - expected.value
    if model.sensor != "position":
        nu[-1] = wrap(nu[-1])  # the bearing comes last
    squared = nu @ np.linalg.inv(s) @ nu
    log_det = np.log(np.linalg.det(s)) + len(nu) * math.log(2 * math.pi)
    return nu, s, -0.5 * (squared + log_det)


def update(landmark, measurement, s, model):
    """Correct one landmark in place (paper, eq. 5 for one factor of eq. 6).

    Returns the log predictive density of the measurement: what it adds to the particle's weight.
    """
    expected = predict(landmark, s, model)
    nu, nu_cov, log_density = innovation(landmark, measurement, expected, model)
    gain = landmark.cov @ expected.jacobian.T @ np.linalg.inv(nu_cov)
    landmark.mean = landmark.mean + gain @ nu
    cov = (np.eye(2) - gain @ expected.jacobian) @ landmark.cov
    landmark.cov = (cov + cov.T) / 2
    if model.sensor == "bearing":
        landmark.mean[1] = max(landmark.mean[1], MIN_INV_DEPTH)
    landmark.count += 1
    return log_density


def create(measurement, s, birth, model):
    """A landmark seen for the first time, from sensor pose s [3]."""
    if model.sensor == "bearing":
        mean = np.array([s[2] + measurement.value[0], model.inv_depth_mean])
        var_phi = model.sigma_bearing**2 + (model.growth * model.inv_depth_mean) ** 2
        cov = np.diag([var_phi, model.inv_depth_sd**2])
    else:
        r, point, jacobian = None, measurement.value, rotation(s[2])
        if model.sensor == "range_bearing":
            r, b = measurement.value
            point = r * np.array([math.cos(b), math.sin(b)])
            jacobian = rotation(s[2] + b) @ np.diag([1.0, r])
        mean = s[:2] + rotation(s[2]) @ point
        cov = jacobian @ noise(r, measurement, model) @ jacobian.T
    return Landmark(mean, cov, s[:2].copy(), 1, model.existence_new, birth)


def point_of(landmark, sensor):
    """Mean [2] and covariance [2, 2] of the landmark as a point in the world, m."""
    if sensor != "bearing":
        return landmark.mean.copy(), landmark.cov.copy()
    phi, rho = landmark.mean
    ray = np.array([math.cos(phi), math.sin(phi)])
    jacobian = np.column_stack([[-ray[1] / rho, ray[0] / rho], -ray / rho**2])
    return landmark.anchor + ray / rho, jacobian @ landmark.cov @ jacobian.T
