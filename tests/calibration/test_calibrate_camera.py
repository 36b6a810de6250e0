"""Camera calibration: simulated boards against the true camera, bad sets, real images."""

import jax
import numpy as np
import pytest
from simulated_boards import azimuth_error, simulate_boards

from calibration.bundle import Corners, derivatives, rotation
from calibration.camera import calibrate_camera, calibrate_corners, cross_validate
from calibration.camera_report import draw, text
from calibration.coverage import angle_change
from calibration.initial import first_solution
from jaxslam.simulation.room.render import double_mirror_camera
from jaxslam.vision.camera import Camera, ray_to_pixel
from jaxslam.vision.camera_files import load_camera, save_camera

MIRROR = Camera(
    1024, 768, "polynomial",
    (516.1, 385.0, 0.9985, -9e-4, -9e-4, 1.7e-3, 2.9e-3, 0.257, -0.95, -0.06, 0.12),
    mirror=True, elevation=(-0.75, 0.28),
)  # fmt: skip
FISHEYE = Camera(
    748, 480, "polynomial",
    (384.8, 238.9, 0.9993, 2e-4, 2e-4, 1e-3, -1e-4, 0.559, -0.71, 0.0, -0.3, 0.1),
    elevation=(0.2, 1.5),
)  # fmt: skip
MEI = Camera(
    1280, 1024, "unified", (642.2, 521.9, 354.9, 355.2, 0.31, 1.371, 0.02, 0.01, 1e-3, 5e-4),
    mirror=True, elevation=(-0.9, 0.18),
)  # fmt: skip
NARROW = Camera(
    640, 480, "polynomial", (330.0, 236.0, 1, 0, 0, 0, 0, 1.6, 0.05, 0, 0), elevation=(1.0, 1.57)
)
CAMERAS = {"mirror": MIRROR, "fisheye": FISHEYE, "unified": MEI, "narrow": NARROW}


def boards(camera, count=12, noise=0.0, seed=3, **changes):
    pixels, points = simulate_boards(camera, count, noise, seed, **changes)
    return dict(pixels=pixels, points=points, size=camera.size, mirror=camera.mirror)


def off_deg(found, true):
    """Largest azimuth error [deg] where the boards were."""
    error, _ = azimuth_error(found.camera, true, found.coverage.radius)
    return np.degrees(np.abs(error).max())


@pytest.mark.parametrize("name", ["mirror", "unified"])
def test_derivatives_are_those_of_finite_differences(name):
    camera = CAMERAS[name]
    ray = np.random.default_rng(0).normal(size=(20, 3)) + [0, 0, 1.5]
    ray = ray[np.isfinite(camera.pixel(ray)).all(1)]
    pixel, by_params, by_point = derivatives(camera.model, camera.size, camera.params, ray)
    np.testing.assert_allclose(pixel, camera.pixel(ray), atol=1e-9)

    def at(params, point):
        return ray_to_pixel(camera.model, params, camera.size, point)

    for i in range(len(camera.params)):
        step = np.zeros(len(camera.params))
        step[i] = 1e-6
        slope = (at(camera.params + step, ray) - at(camera.params - step, ray)) / 2e-6
        np.testing.assert_allclose(by_params[..., i], slope, rtol=1e-5, atol=1e-4)
    for i, step in enumerate(1e-6 * np.eye(3)):
        slope = (at(camera.params, ray + step) - at(camera.params, ray - step)) / 2e-6
        np.testing.assert_allclose(by_point[..., i], slope, rtol=1e-5, atol=1e-4)


def test_rotation_is_rodrigues():
    vector = np.array([[0.0, 0, 0], [0, 0, np.pi / 2], [1e-9, 0, 0], [0.3, -1.2, 2.0]])
    got = rotation(vector)
    np.testing.assert_allclose(got @ got.mT, np.broadcast_to(np.eye(3), got.shape), atol=1e-14)
    np.testing.assert_allclose(got[1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(got[3] @ vector[3], vector[3], atol=1e-14)


@pytest.mark.parametrize("name", ["mirror", "fisheye", "narrow"])
def test_linear_start_is_near_the_truth(name):
    camera, given = CAMERAS[name], boards(CAMERAS[name])
    count = len(given["points"])
    board = np.repeat(np.arange(12), count)
    corners = Corners(
        np.concatenate(given["pixels"]), np.tile(given["points"], (12, 1)), board, camera.size
    )
    start = first_solution(corners)
    np.testing.assert_allclose(start.params[:2], camera.params[:2], atol=0.03 * camera.width)
    assert 0.7 < start.params[7] / camera["a0"] < 1.4
    point = np.einsum("nij,nj->ni", start.rotation[board][..., :2], corners.point)
    pixel = ray_to_pixel("polynomial", start.params, camera.size, point + start.translation[board])
    assert np.median(np.hypot(*(pixel - corners.pixel).T)) < 0.02 * camera.width


@pytest.mark.parametrize("name", CAMERAS)
def test_boards_without_noise_give_the_true_camera(name):
    camera = CAMERAS[name]
    found = calibrate_corners(**boards(camera), model=camera.model)
    assert found.rms < 2e-4 and not found.outliers and not found.rejected
    assert off_deg(found, camera) < 2e-4
    np.testing.assert_allclose(found.camera.params[:2], camera.params[:2], atol=0.02)
    assert found.camera.elevation[0] >= camera.elevation[0]
    assert found.camera.elevation[1] <= camera.elevation[1]
    assert found.camera.mirror == camera.mirror
    assert not jax.config.jax_enable_x64


def test_noise_is_reported_and_the_azimuth_is_good_to_a_few_hundredths():
    true = double_mirror_camera()
    errors = []
    for seed in range(4):
        found = calibrate_corners(**boards(true, 25, 0.1, seed), order=4)
        assert 0.125 < found.rms < 0.15 and not found.outliers  # 0.1 px on each axis
        error, sigma = azimuth_error(found.camera, true, found.coverage.radius)
        errors.append(np.degrees(np.sqrt(np.mean(error**2))))
        assert 0.1 < np.sqrt(np.mean((error / sigma) ** 2)) < 2.5
        assert found.bearings.rms_deg == pytest.approx(0.027, abs=0.008)
    assert np.sqrt(np.mean(np.square(errors))) < 0.03


@pytest.mark.slow
def test_stated_uncertainty_is_that_of_fifty_simulations():
    true, ratio = double_mirror_camera(), []
    for seed in range(50):
        found = calibrate_corners(**boards(true, 25, 0.1, seed + 100))
        error, sigma = azimuth_error(found.camera, true, found.coverage.radius)
        ratio.append(np.mean((error / sigma) ** 2))
    assert 0.8 < np.sqrt(np.mean(ratio)) < 1.25


def test_a_common_rotation_is_no_error():
    ray = MIRROR.ray(np.random.default_rng(1).uniform(200, 700, (40, 2)))
    change = np.cross([0.01, -0.02, 0.03], ray)[..., None]
    for part in angle_change(ray, change):
        np.testing.assert_allclose(part, 0, atol=1e-12)
    bent = (
        np.stack([-ray[:, 1], ray[:, 0], 0 * ray[:, 0]], 1)
        * np.sin(4 * np.arctan2(ray[:, 1], ray[:, 0]))[:, None]
    )
    azimuth, polar = angle_change(ray, 1e-3 * bent[..., None])
    assert np.abs(azimuth).max() > 5e-4 and np.abs(polar).max() < 5e-4


def test_parts_of_boards_are_welcome_and_gross_outliers_are_set_aside():
    given = boards(MIRROR, 14, 0.1)
    full = given["points"]
    given["points"] = [full] * 14
    for b in (2, 5):
        given["pixels"][b], given["points"][b] = given["pixels"][b][:25], full[:25]
    given["pixels"][7][11] += [9.0, -7.0]
    found = calibrate_corners(**given)
    assert [row[1] for row in found.per_image][:6] == [42, 42, 25, 42, 42, 25]
    ((name, corner, distance),) = found.outliers
    assert (name, corner) == ("board 7", 11) and distance == pytest.approx(np.hypot(9, 7), abs=0.6)
    assert off_deg(found, MIRROR) < 0.15
    assert found.rms > 0.4 and found.per_image[7][4] > 10  # every corner counts in what is printed


def test_a_board_in_a_wrong_order_is_rejected():
    given = boards(MIRROR, 12, 0.1)
    shuffled = np.random.default_rng(0).permutation(42)
    given["pixels"][4] = given["pixels"][4][shuffled]
    found = calibrate_corners(**given)
    assert [name for name, _ in found.rejected] == ["board 4"] and len(found.names) == 11
    assert off_deg(found, MIRROR) < 0.15


def one_azimuth(given):
    """The boards within a sector of the image."""
    kept = []
    for pixel in given["pixels"]:
        u, v = (pixel - MIRROR.params[:2]).T
        if (np.abs(np.arctan2(v, u)) < 0.9).all():
            kept.append(pixel)
    return kept


def test_bad_sets_are_refused_with_the_reason():
    given = boards(MIRROR, 12, 0.1)
    pixels = given.pop("pixels")
    with pytest.raises(ValueError, match="2 usable boards; must be 3 or more"):
        calibrate_corners(pixels[:2], **given)
    many = boards(MIRROR, 60, 0.1)
    with pytest.raises(ValueError, match=r"all corners lie within \d+° of azimuth"):
        calibrate_corners(one_azimuth(many), **given)
    with pytest.raises(ValueError, match="order 7 of the polynomial"):
        calibrate_corners(pixels, **given, order=7)
    # parallel to the image and at one distance: focal length and distance are one unknown
    shift = np.random.default_rng(0).uniform(-0.1, 0.05, (6, 1, 2))
    point = np.concatenate([given["points"] + shift, np.full((6, 42, 1), 0.5)], -1)
    pixels = NARROW.pixel(point) + np.random.default_rng(1).normal(0, 0.1, (6, 42, 2))
    with pytest.raises(ValueError, match=r"uncertain by|don't determine"):
        calibrate_corners(list(pixels), given["points"], NARROW.size)


def test_bad_boards_are_rejected_one_by_one():
    given = boards(MIRROR, 9, 0.1)
    points = [given.pop("points")] * 9
    bad = [given["pixels"][0][:7], given["pixels"][1] * np.nan, given["pixels"][2] + 900]
    bad.append(given["pixels"][3][:12])
    faults = [points[0][:7], points[0], points[0], points[0]]
    line = given["pixels"][4][:12], np.column_stack([np.arange(12), np.zeros(12)])
    pixels = bad + [line[0]] + given["pixels"][5:]
    found = calibrate_corners(
        pixels, faults + [line[1]] + points[5:], MIRROR.size, mirror=True, order=4
    )
    reasons = dict(found.rejected)
    for i, told in enumerate(("7 corners", "not finite", "outside", "12 corners for 42", "line")):
        assert told in reasons[f"board {i}"]
    assert "only 4 boards" in found.warnings[0]


def test_doubtful_sets_are_warned_of():
    given = boards(MIRROR, 12, 0.1, distance=(0.2, 0.2))
    given["pixels"][9] = given["pixels"][10] = given["pixels"][2].copy()
    told = " / ".join(calibrate_corners(**given).warnings)
    assert "all boards are at one distance" in told
    assert "board 2 and board 9 are the same picture, which counts twice (1 more" in told


@pytest.mark.parametrize(
    ("model", "suffix", "kind"), [("polynomial", "txt", None), ("unified", "yaml", "kalibr")]
)
def test_simple_cameras_fit_other_tools_files(tmp_path, model, suffix, kind):
    found = calibrate_corners(**boards(MIRROR, 12, 0.1), model=model, simple=True)
    save_camera(tmp_path / f"c.{suffix}", found.camera, kind)
    again = load_camera(tmp_path / f"c.{suffix}", mirror=True)
    pixel = found.corners.pixel
    np.testing.assert_allclose(again.ray(pixel), found.camera.ray(pixel), atol=1e-9)


def test_report_and_picture(tmp_path):
    given = boards(MIRROR, 12, 0.1)
    given["pixels"][7][11] += [9.0, -7.0]
    found = calibrate_corners(**given)
    told = text(found)
    assert "board 11" in told and "outlier excluded: board 7, corner 11" in told
    assert f"{found.rms:.3f}" in told and f"{found.bearings.rms_deg:.3f}°" in told
    draw(found, tmp_path / "camera.png")
    assert (tmp_path / "camera.png").stat().st_size > 50_000


def held_out_px(found, order=None):
    length = cross_validate(found.corners, {found.order: found.solution}, "polynomial", found.order)
    d = length[found.order]
    return d.mean(), np.sqrt(np.mean(d**2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "board", "mirror", "images", "fit", "left_out"),
    [
        ("calib_ocam_vmr/VMR*.jpg", (6, 7), True, 10, (0.277, 0.320), (0.303, 0.353)),
        ("calib_fisheye2", (6, 8), False, 16, (0.077, 0.090), (0.082, 0.097)),
        ("calib_inria_para", (8, 6), True, 10, (0.38, 0.38), (0.4, 0.45)),
    ],
)
def test_real_sets(shared_data, folder, board, mirror, images, fit, left_out):
    found = calibrate_camera(shared_data / folder, board, 0.03, mirror=mirror)
    assert len(found.names) == images and not found.rejected and not found.outliers
    assert (np.round([found.mean, found.rms], 3) <= fit).all()
    assert (np.round(held_out_px(found), 3) <= left_out).all()
