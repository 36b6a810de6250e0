from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import SENSORS, Config
from jaxslam.models import geometry, sensors
from jaxslam.parameters import default_params
from jaxslam.reference import fastslam

PARAMS = default_params()._replace(mount_x=0.2, mount_y=-0.1, mount_yaw=0.3, landmark_extent=0.02)
COV = (0.04, 0.01, 0.02)


def scene(sensor, seed):
    """A robot, the sensor on it, and a landmark in the sensor's own parameters."""
    rng = np.random.default_rng(seed)
    pose = tuple(rng.uniform(-3, 3, 3))
    sensor_pose = sensors.sensor_pose_of(pose, PARAMS)
    anchor = tuple(rng.uniform(-1, 1, 2))
    mean = (
        tuple(rng.uniform([-3, 0.1], [3, 2]))
        if sensor == "bearing"
        else tuple(rng.uniform(3, 9, 2))
    )
    return pose, sensor_pose, mean, anchor


def test_the_mounting_puts_the_sensor_on_the_robot():
    got = sensors.sensor_pose_of((1.0, 2.0, np.pi / 2), PARAMS)
    np.testing.assert_allclose(got, [1.1, 2.2, np.pi / 2 + 0.3], atol=1e-6)


def test_a_translation_gain_rescales_positions_that_rest_on_odometry():
    value = jnp.array([[2.0, 1.0], [3.0, -1.0]])
    scale = jnp.array([1.0, 0.0])
    frame = sensors.Measurements(value, jnp.ones((2, 3)), None, None, None, scale)

    def total(gain):
        return sensors.apply_position_scale(frame, PARAMS._replace(gain_tran=gain)).value

    np.testing.assert_allclose(total(1.1), [[2.2, 1.1], [3.0, -1.0]], rtol=1e-6)
    np.testing.assert_allclose(jax.jacobian(total)(1.1), [[2.0, 1.0], [0.0, 0.0]])
    unscaled = frame._replace(scale=None)
    assert sensors.apply_position_scale(unscaled, PARAMS._replace(gain_tran=2.0)) is unscaled


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("seed", range(5))
def test_jacobian_against_finite_differences(x64, sensor, seed):
    _, sensor_pose, mean, anchor = scene(sensor, seed)
    seen = sensors.observe(sensor, sensor_pose, mean, anchor, PARAMS)
    h = 1e-6
    for column in range(2):
        ends = []
        for sign in (1, -1):
            moved = [*mean]
            moved[column] += sign * h
            ends.append(sensors.observe(sensor, sensor_pose, tuple(moved), anchor, PARAMS).value)
        for row, plus, minus in zip(seen.rows, *ends, strict=True):
            slope = geometry.wrap(plus - minus) / (2 * h)
            assert float(row[column]) == pytest.approx(float(slope), abs=1e-7)


@pytest.mark.parametrize("sensor", ["position", "range_bearing"])
@pytest.mark.parametrize("seed", range(5))
def test_locate_inverts_observe_and_carries_the_noise_over(x64, sensor, seed):
    _, sensor_pose, mean, anchor = scene(sensor, seed)
    seen = sensors.observe(sensor, sensor_pose, mean, anchor, PARAMS)
    got, factor, _ = sensors.locate(sensor, sensor_pose, seen.value, COV, PARAMS)
    np.testing.assert_allclose(got, mean, atol=1e-9)
    noise = np.array([[COV[0], COV[1]], [COV[1], COV[2]]])
    if sensor == "range_bearing":
        noise = np.diag(seen.noise)
    back = np.linalg.inv(np.array(seen.rows))
    expected = back @ noise @ back.T
    xx, xy, yy = geometry.covariance(factor)
    np.testing.assert_allclose([[xx, xy], [xy, yy]], expected, atol=1e-9)


def test_a_first_bearing_is_a_ray_from_where_it_was_seen(x64):
    _, sensor_pose, _, _ = scene("bearing", 1)
    mean, factor, anchor = sensors.locate("bearing", sensor_pose, (0.4, 0.0), COV, PARAMS)
    assert anchor == sensor_pose[:2]
    seen = sensors.observe("bearing", sensor_pose, mean, anchor, PARAMS)
    assert float(seen.value[0]) == pytest.approx(0.4)
    assert float(seen.range) == pytest.approx(1 / PARAMS.inv_depth_mean)
    assert float(seen.rows[0][1]) == pytest.approx(0)  # from the anchor depth can't be seen
    assert float(factor[2]) == PARAMS.inv_depth_sd


def test_inverse_depth_and_world_point_predict_the_same_bearing(x64):
    rng = np.random.default_rng(3)
    for _ in range(50):
        anchor, point, pose = rng.uniform(-5, 5, 2), rng.uniform(-5, 5, 2), rng.uniform(-3, 3, 3)
        off = point - anchor
        mean = (np.arctan2(off[1], off[0]), 1 / np.hypot(*off))
        bearing = sensors.observe("bearing", tuple(pose), mean, tuple(anchor), PARAMS)
        both = sensors.observe("range_bearing", tuple(pose), tuple(point), None, PARAMS)
        assert float(geometry.wrap(bearing.value[0] - both.value[1])) == pytest.approx(0, abs=1e-9)
        assert float(bearing.range) == pytest.approx(float(both.range))
        assert float(bearing.noise[0]) == pytest.approx(float(both.noise[1]))


def test_bearings_get_worse_up_close():
    near, far = sensors.bearing_variance(0.5, PARAMS), sensors.bearing_variance(50.0, PARAMS)
    assert near == pytest.approx(PARAMS.sigma_bearing**2 + 0.04**2)
    assert far == pytest.approx(PARAMS.sigma_bearing**2, rel=1e-3)


def test_clutter_is_a_density_over_the_view():
    p = PARAMS._replace(view_min=-1.0, view_max=0.5, view_range=4.0, outlier=0.2)
    volume = {"bearing": 1.5, "range_bearing": 6.0, "position": 12.0}
    for sensor in SENSORS:
        density = jnp.exp(sensors.log_clutter_density(sensor, p))
        assert float(density) * volume[sensor] == pytest.approx(0.2, rel=1e-5)


def test_new_landmarks_are_as_dense_in_the_world_whatever_the_sensor():
    """Integrated over the view, each sensor expects the same number of new landmarks."""
    p = PARAMS._replace(outlier=0.1, density_new=0.3, view_min=-1.0, view_max=1.0, view_range=5.0)
    expected = 0.9 * 0.3 * 25.0  # half the angle times the radius squared, 25 m^2
    r = jnp.linspace(1e-3, 5, 4001)
    by_range = jnp.exp(sensors.log_new_density("range_bearing", (r, 0 * r), p))
    assert float(jnp.trapezoid(by_range, r)) * 2 == pytest.approx(expected, rel=1e-3)
    by_bearing = jnp.exp(sensors.log_new_density("bearing", (jnp.zeros(1), None), p))
    assert float(by_bearing[0]) * 2 == pytest.approx(expected, rel=1e-4)
    flat = jnp.exp(sensors.log_new_density("position", (jnp.zeros(1), None), p))
    assert float(flat[0]) * 25 == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("sensor", SENSORS)
def test_gradients_by_parameters_are_finite_at_the_landmark(sensor):
    """A landmark right under the sensor: no bearing, no range, but no NaN either."""

    def total(params):
        mean = (0.0, 0.5) if sensor == "bearing" else (0.0, 0.0)
        anchor = (-2.0, 0.0)
        seen = sensors.observe(
            sensor, sensors.sensor_pose_of((0.0, 0.0, 0.0), params), mean, anchor, params
        )
        return sum(jnp.sum(part) for part in jax.tree.leaves(seen.value))

    gradient = jax.grad(total)(PARAMS._replace(mount_x=0.0, mount_y=0.0))
    assert np.isfinite(np.array(gradient)).all()


def test_correlated_noise_is_that_of_an_autoregression_averaged(x64):
    """The mean of many AR(1) errors is as certain as that of independent ones so inflated."""
    params = PARAMS._replace(correlation=0.4, sigma_bearing=0.03)
    noisy = sensors.correlated_noise(
        params, SimpleNamespace(distance=jnp.asarray(0.07), turn=jnp.asarray(0.3))
    )
    apart = 0.1 * np.abs(np.subtract.outer(np.arange(1500), np.arange(1500)))
    inflation = np.exp(-apart / 0.4).sum() / 1500
    for name in ("sigma_range", "sigma_bearing", "landmark_extent", "position_scale"):
        ratio = float(getattr(noisy, name)) / getattr(params, name)
        assert ratio**2 == pytest.approx(inflation, rel=0.01)
    assert noisy.outlier == params.outlier


def test_a_robot_that_stands_learns_next_to_nothing_and_white_errors_stay(x64):
    params, still = (
        PARAMS._replace(correlation=0.4),
        SimpleNamespace(distance=jnp.asarray(0.0), turn=jnp.asarray(0.0)),
    )
    ratio = float(sensors.correlated_noise(params, still).sigma_range) / params.sigma_range
    assert ratio**2 == pytest.approx(sensors.MOST_INFLATION, rel=1e-3)
    white = sensors.correlated_noise(PARAMS._replace(correlation=0.0), still)
    assert float(white.sigma_range) == PARAMS.sigma_range

    def noise(correlation, distance):
        moved = SimpleNamespace(distance=distance, turn=0.0)
        return sensors.correlated_noise(
            PARAMS._replace(correlation=correlation), moved
        ).sigma_bearing

    for correlation, distance in ((0.0, 0.0), (0.4, 0.0), (0.4, 0.1), (1e-3, 5.0)):
        assert np.isfinite(jax.grad(noise, (0, 1))(correlation, distance)).all()


@pytest.mark.parametrize("distance", [0.0, 0.03, 1.0, 100.0])
def test_correlated_noise_is_the_baselines(x64, distance):
    params = PARAMS._replace(correlation=0.4)
    moved = SimpleNamespace(distance=distance, turn=distance / 2)
    noisy = sensors.correlated_noise(params, moved)
    model = fastslam.with_extra_noise(fastslam.make_model(params, Config()), moved)
    for name in ("sigma_range", "sigma_bearing", "landmark_extent", "position_scale"):
        assert getattr(model, name) == pytest.approx(float(getattr(noisy, name)), rel=1e-9)
