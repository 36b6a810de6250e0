"""Simulated worlds: what was drawn has the distribution promised (bounds at 1e-4, seeds fixed)."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxslam.models import motion
from jaxslam.simulation import planar as simulate
from jaxslam.simulation.planar import planar

TAIL = 1e-4
EXACT = dict(err_tran=0.0, err_rot=0.0, err_drift=0.0, floor_tran=0.0, floor_rot=0.0)
MANY = dict(max_per_frame=None, length_m=100.0, landmarks=60)


def wrap(angle):
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def assert_chi_square(total, dof):
    assert stats.chi2.ppf(TAIL, dof) < total < stats.chi2.isf(TAIL, dof), total / dof


def small_steps(log, k):
    """(distance, turn, seconds) of the odometry between frames k and k + 1, cut small."""
    begin, end = log.frame_time[k : k + 2]
    if log.odometry_kind == "command":
        (distance, turn), seconds = log.odometry[log.odometry_time == end][0], (end - begin) * 1e-9
        return [(distance / 50, 0.0, seconds / 50)] * 50 + [(0.0, turn, 0.0)]
    edges = np.union1d(log.odometry_time, [begin, end])
    edges = edges[(edges >= begin) & (edges <= end)]
    held = np.searchsorted(log.odometry_time, edges[:-1], side="right") - 1
    seconds = np.diff(edges) * 1e-9
    return [(v * s, w * s, s) for (v, w), s in zip(log.odometry[held], seconds, strict=True)]


def motion_errors(log):
    """Normalised squared errors [F - 1] of predicting each true pose from the true one before it.

    Mean and covariance are those of many small steps, accumulated to first order.
    """
    n, errors = SimpleNamespace(**log.noise), []
    for k in range(len(log.frame_time) - 1):
        x, y, heading = log.truth.pose[k]
        cov = np.zeros((3, 3))
        for distance, turn, seconds in small_steps(log, k):
            turned = n.gain_rot * turn + n.bias_drift * distance
            c, s = np.cos(heading + turned / 2), np.sin(heading + turned / 2)
            moved = n.gain_tran * distance
            step = np.array([[1, 0, -moved * s], [0, 1, moved * c], [0, 0, 1]])
            axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            floor = n.floor_tran**2 * seconds
            spin = n.err_drift**2 * distance + n.err_rot**2 * abs(turn) + n.floor_rot**2 * seconds
            noise = np.diag([n.err_tran**2 * distance + floor, floor, spin])
            cov = step @ cov @ step.T + axes @ noise @ axes.T
            x, y, heading = x + moved * c, y + moved * s, heading + turned
        error = log.truth.pose[k + 1] - (x, y, heading)
        error[2] = wrap(error[2])
        errors.append(error @ np.linalg.solve(cov, error))
    return np.array(errors)


@pytest.mark.parametrize(
    "noise",
    [
        dict(err_tran=0.05, err_rot=0.001, err_drift=0.001),
        dict(err_tran=0.001, err_rot=0.05, err_drift=0.001),
        dict(err_tran=0.001, err_rot=0.001, err_drift=0.05),
        dict(**EXACT | dict(floor_tran=0.01, floor_rot=0.01)),
        dict(gain_tran=1.1, gain_rot=0.9, bias_drift=0.05),
    ],
    ids=["err_tran", "err_rot", "err_drift", "floors", "gains"],
)
@pytest.mark.parametrize("commands", [False, True])
def test_motion_is_drawn_from_the_model(noise, commands):
    floors = dict(floor_tran=2e-3, floor_rot=2e-3)
    drive = dict(rate_hz=3.0, odometry_hz=20.0, commands=commands, length_m=150.0, landmarks=1)
    errors = motion_errors(planar("room", 1, **drive, **floors | noise))
    assert len(errors) > 450
    assert_chi_square(errors.sum(), 3 * len(errors))
    assert_chi_square(errors[::2].sum(), 3 * len(errors[::2]))


def test_one_odometry_interval_is_the_filters_own_step():
    numbers = dict(err_tran=0.1, err_rot=0.2, err_drift=0.3, floor_tran=0.04, floor_rot=0.05)
    params = SimpleNamespace(**numbers, gain_tran=1.1, gain_rot=0.8, bias_drift=0.2)
    pose, draw = (1.0, -2.0, 0.7), np.array([0.3, -1.2, 0.8])
    for turn, lever, lever_var in ((0.6, 0.5, 1 / 12), (-0.6, 0.0, 0.0)):
        length, chord, rest = 0.5, turn * lever, (0.52, 0.3, lever, lever_var)
        distance, duration, *levers = rest
        dx, dy = length * np.cos(chord), length * np.sin(chord)
        odometry = motion.Odometry(dx, dy, turn, distance, abs(turn), duration, *levers)
        with jax.enable_x64(True):
            expected = motion.sample(pose, odometry, params, jnp.asarray(draw))
        found = simulate._move(pose, length, chord, turn, *rest, params, draw)
        np.testing.assert_allclose(found, np.asarray(expected), atol=1e-12)


def test_without_noise_truth_is_the_integrated_odometry():
    log = planar("field", 2, **EXACT, length_m=20.0)
    x, y, heading = log.start_pose
    for v, w in log.odometry:
        heading += w / 100
        x, y, heading = (
            x + v / 50 * np.cos(heading),
            y + v / 50 * np.sin(heading),
            heading + w / 100,
        )
    np.testing.assert_allclose(log.truth.pose[-1, :2], (x, y), atol=1e-4)
    assert abs(wrap(log.truth.pose[-1, 2] - heading)) < 1e-9


def predicted(log):
    """True range and bearing [F, L] of every landmark at every frame."""
    x, y, heading = log.truth.pose.T
    mx, my, yaw = log.mounting
    sx = x + mx * np.cos(heading) - my * np.sin(heading)
    sy = y + mx * np.sin(heading) + my * np.cos(heading)
    dx, dy = log.truth.landmarks[:, 0] - sx[:, None], log.truth.landmarks[:, 1] - sy[:, None]
    return np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - (heading + yaw)[:, None])


@pytest.fixture(scope="module")
def seen():
    """A log with a mounted sensor of limited view and much clutter."""
    sensor = dict(
        sigma_range=0.08, sigma_bearing=0.015, landmark_extent=0.03, detection=0.7, outlier=0.15
    )
    return planar("grid", 3, **MANY, **sensor, view=(-1.0, 2.0, 7.0), mounting=(0.2, -0.1, 0.4))


def test_ranges_and_bearings_have_the_noise_declared(seen):
    ranges, bearings = predicted(seen)
    true = seen.identity >= 0
    at = seen.frame[true], seen.identity[true]
    far = ranges[at] > 0.4  # nearer, ranges below 0 were cut off
    r, b = ranges[at][far], bearings[at][far]
    range_error = (seen.range[true][far] - r) / 0.08
    bearing_error = wrap(seen.bearing[true][far] - b) / np.sqrt(0.015**2 + (0.03 / r) ** 2)
    for near in (r < 3, r >= 3):
        for error in (range_error[near], bearing_error[near]):
            assert_chi_square((error**2).sum(), len(error))
            assert abs(error.mean()) * np.sqrt(len(error)) < stats.norm.isf(TAIL / 2)
    assert abs(np.corrcoef(range_error, bearing_error)[0, 1]) * np.sqrt(len(r)) < 4


def test_detection_falls_linearly_with_range(seen):
    ranges, bearings = predicted(seen)
    hits = np.zeros(ranges.shape)
    true = seen.identity >= 0
    np.add.at(hits, (seen.frame[true], seen.identity[true]), 1)
    assert hits.max() == 1
    visible = (bearings >= -1.0) & (bearings <= 2.0) & (ranges < 7.0)
    assert hits[~visible].sum() == 0
    for low in range(7):
        cell = visible & (ranges >= max(low, 0.4)) & (ranges < low + 1)
        p = 0.7 * (1 - ranges[cell] / 7.0)
        z = (hits[cell].sum() - p.sum()) / np.sqrt((p * (1 - p)).sum())
        assert len(p) > 100 and abs(z) < stats.norm.isf(TAIL / 2)


def test_clutter_rate_and_place(seen):
    clutter = seen.identity < 0
    test = stats.binomtest(int(clutter.sum()), len(clutter), 0.15)
    assert test.pvalue > TAIL
    assert stats.kstest(seen.range[clutter], stats.uniform(0, 7.0).cdf).pvalue > TAIL
    assert stats.kstest(seen.bearing[clutter], stats.uniform(-1.0, 3.0).cdf).pvalue > TAIL
    assert (planar("grid", 3, outlier=0.0, length_m=10.0).identity >= 0).all()


def same(a, b):
    names = ("odometry", "frame_time", "frame", "bearing", "range", "identity")
    return [np.array_equal(getattr(a, name), getattr(b, name)) for name in names]


@pytest.mark.parametrize("world", ["room", "grid", "field"])
def test_a_seed_gives_one_world(world):
    first, again, other = (planar(world, seed, length_m=10.0) for seed in (5, 5, 6))
    assert all(same(first, again))
    assert np.array_equal(first.truth.pose, again.truth.pose)
    assert not np.array_equal(first.truth.landmarks, other.truth.landmarks)
    assert not np.array_equal(first.truth.pose, other.truth.pose)
    assert not np.array_equal(first.range, other.range)


@pytest.mark.parametrize(
    "rate_hz, odometry_hz", [(5.0, 50.0), (7.0, 30.0), (30.0, 67.0), (9.0, 2.0)]
)
def test_frames_come_at_their_rate(rate_hz, odometry_hz):
    log = planar("room", 1, rate_hz=rate_hz, odometry_hz=odometry_hz, length_m=10.0)
    assert len(log.frame_time) == int(20 * rate_hz)
    assert np.abs(np.diff(log.frame_time) - 1e9 / rate_hz).max() <= 1
    assert log.odometry_time[0] == 0 and log.frame_time[0] == round(1e9 / rate_hz)
    left = log.frame_time[-1] - log.odometry_time[-1]
    assert 0 < left <= np.median(np.diff(log.odometry_time)) + 1  # its last sample is held so long
    assert np.array_equal(log.truth.time, log.frame_time)
    assert np.array_equal(log.truth.identity, log.identity)
    assert motion_errors(log).mean() < 4


@pytest.mark.parametrize("commands", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_the_robot_stays_in_the_room_and_landmarks_on_its_walls(seed, commands):
    log = planar("room", seed, commands=commands, length_m=200.0, err_drift=0.05, err_tran=0.05)
    x, y, _ = log.truth.pose.T
    assert x.min() > 0.5 and x.max() < 9.5 and y.min() > 0.5 and y.max() < 3.5
    assert np.hypot(np.diff(x), np.diff(y)).sum() == pytest.approx(200, rel=0.1)
    ax, ay = log.truth.landmarks.T
    on_wall = np.minimum(np.minimum(ax, 10 - ax), np.minimum(ay, 4 - ay))
    assert np.abs(on_wall).max() < 1e-12 and len(ax) == 40
    assert log.plan.segments.shape == (4, 4)
    assert np.hypot(*(log.plan.segments[:, 2:] - log.plan.segments[:, :2]).T).sum() == 28


def test_commands_go_from_stop_to_stop():
    log = planar("room", 4, commands=True, stop_m=0.3, speed=0.2, length_m=30.0)
    assert log.odometry_kind == "command" and log.odometry.shape == (100, 2)
    assert log.frame_time[0] == 0 and np.array_equal(log.frame_time[1:], log.odometry_time)
    assert np.all(np.diff(log.frame_time) == 1_500_000_000)
    assert np.array_equal(log.truth.pose[0], log.start_pose)
    assert (log.odometry[:, 0] >= 0).all()
    assert np.abs(log.odometry[:, 0] - 0.3).max() < 0.1


@pytest.mark.parametrize("commands", [False, True])
def test_coarse_truth_is_read_off_tiles(commands):
    drive = dict(commands=commands, length_m=30.0)
    exact = planar("room", 4, **drive)
    coarse = planar("room", 4, truth_resolution=0.3, **drive)
    assert all(same(exact, coarse)) and coarse.truth.resolution == 0.3
    tile = coarse.truth.pose[:, :2] / 0.3
    np.testing.assert_allclose(tile, np.round(tile), atol=1e-9)
    at = np.searchsorted(exact.truth.time, coarse.truth.time)
    assert np.array_equal(exact.truth.time[at], coarse.truth.time)
    error = np.abs(coarse.truth.pose - exact.truth.pose[at])
    assert error[:, :2].max() <= 0.15 + 1e-9 and error[:, 2].max() == 0
    assert len(at) == (101 if commands else 100)


def test_the_true_start_is_drawn_from_its_covariance():
    cov = np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.003], [0.0, 0.003, 0.01]])
    logs = [planar("room", seed, commands=True, length_m=0.3, start_cov=cov) for seed in range(200)]
    errors = np.array([log.truth.pose[0] - log.start_pose for log in logs])
    assert_chi_square(np.einsum("ni,ij,nj", errors, np.linalg.inv(cov), errors), 600)
    assert np.array_equal(logs[0].start_cov, cov)
    assert planar("room", 0, length_m=1.0).start_cov.max() == 0


def test_blind_driving_ignores_the_noise():
    first, second = (planar("room", seed, closed_loop=False, length_m=20.0) for seed in (0, 1))
    assert np.array_equal(first.odometry, second.odometry)
    assert not np.array_equal(first.truth.pose[-1], second.truth.pose[-1])
    steered = [planar("room", seed, length_m=20.0).odometry for seed in (0, 1)]
    assert not np.array_equal(*steered)


def test_a_frame_holds_no_more_than_its_limit():
    log = planar("room", 0, max_per_frame=4, length_m=10.0)
    assert np.bincount(log.frame).max() == 4
    assert log.noise["density_new"] == 1.0 and log.noise["err_tran"] == 0.02


@pytest.mark.parametrize(
    "name, value",
    [
        ("world", "mars"),
        ("landmarks", 0),
        ("length_m", -1.0),
        ("speed", 0.0),
        ("rate_hz", float("nan")),
        ("sigma_range", -0.1),
        ("err_drift", float("inf")),
        ("outlier", 1.0),
        ("detection", 1.5),
        ("max_per_frame", 0),
        ("view", (1.0, -1.0, 5.0)),
        ("start_cov", np.eye(2)),
        ("truth_resolution", -0.3),
    ],
)
def test_what_is_not_allowed_is_named(name, value):
    with pytest.raises(ValueError) as caught:
        planar(**{"length_m": 5.0, name: value})
    message = str(caught.value)
    assert "\n" not in message and name in message


def test_a_start_covariance_is_one():
    with pytest.raises(ValueError, match="covariance"):
        planar(length_m=5.0, start_cov=-np.eye(3))


def test_clearance_keeps_landmarks_out_of_the_way():
    told = dict(seed=3, landmarks=30, closed_loop=False)
    log = planar("field", clearance=0.7, **told)
    apart = log.truth.landmarks[:, None] - log.truth.pose[:, :2]
    assert np.hypot(*apart.transpose(2, 0, 1)).min() >= 0.7
    same = (log.truth.landmarks == planar("field", **told).truth.landmarks).all(1)
    assert 0 < same.sum() < 30  # the others stay where they were


@pytest.mark.parametrize(
    ("world", "clearance", "message"),
    [("room", 0.5, "in a field only"), ("field", -1.0, "0 or more"), ("field", 9.0, "no room")],
)
def test_clearance_refuses_what_can_not_be(world, clearance, message):
    with pytest.raises(ValueError, match=message):
        planar(world, clearance=clearance)
