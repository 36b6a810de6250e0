"""The log: validation, and its file."""

import dataclasses

import numpy as np
import pytest

from jaxslam.logs.log import FloorPlan, Log, Truth
from jaxslam.logs.log_file import load_log, save_log

S = 10**9
GAP = [np.nan] * 3


def make(**changes):
    """Three frames, the middle one empty, and three measurements."""
    values = {
        "name": "small",
        "odometry_time": np.arange(5) * S,
        "odometry": np.column_stack([np.ones(5), np.zeros(5)]),
        "frame_time": np.array([1, 2, 3]) * S,
        "frame": [0, 0, 2],
        "bearing": [0.1, -0.2, 0.3],
        "range": [1.0, 2.0, 3.0],
        "identity": [7, 9, -1],
        "view": (-1.0, 1.0, 5.0),
    }
    return Log(**(values | changes))


def full():
    truth = Truth([0, S], [[0, 0, 0], [1, 0, 0.5]], [[1, 2]], [7], [7, -1, 7], 0.3)
    plan = FloorPlan([[0, 0, 1, 0]], np.arange(6, dtype=np.uint8).reshape(2, 3), 0.05, (-1.0, 2.0))
    return make(
        point=[[1, 2], GAP[:2], [5, 6]],
        point_cov=[[1, 0.1, 1], GAP, [1, 0.1, 1]],
        point_baseline=[0.4, np.nan, np.nan],
        bearing_sigma=[0.002, 0.003, 0.1],
        descriptor=np.ones((3, 4), np.float32),
        mounting=(0.2, 0.0, 0.1),
        time_offset=-0.05,
        noise={"sigma_bearing": 0.02},
        start_pose=(1, 2, 3),
        start_cov=np.diag([0.1, 0.2, 0.3]),
        truth=truth,
        plan=plan,
        skipped={"bad row in a/b.csv (line 3: '' is not a number)": 4},
    )


def assert_same(a, b):
    for item in dataclasses.fields(a):
        left, right = getattr(a, item.name), getattr(b, item.name)
        if dataclasses.is_dataclass(left):
            assert_same(left, right)
        elif isinstance(left, np.ndarray):
            assert left.dtype == right.dtype, item.name
            assert np.array_equal(left, right, equal_nan=left.dtype.kind == "f"), item.name
        else:
            assert left == right, item.name


@pytest.mark.parametrize("log", [make(), full()], ids=["least", "everything"])
def test_file_keeps_everything(log, tmp_path):
    path = tmp_path / "a.npz"
    save_log(path, log)
    assert_same(log, load_log(path))
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]
    first = path.read_bytes()
    save_log(path, log)
    assert path.read_bytes() == first  # the same log makes the same bytes


def test_plain_numpy_writes_a_log(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(
        path,
        **{
            "schema": 1,
            "name": "theirs",
            "odometry_time": [0, S],
            "odometry": [[1.0, 0.0], [1.0, 0.1]],
            "frame_time": [S],
            "frame": [0],
            "bearing": [0.5],
            "view": [-1.0, 1.0, 5.0],
            "truth/landmarks": [[1.0, 2.0]],
        },
    )
    log = load_log(path)
    assert (log.name, log.bearing.tolist(), log.has("bearing")) == ("theirs", [0.5], True)
    assert log.truth.landmarks.tolist() == [[1.0, 2.0]]
    assert log.truth.pose is None
    assert not log.has("range_bearing")
    assert not log.has("position")


def test_a_log_whose_lines_have_no_point_supplies_no_position():
    gaps = {"point": [GAP[:2]] * 3, "point_cov": [GAP] * 3, "point_baseline": GAP}
    assert not make(range=None, **gaps).has("position")
    assert make(**gaps).has("position")  # by range and bearing
    assert full().has("position")


def test_arrays_are_read_only_copies():
    given = np.array([0.1, -0.2, 0.3])
    log = make(bearing=given)
    given[0] = 9
    assert log.bearing[0] == 0.1
    with pytest.raises(ValueError, match="read-only"):
        log.bearing[0] = 1


def test_bundled_log():
    log = load_log("lost-in-the-woods")
    assert (len(log.frame_time), len(log.frame), len(log.truth.landmarks)) == (12609, 61086, 17)
    assert log.mounting == pytest.approx((0.219016, 0, 0), abs=1e-6)
    assert log.frame_time[-1] == 1260.8 * S
    assert log.view == pytest.approx((-2.0944, 2.0944, 6), abs=1e-4)
    assert np.array_equal(np.unique(log.identity), np.arange(17))
    assert log.start_pose == pytest.approx(log.truth.pose[0])
    assert log.noise == {}
    assert not log.start_cov.any()
    # The measurements fit the truth: bearings of all landmarks to 1.5 degrees, ranges to 3.3 cm.
    row = np.searchsorted(log.truth.time, log.frame_time[log.frame])
    row = np.minimum(row, len(log.truth.time) - 1)
    valid = log.truth.time[row] == log.frame_time[log.frame]
    x, y, heading = log.truth.pose[row].T
    ahead = log.mounting[0] * np.array([np.cos(heading), np.sin(heading)])
    dx, dy = log.truth.landmarks[log.identity].T - ahead - [x, y]
    error = (log.bearing - np.arctan2(dy, dx) + heading + np.pi) % (2 * np.pi) - np.pi
    assert np.std(error[valid]) == pytest.approx(np.radians(1.46), rel=0.01)
    assert np.std((log.range - np.hypot(dx, dy))[valid]) == pytest.approx(0.033, abs=0.001)


BAD = {
    "name": ({"name": "two\nlines"}, "name"),
    "kind": ({"odometry_kind": "pose"}, "odometry_kind: 'pose'"),
    "no odometry": ({"odometry_time": [], "odometry": np.empty((0, 2))}, "no odometry"),
    "odometry shape": ({"odometry": np.ones((5, 3))}, r"odometry: shape \(5, 3\); must be 5 x 2"),
    "odometry NaN": ({"odometry": [[0, 0]] * 4 + [[np.nan, 0]]}, "odometry, row 4: .*finite"),
    "odometry text": ({"odometry": [["a", "b"]] * 5}, "odometry: is not an array of numbers"),
    "ragged": ({"odometry": [[1, 2], [1]]}, "odometry"),
    "duplicate": ({"odometry_time": [0, 1, 1, 2, 3]}, "odometry_time, row 2"),
    "reversed": ({"odometry_time": [4, 3, 2, 1, 0]}, "odometry_time, row 1"),
    "float stamps": ({"frame_time": [1.0, 2.0, 3.0]}, "frame_time: float64 is not int64"),
    "huge stamps": ({"frame_time": [1, 2, 2**63 - 1]}, "frame_time, row 2"),
    "unsigned": ({"frame_time": np.array([1, 2, 2**64 - 1], np.uint64)}, "do not fit"),
    "huge int": ({"frame_time": [1, 2, 2**70]}, "frame_time"),
    "no frames": ({"frame_time": np.empty(0, int)}, "no frames"),
    "frame times": ({"frame_time": [3, 3, 4]}, "frame_time, row 1"),
    "frame range": ({"frame": [0, 0, 3]}, r"frame, row 2: 3 must be in 0..2"),
    "frame order": ({"frame": [0, 2, 0]}, "frame, row 2"),
    "degrees": ({"bearing": [0.1, 35.0, 0.2]}, "bearing, row 1: 35.0 .*degrees"),
    "length": ({"bearing": [0.1, 0.2]}, "bearing: shape"),
    "nothing": ({"bearing": None, "range": None}, "neither bearings nor points"),
    "range alone": (
        {"bearing": None, "point": [[1, 1]] * 3, "point_cov": [[1, 0, 1]] * 3},
        "range: given without bearing",
    ),
    "range zero": ({"range": [1.0, 0.0, 1.0]}, "range, row 1: 0.0 must be above 0"),
    "point alone": ({"point": [[1, 1]] * 3}, "point: given without point_cov"),
    "cov": (
        {"point": [[1, 1]] * 3, "point_cov": [[1, 2, 1]] * 3},
        "point_cov, row 0: .* positive definite",
    ),
    "half a point": (
        {"point": [[1, np.nan]] + [[1, 1]] * 2, "point_cov": [[1, 0, 1]] * 3},
        "point, row 0: .* must be finite, or nothing but NaN",
    ),
    "point without cov": (
        {"point": [[1, 1]] * 3, "point_cov": [[1, 0, 1]] * 2 + [GAP]},
        "point, row 2: .* must both be given",
    ),
    "nothing in a row": (
        {"bearing": None, "range": None}
        | {"point": [[1, 1]] * 2 + [GAP[:2]], "point_cov": [[1, 0, 1]] * 2 + [GAP]},
        "point, row 2: .* no bearing either",
    ),
    "baseline": (
        {"point": [[1, 1]] * 3, "point_cov": [[1, 0, 1]] * 3, "point_baseline": [1.0, 0.0, 1.0]},
        "point_baseline, row 1: 0.0 must be above 0 m",
    ),
    "baseline of nothing": (
        {"point": [[1, 1]] * 2 + [GAP[:2]], "point_cov": [[1, 0, 1]] * 2 + [GAP]}
        | {"point_baseline": [1.0, 1.0, 1.0]},
        "point_baseline, row 2: .* NaN without a point",
    ),
    "baseline alone": ({"point_baseline": [1.0] * 3}, "point_baseline: given without point"),
    "sigma": ({"bearing_sigma": [0.1, 0.0, 0.1]}, "bearing_sigma, row 1: 0.0 must be above 0 rad"),
    "sigma NaN": (
        {"bearing_sigma": [0.1, np.nan, 0.1]},
        "bearing_sigma, row 1: nan must be finite",
    ),
    "identity": ({"identity": [1, 2, -2]}, "identity, row 2"),
    "descriptor": ({"descriptor": np.ones(3)}, "descriptor: shape"),
    "view": ({"view": (1.0, -1.0, 5.0)}, "view"),
    "view beyond": ({"view": (2.0, 4.0, 5.0)}, "view"),
    "view range": ({"view": (-1.0, 1.0, np.inf)}, "view"),
    "mounting": ({"mounting": (0, 0)}, "mounting"),
    "offset": ({"time_offset": np.nan}, "time_offset"),
    "noise name": ({"noise": {"sigma": 1.0}}, "noise/sigma: no such parameter"),
    "noise value": ({"noise": {"sigma_range": "1"}}, "noise/sigma_range"),
    "start": ({"start_pose": (0, 0)}, "start_pose"),
    "asymmetric": ({"start_cov": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, "start_cov"),
    "negative": ({"start_cov": np.diag([1, -1, 1])}, "start_cov"),
    "truth length": ({"truth": Truth(identity=[1, 2])}, "truth.identity: shape"),
    "skipped": ({"skipped": {"x": -1}}, "skipped/x"),
}


@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD)
def test_bad_field_is_named(changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        make(**changes)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"time": [0, 1]}, "together"),
        ({"time": [1, 1], "pose": np.zeros((2, 3))}, "truth.time, row 1"),
        ({"time": [0], "pose": [[0, 0, np.nan]]}, "truth.pose, row 0"),
        ({"landmarks": [[0, 0], [1, 1]], "landmark_id": [3, 3]}, "same id"),
        ({"landmark_id": [3]}, "landmark_id"),
        ({"resolution": -1.0}, "resolution"),
    ],
)
def test_bad_truth_is_named(values, message):
    with pytest.raises(ValueError, match=message):
        Truth(**values)


@pytest.mark.parametrize(
    "values", [{}, {"segments": [[1, 2, 3]]}, {"segments": [[0, 0, 1, 1]], "scale": 0.0}]
)
def test_bad_plan_is_refused(values):
    with pytest.raises(ValueError, match="plan"):
        FloorPlan(**values)


@pytest.mark.parametrize(
    ("failure", "expected"),
    [
        (OSError(28, "No space left on device"), OSError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch, failure, expected):
    path = tmp_path / "a.npz"
    save_log(path, make())
    old = path.read_bytes()
    write, calls = np.lib.format.write_array, []

    def failing(file, array, **options):
        calls.append(1)
        if len(calls) > 5:
            raise failure
        write(file, array, **options)

    monkeypatch.setattr(np.lib.format, "write_array", failing)
    with pytest.raises(expected):
        save_log(path, full())
    assert path.read_bytes() == old
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


def test_places_that_cannot_be_written(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere.*cannot write"):
        save_log(tmp_path / "nowhere" / "a.npz", make())
    with pytest.raises(ValueError, match=r"name it a\.log\.npz"):
        save_log(tmp_path / "a.log", make())
    assert list(tmp_path.iterdir()) == []
    folder = tmp_path / "b.npz"
    folder.mkdir()
    with pytest.raises(ValueError, match="cannot write"):
        save_log(folder, make())
    assert list(tmp_path.iterdir()) == [folder]


def test_has_names_what_can_be_supplied():
    assert all(make().has(sensor) for sensor in ("position", "range_bearing", "bearing"))
    points = make(bearing=None, range=None, point=[[1, 1]] * 3, point_cov=[[1, 0, 1]] * 3)
    assert points.has("position")
    assert not points.has("bearing")
    assert not points.has("range_bearing")
    assert not points.has("sonar")


def test_start_is_the_first_stamp():
    assert make().start == 0
    assert make(frame_time=np.array([-2, 2, 3]) * S).start == -2 * S
