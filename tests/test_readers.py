"""Readers of foreign logs, on good files and on broken ones."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from jaxslam.log import load_log, save_log
from jaxslam.readers import mat5, read
from jaxslam.readers.csvpair import read_csv
from jaxslam.readers.mat import read_mat

S = 10**9
SHARED = Path(__file__).parents[2] / "shared" / "data"
MRCLAM = SHARED / "mrclam"
COURSE = SHARED / "lost_in_the_woods" / "dataset2.mat"


def refused(paths, message, robot=None):
    """The reader refuses in one line that names a file."""
    with pytest.raises(ValueError, match=message) as caught:
        read(paths, robot)
    paths = paths if isinstance(paths, list) else [paths]
    assert any(str(path) in str(caught.value) for path in paths), caught.value
    assert "\n" not in str(caught.value)


# The course's .mat


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


# MRCLAM


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


# CSV

ODOMETRY = "time_s,forward_m_s,yaw_rate_rad_s\n0,0.5,0.1\n0.5,0.5,0.2\n1.0,0.5,0.3\n"
MEASURED = "time_s,bearing_rad,range_m,identity\n0.5,0.1,2,7\n0.5,-0.2,3,\n0.75\n1.0,3.5,4,8\n"


def csv(tmp_path, **files):
    """Files of the given contents, in the order given."""
    paths = []
    for name, text in ({"odometry": ODOMETRY, "measured": MEASURED} | files).items():
        paths.append(tmp_path / f"{name}.csv")
        paths[-1].write_text(text)
    return paths


def test_csv(tmp_path):
    paths = csv(
        tmp_path,
        truth="time_s,x_m,y_m,theta_rad\n0,1,2,0.5\n1,2,2,0.5\n",
        landmarks="id,x_m,y_m\n7,1,1\n8,2,2\n",
    )
    log = read(paths[::-1])
    assert log.odometry_kind == "velocity"
    assert log.odometry_time.tolist() == [0, S // 2, S]
    assert log.frame_time.tolist() == [S // 2, 3 * S // 4, S]
    assert log.frame.tolist() == [0, 0, 2]
    assert log.bearing == pytest.approx([0.1, -0.2, 3.5 - 2 * np.pi])
    assert log.range.tolist() == [2, 3, 4]
    assert log.identity.tolist() == [7, -1, 8]
    assert log.view == pytest.approx((3.5 - 2 * np.pi, 0.1, 4))
    assert log.start_pose.tolist() == [1, 2, 0.5]
    assert log.truth.landmark_id.tolist() == [7, 8]
    assert log.skipped == {}
    assert log.name == "measured"
    save_log(tmp_path / "a.npz", log)
    assert load_log(tmp_path / "a.npz").range.tolist() == [2, 3, 4]


def test_csv_commands_and_points(tmp_path):
    odometry = "time_s,distance_m,turn_rad\n1,0.5,0.1\n2,0.5,0.2\n"
    measured = "# stops\n\ntime_s,x_m,y_m,sxx,sxy,syy\n1,2,1,0.1,0,0.2\n2,,,,,\n"
    log = read(csv(tmp_path, odometry=odometry, measured=measured))
    assert log.odometry_kind == "command"
    assert log.bearing is None
    assert log.truth is None
    assert log.point.tolist() == [[2, 1]]
    assert log.point_cov.tolist() == [[0.1, 0, 0.2]]
    assert log.frame_time.tolist() == [S, 2 * S]
    assert log.frame.tolist() == [0]


def test_csv_bearings_alone_see_ten_metres(tmp_path):
    measured = "time_s,bearing_rad\n0.5,-0.5\n0.5,0.5\n"
    paths = csv(tmp_path, measured=measured)
    assert read(paths).view == (-0.5, 0.5, 10)
    log = read_csv(paths, view=(-1.0, 1.0, 30.0), mounting=(0.1, 0, 0))
    assert log.view == (-1, 1, 30)
    assert log.mounting == (0.1, 0, 0)
    assert not log.has("range_bearing")


def test_csv_that_never_saw_anything(tmp_path):
    log = read(csv(tmp_path, measured="time_s,bearing_rad\n0.5\n1\n"))
    assert len(log.frame) == 0
    assert len(log.frame_time) == 2


def test_csv_stamps_are_exact(tmp_path):
    odometry = "time_s,forward_m_s,yaw_rate_rad_s\n1700000000.123456789,0,0\n1.7000000005e9,0,0\n"
    measured = "time_s,bearing_rad\n1700000000.2,0\n"
    log = read(csv(tmp_path, odometry=odometry, measured=measured))
    assert log.odometry_time.tolist() == [1700000000123456789, 1700000000500000000]


def test_csv_order_and_duplicates_are_counted(tmp_path):
    odometry = "time_s,forward_m_s,yaw_rate_rad_s\n1,1,0\n0,2,0\n1,3,0\n"
    measured = "time_s,bearing_rad\n1,0.1\n0,0.2\n1,0.3\n"
    log = read(csv(tmp_path, odometry=odometry, measured=measured))
    assert log.odometry.tolist() == [[2, 0], [3, 0]]
    assert log.bearing.tolist() == [0.2, 0.1, 0.3]
    assert log.skipped == {
        "odometry row out of order (sorted, none lost)": 1,
        "odometry row with the stamp of another (last kept)": 1,
        "measurement out of order (sorted, none lost)": 1,
    }


BAD_ROWS = {
    "text": ("0.6,left,2,7", "'left' is not a number"),
    "NaN": ("0.6,nan,2,7", "nan is not finite"),
    "infinite": ("0.6,0.1,inf,7", "inf is not finite"),
    "short": ("0.6,0.1", "2 columns instead of 4"),
    "long": ("0.6,0.1,2,7,9", "5 columns instead of 4"),
    "half empty": ("0.6,,2,7", "empty cells"),
    "no stamp": (",0.1,2,7", "stamp '' is not a number"),
    "identity": ("0.6,0.1,2,7.5", "identity"),
    "negative identity": ("0.6,0.1,2,-7", "identity"),
    "range": ("0.6,0.1,0,7", "range not above 0"),
    "one bearing": ("0.6,35,2,7", "degrees"),
    "one stamp": ("1700000000000000000,0.1,2,7", "nanoseconds"),
}


@pytest.mark.parametrize(("row", "reason"), BAD_ROWS.values(), ids=BAD_ROWS)
def test_csv_single_bad_row_is_counted(tmp_path, row, reason):
    log = read(csv(tmp_path, measured=MEASURED + row + "\n"))
    ((text, count),) = log.skipped.items()
    assert count == 1
    assert "measured.csv (line 6: " in text
    assert reason in text
    assert len(log.frame) == 3
    assert len(log.frame_time) == 3


@pytest.mark.parametrize(("row", "reason"), BAD_ROWS.values(), ids=BAD_ROWS)
def test_csv_many_bad_rows_are_refused(tmp_path, row, reason):
    refused(csv(tmp_path, measured=MEASURED + (row + "\n") * 2), f"line 6: .*{reason}.*2 .*rows")


@pytest.mark.parametrize(("row", "allowed"), [("0.6,nan,2,7", 5), ("0.6,40,2,7", 1)])
def test_csv_five_percent_may_be_bad_but_not_the_unit(tmp_path, row, allowed):
    good = "".join(f"{i / 100},0.1,2,7\n" for i in range(95))
    header = MEASURED.splitlines()[0] + "\n"
    log = read(csv(tmp_path, measured=header + good + (row + "\n") * allowed))
    assert list(log.skipped.values()) == [allowed]
    refused(csv(tmp_path, measured=header + good + (row + "\n") * (allowed + 1)), "line 97")


def test_csv_covariance_must_be_one(tmp_path):
    measured = "time_s,x_m,y_m,sxx,sxy,syy\n1,2,1,0.1,0,0.2\n1,2,1,0.1,1,0.2\n"
    log = read(csv(tmp_path, measured=measured))
    assert "not positive definite" in next(iter(log.skipped))


CSV_BAD = {
    "empty": ({"odometry": ""}, "odometry.csv: is empty"),
    "header alone": ({"odometry": ODOMETRY.splitlines()[0] + "\n"}, "odometry.csv: no rows"),
    "no header": ({"odometry": "0,0.5,0.1\n1,0.5,0.1\n"}, "line 1: '0,0.5,0.1' is no known header"),
    "unit": ({"measured": MEASURED.replace("bearing_rad", "bearing_deg")}, "no known header"),
    "two alike": ({"measured": ODOMETRY}, "second odometry"),
    "degrees": (
        {"odometry": ODOMETRY.replace("0.1\n", "45\n").replace("0.2\n", "-60\n")},
        "line 2: turn beyond 18.8 rad/s .degrees",
    ),
    "degrees turned": (
        {"odometry": "time_s,distance_m,turn_rad\n1,1,90\n2,1,-90\n"},
        "line 2: turn beyond 6.3 rad .degrees",
    ),
    "nanoseconds": (
        {"odometry": "time_s,forward_m_s,yaw_rate_rad_s\n0,1,0\n500000000,1,0\n"},
        "lines 2 and 3: more than ten years apart.*nanoseconds",
    ),
    "cut": ({"measured": MEASURED + "2.0,0.1,"}, "line 6: the file ends here .3 columns"),
    "binary": ({"measured": "\x00\x93NUMPY" * 50}, "no known header"),
    "landmarks": ({"landmarks": "id,x_m,y_m\n7,1,1\n7,2,2\n"}, "same id"),
    "landmark ids": ({"landmarks": "id,x_m,y_m\n7.5,1,1\n1e99,2,2\n"}, "line 2: id is not a whole"),
    "stamps": ({"odometry": ODOMETRY + "1e999999999,0,0\n" * 2}, "line 5: stamp 1e999999999: "),
}


@pytest.mark.parametrize(("files", "message"), CSV_BAD.values(), ids=CSV_BAD)
def test_csv_refused(tmp_path, files, message):
    refused(csv(tmp_path, **files), message)


def test_what_no_reader_takes(tmp_path):
    paths = csv(tmp_path)
    refused(paths[:1], "no measurements file among them")
    refused(paths[1:], "no odometry file among them")
    refused(paths, "only an MRCLAM folder", robot=1)
    refused(tmp_path, "format not known")
    refused(tmp_path / "absent", "no such file or folder")
    other = tmp_path / "a.bag"
    other.write_bytes(b"#ROSBAG")
    refused(other, "format not known")
    with pytest.raises(ValueError, match="nothing to read"):
        read([])
    paths[0].unlink()
    paths[0].mkdir()
    refused(paths, "no such file")
