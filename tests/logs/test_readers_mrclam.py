"""The reader of MRCLAM's folders, on good files and on broken ones."""

from pathlib import Path

import numpy as np
import pytest
from refusal import refused

from jaxslam.logs.readers import read

S = 10**9
MRCLAM = Path(__file__).parents[3] / "shared" / "data" / "mrclam"


def mrclam(tmp_path, **changes):
    """Robot 2's files, in the published layout."""
    files = {
        "Barcodes": "1 5\n2 14\n6 72\n7 27\n",
        "Landmark_Groundtruth": "6 1.0 2.0 0.0001 0.0002\n7 3.0 4.0 0.0001 0.0002\n",
        "Robot2_Odometry": "1248444187.156\t 0.1 \t -0.4\n1248444187.166 0.1 -0.3\n",
        "Robot2_Measurement": "1248444187.256 72 3.5 -0.25\n1248444187.256 5 6.5 0.0\n"
        "1248444187.300 5 6.5 0.0\n1248444187.4 27 2.5 0.5\n",
        "Robot2_Groundtruth": "1248444187.146 1.0 2.0 3.1\n1248444187.166 2.0 4.0 -3.1\n",
    }
    header = "# UTIAS Multi-Robot Dataset\n# Time [s]    x [m]\n"
    for name, text in (files | changes).items():
        if text is not None:
            (tmp_path / f"{name}.dat").write_bytes((header + text).encode())
    return tmp_path


def test_mrclam(tmp_path):
    log = read(mrclam(tmp_path), 2)
    start = 1248444187156 * 10**6
    assert log.odometry_time.tolist() == [start, start + S // 100]  # exact to the nanosecond
    assert log.odometry.tolist() == [[0.1, -0.4], [0.1, -0.3]]
    since = log.frame_time - start
    assert since.tolist() == [S // 10, 144 * S // 1000, 244 * S // 1000]  # the second: a robot only
    assert log.frame.tolist() == [0, 2]
    assert log.identity.tolist() == [6, 7]
    assert log.range.tolist() == [3.5, 2.5]
    assert log.bearing == pytest.approx([-0.25, 0.5])
    assert log.view == (-0.6, 0.6, 9.0)
    assert log.name.endswith("robot2")
    assert log.start_pose == pytest.approx((1.5, 3.0, np.pi))  # half-way, across the wrap
    assert log.truth.landmark_id.tolist() == [6, 7]
    assert log.truth.landmarks.tolist() == [[1, 2], [3, 4]]
    assert log.truth.identity.tolist() == [6, 7]
    assert log.skipped == {"not used: measurement of another robot": 2}


def test_mrclam_line_ends_and_order_do_not_matter(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    plain = read(mrclam(tmp_path / "a"), 2)
    folder = mrclam(tmp_path / "b")
    for file in folder.iterdir():
        head, rows = file.read_text().splitlines()[:2], file.read_text().splitlines()[2:]
        file.write_bytes("\r\n".join(head + rows[::-1]).encode())
    other = read(folder)  # the only robot
    for name in ("odometry_time", "odometry", "frame_time", "frame", "bearing", "identity"):
        assert np.array_equal(getattr(plain, name), getattr(other, name)), name
    assert np.array_equal(plain.truth.pose, other.truth.pose)
    assert other.skipped == plain.skipped | {
        "odometry row out of order (sorted, none lost)": 1,
        "measurement out of order (sorted, none lost)": 2,
        "truth row out of order (sorted, none lost)": 1,
    }


def test_mrclam_single_bad_rows_are_counted(tmp_path):
    odometry = "".join(f"{100 + i / 10} 0.1 {i}\n" for i in range(40))
    odometry += "103.9 0.1 99\n104.0 0.1\n"  # a duplicate stamp, a missing column
    measured = "101 72 3.5 0.1\n101 99 1.0 0.1\n102 27 -1.0 0.2\n"
    changes = {"Robot2_Odometry": odometry, "Robot2_Measurement": measured}
    log = read(mrclam(tmp_path, **changes, Robot2_Groundtruth=None), 2)
    assert len(log.odometry) == 40
    assert log.odometry[-1].tolist() == [0.1, 99]
    assert log.identity.tolist() == [6]
    assert log.truth.pose is None
    assert log.start_pose.tolist() == [0, 0, 0]
    reasons = sorted(log.skipped.items())
    assert [count for _, count in reasons] == [1, 1, 1, 1]
    assert "Robot2_Measurement.dat (line 5: range not above 0" in reasons[0][0]
    assert "Robot2_Odometry.dat (line 44: 2 columns instead of 3)" in reasons[1][0]
    assert reasons[2][0] == "measurement of an unknown barcode (99)"
    assert reasons[3][0] == "odometry row with the stamp of another (last kept)"


MRCLAM_BAD = {
    "no rows": ({"Robot2_Odometry": ""}, "Robot2_Odometry.dat: is empty"),
    "no file": ({"Robot2_Measurement": None}, "Robot2_Measurement.dat: no such file"),
    "text": ({"Robot2_Odometry": "a b c\n" * 5}, "line 3: stamp 'a' is not a number .5 of 5"),
    "NaN": ({"Robot2_Odometry": "1 nan 0\n2 nan 0\n"}, "line 3: nan is not finite"),
    "columns": ({"Robot2_Measurement": "1 72 0.5\n" * 3}, "line 3: 3 columns instead of 4"),
    "nanoseconds": (
        {"Robot2_Odometry": "1248444187156000000 0.1 0\n" * 3},
        "line 3: stamp 1248444187156000000: .*nanoseconds. divide",
    ),
    "relative ns": ({"Robot2_Odometry": "0 0.1 0\n900000000 0.1 0\n"}, "nanoseconds. divide"),
    "degrees": ({"Robot2_Measurement": "1 72 2 30\n2 72 2 -20\n3 72 2 1\n"}, "line 3: .*degrees"),
    "cut": ({"Robot2_Odometry": "1 0.1 0\n2 0.1 0\n3 0."}, "line 5: the file ends here"),
    "barcodes": ({"Barcodes": "1 5\n2 5\n"}, "same barcode"),
    "binary": ({"Robot2_Odometry": "\x00\x01\xff\x93" * 99}, "Robot2_Odometry.dat"),
    "landmarks": ({"Landmark_Groundtruth": "6 1 1 0 0\n6 2 2 0 0\n"}, "same id"),
}


@pytest.mark.parametrize(("changes", "message"), MRCLAM_BAD.values(), ids=MRCLAM_BAD)
def test_mrclam_refused(tmp_path, changes, message):
    refused(mrclam(tmp_path, **changes), message, robot=2)


def test_mrclam_robots(tmp_path):
    refused(mrclam(tmp_path), "no robot 7; there are 2", robot=7)
    (tmp_path / "Robot4_Odometry.dat").write_text("1 0 0\n")
    refused(tmp_path, "choose a robot; there are 2, 4")


@pytest.mark.skipif(not MRCLAM.exists(), reason="MRCLAM has no licence to be bundled; not here")
@pytest.mark.parametrize(("robot", "rows"), [(1, 1534), (4, 2023)])
def test_mrclam_dataset_6(robot, rows):
    log = read(MRCLAM / "MRCLAM_Dataset6", robot)
    assert len(log.frame) == rows
    assert set(log.identity.tolist()) == set(range(6, 21))
    stamps = log.frame_time[log.frame]
    inside = stamps < log.truth.time[-1]
    pose = np.column_stack([log.truth.pose[:, :2], np.unwrap(log.truth.pose[:, 2])])
    since = (log.truth.time - log.start) / 1e9
    x, y, heading = (np.interp((stamps - log.start) / 1e9, since, c) for c in pose.T)
    dx, dy = log.truth.landmarks[log.identity - 6].T - [x, y]
    error = (log.bearing - np.arctan2(dy, dx) + heading + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(1.4826 * np.median(np.abs(error[inside]))) < 1.5
    assert np.abs(log.start_pose[:2] - [x[0], y[0]]).max() < 0.5


@pytest.mark.skipif(not MRCLAM.exists(), reason="MRCLAM has no licence to be bundled; not here")
def test_mrclam_dataset_1_has_no_poses():
    log = read(MRCLAM / "MRCLAM_Dataset1", 3)
    assert log.truth.pose is None
    assert len(log.truth.landmarks) == 15
    assert log.skipped["odometry row with the stamp of another (last kept)"] == 22
    assert log.skipped["measurement of an unknown barcode (43)"] == 2
