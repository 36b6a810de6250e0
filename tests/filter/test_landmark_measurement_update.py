"""One landmark's update, against plain NumPy in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from landmark_cases import COV, PARAMS, SENSOR_POSE, case, matrix, padded, predict, wrap
from scipy.stats import multivariate_normal

from jaxslam.config import SENSORS, Config
from jaxslam.filter import landmarks
from jaxslam.models import geometry, sensors
from jaxslam.reference import ekf
from jaxslam.reference.fastslam import make_model


def jacobian(sensor, mean, anchor, h=1e-6):
    columns = []
    for step in h * np.eye(2):
        ends = [predict(sensor, mean + sign * step, anchor)[0] for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * h))
    return np.array(columns).T


def kalman(sensor, mean, cov, anchor, value):
    """Textbook EKF in covariance form: mean, covariance, log density of the measurement."""
    expected, r = predict(sensor, mean, anchor)
    bearing_var = PARAMS.sigma_bearing**2 + (PARAMS.landmark_extent / r) ** 2
    xx, xy, yy = PARAMS.position_scale**2 * np.array(COV)
    noise = {
        "bearing": np.array([[bearing_var]]),
        "range_bearing": np.diag([PARAMS.sigma_range**2, bearing_var]),
        "position": np.array([[xx, xy], [xy, yy]]),
    }[sensor]
    h = jacobian(sensor, mean, anchor)
    s = h @ cov @ h.T + noise
    innovation = value - expected
    if sensor != "position":
        innovation[-1] = wrap(innovation[-1])
    gain = cov @ h.T @ np.linalg.inv(s)
    after = (np.eye(2) - gain @ h) @ cov
    density = multivariate_normal(np.zeros(len(s)), s).logpdf(innovation)
    return mean + gain @ innovation, after, density


@pytest.mark.parametrize("sensor", ["position", "range_bearing"])
@pytest.mark.parametrize("seed", range(4))
def test_update_is_the_kalman_filter_in_covariance_form(x64, sensor, seed):
    mean, factor, anchor, value = case(sensor, seed)
    cov = matrix(geometry.covariance(factor))
    got, root, density = landmarks.update(
        sensor, SENSOR_POSE, tuple(mean), tuple(factor), anchor, padded(value), COV, PARAMS
    )
    want_mean, want_cov, want_density = kalman(sensor, mean, cov, anchor, value)
    np.testing.assert_allclose(got, want_mean, atol=1e-8)
    np.testing.assert_allclose(matrix(geometry.covariance(root)), want_cov, atol=1e-8)
    assert float(density) == pytest.approx(want_density, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_well_known_bearing_landmark_is_a_kalman_filter(x64, seed):
    mean, factor, anchor, value = case("bearing", seed)
    factor = factor / 100
    cov = matrix(geometry.covariance(factor))
    got, root, density = landmarks.update(
        "bearing", SENSOR_POSE, tuple(mean), tuple(factor), anchor, padded(value), COV, PARAMS
    )
    want_mean, want_cov, want_density = kalman("bearing", mean, cov, anchor, value)
    np.testing.assert_allclose(got - mean, want_mean - mean, rtol=0.02, atol=1e-8)
    np.testing.assert_allclose(matrix(geometry.covariance(root)), want_cov, rtol=2e-3, atol=1e-11)
    assert float(density) == pytest.approx(want_density, abs=1e-3)


def on_a_grid(first, sigma, landmark_extent, values, x, size=200):
    """Mean and covariance of (direction, inverse depth) given bearings at (x, 0), sensor ahead."""
    phi = (first + np.linspace(-5, 5, size) * sigma)[:, None]
    rho = np.linspace(1e-3, PARAMS.inv_depth_mean + 5 * PARAMS.inv_depth_sd, size)[None]
    log_p = -0.5 * ((phi - first) ** 2 / (sigma**2 + landmark_extent**2 * rho**2))
    log_p = log_p - 0.5 * np.log(sigma**2 + landmark_extent**2 * rho**2)
    log_p = log_p - 0.5 * ((rho - PARAMS.inv_depth_mean) / PARAMS.inv_depth_sd) ** 2
    for value, at in zip(values, x, strict=True):
        dx, dy = np.cos(phi) - rho * at, np.sin(phi)
        variance = sigma**2 + landmark_extent**2 * rho**2 / (dx**2 + dy**2)
        log_p = log_p - 0.5 * wrap(value - np.arctan2(dy, dx)) ** 2 / variance
        log_p = log_p - 0.5 * np.log(variance)
    p = np.exp(log_p - log_p.max())
    p = p / p.sum()
    mean = np.array([(p * phi).sum(), (p * rho).sum()])
    d0, d1 = phi - mean[0], rho - mean[1]
    return mean, [
        [(p * d0 * d0).sum(), (p * d0 * d1).sum()],
        [(p * d0 * d1).sum(), (p * d1**2).sum()],
    ]


@pytest.mark.parametrize("ahead", [0.0, 3.0, 10.0, 60.0])
def test_a_bearing_landmark_stays_with_the_exact_posterior(ahead):
    """2 m driven past it or towards it, depth drawn from the prior: expected NEES under the exact
    posterior, which should be 2. One EKF has hundreds straight ahead."""
    rng, draws, sigma, landmark_extent = np.random.default_rng(5), 40, np.deg2rad(4), 0.02
    params = PARAMS._replace(sigma_bearing=float(sigma), landmark_extent=landmark_extent)
    first = np.deg2rad(ahead)
    rho = np.abs(rng.normal(params.inv_depth_mean, params.inv_depth_sd, draws))
    phi = first + rng.normal(size=draws) * np.hypot(sigma, landmark_extent * rho)
    x = 0.1 * np.arange(1, 21)
    dx, dy = np.cos(phi) - rho * x[:, None], np.sin(phi) + 0 * x[:, None]
    noise = np.sqrt(sigma**2 + landmark_extent**2 * rho**2 / (dx**2 + dy**2))
    values = np.arctan2(dy, dx) + noise * rng.normal(size=dx.shape)

    zero = jnp.zeros(draws)
    mean, factor, anchor = sensors.locate("bearing", (zero, zero, zero), (first, 0.0), None, params)

    def update(state, seen):
        at, value = seen
        pose = (zero + at, zero, zero)
        after = landmarks.update("bearing", pose, *state, anchor, (value, 0.0), None, params)
        return after[:2], after[2]

    given = jnp.asarray(x, jnp.float32), jnp.asarray(values, jnp.float32)
    (mean, factor), _ = jax.jit(lambda s, g: jax.lax.scan(update, s, g))((mean, factor), given)
    cov = np.moveaxis(matrix(np.asarray(geometry.covariance(factor), float)), -1, 0)
    nees = []
    for i in range(draws):
        exact_mean, exact_cov = on_a_grid(first, sigma, landmark_extent, values[:, i], x)
        off = exact_mean - np.asarray(mean, float)[:, i]
        nees.append(np.trace(np.linalg.solve(cov[i], exact_cov + np.outer(off, off))))
    assert 1.0 < np.median(nees) < 3.0
    assert np.mean(nees) < 10.0


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("seed", range(4))
def test_update_is_the_baselines(x64, sensor, seed):
    mean, factor, anchor, value = case(sensor, seed)
    cov = matrix(geometry.covariance(factor))
    got, root, density = landmarks.update(
        sensor, SENSOR_POSE, tuple(mean), tuple(factor), anchor, padded(value), COV, PARAMS
    )
    other = ekf.Landmark(mean.copy(), cov.copy(), anchor, 1, 0.0, 0)
    measured = type("Measured", (), {"value": value, "cov": matrix(COV)})
    model = make_model(PARAMS, Config(sensor=sensor))
    expected = ekf.update(other, measured, SENSOR_POSE, model)
    np.testing.assert_allclose(got, other.mean, atol=1e-11)
    np.testing.assert_allclose(matrix(geometry.covariance(root)), other.cov, atol=1e-11)
    assert float(density) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_two_whitened_scalars_have_the_joint_density(x64, seed):
    rng = np.random.default_rng(seed)
    mean, factor, anchor, value = case("position", seed)
    spread = rng.normal(size=(2, 2))
    noise = spread @ spread.T + 0.01 * np.eye(2)  # of any correlation
    cov = noise[0, 0], noise[0, 1], noise[1, 1]
    *_, density = landmarks.update(
        "position", SENSOR_POSE, tuple(mean), tuple(factor), anchor, tuple(value), cov, PARAMS
    )
    c, s = np.cos(SENSOR_POSE[2]), np.sin(SENSOR_POSE[2])
    turn = np.array([[c, s], [-s, c]])
    prior = turn @ matrix(geometry.covariance(factor)) @ turn.T
    joint = multivariate_normal(
        turn @ (mean - SENSOR_POSE[:2]), prior + PARAMS.position_scale**2 * noise
    )
    assert float(density) == pytest.approx(joint.logpdf(value), abs=1e-9)


def test_bearings_far_behind_never_push_a_landmark_through_infinity(x64):
    anchor, mean, factor = np.array([0.5, -1.5]), (0.9, 0.01), (0.02, 0.0, 0.5)
    value = predict("bearing", np.array(mean), anchor)[0]
    depths = []
    for off in (-0.5, 0.5):
        (_, depth), _, _ = landmarks.update(
            "bearing", SENSOR_POSE, mean, factor, anchor, (value[0] + off, 0.0), COV, PARAMS
        )
        depths.append(float(depth))
    assert min(depths) == sensors.LEAST_INVERSE_DEPTH < max(depths)


def test_bearings_across_the_cut_are_close(x64):
    mean, factor = (
        (SENSOR_POSE[0] - 3 * np.cos(0.8), SENSOR_POSE[1] - 3 * np.sin(0.8)),
        (0.1, 0, 0.1),
    )
    kept = [
        landmarks.update(
            "range_bearing", SENSOR_POSE, mean, factor, None, (3.0, bearing), COV, PARAMS
        )
        for bearing in (np.pi - 0.01, -np.pi - 0.01)
    ]
    np.testing.assert_allclose(kept[0][0], kept[1][0], atol=1e-9)
    assert np.hypot(*(np.array(kept[0][0]) - mean)) < 0.1
