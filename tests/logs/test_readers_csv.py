"""The reader of CSV files, on good ones and on broken ones; and what no reader takes."""

import numpy as np
import pytest
from refusal import refused

from jaxslam.logs.log_file import load_log, save_log
from jaxslam.logs.readers import read
from jaxslam.logs.readers.csv_files import read_csv

S = 10**9


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


def test_csv_looks_become_descriptors(tmp_path):
    measured = (
        "time_s,bearing_rad,identity,look_red,look_top\n"
        "0.5,0.1,7,0.25,-3\n0.75,,,,\n1.0,0.2,,0.5,4\n"
    )
    log = read(csv(tmp_path, measured=measured))
    assert log.descriptor.tolist() == [[0.25, -3], [0.5, 4]]
    assert log.identity.tolist() == [7, -1]
    assert log.frame.tolist() == [0, 2]
    assert read(csv(tmp_path)).descriptor is None


@pytest.mark.parametrize(
    "header",
    [
        "time_s,look_red,bearing_rad",  # before what was measured
        "time_s,bearing_rad,look_red,identity",
        "time_s,bearing_rad,look_red,look_red",
        "time_s,x_m,y_m,theta_rad,look_red",  # of the truth
    ],
)
def test_csv_looks_anywhere_else_are_refused(tmp_path, header):
    row = ",".join("1" for _ in header.split(","))
    with pytest.raises(ValueError, match=r"line 1: .* is no known header; .*look_NAME columns"):
        read(csv(tmp_path, measured=f"{header}\n{row}\n"))


def test_csv_looks_too_large_are_bad_rows(tmp_path):
    rows = "".join(f"{t / 100},0.1,{t}\n" for t in range(1, 60))
    log = read(csv(tmp_path, measured=f"time_s,bearing_rad,look_red\n{rows}0.9,0.1,1e300\n"))
    assert len(log.frame) == 59
    assert log.skipped == {"bad row in measured.csv (line 61: a number too large)": 1}


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
