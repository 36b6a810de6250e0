"""`jaxslam calibrate camera`: pictures of a chessboard, good, useless and degenerate."""

import os
import re
import shutil

import cv2
import numpy as np
import pytest
from simulated_boards import simulate_boards

from calibration import camera as fitting
from calibration.bundle import rotation
from calibration.corners import VARIANTS, Views, board_points
from jaxslam.vision.camera import Camera
from jaxslam.vision.camera_files import load_camera

FISHEYE = Camera(
    480, 360, "polynomial", (240.4, 178.2, 1.0, 0, 0, 1e-3, -5e-4, 0.62, -0.55, 0.0, -0.1),
    elevation=(0.45, 1.4),
)  # fmt: skip
BOARD, SQUARE = (6, 7), 0.03
CAMERA = "calibrate", "camera", "--board", "6x7", "--square", str(SQUARE)


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    """Ten pictures of a chessboard, and one that shows none."""
    place = tmp_path_factory.mktemp("boards")
    for i, picture in enumerate(photographs(10)):
        cv2.imwrite(str(place / f"board{i}.png"), picture)
    cv2.imwrite(str(place / "wall.png"), np.full((360, 480, 3), 120, np.uint8))
    return place


def photographs(count):
    """Pictures of a chessboard before `FISHEYE`, by the rays' way to the board's plane."""
    rng, fine = np.random.default_rng(5), (np.arange(3) - 1) / 3
    u, v = ((np.arange(n)[:, None] + fine).ravel() for n in FISHEYE.size)
    ray = FISHEYE.ray(np.stack(np.meshgrid(u, v), -1))
    middle = board_points(BOARD, 1.0).mean(0)
    for i in range(count):
        around, away = 2 * np.pi * i / count, rng.uniform(0.2, 0.8)
        towards = np.array([np.cos(around) * np.sin(away), np.sin(around) * np.sin(away),
                            np.cos(away)])  # fmt: skip
        turn = rotation(rng.normal(0, 0.35, 3)) @ rotation(np.array([0, 0, rng.uniform(-3, 3)]))
        centre = rng.uniform(0.14, 0.3) * towards
        # a ray t r meets the board's points p where turn^T (t r - centre) has z = 0
        local = ray @ turn
        offset = centre @ turn
        t = offset[2] / local[..., 2]
        x, y = (((local[..., k] * t - offset[k]) / SQUARE + middle[k]) for k in (0, 1))
        on = (x > -1) & (x < BOARD[0]) & (y > -1) & (y < BOARD[1])
        margin = (x > -1.5) & (x < BOARD[0] + 0.5) & (y > -1.5) & (y < BOARD[1] + 0.5)
        black = on & ((np.floor(x) + np.floor(y)) % 2 == 0)
        grey = np.where(black, 30.0, np.where(margin, 220.0, 120.0))
        image = grey.reshape(360, 3, 480, 3).mean((1, 3)) + rng.normal(0, 2, (360, 480))
        yield np.repeat(np.rint(image)[..., None], 3, 2).astype(np.uint8)


def test_a_camera_is_calibrated_from_images(boards, at, call, refuse):
    code, out, err = call(*CAMERA, boards)
    assert (code, err) == (1, "")
    assert "420 corners of 10 boards" in out
    assert "rejected: wall.png: no board of 6 x 7 inner corners found" in out
    assert "bearing uncertainty (1 sigma): 0.0" in out
    assert "camera.toml: the camera; camera.png: the fit" in out
    found = load_camera("camera.toml")
    v, u = np.mgrid[90:271:45, 120:361:60]
    pixel = np.column_stack([u.ravel(), v.ravel()])
    off = np.linalg.norm(found.ray(pixel) - FISHEYE.ray(pixel), axis=1)
    assert np.degrees(off).max() < 0.3
    assert (at / "camera.png").stat().st_size > 10_000
    assert "camera.toml: exists" in refuse(*CAMERA, boards)
    os.remove("camera.toml")
    assert "camera.png: exists" in refuse(*CAMERA, boards)


def test_images_of_boards_that_are_of_no_use(boards, at, refuse):
    os.mkdir("empty")
    for i in range(2):
        shutil.copy(boards / f"board{i}.png", at)
    (at / "board2.png").write_bytes((boards / "board2.png").read_bytes()[:5000])
    picture = cv2.imread(str(boards / "board3.png"))
    cv2.imwrite("board3.png", picture.astype(np.uint16) * 256)
    cv2.imwrite("board4.png", picture[:300])
    line = refuse(*CAMERA, *(f"board{i}.png" for i in range(5)))
    assert "2 usable boards; must be 3 or more; board2.png: " in line and "truncated" in line
    assert "empty: no images" in refuse(*CAMERA, "empty")
    assert "nowhere: no such file or folder" in refuse(*CAMERA, "nowhere")
    line = refuse("calibrate", "camera", "board0.png", "--board", "9x9", "--square", "0.03")
    assert "no board of 9 x 9 inner corners found in any of 1 images; count where four" in line
    line = refuse(*CAMERA, "empty", boards)
    assert "empty: is a folder, not an image" in line and "Path(" not in line


def test_options_of_calibrate_camera(boards, refuse):
    def given(*words):
        return refuse("calibrate", "camera", boards, *words)

    assert "--board" in given("--square", "0.03")
    assert "--square" in given("--board", "6x7")
    assert "--board is '6'; must be two counts" in given("--board", "6", "--square", "1")
    assert "must be two numbers of inner corners, 3 to 100" in given(
        "--board", "2x7", "--square", "1"
    )
    assert "square -1.0: must be above 0 m" in given("--board", "6x7", "--square", "-1")
    assert "a camera is a .toml file" in refuse(*CAMERA, boards, "--out", "camera.txt")
    assert "a picture is a .png file" in refuse(*CAMERA, boards, "--report", "camera.pdf")
    assert "a folder, or files, of images are needed" in refuse(*CAMERA)


@pytest.fixture
def corners(monkeypatch, at):
    """Puts given corners in the place of those found in images."""

    def put(pixels):
        names = [f"board{i}.png" for i in range(len(pixels))]
        views = Views(names, names, {name: pixels for name in VARIANTS}, FISHEYE.size, [])
        monkeypatch.setattr(fitting, "find_views", lambda *_: views)
        monkeypatch.setattr(fitting, "_find_outliers_again", lambda files, given, *_: (pixels, 0))

    return put


def test_degenerate_boards(corners, call, refuse):
    given = {"board": BOARD, "square": SQUARE, "tilt": 0.4}
    many = simulate_boards(FISHEYE, 80, 0.1, distance=(0.25, 0.4), **given)[0]
    centred = [p.mean(0) - FISHEYE.params[:2] for p in many]
    right = [np.hypot(u, v) > 60 and abs(np.arctan2(v, u)) < 0.3 for u, v in centred]
    corners([p for p, taken in zip(many, right, strict=True) if taken])
    line = refuse(*CAMERA, "boards")
    assert "all corners lie within " in line and "move the board all round" in line
    # parallel to the image, all at one distance: it can't be told from the focal length
    flat = [board_points(BOARD, 20.0) + [100 + 30 * k, 40 + 25 * k] for k in range(4)]
    noise = np.random.default_rng(0).normal(0, 0.1, (4, 42, 2))
    corners(list(flat + noise))
    line = refuse(*CAMERA, "boards")
    assert re.search("uncertain by .* at one distance|don't determine the camera: place", line)
    assert not os.listdir()
    corners(simulate_boards(FISHEYE, 5, 0.1, distance=(0.2, 0.2), **given)[0])
    code, out, _ = call(*CAMERA, "boards")
    assert code == 0
    assert "warning: all boards are at one distance: bring some nearer and some farther" in out
