"""Triangulation: geometry, error propagation, refusals; and points for a whole log."""

from dataclasses import replace

import numpy as np
import pytest

from jaxslam.logs.log import Log, Truth
from jaxslam.logs.log_file import load_log, save_log
from jaxslam.logs.odometry import Odometry, increments, moments
from jaxslam.logs.slicing import select_frames
from jaxslam.models import motion
from jaxslam.parameters import default_params
from jaxslam.simulation import planar
from jaxslam.vision.log_triangulation import PointSettings, triangulate_log
from jaxslam.vision.triangulation import (
    BEHIND,
    FAR,
    NEAR,
    OK,
    PARALLEL,
    STILL,
    TriangulationSettings,
    compose,
    sensor_motion,
    triangulate,
)

STEP = np.array([0.4, 0.05, 0.2])
STEP_COV = np.array([[4e-5, 1e-6, 2e-6], [1e-6, 5e-5, 4e-5], [2e-6, 4e-5, 1.5e-4]])
SIGMA = 1e-3
WIDE = TriangulationSettings(parallax=0.0, farthest=1e3)


def seen_from(point, pose):
    """Points [m, 2] of one frame in another, whose poses [3] or [m, 3] are given in the first."""
    x, y, turn = np.asarray(pose).T
    dx, dy = point[:, 0] - x, point[:, 1] - y
    return np.column_stack(
        [np.cos(turn) * dx + np.sin(turn) * dy, np.cos(turn) * dy - np.sin(turn) * dx]
    )


def bearings(point):
    return np.arctan2(point[:, 1], point[:, 0])


def ring(count, seed=0, near=0.6, far=6.0):
    rng = np.random.default_rng(seed)
    angle, r = rng.uniform(-np.pi, np.pi, count), rng.uniform(near, far, count)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle)])


def pair(point, pose):
    return np.column_stack([bearings(point), bearings(seen_from(point, pose))])


def square(error, cov):
    """Mahalanobis squares [m] of errors [m, 2] under (xx, xy, yy)."""
    xx, xy, yy = cov.T
    x, y = error.T
    return (x * x * yy - 2 * x * y * xy + y * y * xx) / (xx * yy - xy * xy)


def test_exact_bearings_give_the_point():
    points = ring(200)
    found = triangulate(pair(points, STEP), SIGMA, STEP, STEP_COV, WIDE)
    assert found.ok.all()
    np.testing.assert_allclose(found.point, seen_from(points, STEP), atol=1e-9)


def test_covariance_is_that_of_finite_differences():
    points = ring(30, seed=2)
    b = pair(points, STEP)
    found = triangulate(b, SIGMA, STEP, STEP_COV, WIDE)
    inputs = np.column_stack([b, np.tile(STEP, (len(b), 1))])

    def point_of(values):
        return triangulate(values[:, :2], SIGMA, values[:, 2:], STEP_COV, WIDE).point

    h = 1e-7
    jacobian = np.stack(
        [(point_of(inputs + h * e) - point_of(inputs - h * e)) / (2 * h) for e in np.eye(5)], -1
    )
    noise = np.zeros((5, 5))
    noise[:2, :2], noise[2:, 2:] = SIGMA**2 * np.eye(2), STEP_COV
    cov = jacobian @ noise @ jacobian.transpose(0, 2, 1)
    np.testing.assert_allclose(found.cov, cov[:, [0, 0, 1], [0, 1, 1]], rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(found.by_bias, jacobian[..., 0] + jacobian[..., 1], rtol=1e-4,
                               atol=1e-5)  # fmt: skip


@pytest.mark.parametrize("sigma", [5e-4, 3e-3])
def test_true_points_lie_in_their_ellipses(sigma):
    """Drawn noise on bearings and motion, ranges all over: the share within 95 % ellipses."""
    count = 20_000
    rng = np.random.default_rng(5)
    points = ring(count, seed=3)
    true = STEP + rng.multivariate_normal(np.zeros(3), STEP_COV, count)
    here = seen_from(points, true)
    b = np.column_stack([bearings(points), bearings(here)])
    b += sigma * rng.standard_normal(b.shape)
    found = triangulate(b, sigma, STEP, STEP_COV)
    ok = found.ok
    inside = square((found.point - here)[ok], found.cov[ok]) < 5.991
    assert 0.6 < ok.mean() < 0.99
    assert 0.90 < inside.mean() < 0.965
    relative = np.sum((found.point - here) * here, 1)[ok] / np.sum(here**2, 1)[ok]
    assert abs(relative.mean()) < 0.03  # a range is skew, and the far ones are refused
    # Without the motion's share the ellipses would be far too small.
    alone = triangulate(b, sigma, STEP, 1e-12 * np.eye(3), WIDE)
    assert (square((found.point - here)[ok], alone.cov[ok]) < 5.991).mean() < 0.8


def test_a_common_bias_mostly_turns_the_point_and_is_not_in_the_covariance():
    points, bias = ring(100, seed=7), 2e-3
    b = pair(points, STEP)
    plain, off = (triangulate(x, SIGMA, STEP, STEP_COV, WIDE) for x in (b, b + bias))
    np.testing.assert_allclose(off.point - plain.point, bias * plain.by_bias, atol=2e-3)
    once = triangulate(b + [bias, 0.0], SIGMA, STEP, STEP_COV, WIDE)
    apart = [np.abs(np.hypot(*p.point.T) - np.hypot(*plain.point.T)) for p in (off, once)]
    assert np.median(apart[0]) < 0.3 * np.median(apart[1])  # in range it mostly cancels


def test_refusals_say_why():
    def reason(point, motion=(0.4, 0.0, 0.0), **settings):
        p = np.atleast_2d(point).astype(float)
        b = pair(p, np.asarray(motion))
        return triangulate(b, SIGMA, motion, STEP_COV, TriangulationSettings(**settings)).reason[0]

    assert reason((1.0, 2.0)) == OK
    assert reason((1.0, 2.0), motion=(0.0, 0.0, 0.5)) == STILL
    assert reason((100.0, 300.0)) == PARALLEL
    assert reason((3.0, 0.001)) == PARALLEL  # straight ahead
    assert reason((0.4, 0.1)) == NEAR
    assert reason((1.0, 8.0), farthest=5.0, parallax=1.0) == FAR
    b = np.array([[1.0, 0.9]])  # the rays part
    assert triangulate(b, SIGMA, (0.4, 0, 0), STEP_COV).reason[0] == BEHIND
    refused = triangulate(b, SIGMA, (0.4, 0, 0), STEP_COV)
    assert np.isnan(refused.point).all() and np.isnan(refused.cov).all()
    assert len(triangulate(np.empty((0, 2)), SIGMA, STEP, STEP_COV).point) == 0


def test_the_moments_are_those_of_the_motion_model():
    rows = [(0.4, 0.05, 0.3, 0.42, 0.35, 1.0, 0.4, 0.05), (0, 0, 0.5, 0, 0.5, 1.0, 0.5, 1 / 12)]
    odometry = Odometry(*np.array(rows).T)
    params = default_params()._replace(gain_rot=0.9, bias_drift=0.02, gain_tran=1.3)
    mean, cov = moments(odometry, params)
    rng = np.random.default_rng(0)
    for i, row in enumerate(rows):
        # `moments` leaves the gain on the distance out.
        one = params._replace(gain_tran=1.0)
        normals = rng.standard_normal((3, 200_000))
        drawn = np.array(motion.sample((0.0, 0.0, 0.0), Odometry(*row), one, normals))
        np.testing.assert_allclose(drawn.mean(1), mean[i], atol=1e-3)
        np.testing.assert_allclose(np.cov(drawn), cov[i], atol=0.02 * np.abs(cov[i]).max())


def test_motions_compose_and_move_to_the_sensor_with_their_errors():
    rng = np.random.default_rng(1)
    mounting, count = (0.3, -0.1, 0.4), 200_000
    first = rng.multivariate_normal(STEP, STEP_COV, count)
    second = rng.multivariate_normal(-STEP, STEP_COV, count)
    mean, cov = compose(STEP[None], STEP_COV[None], -STEP, STEP_COV)
    drawn = compose(first, np.zeros((count, 3, 3)), -STEP, STEP_COV)[0]
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    x, y, turn = second.T
    drawn = first + np.column_stack([c * x - s * y, s * x + c * y, turn])
    np.testing.assert_allclose(drawn.mean(0), mean[0], atol=1e-3)
    np.testing.assert_allclose(np.cov(drawn.T), cov[0], atol=0.02 * cov[0].max())
    seen, seen_cov = sensor_motion(STEP[None], STEP_COV[None], mounting)
    drawn = sensor_motion(first, np.zeros((count, 3, 3)), mounting)[0]
    np.testing.assert_allclose(np.cov(drawn.T), seen_cov[0], atol=0.02 * seen_cov[0].max())
    # A point fixed on the ground, by way of both frames.
    point = np.array([[2.0, 1.0]])
    there = seen_from(seen_from(point, STEP), mounting)
    np.testing.assert_allclose(seen_from(seen_from(point, mounting), seen[0]), there, atol=1e-12)


def drive(**changes):
    """Stop and go round a room, sharp bearings, every mark in view."""
    values = {"commands": True, "stop_m": 0.2, "length_m": 20.0, "sigma_bearing": 1e-3, "seed": 4}
    values |= {"err_tran": 0.005, "err_rot": 0.01, "err_drift": 0.01, "outlier": 0.0}
    values |= {"view": (-np.pi, np.pi, 12.0), "max_per_frame": None, "landmarks": 20}
    log = planar.planar(**(values | changes))
    return replace(log, range=None)


def errors(log):
    """Errors of the points in the robot's frame [n, 2], NaN where there is none."""
    pose, mark = log.truth.pose[log.frame], log.truth.landmarks[log.truth.identity]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    dx, dy = (mark - pose[:, :2]).T
    return log.point - np.column_stack([c * dx + s * dy, c * dy - s * dx]) + [log.mounting[0], 0]


def test_points_of_a_log_lie_in_their_ellipses():
    log = drive(mounting=(0.2, 0.0, 0.0))
    for known in (True, False):
        found = triangulate_log(log, use_identity=known)
        e = errors(found)
        given = np.isfinite(e[:, 0])
        assert given.sum() > 300
        assert np.median(np.hypot(*e[given].T)) < 0.14
        inside = square(e[given], found.point_cov[given]) < 5.991
        assert (0.88 if known else 0.82) < inside.mean() < 0.99
        counts = {k: v for k, v in found.skipped.items() if "without a point" in k}
        assert sum(counts.values()) == (~given).sum()
        assert all(k.startswith("not used: ") for k in counts)
    assert np.nanmin(found.point_baseline) >= 0.4 - 1e-9
    assert found.has("position")


def test_a_log_with_points_is_kept_by_its_file(tmp_path):
    found = triangulate_log(drive(length_m=6.0))
    save_log(tmp_path / "a.npz", found)
    again = load_log(tmp_path / "a.npz")
    np.testing.assert_array_equal(found.point, again.point)
    assert again.noise == found.noise
    assert 4 * np.sqrt(2) <= found.noise["position_scale"] <= 4 * np.sqrt(3.1)  # 2 or 3 frames back
    # Doing it again changes nothing: what was counted is not counted twice.
    assert triangulate_log(again).skipped == again.skipped


def test_pairs_share_what_they_say_they_share():
    log = drive(detection=1.0, view=(-np.pi, np.pi, 1e3), length_m=8.0)  # nothing is missed
    settings = {"baseline": 0.3, "triangulation": WIDE}
    frames = {}
    for pairs in ("disjoint", "consecutive", "overlapping"):
        found = triangulate_log(log, None, PointSettings(pairs=pairs, **settings), True)
        mark = log.identity == 3
        frames[pairs] = found.frame[mark & np.isfinite(found.point[:, 0])]
        assert np.nanmin(found.point_baseline) > 0.3
        assert np.nanmedian(found.point_baseline) == pytest.approx(0.4, rel=0.05)
    assert set(np.diff(frames["overlapping"])) == {1}
    assert set(np.diff(frames["consecutive"])) == {2}  # a pair ends where the next one begins
    assert set(np.diff(frames["disjoint"])) == {3}


def standing(turn, count=12):
    """A robot that turns on the spot by `turn` at every step, among three marks."""
    marks, time = np.array([[2.0, 1.0], [-1.0, 2.0], [0.5, -3.0]]), np.arange(count) * 10**9
    heading = turn * np.arange(count)
    b = (np.arctan2(marks[:, 1], marks[:, 0]) - heading[:, None] + np.pi) % (2 * np.pi) - np.pi
    return Log(
        name="standing",
        odometry_time=time[1:],
        odometry=np.column_stack([np.zeros(count - 1), np.full(count - 1, turn)]),
        odometry_kind="command",
        frame_time=time,
        frame=np.repeat(np.arange(count), 3),
        bearing=b.ravel(),
        view=(-np.pi, np.pi, 10.0),
        truth=Truth(time, np.column_stack([np.zeros((count, 2)), heading])),
    )


@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_pure_turn_yields_no_points_and_counts_them(turn):
    found = triangulate_log(standing(turn))
    assert not found.has("position")
    counted = {k.split(": ")[-1]: v for k, v in found.skipped.items()}
    assert counted == {
        "no baseline (a pure turn, or the robot stood)": 33,  # matched all the way, for nothing
        "first seen here": 3,
    }


def test_a_false_match_is_found_by_what_lies_between():
    log = drive(detection=1.0, view=(-np.pi, np.pi, 1e3), length_m=4.0)
    wrong = (log.identity == 3) & (log.frame == 10)
    bearing = np.where(wrong, log.bearing + 0.2, log.bearing)
    settings = PointSettings(baseline=0.75)
    found = triangulate_log(replace(log, bearing=bearing), None, settings, use_identity=True)
    why = "not used: bearing without a point: the line was elsewhere in between (a false match)"
    assert found.skipped.get(why, 0) >= 1
    spoilt = np.isfinite(found.point[:, 0]) & (log.identity == 3) & (log.frame == 12)
    assert not spoilt.any()  # the frame half-way of that pair is the wrong one


def test_bad_requests_are_named():
    with pytest.raises(ValueError, match="no measured identities"):
        triangulate_log(replace(drive(length_m=2.0), identity=None), use_identity=True)
    points = standing(0.1)
    n = len(points.frame)
    given = {"point": np.ones((n, 2)), "point_cov": np.tile([1, 0, 1], (n, 1))}
    points = replace(points, bearing=None, **given)
    with pytest.raises(ValueError, match="standing: has no bearings"):
        triangulate_log(points)
    for bad in ({"pairs": "all"}, {"baseline": 0.0}, {"baseline": 3.0}, {"memory": 0}):
        with pytest.raises(ValueError, match=r"must be|is not one of"):
            PointSettings(**bad)


def test_the_bundled_log_gets_points():
    """The paper's way on a real robot: a fifth of the log, identities hidden."""
    log = load_log("lost-in-the-woods")
    log = select_frames(log, np.arange(0, 2500, 2))
    found = triangulate_log(log)
    moved = increments(found).distance.sum()
    given = np.isfinite(found.point[:, 0])
    assert given.sum() > 3 * moved
    at = np.searchsorted(log.truth.time, log.frame_time[log.frame])
    pose, mark = log.truth.pose[at], log.truth.landmarks[log.identity]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    dx, dy = (mark - pose[:, :2]).T
    true = np.column_stack([c * dx + s * dy - log.mounting[0], c * dy - s * dx])
    off = np.hypot(*(found.point - true)[given].T)
    assert np.median(off) < 0.32
