import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.models import geometry


def test_wrap_brings_any_angle_into_half_open_interval(x64):
    angle = jnp.asarray(np.random.default_rng(0).uniform(-50, 50, 1000))
    wrapped = geometry.wrap(angle)
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    turns = (angle - wrapped) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)


def test_poses_form_a_group(x64):
    a, b, c = jnp.asarray(np.random.default_rng(1).uniform(-3, 3, (3, 3, 1000)))
    left = geometry.compose(geometry.compose(a, b), c)
    right = geometry.compose(a, geometry.compose(b, c))
    np.testing.assert_allclose(jnp.stack(left), jnp.stack(right), atol=1e-12)
    x, y, heading = a
    back = (
        -x * jnp.cos(heading) - y * jnp.sin(heading),
        x * jnp.sin(heading) - y * jnp.cos(heading),
        -heading,
    )
    np.testing.assert_allclose(jnp.stack(geometry.compose(a, back)), 0, atol=1e-12)


def test_direction_is_arctan2_in_single_precision_in_all_octants():
    rng = np.random.default_rng(2)
    angle = rng.uniform(-np.pi, np.pi, 100_000)
    radius = 10 ** rng.uniform(-3, 3, angle.size)
    y, x = (radius * np.sin(angle)).astype("f"), (radius * np.cos(angle)).astype("f")
    got = geometry.direction(jnp.asarray(y), jnp.asarray(x))
    assert got.dtype == jnp.float32
    exact = np.arctan2(y.astype(float), x.astype(float))
    assert np.abs(geometry.wrap(np.asarray(got, float) - exact)).max() < 5e-7
    axes = geometry.direction(jnp.array([0.0, 1, 0, -1]), jnp.array([1.0, 0, -1, 0]))
    np.testing.assert_allclose(axes, [0, np.pi / 2, np.pi, -np.pi / 2], atol=3e-7)


@pytest.mark.parametrize("function", [geometry.direction, geometry.norm])
def test_gradients_are_right_and_finite_at_the_origin(function):
    gradient = jax.grad(function, (0, 1))
    assert np.isfinite(np.array(gradient(0.0, 0.0))).all()
    y, x = 0.7, -1.3
    h = 1e-6
    with jax.enable_x64(True):
        by_y = (function(y + h, x) - function(y - h, x)) / (2 * h)
        by_x = (function(y, x + h) - function(y, x - h)) / (2 * h)
    np.testing.assert_allclose(gradient(y, x), [by_y, by_x], rtol=1e-5)


def test_cholesky_of_known_determinant(x64):
    factor = np.random.default_rng(4).uniform(0.1, 2, (3, 50))
    xx, xy, yy = geometry.covariance(factor)
    again = geometry.cholesky(xx, xy, xx * yy - xy * xy)
    np.testing.assert_allclose(jnp.stack(again), factor, rtol=1e-10)


def _principal(cov):
    return np.sqrt(np.linalg.eigvalsh(cov))


@pytest.mark.parametrize("sigma", [5e-4, 2e-3, 2e-2, 0.1])
@pytest.mark.parametrize("prior", [1.0, 30.0, 1000.0])
@pytest.mark.parametrize("at_once", [False, True])
def test_square_root_update_in_single_precision_against_double(sigma, prior, at_once):
    """A range and a bearing of `sigma` on a landmark known to `prior` m: what float32 keeps."""
    rng = np.random.default_rng(int(prior) + int(1e4 * sigma))
    for _ in range(200):
        angle, r, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 20), rng.uniform(-0.9, 0.9)
        factor = np.array([prior, prior * tilt, prior * np.sqrt(1 - tilt**2)])
        c, s = np.cos(angle), np.sin(angle)
        rows = np.array([[c, s], [-s / r, c / r]])
        mean, small = jnp.zeros(2, "f"), tuple(jnp.asarray(factor, "f"))
        exact = np.array([[factor[0], 0], factor[1:]])
        precise = exact @ exact.T
        for row in rows:
            row32 = row.astype("f")
            mean, small, _ = geometry.scalar_update(
                mean, small, row32, np.float32(0.01), np.float32(sigma) ** 2
            )
            h = row32.astype(float)
            gain = precise @ h / (h @ precise @ h + sigma**2)
            # Joseph form in double precision
            keep = np.eye(2) - np.outer(gain, h)
            precise = keep @ precise @ keep.T + np.outer(gain, gain) * sigma**2
        if at_once:
            given = np.zeros(2, "f"), factor.astype("f"), rows.astype("f"), np.full(2, 0.01, "f")
            _, small, *_ = geometry.pair_update(*given, np.full(2, sigma, "f") ** 2)
        l11, l21, l22 = np.array(small, float)
        assert l11 > 0
        assert l22 > 0
        got = np.array([[l11, 0], [l21, l22]])
        got = got @ got.T
        np.testing.assert_allclose(_principal(got), _principal(precise), rtol=1e-3)
        np.testing.assert_allclose(np.sqrt(np.diag(got)), np.sqrt(np.diag(precise)), rtol=1e-3)


def test_scalar_update_is_the_kalman_filter(x64):
    rng = np.random.default_rng(5)
    for _ in range(100):
        factor, h, mean = rng.uniform(0.1, 2, 3), rng.normal(size=2), rng.normal(size=2)
        root = np.array([[factor[0], 0], factor[1:]])
        cov, innovation, variance = root @ root.T, rng.normal(), rng.uniform(0.01, 1)
        s = h @ cov @ h + variance
        gain = cov @ h / s
        got_mean, got, got_s = geometry.scalar_update(mean, factor, h, innovation, variance)
        np.testing.assert_allclose(got_mean, mean + gain * innovation, rtol=1e-10)
        np.testing.assert_allclose(got_s, s, rtol=1e-12)
        expected = cov - np.outer(gain, h @ cov)
        np.testing.assert_allclose(
            geometry.covariance(got), expected[[0, 0, 1], [0, 1, 1]], rtol=1e-8, atol=1e-12
        )


def test_two_scalars_at_once_are_one_after_the_other(x64):
    rng = np.random.default_rng(4)
    for _ in range(50):
        mean, factor = rng.normal(size=2), np.array([1, rng.normal(), 1]) * rng.uniform(0.01, 5)
        rows, innovations = rng.normal(size=(2, 2)), rng.normal(size=2)
        variances = rng.uniform(1e-4, 1, 2)
        once, between, s1 = geometry.scalar_update(
            mean, factor, rows[0], innovations[0], variances[0]
        )
        rest = innovations[1] - rows[1] @ (np.array(once) - mean)
        twice, expected, s2 = geometry.scalar_update(once, between, rows[1], rest, variances[1])
        got, small, square, log = geometry.pair_update(mean, factor, rows, innovations, variances)
        np.testing.assert_allclose(got, twice, atol=1e-10)
        np.testing.assert_allclose(small, expected, atol=1e-10)
        np.testing.assert_allclose(square, innovations[0] ** 2 / s1 + rest**2 / s2, rtol=1e-9)
        np.testing.assert_allclose(log, np.log(s1 * s2), atol=1e-9)
