"""`check`: a good log passes, and each thing that looks wrong is said."""

import subprocess
import sys

import numpy as np
import pytest

from jaxslam.logs.diagnostics import check, status
from jaxslam.logs.log import Log, Truth
from jaxslam.logs.log_file import load_log

S = 10**9


def make(**changes):
    """Ten seconds at 1 m/s along x, a frame a second, truth beside it."""
    time = np.arange(101) * S // 10
    values = {
        "name": "small",
        "odometry_time": time,
        "odometry": np.tile([1.0, 0.0], (101, 1)),
        "frame_time": np.arange(1, 11) * S,
        "frame": np.repeat(np.arange(10), 2),
        "bearing": np.tile([0.1, -0.2], 10),
        "range": np.full(20, 2.0),
        "identity": np.tile([3, 4], 10),
        "view": (-1.0, 1.0, 5.0),
        "truth": Truth(time, np.column_stack([time / 1e9, np.zeros((101, 2))])),
    }
    return Log(**(values | changes))


def texts(log, severity):
    return [finding.text for finding in check(log) if finding.severity == severity]


def test_good_logs_pass():
    for log in (make(), load_log("lost-in-the-woods")):
        findings = check(log)
        assert status(findings) == 0, findings
        assert all(finding.text and "\n" not in finding.text for finding in findings)


def test_counts_and_rates_are_right():
    said = " | ".join(texts(make(), "ok"))
    for part in (
        "10 frames over 9.0 s (1.0 Hz)",
        "20 measurements (2.0 per frame, at most 2; 0.0 % of frames empty)",
        "101 odometry rows over 10.0 s (10.0 Hz)",
        "largest speed 1.00 m/s",
        "2 measured identities",
        "path 10.0 m by odometry, 10.0 m in truth",
        "start pose is 0.00 m from the truth",
        "101 true poses; 100 % of frames",
    ):
        assert part in said


def test_points_are_counted():
    point = np.tile([2.0, 0.1], (20, 1))
    cov, base = np.tile([0.1, 0.0, 0.1], (20, 1)), np.full(20, 0.4)
    point[5:], cov[5:], base[5:] = np.nan, np.nan, np.nan
    log = make(range=None, point=point, point_cov=cov, point_baseline=base)
    said = " | ".join(texts(log, "ok"))
    assert "5 of 20 measurements have a point, over 0.40 m of odometry in the median" in said
    assert "ranges 2.00..2.00 m" in said
    point[:], cov[:] = np.nan, np.nan
    log = make(point=point, point_cov=cov)
    assert "0 of 20 measurements have a point" in texts(log, "warning")


def gap():
    time = np.arange(101) * S // 10
    time[50:] += 3 * S
    return {"odometry_time": time, "truth": None}


def fast(column, value):
    odometry = np.tile([1.0, 0.0], (101, 1))
    odometry[7, column] = value
    return {"odometry": odometry}


ramp = np.arange(101.0)
WARNINGS = {
    "speed": (fast(0, 6.0), "largest speed 6.00 m/s, above 5: millimetres"),
    "yaw rate": (fast(1, -12.0), "largest yaw rate 12.00 rad/s, above 10: degrees"),
    "stands": ({"odometry": np.zeros((101, 2)), "truth": None}, "never moved"),
    "gap": (gap(), "odometry: usual step 0.100 s, longest gap 3.100 s at 4.9 s"),
    "long blind": ({"frame_time": np.append(np.arange(1, 10), 99) * S}, "longest gap 90.000 s"),
    "late": ({"frame_time": np.arange(5, 15) * S}, "0 frames before the first odometry, 3 well"),
    "early": ({"frame_time": np.arange(-3, 7) * S, "truth": None}, "3 frames before the first"),
    "lost": ({"skipped": {"bad row in x.csv": 3}}, "3 rows: bad row in x.csv"),
    "range": ({"range": np.full(20, 2500.0)}, "above 1000 m: millimetres"),
    "view": ({"bearing": np.tile([0.1, -2.0], 10)}, "50.0 % of measurements are outside"),
    "reach": ({"view": (-1.0, 1.0, 1.5)}, "100.0 % of measurements are outside"),
    "twice": ({"identity": np.full(20, 3)}, "10 measurements repeat an identity"),
    "start": ({"start_pose": (1.0, 0, 0)}, "start pose is 1.00 m from the truth"),
    "truth elsewhere": ({"truth": Truth([99 * S], [[0, 0, 0]])}, "0 % of frames in their time"),
    "paths": (
        {"truth": Truth(make().odometry_time, np.column_stack([ramp / 4, ramp * 0, ramp * 0]))},
        "path 10.0 m by odometry, 25.0 m in truth",
    ),
}


@pytest.mark.parametrize(("changes", "text"), WARNINGS.values(), ids=WARNINGS)
def test_warnings(changes, text):
    log = make(**changes)
    assert any(text in warning for warning in texts(log, "warning")), check(log)
    assert status(check(log)) == 1


def commands(**changes):
    """Ten commands of 1 m, a truth reading per stop."""
    stops = np.arange(1, 11) * S
    pose = np.column_stack([np.arange(1.0, 11), np.zeros((10, 2))])
    values = {
        "odometry_time": stops,
        "odometry": np.tile([1.0, 0.0], (10, 1)),
        "odometry_kind": "command",
        "truth": Truth(stops, pose, resolution=0.1),
    }
    return make(**(values | changes))


def test_commands():
    log = commands()
    assert status(check(log)) == 0, check(log)
    assert "path 9.0 m by odometry, 9.0 m in truth" in texts(log, "ok")
    log = commands(odometry=np.tile([1.0, 45.0], (10, 1)))
    assert "largest turn 45.00 rad, above 1000 or 2 pi" in texts(log, "warning")[0]


ERRORS = {
    "nothing seen": (
        {"frame": [], "bearing": [], "range": [], "identity": None},
        "0 measurements",
    ),
    "two clocks": (
        {"frame_time": 10**18 + np.arange(10) * S, "truth": None},
        "do not overlap in time",
    ),
    "seconds as ns": (
        {"odometry_time": np.arange(101), "frame_time": np.arange(1, 11), "truth": None},
        "are the stamps seconds, not nanoseconds",
    ),
    "too long": (
        {
            "odometry_time": np.arange(101) * S * 10**6,
            "frame_time": np.arange(10) * S * 10**7,
            "truth": None,
        },
        "stamps are int64 nanoseconds",
    ),
    "millimetres": (
        {"odometry": np.tile([1000.0, 0.0], (101, 1))},
        "one of them is not in metres",
    ),
}


@pytest.mark.parametrize(("changes", "text"), ERRORS.values(), ids=ERRORS)
def test_errors(changes, text):
    log = make(**changes)
    assert any(text in error for error in texts(log, "error")), check(log)
    assert status(check(log)) == 2


def test_truth_that_begins_after_the_start_allows_for_the_way():
    time = np.arange(5, 101) * S // 10
    truth = Truth(time, np.column_stack([time / 1e9, np.zeros((96, 2))]))
    assert status(check(make(truth=truth))) == 0
    assert status(check(make(truth=truth, start_pose=(0, -2, 0)))) == 1


def test_rows_left_out_by_design_are_no_warning():
    log = make(skipped={"not used: measurement of another robot": 9})
    assert status(check(log)) == 0
    assert "9 rows: not used: measurement of another robot" in texts(log, "ok")


def test_absurd_truth_is_checked_quickly():
    truth = Truth([0, 2**61], [[0, 0, 0], [1, 0, 0]])
    assert status(check(make(truth=truth))) in (0, 1)


def test_checking_and_reading_need_no_jax():
    code = (
        "import sys, jaxslam.logs.diagnostics, jaxslam.logs.log_file, jaxslam.logs.readers;"
        "jaxslam.logs.diagnostics.check(jaxslam.logs.log_file.load_log('lost-in-the-woods'));"
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
