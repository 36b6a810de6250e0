"""Frames: odometry integrated exactly between them, measurements in slots."""

import itertools

import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.log import Log
from jaxslam.logs.log_file import load_log
from jaxslam.logs.odometry import dead_reckoning, increments
from jaxslam.parameters import Params, default_params

S = 10**9


def make(odometry_s, odometry, frame_s, frame=(), **changes):
    bearing = np.zeros(len(frame))
    values = {
        "name": "small",
        "odometry_time": stamps(odometry_s),
        "odometry": odometry,
        "frame_time": stamps(frame_s),
        "frame": np.array(frame, int),
        "bearing": bearing,
        "range": bearing + 1,
        "view": (-1.0, 1.0, 5.0),
    }
    return Log(**(values | changes))


def frames(log, sensor, params=None, **settings):
    """Frames of at most three measurements."""
    return frames_from_log(log, Config(sensor=sensor, **dict(measurements=3) | settings), params)


def stamps(seconds):
    return np.round(np.asarray(seconds, float) * S).astype(np.int64)


def euler(log, steps=200):
    """Per frame: displacement, turn, path, turned, first and second moment of the path ahead.

    Small steps between all stamps, one after the other: slow, and written differently.
    """
    time_s, end = log.odometry_time / 1e9, log.frame_time / 1e9
    hold = np.median(np.diff(time_s))
    since, out = log.start / 1e9, []
    for until in end:
        inside = time_s[(time_s > since) & (time_s < until)]
        last = [t for t in [time_s[-1] + hold] if since < t < until]
        cuts = np.concatenate([[since], inside, last, [until]])
        x = y = heading = 0.0
        travels, turns = [], []
        for a, b in itertools.pairwise(cuts):
            row = np.searchsorted(time_s, (a + b) / 2) - 1
            moving = row >= 0 and (a + b) / 2 < time_s[-1] + hold
            v, w = log.odometry[row] if moving else (0.0, 0.0)
            h = (b - a) / steps
            for _ in range(steps):
                x += v * h * np.cos(heading + w * h / 2)
                y += v * h * np.sin(heading + w * h / 2)
                heading += w * h
                travels.append(abs(v) * h)
                turns.append(abs(w) * h)
        travels, turns = np.array(travels), np.array(turns)
        path, turned = travels.sum(), turns.sum()
        ahead = (path - np.cumsum(travels) + travels / 2) / (path or 1)
        mean = (ahead * turns).sum() / (turned or 1)
        square = (ahead**2 * turns).sum() / (turned or 1)
        lever = (mean, square - mean**2) if path and turned else (0.5, 1 / 12)
        out.append((x, y, heading, path, turned, until - since, *lever))
        since = until
    return np.array(out).T


def random_log(seed, rows=40, count=25):
    rng = np.random.default_rng(seed)
    odometry = np.column_stack([rng.normal(0.3, 0.5, rows), rng.normal(0, 1, rows)])
    odometry[rng.random(rows) < 0.2, 0] = 0  # turning on the spot
    odometry[rng.random(rows) < 0.2, 1] = 0  # straight
    odometry[rng.random(rows) < 0.1] = 0
    times = np.cumsum(rng.uniform(0.02, 0.4, rows))
    frame_s = np.sort(rng.uniform(-1, times[-1] + 2, count))
    frame_s[3] = times[10]  # a frame at a stamp of odometry
    return make(times, odometry, np.sort(frame_s))


@pytest.mark.parametrize("seed", range(4))
def test_integration_agrees_with_small_steps(seed):
    log = random_log(seed)
    o = increments(log)
    fine = euler(log)
    for name, have, want in zip(o._fields, o, fine, strict=True):
        tolerance = 1e-5 if name.startswith(("d", "l")) else 1e-12
        np.testing.assert_allclose(have, want, atol=tolerance, err_msg=name)


def test_an_arc_in_closed_form():
    v, w = 0.7, -1.3
    log = make([0, 1, 2], [[v, w]] * 3, [2.0])
    o = increments(log)
    assert o.dx[0] == pytest.approx(v / w * np.sin(2 * w), abs=1e-15)
    assert o.dy[0] == pytest.approx(v / w * (1 - np.cos(2 * w)), abs=1e-15)
    assert (o.dtheta[0], o.distance[0], o.turn[0]) == pytest.approx((2 * w, 2 * v, -2 * w))
    assert (o.lever[0], o.lever_var[0]) == pytest.approx((1 / 2, 1 / 12))


def test_reverse_keeps_path_positive():
    o = increments(make([0, 1], [[-1.0, 0.0]] * 2, [1.0]))
    assert (o.dx[0], o.distance[0], o.dy[0], o.turn[0]) == (-1.0, 1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("rows", "lever", "var"),
    [
        ([[0, 1], [1, 0]], 1.0, 0.0),  # turn, then drive: all of the path is ahead
        ([[1, 0], [0, 1]], 0.0, 0.0),  # drive, then turn
        ([[1, 0], [1, 1]], 0.25, 1 / 48),  # turning along the second half only
        ([[1, 1], [0, 1]], 0.25, 1 / 6 - 1 / 16),  # half along the path, half at its end
        ([[0, 1], [0, 1]], 0.5, 1 / 12),  # no path
        ([[1, 0], [1, 0]], 0.5, 1 / 12),  # no turn
    ],
)
def test_lever_moments(rows, lever, var):
    o = increments(make([0, 1], rows, [2.0]))
    assert (o.lever[0], o.lever_var[0]) == pytest.approx((lever, var))


def test_the_last_velocity_is_held_for_a_usual_period():
    log = make([0, 1, 2, 5, 6], [[1.0, 0.0]] * 5, [2.0, 20.0])
    assert increments(log).distance == pytest.approx([2.0, 5.0])  # until 7 s
    assert increments(log).duration == pytest.approx([2.0, 18.0])


def test_frames_before_the_odometry_stand_still():
    o = increments(make([10, 11], [[1.0, 0.0]] * 2, [4.0, 9.0, 10.5]))
    assert o.dx == pytest.approx([0, 0, 0.5])
    assert o.duration == pytest.approx([0, 5, 1.5])


def test_single_row_of_odometry_has_no_period():
    o = increments(make([0], [[1.0, 1.0]], [1.0]))
    assert not o.dx.any()
    assert o.duration == [1.0]


def test_commands_translate_then_turn():
    rows = [[2.0, 0.5], [1.0, -0.25], [1.0, 1.0]]
    log = make([1, 2, 3], rows, [1.0, 1.5, 3.0], odometry_kind="command")
    o = increments(log)
    assert (o.dx[0], o.dy[0], o.dtheta[0]) == (2.0, 0.0, 0.5)  # alone: exactly the command
    assert (o.lever[0], o.lever_var[0], o.distance[0], o.turn[0]) == (0.0, 0.0, 2.0, 0.5)
    assert (o.dx[1], o.dtheta[1], o.distance[1], o.turn[1]) == (0, 0, 0, 0)
    assert o.dx[2] == pytest.approx(1 + np.cos(-0.25))
    assert o.dy[2] == pytest.approx(np.sin(-0.25))
    assert (o.dtheta[2], o.distance[2], o.turn[2]) == (0.75, 2.0, 1.25)
    # A fifth of the turning with half of the path ahead, the rest at its end.
    assert (o.lever[2], o.lever_var[2]) == pytest.approx((0.1, 0.2 * 0.25 - 0.01))
    assert o.duration == pytest.approx([0, 0.5, 1.5])


def test_command_after_the_last_frame_is_left_out():
    log = make([1, 9], [[1.0, 0.0]] * 2, [2.0], odometry_kind="command")
    assert increments(log).distance == [1.0]


@pytest.mark.parametrize("kind", ["velocity", "command"])
def test_thinned_frames_describe_the_same_motion(kind):
    rng = np.random.default_rng(1)
    time_s = np.arange(2000) * 0.015
    odometry = rng.normal(0, 1, (2000, 2)) * (0.3, 0.5)
    frame_s = np.sort(rng.choice(time_s, 500, replace=False)) + 0.004
    start = (3.0, -2.0, 3.0)
    dense = increments(make(time_s, odometry, frame_s, odometry_kind=kind))
    path = dead_reckoning(dense, start)
    for step in (3, 20, 500):
        few = frame_s[step - 1 :: step]
        o = increments(make(time_s, odometry, few, odometry_kind=kind))
        np.testing.assert_allclose(dead_reckoning(o, start), path[step - 1 :: step], atol=1e-10)
        for name in ("distance", "turn", "duration"):
            sums = getattr(dense, name)[: len(few) * step].reshape(-1, step).sum(1)
            np.testing.assert_allclose(getattr(o, name), sums, rtol=1e-9)


def test_dead_reckoning_of_the_bundled_log():
    log = load_log("lost-in-the-woods")
    o = increments(log)
    poses = dead_reckoning(o, log.start_pose)
    row = np.searchsorted(log.frame_time, log.truth.time)
    apart = np.hypot(*(poses[row, :2] - log.truth.pose[:, :2]).T)
    assert o.distance.sum() == pytest.approx(341.8, abs=0.1)
    assert 4 < apart[-1] < 5
    assert np.abs(poses[:, 2]).max() <= np.pi


def test_an_hour_at_full_rate_keeps_every_row():
    rng = np.random.default_rng(0)
    log = make(
        np.arange(60_000) * 0.015,
        rng.normal(size=(60_000, 2)),
        np.arange(13_000) * 0.07,
        np.repeat(np.arange(13_000), 5),
        identity=np.tile(np.arange(5), 13_000),
    )
    found = frames(log, "bearing", association="known", measurements=5)
    assert np.array_equal(found.row.ravel(), np.arange(65_000))
    assert found.dropped == {}


def five(**changes):
    """Frames with three, no and two measurements."""
    values = {
        "range": [3.0, 1.0, 2.0, 4.0, 5.0],
        "bearing": [0.1, 0.2, 0.3, 0.4, 0.5],
        "identity": [40, 20, 40, -1, 10],
    }
    return make([0, 1], [[1, 0]] * 2, [1.0, 2.0, 3.0], [0, 0, 0, 2, 2], **(values | changes))


def test_measurements_are_padded():
    f = frames(five(), "range_bearing")
    m = f.measurements
    assert m.value.shape == (3, 3, 2)
    assert m.cov.shape == (3, 3, 3)
    assert not m.cov.any()
    assert f.row.tolist() == [[0, 1, 2], [-1, -1, -1], [3, 4, -1]]
    assert m.valid.tolist() == [[True] * 3, [False] * 3, [True, True, False]]
    assert m.value[0].tolist() == [[3.0, 0.1], [1.0, 0.2], [2.0, 0.3]]
    assert not m.value[~m.valid].any()
    assert m.active.all()
    assert (m.identity == -1).all()
    assert len(f.identities) == 0
    assert f.dropped == {}
    assert f.time.tolist() == [S, 2 * S, 3 * S]


def test_known_identities_are_dense_and_unique():
    f = frames(five(), "bearing", association="known", measurements=2)
    assert f.identities.tolist() == [10, 20, 40]
    assert f.measurements.identity.tolist() == [[2, 1], [-1, -1], [0, -1]]
    assert f.row.tolist() == [[0, 1], [-1, -1], [4, -1]]
    assert f.dropped == {"no identity": 1, "duplicate identity": 1}
    assert f.measurements.identity.dtype == np.int32
    assert f.measurements.value[0].tolist() == [[0.1, 0], [0.2, 0]]


def test_the_farthest_find_no_slot():
    f = frames(five(), "range_bearing", measurements=2)
    assert f.row.tolist() == [[1, 2], [-1, -1], [3, 4]]
    assert f.dropped == {"no measurement slot": 1}
    f = frames(five(), "bearing", measurements=2)  # bearings alone: the last
    assert f.row.tolist() == [[0, 1], [-1, -1], [3, 4]]
    f = frames(five(), "bearing", measurements=7)
    assert f.row.shape == (3, 7)
    assert f.dropped == {}


def numbers(**changes):
    return Params(**(dict.fromkeys(Params._fields, 0.0) | changes))


def test_positions_made_of_range_and_bearing():
    params = numbers(sigma_range=0.1, sigma_bearing=0.02, landmark_extent=0.03)
    m = frames(five(), "position", params=params).measurements
    r, b = 2.0, 0.3
    place = m.value[0, 2]
    assert place == pytest.approx((r * np.cos(b), r * np.sin(b)))
    rng = np.random.default_rng(0)
    sd = np.hypot(0.02, 0.03 / r)
    ranges, bearings = r + 0.1 * rng.normal(size=200_000), b + sd * rng.normal(size=200_000)
    cov = np.cov(ranges * np.cos(bearings), ranges * np.sin(bearings))
    assert m.cov[0, 2] == pytest.approx((cov[0, 0], cov[0, 1], cov[1, 1]), rel=0.02)


def test_noise_of_made_positions_is_the_declared_one():
    declared = frames(
        five(noise={"sigma_range": 0.4, "landmark_extent": 0.0}), "position"
    ).measurements
    given = numbers(sigma_range=0.4, sigma_bearing=default_params("position").sigma_bearing)
    same = frames(five(), "position", params=given).measurements
    assert declared.cov == pytest.approx(same.cov)


def test_positions_of_the_log_itself_come_first():
    points, covs = np.arange(10.0).reshape(5, 2) + 1, [[1, 0.5, 2]] * 5
    f = frames(five(point=points, point_cov=covs), "position", measurements=2)
    assert f.measurements.value[0].tolist() == [[1, 2], [3, 4]]  # the nearest two
    assert f.measurements.cov[2, 1].tolist() == [1, 0.5, 2]


def test_bearings_without_a_point_are_no_positions_and_nothing_lost():
    nan = np.nan
    points, covs = np.arange(10.0).reshape(5, 2) + 1, np.tile([1, 0.5, 2], (5, 1))
    points[[1, 3]], covs[[1, 3]] = nan, nan
    log = five(point=points, point_cov=covs, point_baseline=[0.2, nan, nan, nan, 0.3])
    f = frames(log, "position")
    assert f.row[f.row >= 0].tolist() == [0, 2, 4]
    assert np.isfinite(f.measurements.value).all()
    assert np.isfinite(f.measurements.cov).all()
    assert f.measurements.scale[f.row >= 0].tolist() == [1, 0, 1]
    assert not f.measurements.scale[f.row < 0].any()
    assert f.dropped == {}
    assert frames(log, "bearing").measurements.scale is None
    known = frames(log, "position", association="known")
    identified = [row for row in (0, 2, 4) if log.identity[row] >= 0]
    assert known.dropped.get("no identity", 0) == 3 - len(identified)


def test_where_no_row_has_a_point_positions_are_made_of_ranges():
    gaps = {"point": np.full((5, 2), np.nan), "point_cov": np.full((5, 3), np.nan)}
    made = frames(five(**gaps), "position").measurements
    assert made.value == pytest.approx(frames(five(), "position").measurements.value)


def test_no_measurements_at_all():
    f = frames(make([0, 1], [[1, 0]] * 2, [1.0, 2.0]), "range_bearing", measurements=1)
    assert f.row.tolist() == [[-1], [-1]]
    assert f.measurements.value.shape == (2, 1, 2)
    log = make([0, 1], [[1, 0]] * 2, [1.0], identity=np.empty(0, int))
    assert frames(log, "bearing", association="known").identities.tolist() == []


def test_wrong_requests_say_what_the_log_has():
    log = five(range=None, identity=None)
    with pytest.raises(ValueError, match="'range_bearing' is not in this log; it has bearing"):
        frames(log, "range_bearing")
    with pytest.raises(ValueError, match="'sonar'"):
        frames(log, "sonar")
    for identity in (None, [-1] * 5):
        with pytest.raises(ValueError, match="needs identities"):
            frames(five(identity=identity), "bearing", association="known")
