"""The reader of the course's .mat, on good files and on broken ones."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from refusal import refused

from jaxslam.logs.log_file import load_log
from jaxslam.logs.readers import mat5, read
from jaxslam.logs.readers.aer1513 import read_mat

S = 10**9
COURSE = Path(__file__).parents[3] / "shared" / "data" / "lost_in_the_woods" / "dataset2.mat"


def course(**changes):
    """Four steps, two landmarks, the truth unknown at the third."""
    column = np.arange(4.0)[:, None]
    values = {
        "t": column / 10,
        "v": column + 1,
        "om": column / 10,
        "r": np.array([[1, 0], [0, 0], [1, 2], [0, 2.0]]),
        "b": np.array([[0.5, 0], [0, 0], [0.1, -0.2], [0, 0.3]]),
        "l": np.array([[1, 2], [3, 4.0]]),
        "d": np.array([[0.2]]),
        "x_true": column,
        "y_true": -column,
        "th_true": column / 2 + 3,
        "true_valid": np.array([[1], [1], [0], [1]], np.uint8),
    }
    return {k: v for k, v in (values | changes).items() if v is not None}


def mat(tmp_path, **changes):
    path = tmp_path / "course.mat"
    scipy.io.savemat(path, course(**changes))
    return path


def test_mat(tmp_path):
    log = read(mat(tmp_path))
    assert log.odometry_time.tolist() == [0, S // 10, S // 5]
    assert log.odometry == pytest.approx(np.array([[2, 0.1], [3, 0.2], [4, 0.3]]))
    assert log.frame_time.tolist() == [0, S // 10, S // 5, 3 * S // 10]
    assert log.frame.tolist() == [0, 2, 2, 3]
    assert log.identity.tolist() == [0, 0, 1, 1]
    assert log.range.tolist() == [1, 1, 2, 2]
    assert log.bearing.tolist() == [0.5, 0.1, -0.2, 0.3]
    assert log.mounting == (0.2, 0, 0)
    assert log.view[2] == 6
    assert log.noise == {}
    assert log.start_pose.tolist() == [0, 0, 3]
    assert not log.start_cov.any()
    assert log.truth.time.tolist() == [0, S // 10, 3 * S // 10]
    assert log.truth.pose[2].tolist() == [3, -3, 4.5]
    assert log.truth.landmark_id.tolist() == [0, 1]
    assert log.truth.identity.tolist() == [0, 0, 1, 1]
    assert log.skipped == {}


def test_mat_stamps_can_be_moved(tmp_path):
    log = read_mat(mat(tmp_path), lag=0, time_offset=-0.05)
    assert log.odometry_time[0] == 0
    assert log.odometry[0].tolist() == [1, 0]
    assert len(log.odometry) == 4
    assert log.time_offset == -0.05
    assert log.frame_time[:2].tolist() == [-S // 20, S // 20]
    assert log.start_pose.tolist() == [0, 0, 3]


def test_mat_without_truth(tmp_path):
    log = read(mat(tmp_path, l=None, x_true=None))
    assert log.truth.pose is None
    assert log.truth.landmarks is None
    assert log.start_pose.tolist() == [0, 0, 0]


def test_mat_bad_rows_are_counted(tmp_path):
    t = np.array([[0], [0.2], [0.1], [0.2]])
    r = np.array([[1, 0], [0, 0], [np.nan, -2], [0, 2.0]])
    log = read(mat(tmp_path, t=t, r=r, v=np.array([[1], [1], [np.nan], [1.0]])))
    assert log.frame_time.tolist() == [0, S // 10, S // 5]
    assert len(log.odometry) == 1
    assert log.range.tolist() == [1, 2]
    assert log.skipped == {
        "step out of order (sorted, none lost)": 1,
        "step with the stamp of another (last kept)": 1,
        "odometry that is not finite": 1,
        "range or bearing that is not finite, or range not above 0": 2,
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"r": None}, "no variable r"),
        ({"v": np.zeros((3, 1))}, r"v: shape \(3, 1\); must be \(4, 1\)"),
        ({"l": np.zeros((3, 2))}, "l: shape"),
        ({"t": np.zeros((4, 1))}, "at least 2"),
        ({"t": np.full((4, 1), np.nan)}, "0 usable steps"),
        ({"t": np.arange(4.0)[:, None] * 1e8 + 1.2e18}, "nanoseconds"),
        ({"b": np.array([[45, 0], [0, 0], [10, -20], [0, 30.0]])}, "degrees"),
        ({"d": np.array([[np.nan]])}, "mounting"),
        ({"v": np.array(["a"] * 4)[:, None]}, "v: "),
        ({"r": scipy.sparse.eye(4, 2)}, "r: "),
    ],
)
def test_mat_refused(tmp_path, changes, message):
    refused(mat(tmp_path, **changes), message)


@pytest.mark.parametrize("compressed", [False, True])
def test_mat_plain_or_compressed(tmp_path, compressed):
    path = tmp_path / "course.mat"
    scipy.io.savemat(path, course() | {"text": "x", "s": {"a": 1}}, do_compression=compressed)
    whole, refusals = path.read_bytes(), []
    assert read(path).range.tolist() == [1, 1, 2, 2]
    for place in range(0, len(whole), 7):  # no byte turned over may do more than be refused
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            read(path)
        except ValueError as err:
            refusals.append(str(err))
    assert len(refusals) > len(whole) / 7 / 10
    assert all(str(path) in refusal for refusal in refusals)


def test_mat_bomb_is_not_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "course.mat"
    scipy.io.savemat(path, course(r=np.zeros((4, 10**5))), do_compression=True)
    assert path.stat().st_size < 10**5
    monkeypatch.setattr(mat5, "MAX_BYTES", 10**6)
    refused(path, "longer than")


def test_mat_broken_file(tmp_path):
    path = mat(tmp_path)
    data = path.read_bytes()
    for length in (0, 60, 200, len(data) - 300):
        path.write_bytes(data[:length])
        refused(path, "damaged|no variable")
    path.write_text("not a matrix " * 50)
    refused(path, "damaged")
    refused(tmp_path / "absent.mat", "no such file")


@pytest.mark.skipif(not COURSE.exists(), reason="the course's dataset2.mat is not here")
def test_bundled_log_is_what_the_reader_makes(tmp_path):
    made, bundled = read(COURSE), load_log("lost-in-the-woods")
    for name in ("odometry_time", "odometry", "frame_time", "frame", "bearing", "range"):
        assert np.array_equal(getattr(made, name), getattr(bundled, name))
    assert np.array_equal(made.truth.pose, bundled.truth.pose)
