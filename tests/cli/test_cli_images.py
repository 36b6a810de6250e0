"""The commands that begin at images: the whole chain on a tiny drive, and bad input at the door."""

import json
import os
import re
import shutil
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_cli_help import outside
from test_images import png
from test_log_triangulation import normal, straight

from jaxslam.cli import main as cli
from jaxslam.logs.log_file import load_log, save_log
from jaxslam.parameter_file import load_params
from jaxslam.parameters import default_params
from jaxslam.vision import extract as extraction
from jaxslam.vision.camera_files import load_camera, save_camera

COMMANDS = ("calibrate camera", "calibrate tilt", "calibrate sensor", "extract", "triangulate")
COMMANDS += ("simulate room",)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Eight images, 20 cm apart, as the command writes them."""
    place = tmp_path_factory.mktemp("rendered") / "room"
    words = ["simulate", "room", place, "--drive", "straight", "--length", "1.2", "--seed", "2"]
    assert cli.main([str(word) for word in words]) == 0
    return place


@pytest.fixture(scope="module")
def extracted(rendered):
    """The log of these images, as the command makes it, and the drawings beside it."""
    out = rendered.parent / "drive.npz"
    words = ["extract", rendered / "images", "--camera", rendered / "camera.toml"]
    words += ["--odometry", rendered / "odometry.csv", "--truth", rendered, "--out", out]
    assert cli.main([str(word) for word in [*words, "--overlay", rendered.parent / "drawn"]]) == 0
    return out


@pytest.fixture
def room(rendered, at):
    """A copy of the rendered room, to be spoilt, and the words that extract it."""
    shutil.copytree(rendered, "room")
    return at / "room"


EXTRACT = "extract", "room/images", "--camera", "room/camera.toml"
EXTRACT += "--odometry", "room/odometry.csv", "--out", "log.npz"


def rewrite(path, text):
    path.write_text(text.replace(" ", "\n") + "\n")


def each_image(room, change):
    for path in sorted((room / "images").iterdir()):
        change(path)


def save(image):
    return lambda path: cv2.imwrite(str(path), image)


def test_a_drive_from_images_to_errors(extracted, at, call):
    log = load_log(extracted)
    assert len(log.frame_time) == 8
    assert np.isfinite(log.point[:, 0]).sum() > 30
    assert log.plan is not None
    pictures = sorted((extracted.parent / "drawn").iterdir())
    assert [path.name for path in pictures] == [f"{k:06d}.png" for k in range(8)]
    words = "--particles", "30", "--landmarks", "100", "--out", "result"
    code, out, err = call("run", extracted, "--sensor", "position", *words)
    share = "note: all particles share one past"
    assert (code, [line[: len(share)] for line in err.splitlines()]) == (0, [share])
    assert "path, filter" in out
    errors = json.loads(call("evaluate", "result", "--json")[1])
    assert errors["truth_frames"] == 8
    assert errors["ate_filtered_unaligned_rmse_m"] < 0.1


def test_what_extract_tells(room, call, refuse):
    code, out, err = call(*EXTRACT)
    assert (code, err) == (0, "")
    log = load_log("log.npz")
    points = np.isfinite(log.point[:, 0]).sum()
    lines = out.splitlines()
    assert lines[0].startswith("log.npz: Log('log': 7 odometry rows, 8 frames, ")
    assert lines[0].endswith(f", {points} points")
    assert any("not used: bearing without a point: first seen here" in line for line in lines)
    assert lines[-1] == "map it with: jaxslam run log.npz"
    assert "log.npz: exists; choose another name or add --overwrite" in refuse(*EXTRACT)
    assert call(*EXTRACT, "--overwrite")[0] == 0


def test_the_next_step_that_simulate_prints_is_right(at, call):
    words = "simulate", "room", "room", "--drive", "turn", "--length", "0.2"
    code, out, _ = call(*words, "--preset", "clean")
    assert code == 0
    command = out.strip().partition("next: jaxslam ")[2]
    code, out, err = call(*command.split())  # a turn: no points, which is said
    assert (code, err) == (
        1,
        "warning: no points: only jaxslam run --sensor bearing can map this log\n",
    )
    assert "not used: bearing without a point: no baseline" in out


def test_images_that_cannot_be_used_are_counted(room, call):
    images = room / "images"
    (images / "000001.png").write_bytes((images / "000001.png").read_bytes()[:9000])
    (images / "000002.png").write_bytes(b"no image")
    (images / "000003.png").write_bytes(png(30000, 30000))
    picture = cv2.imread(str(images / "000004.png"))
    cv2.imwrite(str(images / "000004.png"), picture.astype(np.uint16) * 256)
    cv2.imwrite(str(images / "000005.png"), picture[:400])
    cv2.imwrite(str(images / "000006.png"), picture // 60)
    cv2.imwrite(str(images / "000007.png"), cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    code, out, err = call(*EXTRACT)
    assert code == 1
    assert "2 frames" in out  # grey is as good as colour
    reasons = (
        "truncated: the file ends before its image does (first: 000001.png): 1",
        "not a PNG, JPEG, PGM, PPM, BMP or TIFF image (first: 000002.png): 1",
        "30000 x 30000 pixels; 1 to 100 million are allowed (first: 000003.png): 1",
        "(first: 000004.png): 1",
        "image of 640 x 400 pixels, camera of 640 x 480 (first: 000005.png): 1",
        "dark image (first: 000006.png): 1",
    )
    for line, reason in zip(err.splitlines(), reasons, strict=True):
        assert line.startswith("warning: ") and line.endswith(reason)
    assert "16 bits per channel; only 8 are read; convert it first" in err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda path: path.write_bytes(b""), "8 of 8: image unreadable: is an empty file"),
        (save(np.zeros((480, 640, 3), np.uint8)), "8 of 8: dark image"),
        (
            save(np.full((240, 320, 3), 90, np.uint8)),
            "8 of 8: image of 320 x 240 pixels, camera of 640 x 480",
        ),
    ],
)
def test_no_image_of_use_is_told_and_leaves_nothing(room, at, refuse, change, told):
    each_image(room, change)
    assert told in refuse(*EXTRACT)
    assert os.listdir() == ["room"]


def test_images_without_a_line(room, call):
    each_image(room, save(np.full((480, 640, 3), 120, np.uint8)))
    code, out, err = call(*EXTRACT)
    assert code == 1
    assert "0 measurements), 0 points" in out
    assert "8 not used: image without a line" in out
    assert err.startswith("warning: no line in any image") and err.count("\n") == 1


def test_odometry_and_images_that_do_not_fit(room, call, refuse):
    table = room / "odometry.csv"
    rewrite(table, "time_s,distance_m,turn_rad 1000,0.2,0 1001,0.2,0")
    line = refuse(*EXTRACT)
    assert "000000.png: no image has odometry; times are from " in line
    assert "frames.csv, 0.0 to 7.0 s; room/odometry.csv has 1000.0 to 1001.0 s" in line
    rows = " ".join(f"{k / 2},0.4,0" for k in range(6))
    rewrite(table, f"time_s,forward_m_s,yaw_rate_rad_s {rows}")
    code, out, err = call(*EXTRACT)
    assert code == 1 and "4 frames" in out
    assert "warning: image without odometry at its time: 4\n" in err
    rewrite(table, "time_s,distance_m,turn_rad " + " ".join(f"{k},0,0" for k in range(1, 8)))
    code, out, err = call(*EXTRACT, "--overwrite")
    assert code == 1 and "7 not used: image without motion since the one before" in out
    assert err == "warning: no points: only jaxslam run --sensor bearing can map this log\n"


def test_images_out_of_order_are_sorted_and_counted(room, call):
    assert call(*EXTRACT)[0] == 0
    straight = load_log("log.npz")
    images = room / "images"
    (images / "000002.png").rename(images / "x.png")
    (images / "000005.png").rename(images / "000002.png")
    (images / "x.png").rename(images / "000005.png")
    rows = (room / "frames.csv").read_text().splitlines()
    rows[3], rows[6] = (f"{rows[k].split(',')[0]},{t}" for k, t in ((3, 5), (6, 2)))
    (room / "frames.csv").write_text("\n".join([*rows, ""]))
    code, _, err = call(*EXTRACT, "--overwrite")
    assert (code, err) == (1, "warning: image out of order (sorted, none lost): 2\n")
    np.testing.assert_array_equal(load_log("log.npz").bearing, straight.bearing)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "odometry.csv: is empty"),
        ("a,b 1,2", "allowed: time_s,forward_m_s,yaw_rate_rad_s or time_s,distance_m,turn_rad\n"),
        ("time_s,distance_m,turn_rad", "odometry.csv: no rows"),
        ("time_s,distance_m,turn_rad 1,x,0 2,0,nan", "odometry.csv, line 2: 'x' is not a number"),
        ("time_s,x_m,y_m,theta_rad 0,0,0,0", "is a truth file; odometry has the header time_s,"),
    ],
)
def test_malformed_odometry_is_named(room, refuse, text, told):
    rewrite(room / "odometry.csv", text) if text else (room / "odometry.csv").write_text("")
    assert told in refuse(*EXTRACT)


def test_places_that_are_none(room, at, refuse):
    def replaced(old, new):
        return [new if word == old else word for word in EXTRACT]

    os.mkdir("empty")
    assert "nowhere: no such file or folder" in refuse(*replaced("room/images", "nowhere"))
    assert "empty: no images; files ending in .png" in refuse(*replaced("room/images", "empty"))
    assert "none.csv: no such file" in refuse(*replaced("room/odometry.csv", "none.csv"))
    assert "none.toml: can't be read" in refuse(*replaced("room/camera.toml", "none.toml"))
    told = refuse(*replaced("room/camera.toml", "room/poses.csv"))
    assert "poses.csv: a camera file ends in one of .toml, .txt, .yaml, .yml" in told
    assert "seed is not a field" in refuse(*replaced("room/camera.toml", "room/room.toml"))
    assert "log.dat: a log is a .npz file; name it like log.npz" in refuse(
        *replaced("log.npz", "log.dat")
    )
    assert "no/log.npz: cannot write: there is no folder no" in refuse(
        *replaced("log.npz", "no/log.npz")
    )
    assert "empty: has none of poses.csv" in refuse(*EXTRACT, "--truth", "empty")
    assert "p.toml: no such file" in refuse(*EXTRACT, "--params", "p.toml")
    assert sorted(os.listdir()) == ["empty", "room"]


def test_drawings_never_replace_the_images(room, at, call, refuse):
    before = (room / "images" / "000000.png").read_bytes()
    for more in ((), ("--overwrite",)):
        line = refuse(*EXTRACT, "--overlay", "room/../room/images", *more)
        assert "the images themselves are there; choose another place for drawings" in line
    (at / "lines.avi").write_bytes(b"mine")
    assert "lines.avi: exists; choose another" in refuse(*EXTRACT, "--overlay", "lines.avi")
    assert "exists; choose another name or add --overwrite" in refuse(*EXTRACT, "--overlay", room)
    assert "can't be written as a video" in refuse(*EXTRACT, "--overlay", "no/lines.avi")
    assert (room / "images" / "000000.png").read_bytes() == before
    assert (at / "lines.avi").read_bytes() == b"mine"


def test_interrupted_and_gone_on(room, at, call, monkeypatch):
    look, asked = extraction.extract_lines, []

    def stopped(*given):
        asked.append(given)
        if len(asked) == 5:
            raise KeyboardInterrupt
        return look(*given)

    monkeypatch.setattr(extraction, "extract_lines", stopped)
    words = *EXTRACT, "--overlay", "drawn"
    code, out, err = call(*words)
    assert (code, out) == (130, "")
    assert err.splitlines() == [
        "warning: stopped; repeat the command to resume",
        "jaxslam: interrupted",
    ]
    assert not (at / "log.npz").exists()
    assert call(*words)[0] == 0
    assert len(asked) == 5 + 4  # four were done
    assert sorted(os.listdir()) == ["drawn", "log.npz", "room"]
    assert len(os.listdir("drawn")) == 8
    monkeypatch.setattr(extraction, "extract_lines", look)
    bearing = load_log("log.npz").bearing
    assert call(*EXTRACT, "--overwrite")[0] == 0
    np.testing.assert_array_equal(load_log("log.npz").bearing, bearing)


def test_tilt_is_found_and_written(room, call, refuse):
    true = load_camera(room / "camera.toml")
    save_camera("untilted.toml", replace(true, roll=0.0, pitch=0.0))
    words = "calibrate", "tilt", "room/images", "--camera", "untilted.toml", "--out", "level.toml"
    (room / "images" / "000003.png").write_bytes(b"")
    code, out, err = call(*words)
    assert code == 1
    assert out.startswith("pitch -0.4") and "roll +0." in out
    assert err == "warning: images skipped, 1: is an empty file (first: 000003.png)\n"
    found = load_camera("level.toml")
    assert np.degrees(np.hypot(found.roll - true.roll, found.pitch - true.pitch)) < 0.1
    assert "level.toml: exists" in refuse(*words)


def test_tilt_that_cannot_be_found(room, refuse):
    tilt = "calibrate", "tilt", "room/images", "--camera", "room/camera.toml"
    assert "x.png: a camera is a .toml file" in refuse(*tilt, "--out", "x.png")
    assert "there is no folder no" in refuse(*tilt, "--out", "no/x.toml")
    each_image(room, save(np.full((480, 640, 3), 120, np.uint8)))
    assert "tilt: 0 nearly vertical lines in 8 images" in refuse(*tilt)
    each_image(room, lambda path: path.write_bytes(png(30000, 30000)))
    line = refuse(*tilt)
    assert line.endswith("8 skipped: 30000 x 30000 pixels; 1 to 100 million are allowed"
                         " (first: 000000.png)\n")  # fmt: skip


def test_a_sensors_errors_from_a_straight_drive(at, call, refuse):
    save_log("straight.npz", straight(3, normal))
    words = "calibrate", "sensor", "straight.npz"
    code, out, err = call(*words, "--figure", "points.png")
    assert (code, err) == (0, "")
    assert re.search("preferred: (propagated|bearing) normal, by ", out)
    assert "params.toml: motion and position_scale" in out
    assert (at / "points.png").stat().st_size > 10_000
    assert "params.toml: exists" in refuse(*words)
    base = default_params("position", load_log("straight.npz"))
    found = load_params("params.toml", base)
    assert found.position_scale == pytest.approx(1.5 * base.position_scale, rel=0.15)
    assert found.sigma_bearing == base.sigma_bearing


def test_a_sensor_that_cannot_be_calibrated(extracted, at, refuse):
    line = refuse("calibrate", "sensor", extracted)
    assert "calibration needs over 30 s of odometry and true poses together" in line
    words = "calibrate", "sensor", "lost-in-the-woods"
    assert "has no points to draw" in refuse(*words, "--figure", "points.png")
    assert "a picture is a .png file" in refuse(*words, "--figure", "points.pdf")
    assert "a file of parameters is a .toml file" in refuse(*words, "--out", "params.json")
    assert "nowhere.npz: no such file" in refuse("calibrate", "sensor", "nowhere.npz")
    assert not os.listdir()


def test_the_bundled_log_is_triangulated(at, call, refuse):
    whole = load_log("lost-in-the-woods")
    save_log("still.npz", cut(whole, 200))  # hardly moves
    code, out, err = call("triangulate", "still.npz", "none.npz")
    assert code == 1 and ", 0 points" in out
    assert err == "warning: no points: only jaxslam run --sensor bearing can map this log\n"
    save_log("short.npz", cut(whole, 1000))
    code, out, err = call("triangulate", "short.npz", "points.npz")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "map it with: jaxslam run points.npz --sensor position"
    found = load_log("points.npz")
    assert np.isfinite(found.point[:, 0]).sum() > 50
    assert f", {np.isfinite(found.point[:, 0]).sum()} points" in out
    assert "exists; choose another" in refuse("triangulate", "short.npz", "points.npz")
    assert "no folder no" in refuse("triangulate", "short.npz", "no/points.npz")
    assert "a log is a .npz file" in refuse("triangulate", "short.npz", "points.csv")


def cut(log, frames):
    """The first frames of a log of bearings, without the truth."""
    rows = log.frame < frames
    kept = log.odometry_time <= log.frame_time[frames - 1]
    return type(log)(
        name="short", odometry_time=log.odometry_time[kept], odometry=log.odometry[kept],
        frame_time=log.frame_time[:frames], frame=log.frame[rows], bearing=log.bearing[rows],
        view=log.view, mounting=log.mounting,
    )  # fmt: skip


def test_a_room_that_cannot_be_rendered(room, refuse):
    assert "room: exists; choose another folder or add --overwrite" in refuse(
        "simulate", "room", "room"
    )
    os.mkdir("mine")
    assert "not a rendered room" in refuse("simulate", "room", "mine", "--overwrite")
    assert "length is -1.0, allowed" in refuse("simulate", "room", "x", "--length", "-1")
    assert "step is 0.0, allowed" in refuse("simulate", "room", "x", "--step", "0")
    assert '"clean", "normal", "hard"' in refuse("simulate", "room", "x", "--preset", "dim")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(call, command):
    code, out, _ = call(*command.split(), "--help")
    assert code == 0
    assert f"Example: jaxslam {command}" in out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_needs_neither_jax_nor_opencv(command):
    program = (
        f"import sys; from jaxslam.cli.main import main; main([*{command.split()}, '--help']); "
        "heavy = {'jax', 'cv2', 'matplotlib', 'scipy'} & set(sys.modules); "
        "sys.exit(bool(heavy))"
    )
    assert outside(f'{sys.executable} -c "{program}"')[0] == 0
