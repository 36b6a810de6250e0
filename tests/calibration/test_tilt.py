"""Tilt from vertical lines: found, with true standard errors, and told the right way round."""

from dataclasses import replace

import numpy as np
import pytest
from line_halves import halves
from stripes import mirror_camera, painted, photograph, room_of_stripes, stripes

from calibration.tilt import Tilt, camera_with_tilt, camera_with_up, describe, find_tilt
from jaxslam.vision.camera import tilt_matrix
from jaxslam.vision.camera_files import load_camera
from jaxslam.vision.images import Images


def degrees(found):
    return np.degrees([found.roll, found.pitch])


def rooms(camera, count, noise=3.0):
    return [(f"{i}.png", room_of_stripes(camera, i, 30, noise, 0.6)[1]) for i in range(count)]


@pytest.mark.parametrize("true", ((0.4, -0.6), (-2.0, 3.0)))
def test_roll_and_pitch_are_found_to_a_hundredth_of_a_degree(true):
    roll, pitch = np.radians(true)
    camera = mirror_camera(roll=roll, pitch=pitch, yaw=0.7)
    found = find_tilt(rooms(camera, 2), replace(camera, roll=0.0, pitch=0.0))
    assert np.abs(degrees(found) - true).max() < 0.02
    assert found.lines > 40 and found.images == 2 and found.skipped == {}
    again = camera_with_tilt(camera, found)
    assert np.abs(again.matrix - camera.matrix).max() < 5e-4
    assert [row[0] for row in found.per_image] == ["0.png", "1.png"]
    assert all(np.abs(np.degrees(row[1:3]) - true).max() < 0.05 for row in found.per_image)


def test_a_tilt_already_in_the_camera_is_kept_or_corrected():
    camera = mirror_camera(roll=0.02, pitch=-0.01)
    images = rooms(camera, 1)
    for start in (camera, replace(camera, roll=-0.01, pitch=0.02)):
        assert np.abs(degrees(find_tilt(images, start)) - np.degrees([0.02, -0.01])).max() < 0.03


def test_leaning_edges_do_not_pull_it_along():
    """A third of the edges lean by up to 5 degrees, in all directions."""
    camera = mirror_camera(roll=0.01, pitch=0.015)
    rng = np.random.default_rng(3)
    azimuth = np.sort(rng.uniform(-np.pi, np.pi, 36))
    lean = np.where(np.arange(36) % 3, 0.0, rng.uniform(-0.09, 0.09, 36))
    colour = rng.uniform(40, 220, (36, 3))

    def seen(direction):
        azimuths = np.arctan2(direction[..., 1], direction[..., 0])
        up = np.arcsin(direction[..., 2])
        i = np.searchsorted(azimuth, azimuths) - 1
        i = np.where(azimuths - azimuth[i] < lean[i] * up, i - 1, i)
        return colour[i]

    image = photograph(painted(camera, seen, samples=10), 2.0, 0.5)
    found = find_tilt([("a", image)], replace(camera, roll=0.0, pitch=0.0))
    assert np.abs(degrees(found) - np.degrees([0.01, 0.015])).max() < 0.1
    assert found.lines < found.candidates


def test_standard_errors_are_those_of_repeated_trials():
    camera = mirror_camera()
    ratios = []
    for image in rooms(camera, 8, noise=8.0):
        found = find_tilt([image], camera)
        ratios.append([found.roll, found.pitch] / np.sqrt(np.diag(found.covariance)))
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 2.5


def test_the_sense_of_the_advice():
    """Pitch down: the robot's front of the camera is low. Roll up: its left is high."""
    nose_down = tilt_matrix(0.0, np.radians(1.0)) @ [1.0, 0.0, 0.0]
    left_high = tilt_matrix(np.radians(1.0), 0.0) @ [0.0, 1.0, 0.0]
    assert nose_down[2] < 0 < left_high[2]
    covariance = np.diag(np.radians([0.02, 0.03]) ** 2)
    text = describe(Tilt(np.radians(1.0), np.radians(0.5), covariance, 9, 9, 1, 0.0, [], {}))
    assert "pitch +0.50 +- 0.03 deg: raise the front by 0.50 deg" in text
    assert "roll +1.00 +- 0.02 deg: lower the left by 1.00 deg" in text
    text = describe(Tilt(-0.01, -0.01, covariance, 9, 9, 1, 0.0, [], {}))
    assert "lower the front" in text and "raise the left" in text


def test_up_is_turned_into_roll_and_pitch():
    camera = mirror_camera(yaw=0.3)
    leaning = replace(camera, roll=0.05, pitch=-0.08)
    # what the upright camera takes for the direction in which the leaning one knows up
    up = camera.matrix @ leaning.matrix.T @ [0.0, 0.0, 1.0]
    found = camera_with_up(camera, up)
    assert np.allclose([found.roll, found.pitch], [0.05, -0.08])


def test_images_without_lines_or_of_another_size_are_counted():
    camera = mirror_camera()
    small = np.zeros((48, 64, 3), np.uint8)
    images = [*rooms(camera, 1), ("b.png", small), ("c.png", ValueError("c.png: truncated"))]
    calls = []
    found = find_tilt(images, camera, progress=lambda done, total: calls.append((done, total)))
    assert found.images == 1
    assert sorted(found.skipped.values()) == [1, 1]
    assert any("64 x 48" in reason for reason in found.skipped)
    assert calls[-1] == (12, 12)
    plain = photograph(np.full((480, 640, 3), 99.0), 2.0)
    with pytest.raises(ValueError, match=r"tilt: 0 nearly vertical lines in 1 images"):
        find_tilt([("d.png", plain)], camera)
    with pytest.raises(ValueError, match=r"in 0 images; .* 1 skipped: truncated"):
        find_tilt(images[2:], camera)


def test_lines_on_one_side_alone_do_not_determine_it():
    camera = mirror_camera()
    azimuth = np.radians(np.linspace(-4, 4, 9))
    colour = np.where(np.arange(9)[:, None] % 2, (190.0,) * 3, (90.0,) * 3)
    images = [
        (str(i), photograph(stripes(camera, azimuth, colour), 2.0, 0.5, seed=i)) for i in range(2)
    ]
    with pytest.raises(ValueError, match="one direction"):
        find_tilt(images, camera)


def test_a_camera_that_leans_far_is_refused():
    camera = mirror_camera(roll=0.3)
    with pytest.raises(ValueError, match="tilt: "):
        find_tilt(rooms(camera, 2), replace(camera, roll=0.0))


def test_a_recorded_camera_leans_as_far_as_others_found(shared_data):
    """OCamCalib's images: 0.25 to 0.59 degrees; afterwards both halves of a line agree."""
    folder = shared_data / "calib_ocam_vmr"
    camera = load_camera(folder / "calib_results_catadioptric.txt", mirror=True)
    camera = replace(camera, elevation=(-0.87, 0.43))
    images = list(Images(folder))
    found = find_tilt(images, camera)
    assert 0.25 < np.hypot(*degrees(found)) < 0.59
    before, after = (
        np.concatenate([np.subtract(*halves(image, c)) for _, image in images])
        for c in (camera, camera_with_tilt(camera, found))
    )
    assert np.median(np.abs(after)) < min(np.radians(0.1), np.median(np.abs(before)))
