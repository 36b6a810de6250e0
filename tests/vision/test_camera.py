"""The camera's models: both directions, derivatives, frames, and OpenCV's formulas beside them."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.vision.camera import Camera, pixel_to_ray, ray_to_pixel, tilt_matrix

MIRROR = (322.0, 238.0, 1.002, 0.001, 0.001, 0.003, -0.002, 0.55, -0.3, 0.05, -0.1)
SPHERE = (322.0, 238.0, 300.0, 301.0, 0.1, 1.1, 0.05, -0.02, 0.001, 0.002)
CAMERAS = {
    "polynomial": Camera(640, 480, "polynomial", MIRROR),
    "order 6": Camera(640, 480, "polynomial", (*MIRROR, 0.02, -0.01)),
    "unified": Camera(640, 480, "unified", SPHERE),
    "xi below 1": Camera(640, 480, "unified", (*SPHERE[:5], 0.7, *SPHERE[6:])),
}


@pytest.fixture(params=CAMERAS)
def camera(request):
    return CAMERAS[request.param]


def pixels(camera):
    return np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1) * 1.0


def test_both_directions_agree_at_every_pixel(camera):
    grid = pixels(camera)
    ray = camera.ray(grid)
    assert np.allclose(np.linalg.norm(ray, axis=-1), 1, atol=1e-12)
    assert np.abs(camera.pixel(ray) - grid).max() < 1e-6
    assert np.abs(camera.pixel(7.5 * ray) - grid).max() < 1e-6


def test_rays_return_from_the_image(camera):
    rng = np.random.default_rng(0)
    angle, azimuth = rng.uniform(0, 1.4, 1000), rng.uniform(-np.pi, np.pi, 1000)
    ray = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth)], -1)
    ray = np.column_stack([ray, np.cos(angle)])
    pixel = camera.pixel(ray)
    seen = np.isfinite(pixel[:, 0])
    assert seen.mean() > 0.4
    assert np.abs(camera.ray(pixel[seen]) - ray[seen]).max() < 1e-9


def test_the_polynomial_is_scaramuzzas():
    """Written out: pixel = A m + centre, m decentred, ray ~ (x, y, f(rho))."""
    cx, cy, c, d, e, p1, p2, a0, a2, a3, a4 = MIRROR
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.6, 0.6, (2, 50))
    rho = np.hypot(x, y)
    ray = np.stack([x, y, a0 + a2 * rho**2 + a3 * rho**3 + a4 * rho**4], -1)
    mx = x + 2 * p1 * x * y + p2 * (rho**2 + 2 * x**2)
    my = y + p1 * (rho**2 + 2 * y**2) + 2 * p2 * x * y
    u, v = cx + 320 * (mx + e * my), cy + 320 * (d * mx + c * my)
    want = np.stack([u, v], -1)
    got = ray_to_pixel("polynomial", np.array(MIRROR), (640, 480), ray)
    assert np.abs(got - want).max() < 1e-9


def test_the_unified_model_is_opencvs_pinhole_after_the_shift():
    import cv2

    rng = np.random.default_rng(2)
    ray = np.column_stack([rng.uniform(-1, 1, (50, 2)), rng.uniform(0.2, 1, 50)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    fx, fy, s, xi = SPHERE[2:6]
    moved = (ray + [0, 0, xi])[:, None]  # the sphere's model: a pinhole xi behind its centre
    matrix = np.array([[fx, 0, SPHERE[0]], [0, fy, SPHERE[1]], [0, 0, 1]])
    want, _ = cv2.projectPoints(moved, np.zeros(3), np.zeros(3), matrix, np.array(SPHERE[6:]))
    got = CAMERAS["unified"].pixel(ray)
    inside = np.isfinite(got[:, 0])
    skew = s * (want[:, 0, 1] - SPHERE[1]) / fy
    want = want[:, 0] + np.column_stack([skew, np.zeros(50)])
    assert inside.sum() > 20
    assert np.abs(got - want)[inside].max() < 1e-9


@pytest.mark.parametrize("direction", ["ray to pixel", "pixel to ray"])
def test_derivatives_are_those_of_finite_differences(camera, direction, x64):
    if direction == "ray to pixel":
        function, at = ray_to_pixel, jnp.array([[0.3, 0.5, 0.2], [0.9, 0.1, 0.1], [0.0, 0.0, 1.0]])
    else:
        function, at = pixel_to_ray, jnp.array([[300.0, 200.0], [100.0, 40.0], [322.0, 238.0]])

    @jax.jit
    def of(params, at):
        return function(camera.model, params, camera.size, at)

    given = jnp.array(camera.params), at
    for argument in (0, 1):
        derivative = jax.jacfwd(of, argument)(*given)
        assert np.isfinite(derivative).all()
        assert np.allclose(derivative, jax.jacrev(of, argument)(*given), rtol=1e-9, atol=1e-9)
        for index in np.ndindex(given[argument].shape):
            if argument == 1 and index[0] == 2:
                continue  # on the axis a difference crosses the table's end
            step = jnp.zeros_like(given[argument]).at[index].set(1e-6)
            ahead, behind = (
                of(*(g + k * step if i == argument else g for i, g in enumerate(given)))
                for k in (1, -1)
            )
            numeric = (ahead - behind) / 2e-6
            assert np.allclose(derivative[(..., *index)], numeric, rtol=1e-6, atol=1e-5), index


def test_numpy_and_jax_give_the_same(camera, x64):
    grid = pixels(camera)[::40, ::40]
    ray = camera.ray(grid)
    jitted = jax.jit(pixel_to_ray, static_argnums=(0, 2))(
        camera.model, jnp.array(camera.params), camera.size, jnp.array(grid)
    )
    assert np.abs(ray - jitted).max() < 1e-12


def test_frames_of_lens_and_mirror():
    plain = Camera(640, 480, "polynomial", (320.0, 240.0, 1, 0, 0, 0, 0, 0.5, -0.3, 0, 0))
    both = np.array([[420.0, 240.0], [320.0, 340.0]])  # to the right of the centre, below it
    up = plain.direction(both)
    assert np.allclose(np.arctan2(up[:, 1], up[:, 0]), [0, np.pi / 2])  # looking up, below is left
    assert (up[:, 2] > 0).all()
    down = replace(plain, lens="down").direction(both)
    assert np.allclose(np.arctan2(down[:, 1], down[:, 0]), [0, -np.pi / 2])
    assert (down[:, 2] < 0).all()
    mirror = replace(plain, mirror=True).direction(both)
    assert np.allclose(mirror, up * [1, 1, -1])
    below_mirror = replace(plain, mirror=True, lens="down").direction(both)
    assert np.allclose(below_mirror, down * [1, 1, -1])
    for camera in (plain, replace(plain, mirror=True, lens="down", roll=0.1, yaw=1.0)):
        assert np.allclose(camera.matrix @ camera.matrix.T, np.eye(3))
        assert np.allclose(camera.project(camera.direction(both)), both)


def test_turning_and_tilting():
    plain = Camera(640, 480, "polynomial", (320.0, 240.0, 1, 0, 0, 0, 0, 0.5, -0.3, 0, 0))
    ahead = np.array([420.0, 240.0])
    turned = replace(plain, yaw=0.3).direction(ahead)
    assert math.isclose(math.atan2(turned[1], turned[0]), 0.3)
    # A positive pitch lowers what is ahead, a positive roll raises what is on the left.
    assert replace(plain, pitch=0.1).direction(ahead)[2] < plain.direction(ahead)[2]
    left = np.array([320.0, 340.0])
    assert replace(plain, roll=0.1).direction(left)[2] > plain.direction(left)[2]
    assert np.allclose(tilt_matrix(0, 0), np.eye(3))


def test_what_is_not_imaged_is_nan():
    camera = CAMERAS["polynomial"]
    assert np.isnan(camera.ray(np.array([[-1.0, 5.0], [640.0, 5.0]]))).all()
    assert np.isnan(camera.pixel(np.array([0.0, 0.0, -1.0]))).all()
    sphere = CAMERAS["unified"]
    assert np.isnan(sphere.pixel(np.array([0.1, 0.0, -1.0]))).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(model="pinhole"), "model 'pinhole' is not one of polynomial, unified"),
        (dict(width=0), "width 0 is not a whole number"),
        (dict(params=MIRROR[:5]), "5 params; polynomial has 9 to 13"),
        (dict(params=(*MIRROR[:7], -0.5, *MIRROR[8:])), "a0 is -0.5; must be above 0"),
        (dict(params=(1.0, math.nan, *MIRROR[2:])), "params must be finite"),
        (dict(lens="left"), "lens 'left' is neither up nor down"),
        (dict(elevation=(0.5, 0.1)), "elevation 0.5..0.1 rad; must rise"),
        (dict(covariance=np.eye(3)), "covariance is not 11 x 11"),
        (dict(position=(1.0, 2.0)), "position has 2 numbers; must be 3"),
        (dict(model="unified", params=(*SPHERE[:5], -1.0, *SPHERE[6:])), "xi at least 0"),
    ],
)
def test_bad_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(CAMERAS["polynomial"], **change)
