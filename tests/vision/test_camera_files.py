"""Camera files: own TOML, OCamCalib, Kalibr, OpenCV; checked against independent formulas."""

import math

import cv2
import numpy as np
import pytest
import yaml

from jaxslam.vision.camera import Camera
from jaxslam.vision.camera_files import load_camera, save_camera

MIRROR = (515.3, 382.3, 0.9998, 4e-4, -2e-4, 0.0, 0.0, 0.257, -0.95, -0.06, 0.1)
UNIFIED = (642.2, 521.9, 354.9, 355.2, 0.31, 1.371, 0.088, 0.115, 0.001, 0.0005)
PIXELS = np.stack(np.meshgrid(np.arange(130.0, 900, 37), np.arange(40.0, 760, 31)), -1)
REAL = (
    "calib_ocam_vmr/calib_results_catadioptric.txt",
    "omni_single_pyomniunwarp/calib_results.txt",
)


def polynomial():
    return Camera(1024, 768, "polynomial", MIRROR)


def unified(skew=0.31):
    params = np.array(UNIFIED)
    params[4] = skew
    return Camera(1280, 1024, "unified", params)


def ocam_lines(path):
    lines = [line.split() for line in path.read_text().splitlines()]
    return [list(map(float, line)) for line in lines if line and line[0][0] != "#"]


def cam2world(lines, row, column):
    """OCamCalib's own C function, transcribed: rays in its axes (row, column, away)."""
    (_, *pol), _, (xc, yc), (c, d, e), _ = lines[:5]
    inverse = 1 / (c - d * e)
    x = inverse * ((row - xc) - d * (column - yc))
    y = inverse * (-e * (row - xc) + c * (column - yc))
    r = math.hypot(x, y)
    z = sum(coefficient * r**i for i, coefficient in enumerate(pol))
    return np.array([x, y, z]) / math.sqrt(x * x + y * y + z * z)


def world2cam(lines, x, y, z):
    """OCamCalib's own C function, transcribed: (row, column) by the inverse polynomial."""
    _, (_, *inverse), (xc, yc), (c, d, e), _ = lines[:5]
    norm = math.hypot(x, y)
    theta = math.atan(z / norm)
    rho = sum(coefficient * theta**i for i, coefficient in enumerate(inverse))
    x, y = x / norm * rho, y / norm * rho
    return np.array([x * c + y * d + xc, x * e + y + yc])


@pytest.mark.parametrize("name", REAL)
def test_real_ocamcalib_files_map_as_its_own_code_does(shared_data, name):
    path = shared_data / name
    camera, lines = load_camera(path, mirror=True), ocam_lines(path)
    assert camera.mirror and camera.size == tuple(map(int, lines[4][::-1]))
    for column, row in PIXELS[::3, ::3].reshape(-1, 2):
        x, y, z = cam2world(lines, row, column)
        np.testing.assert_allclose(camera.ray([column, row]), [y, x, -z], atol=1e-12)
    # its own inverse is a fit; where it is good, it agrees with our exact one
    again = world2cam(lines, *cam2world(lines, 300.0, 700.0))
    ray = camera.ray([700.0, 300.0])
    np.testing.assert_allclose(camera.pixel(ray), [700, 300], atol=1e-6)
    np.testing.assert_allclose(again, [300, 700], atol=0.2)


def test_ocamcalib_round_trip_and_written_inverse(tmp_path):
    camera = polynomial()
    save_camera(tmp_path / "calib_results.txt", camera)
    again = load_camera(tmp_path / "calib_results.txt")
    np.testing.assert_allclose(again.params, camera.params, rtol=1e-12, atol=1e-15)
    lines = ocam_lines(tmp_path / "calib_results.txt")
    assert lines[0][1] < 0 and lines[0][2] == 0 and lines[4] == [768, 1024]
    for column, row in PIXELS[::4, ::4].reshape(-1, 2):
        if math.hypot(column - 515, row - 382) > 10:
            pixel = world2cam(lines, *cam2world(lines, row, column))
            np.testing.assert_allclose(pixel, [row, column], atol=0.02)


def test_toml_keeps_everything(tmp_path):
    covariance = np.diag(np.linspace(1e-6, 1e-3, 11))
    camera = Camera(
        1024, 768, "polynomial", MIRROR, mirror=True, lens="down", yaw=0.1, roll=-0.01,
        pitch=0.02, position=(0.1, 0.0, 0.6), elevation=(-0.7, 0.3), covariance=covariance,
    )  # fmt: skip
    save_camera(tmp_path / "c.toml", camera)
    again = load_camera(tmp_path / "c.toml")
    for name in ("params", "covariance", "mirror", "lens", "yaw", "roll", "pitch", "position"):
        np.testing.assert_array_equal(getattr(again, name), getattr(camera, name))
    assert again.elevation == camera.elevation and again.size == camera.size


def test_opencv_round_trip_and_as_filestorage_writes(tmp_path):
    save_camera(tmp_path / "c.yaml", unified())
    np.testing.assert_allclose(load_camera(tmp_path / "c.yaml").params, UNIFIED, rtol=1e-15)
    storage = cv2.FileStorage(str(tmp_path / "o.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array([[350.0, 0.5, 640], [0, 351, 512], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[0.1], [0.2], [0.003], [0.004]]))
    for name, value in (("xi", 1.2), ("image_width", 1280), ("image_height", 1024)):
        storage.write(name, value)
    storage.release()
    found = load_camera(tmp_path / "o.yml")
    assert found.params.tolist() == [640, 512, 350, 351, 0.5, 1.2, 0.1, 0.2, 0.003, 0.004]


def test_opencv_and_kalibr_mean_meis_projection(tmp_path):
    camera = unified(skew=0.0)
    save_camera(tmp_path / "k.yaml", camera, "kalibr")
    chain = yaml.safe_load((tmp_path / "k.yaml").read_text())["cam0"]
    xi, fu, fv, pu, pv = chain["intrinsics"]
    k1, k2, p1, p2 = chain["distortion_coeffs"]
    again = load_camera(tmp_path / "k.yaml")
    for x, y, z in ([0.3, -0.5, 0.4], [-0.8, 0.2, 0.1], [0.6, 0.7, -0.1]):
        norm = math.sqrt(x * x + y * y + z * z)
        a, b = x / (z + xi * norm), y / (z + xi * norm)
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2 * r2
        u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
        expected = [fu * u + pu, fv * v + pv]
        np.testing.assert_allclose(again.pixel([x, y, z]), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("suffix", "camera", "kind"),
    [
        (".txt", unified(), None),
        (".txt", Camera(9, 9, "polynomial", [4, 4, 1, 0, 0, 1e-3, 0, 1, 0]), None),
        (".yaml", polynomial(), None),
        (".yaml", unified(), "kalibr"),
        (".json", polynomial(), None),
    ],
)
def test_what_a_format_cannot_hold_is_refused(tmp_path, suffix, camera, kind):
    with pytest.raises(ValueError, match=f"c{suffix}: "):
        save_camera(tmp_path / f"c{suffix}", camera, kind)
    assert not list(tmp_path.iterdir())


def spoilt(text, old, new):
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("model =", "modell =", "modell is not a field"),
        ('"polynomial"', '"pinhole"', "model is 'pinhole'"),
        ("mirror = false", 'mirror = "no"', "mirror is 'no'"),
        ("a0 = ", "b0 = ", "params.a0 is missing"),
        ("cx = 515.3", 'cx = "left"', "params does not consist of numbers"),
        ("cx = 515.3", "cx = nan", "params must be finite"),
        ("width = 1024", "width = -3", "width -3"),
        ("[params]", "[params", "is not TOML"),
    ],
)
def test_faults_of_toml_are_named(tmp_path, old, new, told):
    path = tmp_path / "c.toml"
    save_camera(path, polynomial())
    path.write_text(spoilt(path.read_text(), old, new))
    with pytest.raises(ValueError, match=r"c.toml: ") as caught:
        load_camera(path)
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("cut", "told"),
    [
        (lambda lines: lines[:-2], "image size is missing"),
        (lambda lines: [x.replace("768 1024", "768.5 1024") for x in lines], "whole number"),
        (lambda lines: [x.replace("768 1024", "768") for x in lines], "image size has 1 number"),
        (
            lambda lines: [x.replace("5 -", "6 -") for x in lines],
            "announces 6 coefficients but has 5",
        ),
        (lambda lines: [x.replace("768 1024", "high wide") for x in lines], "is high wide"),
    ],
)
def test_faults_of_ocamcalib_files_are_named(tmp_path, cut, told):
    path = tmp_path / "calib_results.txt"
    save_camera(path, polynomial())
    path.write_text("\n".join(cut(path.read_text().splitlines())))
    with pytest.raises(ValueError, match=r"calib_results.txt: ") as caught:
        load_camera(path)
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "old", "new", "told"),
    [
        ("kalibr", "omni", "pinhole", "camera_model is 'pinhole'; must be omni"),
        ("kalibr", "cam0:", "cam7:", "no cam0"),
        ("kalibr", "- 1280", "- wide", "resolution is wide 1024"),
        ("opencv", "xi:", "xy:", "xi is missing"),
        ("opencv", "cols: 4", "cols: 3", ""),
    ],
)
def test_faults_of_yaml_are_named(tmp_path, kind, old, new, told):
    path = tmp_path / "c.yaml"
    save_camera(path, unified(skew=0.0), kind)
    path.write_text(spoilt(path.read_text(), old, new))
    with pytest.raises(ValueError, match=r"c.yaml: ") as caught:
        load_camera(path)
    assert told in str(caught.value)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "c.toml").write_bytes(b"\xff\xfe" * 9)
    (tmp_path / "big.toml").write_bytes(b"#" * (2 << 20))
    for name in ("c.toml", "big.toml", "absent.toml", "c.dat"):
        with pytest.raises(ValueError, match=name):
            load_camera(tmp_path / name)
