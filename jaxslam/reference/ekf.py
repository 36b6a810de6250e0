"""The landmarks of the reference: one 2 x 2 EKF each, for the three sensors, in plain NumPy.

A landmark is a point (x, y) in the world; for the sensor `bearing` it is (direction phi, inverse
depth rho) from `anchor`, the sensor's position when it was first seen. Textbook equations in
covariance form, float64, importing nothing of the filter: see `fastslam`. `s` is the sensor's pose
in the world [3], `model` the filter's `Params` and `Config` in one record.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

MIN_RANGE = 1e-6  # m; a landmark under the sensor has no bearing
MIN_INV_DEPTH = 1e-3  # 1/m; an update must not push a landmark through infinity
PARTS, APART = 5, 0.75  # narrower normals a bearing landmark is split into; variance between them


@dataclass(eq=False)
class Landmark:
    """The EKF of one landmark, a factor of the paper's eq. 6; None in an empty slot."""

    mean: np.ndarray  # [2]
    cov: np.ndarray  # [2, 2]
    anchor: np.ndarray  # [2] world, m
    count: int  # measurements, the first included
    log_odds: float  # of its existence
    landmark_id: int  # frame * K + measurement


class Prediction(NamedTuple):
    value: np.ndarray  # [d] expected measurement
    jacobian: np.ndarray  # [d, 2] derivative of the value by the landmark
    bearing: float  # sensor frame
    range: float  # m
    hessian: np.ndarray | None = None  # [2, 2] of a lone bearing


def wrap(angle):
    """Wrap an angle to [-pi, pi)."""
    return angle - 2 * math.pi * np.floor((angle + math.pi) / (2 * math.pi))


def rotation(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def sensor_pose(pose, model):
    """Sensor pose in the world [3], from the robot's pose and the mounting."""
    xy = pose[:2] + rotation(pose[2]) @ [model.mount_x, model.mount_y]
    return np.append(xy, pose[2] + model.mount_yaw)


def predict(landmark, s, model, centre=None):
    """Predict the measurement at s (paper, eq. 3), linearised at the landmark's mean.

    For `bearing` the unit vector of the direction phi is linearised at `centre` (None: the mean).
    """
    if model.sensor == "bearing":
        phi, rho = landmark.mean
        centre = phi if centre is None else centre
        shift = landmark.anchor - s[:2]
        unit, across = rotation(centre).T
        dx, dy = rho * shift + unit + (phi - centre) * across
        q = math.hypot(dx, dy)
        outwards = np.column_stack([across, shift])  # (dx, dy) by (phi, rho)
        jacobian = np.array([[-dy, dx]]) / q**2 @ outwards
        curve = np.array([[2 * dx * dy, dy**2 - dx**2], [dy**2 - dx**2, -2 * dx * dy]]) / q**4
        bearing = wrap(math.atan2(dy, dx) - s[2])
        hessian = outwards.T @ curve @ outwards
        return Prediction(np.array([bearing]), jacobian, bearing, q / rho, hessian)
    dx, dy = landmark.mean - s[:2]
    r = max(math.hypot(dx, dy), MIN_RANGE)
    bearing = wrap(math.atan2(dy, dx) - s[2])
    if model.sensor == "range_bearing":
        jacobian = np.array([[dx / r, dy / r], [-dy / r**2, dx / r**2]])
        return Prediction(np.array([r, bearing]), jacobian, bearing, r)
    return Prediction(rotation(s[2]).T @ [dx, dy], rotation(s[2]).T, bearing, r)


def noise(r, measurement, model):
    """Measurement noise R [d, d] at range r, which is negative for a negative inverse depth.

    `position` has the paper's 2-D normal error (section III-B.3).
    """
    if model.sensor == "position":
        return model.position_scale**2 * measurement.cov
    var_bearing = model.sigma_bearing**2 + (model.landmark_extent / max(abs(r), MIN_RANGE)) ** 2
    if model.sensor == "bearing":
        return np.array([[var_bearing]])
    return np.diag([model.sigma_range**2, var_bearing])


def innovation(landmark, measurement, expected, model):
    """Innovation nu [d], measured minus predicted; its covariance S = H P H' + R; log N(nu; 0, S).

    The density is p(z | x, M) of the paper's eq. 3 with the landmark integrated out. A lone bearing
    is predicted to second order in the landmark.
    """
    h = expected.jacobian
    s = h @ landmark.cov @ h.T + noise(expected.range, measurement, model)
    nu = measurement.value - expected.value
    if model.sensor == "bearing":
        bent = expected.hessian @ landmark.cov
        nu = nu - np.trace(bent) / 2
        s = s + np.trace(bent @ bent) / 2
    if model.sensor != "position":
        nu[-1] = wrap(nu[-1])  # the bearing comes last
    squared = nu @ np.linalg.inv(s) @ nu
    log_det = np.log(np.linalg.det(s)) + len(nu) * math.log(2 * math.pi)
    return nu, s, -0.5 * (squared + log_det)


def update(landmark, measurement, s, model):
    """Correct one landmark in place (paper, eq. 5 for one factor of eq. 6).

    Returns the log predictive density of the measurement, which is added to the log weight. For
    `bearing` it is that of a mixture of normals from near to far.
    """
    if model.sensor == "bearing":
        shares, parts = zip(*apart(landmark), strict=True)
        centre = landmark.mean[0]
        densities = [correct(part, measurement, s, model, centre) for part in parts]
        logs = np.log(shares) + densities
        log_density = np.logaddexp.reduce(logs)
        merge(landmark, np.exp(logs - log_density), parts)
        landmark.mean[1] = max(landmark.mean[1], MIN_INV_DEPTH)
    else:
        log_density = correct(landmark, measurement, s, model)
    landmark.count += 1
    return log_density


def correct(landmark, measurement, s, model, centre=None):
    """Perform the Kalman update in place; returns the measurement's log density."""
    expected = predict(landmark, s, model, centre)
    nu, nu_cov, log_density = innovation(landmark, measurement, expected, model)
    gain = landmark.cov @ expected.jacobian.T @ np.linalg.inv(nu_cov)
    landmark.mean = landmark.mean + gain @ nu
    cov = landmark.cov - gain @ nu_cov @ gain.T
    landmark.cov = (cov + cov.T) / 2
    return log_density


def apart(landmark):
    """Yield (weight, Landmark) of narrower normals along inverse depth, which together have the
    landmark's mean and covariance: Gauss-Hermite points, and the rest of the variance in each."""
    points, weights = np.polynomial.hermite_e.hermegauss(PARTS)
    step = landmark.cov[:, 1] / math.sqrt(landmark.cov[1, 1])
    narrow = landmark.cov - APART * np.outer(step, step)
    for point, weight in zip(points, weights / weights.sum(), strict=True):
        mean = landmark.mean + math.sqrt(APART) * point * step
        yield weight, replace(landmark, mean=mean, cov=narrow)


def merge(landmark, weights, parts):
    """Set the landmark's mean and covariance to those of the mixture of `parts`."""
    means = np.array([part.mean for part in parts])
    landmark.mean = weights @ means
    between = (means - landmark.mean).T @ np.diag(weights) @ (means - landmark.mean)
    within = sum(w * part.cov for w, part in zip(weights, parts, strict=True))
    landmark.cov = within + between


def create(measurement, s, landmark_id, model):
    """Begin a landmark from its first measurement, at sensor pose s [3]."""
    if model.sensor == "bearing":
        mean = np.array([s[2] + measurement.value[0], model.inv_depth_mean])
        var_phi = model.sigma_bearing**2 + (model.landmark_extent * model.inv_depth_mean) ** 2
        cov = np.diag([var_phi, model.inv_depth_sd**2])
    else:
        r, point, jacobian = None, measurement.value, rotation(s[2])
        if model.sensor == "range_bearing":
            r, b = measurement.value
            point = r * np.array([math.cos(b), math.sin(b)])
            jacobian = rotation(s[2] + b) @ np.diag([1.0, r])
        mean = s[:2] + rotation(s[2]) @ point
        cov = jacobian @ noise(r, measurement, model) @ jacobian.T
    return Landmark(mean, cov, s[:2].copy(), 1, model.existence_new, landmark_id)


def point_of(landmark, sensor):
    """Mean [2] and covariance [2, 2] of the landmark as a point in the world, m."""
    if sensor != "bearing":
        return landmark.mean.copy(), landmark.cov.copy()
    phi, rho = landmark.mean
    ray = np.array([math.cos(phi), math.sin(phi)])
    jacobian = np.column_stack([[-ray[1] / rho, ray[0] / rho], -ray / rho**2])
    return landmark.anchor + ray / rho, jacobian @ landmark.cov @ jacobian.T
