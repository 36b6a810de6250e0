"""The baseline's landmark EKF: Jacobians, births and updates against closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from jaxslam.reference import ekf

SENSORS = ("position", "range_bearing", "bearing")
NOISE = {"sigma_range": 0.1, "sigma_bearing": 0.05, "landmark_extent": 0.03, "position_scale": 1.5}
NEWBORN = {"inv_depth_mean": 0.3, "inv_depth_sd": 0.2, "existence_new": 1.0}


def make_model(sensor, **changes):
    return SimpleNamespace(**NOISE | NEWBORN | {"sensor": sensor} | changes)


def make_landmark(mean, cov=((0.05, 0.01), (0.01, 0.02)), anchor=(0.0, 0.0)):
    return ekf.Landmark(np.array(mean), np.array(cov), np.array(anchor), 1, 1.0, 0)


def make_reading(value):
    return SimpleNamespace(value=np.array(value), cov=np.array([[0.04, 0.01], [0.01, 0.02]]))


def log_normal(x, cov):
    return -0.5 * (x @ np.linalg.solve(cov, x) + np.linalg.slogdet(2 * np.pi * cov)[1])


@pytest.mark.parametrize("sensor", SENSORS)
def test_jacobian_is_the_finite_difference(sensor):
    model = make_model(sensor)
    mean = [0.7, 0.4] if sensor == "bearing" else [2.5, 1.0]
    s, step = np.array([0.6, -0.5, 2.8]), 1e-6
    landmark = make_landmark(mean, anchor=(0.1, 0.2))
    columns = []
    for d in np.eye(2) * step:
        ends = [make_landmark(mean + sign * d, anchor=(0.1, 0.2)) for sign in (1, -1)]
        up, down = (ekf.predict(end, s, model) for end in ends)
        columns.append((up.value - down.value) / (2 * step))
    jacobian = ekf.predict(landmark, s, model).jacobian
    np.testing.assert_allclose(jacobian, np.array(columns).T, atol=1e-8)


@pytest.mark.parametrize("sensor", SENSORS)
def test_created_landmark_predicts_its_own_measurement(sensor):
    """At the birth pose; its covariance there is the measurement's noise."""
    model = make_model(sensor)
    s = np.array([0.6, -0.5, 2.8])
    reading = make_reading({"position": [2.0, 1.0], "bearing": [0.6]}.get(sensor, [2.2, 0.6]))
    landmark = ekf.create(reading, s, 7, model)
    view = ekf.predict(landmark, s, model)
    np.testing.assert_allclose(view.value, reading.value, atol=1e-12)
    cov = view.jacobian @ landmark.cov @ view.jacobian.T
    np.testing.assert_allclose(cov, ekf.noise(view.range, reading, model), atol=1e-12)
    assert (landmark.count, landmark.landmark_id, landmark.log_odds) == (1, 7, 1.0)
    assert view.range == pytest.approx(1 / 0.3 if sensor == "bearing" else np.hypot(*[2, 1]), 0.02)


@pytest.mark.parametrize("sensor", ["position", "range_bearing"])
def test_update_is_the_information_form(sensor):
    """P+ = (P^-1 + H' R^-1 H)^-1, m+ = m + P+ H' R^-1 nu; the angle's innovation is wrapped."""
    model = make_model(sensor)
    s = np.array([3.0, 0.1, 0.0])  # looks back: bearings near +-pi
    landmark = make_landmark([1.0, 0.0])
    before, view = landmark.mean.copy(), ekf.predict(landmark, s, model)
    nu = np.array([0.05, -0.15])[-len(view.value) :]
    reading = make_reading(view.value + nu)
    if sensor != "position":
        reading.value[-1] = ekf.wrap(reading.value[-1])
        assert abs(reading.value[-1] - view.value[-1]) > 6
    h, r = view.jacobian, ekf.noise(view.range, reading, model)
    cov = np.linalg.inv(np.linalg.inv(landmark.cov) + h.T @ np.linalg.inv(r) @ h)
    expected = log_normal(nu, h @ landmark.cov @ h.T + r)

    assert ekf.update(landmark, reading, s, model) == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(landmark.mean, before + cov @ h.T @ np.linalg.inv(r) @ nu)
    np.testing.assert_allclose(landmark.cov, cov, atol=1e-14)
    assert landmark.count == 2


def test_parts_of_a_bearing_landmark_are_together_what_it_was():
    landmark = make_landmark([0.7, 0.4], cov=((0.01, 0.006), (0.006, 0.04)))
    weights, parts = zip(*ekf.apart(landmark), strict=True)
    assert sum(weights) == pytest.approx(1)
    assert all(part.cov[1, 1] < 0.3 * 0.04 for part in parts)
    together = make_landmark([9.0, 9.0])
    ekf.merge(together, np.array(weights), parts)
    np.testing.assert_allclose(together.mean, landmark.mean)
    np.testing.assert_allclose(together.cov, landmark.cov)


def test_hessian_is_the_finite_difference_but_for_the_rays_own_curvature():
    model, s, anchor, step = make_model("bearing"), np.array([0.6, -0.5, 2.8]), (0.1, 0.2), 1e-5
    columns = []
    for d in np.eye(2) * step:
        ends = [make_landmark(np.array([0.7, 0.4]) + e * d, anchor=anchor) for e in (1, -1)]
        up, down = (ekf.predict(end, s, model, centre=0.7).jacobian[0] for end in ends)
        columns.append((up - down) / (2 * step))
    hessian = ekf.predict(make_landmark([0.7, 0.4], anchor=anchor), s, model).hessian
    np.testing.assert_allclose(hessian, np.array(columns), atol=1e-7)


def test_bearing_update_never_reaches_infinity():
    model = make_model("bearing")
    landmark = make_landmark([0.5, 0.3], cov=((1e-4, 0.0), (0.0, 4.0)))
    ekf.update(landmark, make_reading([-0.2]), np.array([0.5, -0.9, 0.0]), model)
    assert landmark.mean[1] == ekf.MIN_INV_DEPTH


def test_mounting_turns_with_the_robot():
    mount = SimpleNamespace(mount_x=0.2, mount_y=-0.1, mount_yaw=0.3)
    s = ekf.sensor_pose(np.array([1.0, 2.0, np.pi / 2]), mount)
    np.testing.assert_allclose(s, [1.1, 2.2, np.pi / 2 + 0.3])


def test_wrap_is_in_the_half_open_interval():
    angles = np.array([np.pi, -np.pi, 3.5, -3.5, 0.0, 20.0])
    wrapped = ekf.wrap(angles)
    assert np.all((wrapped >= -np.pi) & (wrapped < np.pi))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-14)


@pytest.mark.parametrize("sensor", ["position", "range_bearing"])
def test_point_of_a_point_is_a_copy(sensor):
    landmark = make_landmark([1.0, 2.0])
    mean, cov = ekf.point_of(landmark, sensor)
    mean[0] = cov[0, 0] = 9.0
    assert (landmark.mean[0], landmark.cov[0, 0]) == (1.0, 0.05)


def test_point_of_a_bearing_landmark_has_its_jacobian():
    mean, anchor, cov = np.array([2.0, 0.4]), np.array([1.0, -1.0]), [[0.01, 0.005], [0.005, 0.04]]
    point, point_cov = ekf.point_of(make_landmark(mean, cov, anchor), "bearing")

    def place(phi, rho):
        return anchor + np.array([math.cos(phi), math.sin(phi)]) / rho

    steps = np.eye(2) * 1e-6
    j = np.array([(place(*(mean + d)) - place(*(mean - d))) / 2e-6 for d in steps]).T
    np.testing.assert_allclose(point, place(*mean))
    np.testing.assert_allclose(point_cov, j @ cov @ j.T, rtol=1e-6, atol=1e-9)
