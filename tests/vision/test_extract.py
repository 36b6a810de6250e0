"""Extraction: from images and odometry to a log, streamed, resumed, and refused with reasons."""

import csv
import json
import shutil
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from jaxslam.logs.log_file import load_log
from jaxslam.parameters import default_params
from jaxslam.simulation.room.render import double_mirror_camera, render_room
from jaxslam.vision import extract as module
from jaxslam.vision.extract import extract
from jaxslam.vision.lines import LineSettings
from jaxslam.vision.log_triangulation import PointSettings
from jaxslam.vision.matching import appearance_of, match

CAMERA = double_mirror_camera()
ROBOT = default_params("position")._replace(
    err_tran=0.0075, err_rot=0.02, err_drift=0.01, floor_tran=0.0005, floor_rot=0.0005
)
# Seven images are 1.2 m: a shorter baseline than usual leaves points to look at.
POINTS = PointSettings(baseline=0.5)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Seven images, 20 cm apart."""
    place = tmp_path_factory.mktemp("rendered") / "room"
    render_room(place, seed=2, drive="straight", length=1.2, step=0.2, slip=0.0)
    return place


@pytest.fixture(scope="module")
def spin(tmp_path_factory):
    """Five images, turning on the spot."""
    place = tmp_path_factory.mktemp("rendered") / "spin"
    render_room(place, seed=2, drive="turn", length=0.7, preset="clean", turn_error=0.0)
    return place


@pytest.fixture
def copy(room, tmp_path):
    return shutil.copytree(room, tmp_path / "room")


def run(place, out=None, **changes):
    values = {"odometry": place / "odometry.csv", "params": ROBOT, "points": POINTS} | changes
    return extract(values.pop("source", place / "images"), CAMERA, out=out, **values)


def black(path):
    cv2.imwrite(str(path), np.zeros((480, 640, 3), np.uint8))


def test_a_drive_becomes_a_log_whose_points_are_edges(room, tmp_path):
    calls = []
    out = tmp_path / "a.npz"
    log = run(room, out, truth=room, progress=lambda *call: calls.append(call))
    assert calls == [(k, 7) for k in range(1, 8)]
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]  # the partial file is gone
    assert len(load_log(out).bearing) == len(log.bearing) > 7 * 15
    assert len(log.frame_time) == 7
    assert log.descriptor.shape[1] == 9
    assert log.noise["err_drift"] == ROBOT.err_drift
    assert "sigma_bearing" not in log.noise
    assert 0 < np.median(log.bearing_sigma) < np.radians(0.2)
    assert log.view == (-np.pi, np.pi, 10.0)
    assert log.has("bearing") and log.has("position")
    np.testing.assert_allclose(log.start_pose, log.truth.pose[0])
    assert len(log.plan.segments) > 4
    given = np.isfinite(log.point[:, 0])
    assert given.sum() > 20
    pose = log.truth.pose[log.frame[given]]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = log.point[given].T
    world = pose[:, :2] + np.column_stack([c * x - s * y, s * x + c * y])
    with open(room / "edges.csv", encoding="utf-8") as file:
        edges = np.array([(float(r["x_m"]), float(r["y_m"])) for r in csv.DictReader(file)])
    off = np.hypot(*(world[:, None] - edges).transpose(2, 0, 1)).min(axis=1)
    assert np.median(off) < 0.1
    xx, _, yy = log.point_cov[given].T
    assert np.mean(off < 3 * np.sqrt(xx + yy)) > 0.85


def test_lines_of_consecutive_images_match(room):
    log = run(room)
    assert len([k for k in log.skipped if "first seen here" in k]) == 1
    first = next(v for k, v in log.skipped.items() if "first seen here" in k)
    assert first < 0.5 * len(log.bearing)  # most are followed


def test_a_turn_on_the_spot_shifts_every_bearing_and_yields_no_points(spin):
    images = module.Images(spin / "images")
    frames = [module.extract_lines(image, CAMERA) for _, image in images][:-1]  # full turns
    turn = np.pi / 18
    for a, b in pairwise(frames):
        pairs = match(a, b, (0.0, 0.0, turn))
        assert len(pairs) > 0.8 * min(len(a.bearing), len(b.bearing))
        i, j = pairs.T
        shift = (b.bearing[j] - a.bearing[i] + turn + np.pi) % (2 * np.pi) - np.pi
        assert np.median(np.abs(shift)) < np.radians(0.05)
        looks = appearance_of(a), appearance_of(b)
        assert np.median(np.abs(looks[0].high[i] - looks[1].high[j])) < np.radians(1)
        assert np.median(np.abs(looks[0].colour[i] - looks[1].colour[j])) < 0.03
    log = run(spin)
    assert not log.has("position")
    assert sum(v for k, v in log.skipped.items() if "pure turn" in k) > 0.6 * len(log.bearing)


def entries(path):
    with np.load(path) as file:
        return {name: file[name].tobytes() for name in file.files}


def test_interrupted_and_resumed_is_the_same_bit_by_bit(room, tmp_path):
    whole, parts = tmp_path / "whole" / "a.npz", tmp_path / "parts" / "a.npz"
    whole.parent.mkdir()
    parts.parent.mkdir()
    run(room, whole)

    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(room, parts, progress=stop)
    assert not parts.exists()
    partial = parts.with_name(".a.npz.partial")
    with open(partial, "ab") as file:
        file.write(b'{"image": "000003.png", "li')  # torn by a crash
    calls = []
    run(room, parts, progress=lambda *call: calls.append(call))
    assert calls[0] == (4, 7)
    assert not partial.exists()
    assert entries(whole) == entries(parts)


def test_a_partial_file_of_other_settings_is_refused(room, tmp_path):
    out = tmp_path / "a.npz"

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(room, out, progress=stop)
    with pytest.raises(ValueError, match=r"other settings \(lines\).*delete it"):
        run(room, out, lines=LineSettings(length=0.2))
    partial = tmp_path / ".a.npz.partial"
    rows = partial.read_text().splitlines()
    rows[1] = json.dumps({"image": "x"})
    partial.write_text("\n".join(rows) + "\n")
    with pytest.raises(ValueError, match="is damaged"):
        run(room, out)


def test_images_that_are_no_use_are_counted_and_the_rest_goes_on(copy):
    images = copy / "images"
    (images / "000001.png").write_bytes((images / "000001.png").read_bytes()[:2000])
    black(images / "000002.png")
    cv2.imwrite(str(images / "000003.png"), np.full((240, 320, 3), 90, np.uint8))
    cv2.imwrite(str(images / "000004.png"), np.full((480, 640, 3), 90, np.uint8))
    log = run(copy)
    lost = {k: v for k, v in log.skipped.items() if not k.startswith("not used")}
    assert len(lost) == 3 and set(lost.values()) == {1}
    text = " ".join(lost)
    assert "dark image (first: 000002.png)" in text
    assert "image of 320 x 240 pixels, camera of 640 x 480 (first: 000003.png)" in text
    assert "(first: 000001.png)" in text and "truncated" in text
    assert "\n" not in text
    # An image that showed no line was looked at: it is a frame.
    assert len(log.frame_time) == 4
    assert np.bincount(log.frame, minlength=4)[1] == 0
    assert log.skipped["not used: image without a line (a frame all the same)"] == 1


def test_no_image_that_can_be_used_is_an_error(copy):
    for path in (copy / "images").iterdir():
        black(path)
    with pytest.raises(ValueError, match=r"000000.png: no image can be used; 7 of 7: dark image"):
        run(copy)


def write(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")


def test_times_of_the_images(copy, monkeypatch):
    monkeypatch.setattr(module, "extract_lines", lambda *_: nothing())
    stamps = [k * 10**9 for k in range(7)]
    assert run(copy).frame_time.tolist() == stamps  # frames.csv beside the folder
    write(
        copy / "images" / "frames.csv", "image,time_s", [(f"{k:06d}.png", k / 2) for k in range(6)]
    )
    log = run(copy)
    assert log.frame_time.tolist() == [stamp // 2 for stamp in stamps[:6]]
    assert log.skipped["image without a time"] == 1
    (copy / "images" / "frames.csv").unlink()
    (copy / "frames.csv").unlink()
    odometry = copy / "odometry.csv"
    write(odometry, "time_s,distance_m,turn_rad", [(10 + 2 * k, 0.1, 0) for k in range(6)])
    # One image before the first command and one after each.
    assert (run(copy).frame_time[1:] / 1e9).tolist() == [10, 12, 14, 16, 18, 20]
    write(odometry, "time_s,distance_m,turn_rad", [(k, 0.1, 0) for k in range(5)])
    assert run(copy).frame_time.tolist() == stamps  # names that are numbers
    for path in list((copy / "images").iterdir()):
        path.rename(path.with_name("x" + path.name))
    with pytest.raises(ValueError, match=r"no times.*give a frames.csv .*7 images and 5 commands"):
        run(copy)


def nothing():
    return module.Lines(*(np.empty(s) for s in (0, 0, 0, 0, 0, (0, 2, 3), 0)))


def test_frames_out_of_order_twice_or_without_odometry(copy, monkeypatch):
    monkeypatch.setattr(module, "extract_lines", lambda *_: nothing())
    names = [f"{k:06d}.png" for k in range(7)]
    times = [0, 2, 1, 3, 3, 4, 999]
    write(copy / "frames.csv", "image,time_s", zip(names, times, strict=True))
    write(
        copy / "odometry.csv", "time_s,forward_m_s,yaw_rate_rad_s", [(k, 0.1, 0) for k in range(6)]
    )
    log = run(copy)
    assert (log.frame_time / 1e9).tolist() == [0, 1, 2, 3, 4]
    assert log.skipped["image out of order (sorted, none lost)"] == 1
    assert log.skipped["image with the stamp of another (first kept)"] == 1
    assert log.skipped["image without odometry at its time"] == 1
    write(copy / "frames.csv", "image,time_s", [(name, 500 + k) for k, name in enumerate(names)])
    with pytest.raises(ValueError, match=r"no image has odometry; times are from .*frames.csv"):
        run(copy)


def test_images_while_the_robot_stands_are_counted(copy, monkeypatch):
    monkeypatch.setattr(module, "extract_lines", lambda *_: nothing())
    rows = [(k, 0.1 * (k != 3), 0) for k in range(1, 7)]
    write(copy / "odometry.csv", "time_s,distance_m,turn_rad", rows)
    log = run(copy)
    assert len(log.frame_time) == 7
    why = "not used: image without motion since the one before (a frame all the same)"
    assert log.skipped[why] == 1


def test_bad_files_are_named(copy, tmp_path):
    bad = tmp_path / "bad.csv"
    write(bad, "picture,when", [("a", 1)])
    with pytest.raises(ValueError, match=r"bad.csv, line 1: header 'picture,when'; must be image"):
        run(copy, times=bad)
    write(bad, "image,time_s", [("000000.png", "soon")])
    with pytest.raises(ValueError, match=r"bad.csv, line 2: '000000.png': stamp 'soon'"):
        run(copy, times=bad)
    write(bad, "image,time_s", [("other.png", 1)])
    with pytest.raises(ValueError, match="names none of the images"):
        run(copy, times=bad)
    with pytest.raises(ValueError, match=r"frames.csv, line 1: .* is no known header"):
        run(copy, odometry=copy / "frames.csv")
    with pytest.raises(ValueError, match=r"poses.csv: is a truth file; odometry has the header"):
        run(copy, odometry=copy / "poses.csv")
    write(copy / "plan.csv", "a,b", [(1, 2)])
    with pytest.raises(ValueError, match=r"plan.csv, line 1: header 'a,b'"):
        run(copy, truth=copy)
    with pytest.raises(ValueError, match=r"has none of poses.csv"):
        run(copy, truth=tmp_path)
    (tmp_path / "there.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"there.npz: exists"):
        run(copy, tmp_path / "there.npz")
    with pytest.raises(ValueError, match=r"is a .npz file"):
        run(copy, tmp_path / "log.dat")


def test_pictures_and_videos_show_the_lines(room, tmp_path):
    run(room, overlay=tmp_path / "pictures")
    names = sorted(p.name for p in (tmp_path / "pictures").iterdir())
    assert names == [f"{k:06d}.png" for k in range(7)]
    drawn = cv2.imread(str(tmp_path / "pictures" / names[0])).astype(int)
    changed = np.abs(drawn - cv2.imread(str(room / "images" / names[0]))).max(axis=2) > 30
    assert 200 < changed.sum() < 0.2 * changed.size
    run(room, overlay=tmp_path / "lines.avi")
    video = cv2.VideoCapture(str(tmp_path / "lines.avi"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 7
    video.release()


def test_a_video_has_times_of_its_own(room, tmp_path):
    path = tmp_path / "drive.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 2.0, (640, 480))
    for name in sorted((room / "images").iterdir()):
        video.write(cv2.imread(str(name)))
    video.release()
    odometry = tmp_path / "odometry.csv"
    write(odometry, "time_s,forward_m_s,yaw_rate_rad_s", [(k / 2, 0.4, 0) for k in range(7)])
    log = run(room, source=path, odometry=odometry)
    assert (log.frame_time / 1e9).tolist() == [0, 0.5, 1, 1.5, 2, 2.5, 3]
    assert np.isfinite(log.point[:, 0]).sum() > 10


def test_the_camera_says_where_it_sits(room, monkeypatch):
    monkeypatch.setattr(module, "extract_lines", lambda *_: nothing())
    moved = replace(CAMERA, position=(0.2, -0.1, 0.6))
    log = extract(room / "images", moved, room / "odometry.csv", reach=7.0)
    assert log.mounting == (0.2, -0.1, 0.0)
    assert log.view[2] == 7.0
    assert set(log.noise) == {"position_scale", "detection"}
