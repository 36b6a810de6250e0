"""The baseline's runs, by themselves: against closed forms and cases worked by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.parameters import default_params
from jaxslam.reference import compare, ekf, fastslam
from jaxslam.simulation import planar

SENSORS = ("position", "range_bearing", "bearing")
STILL = {"dx": 0, "dy": 0, "dtheta": 0, "distance": 0, "turn": 0, "duration": 0}
STILL |= {"lever": 0.5, "lever_var": 1 / 12}
MOTION = {"err_tran": 0, "err_rot": 0, "err_drift": 0, "floor_tran": 0, "floor_rot": 0}
MOTION |= {"gain_tran": 1, "gain_rot": 1, "bias_drift": 0}
SENSING = {"sigma_range": 0.1, "sigma_bearing": 0.05, "landmark_extent": 0.03, "position_scale": 1}
SENSING |= {"correlation": 0.0, "extra_bearing_noise": 0.0}
SENSING |= {"mount_x": 0.2, "mount_y": -0.1, "mount_yaw": 0.3, "outlier": 0.02, "density_new": 0.1}
SENSING |= {"detection": 0.9, "view_min": -2.0, "view_max": 2.0, "view_range": 10.0}
SENSING |= {"inv_depth_mean": 0.3, "inv_depth_sd": 0.2}
EXISTENCE = {"existence_new": 1.0, "existence_seen": 0.5, "existence_miss": 1.0}
EXISTENCE |= {"existence_max": 2.0, "existence_confirm": 1.0}


def make_params(**changes):
    return SimpleNamespace(**MOTION | SENSING | EXISTENCE | changes)


def make_config(**changes):
    rules = {"sensor": "range_bearing", "association": "maximum_likelihood", "landmarks": 4}
    rules |= {"exclusive": True, "clutter": True, "forgetting": False, "resample_threshold": 0.0}
    return SimpleNamespace(**rules | changes)


def make_model(config=None, **changes):
    return fastslam.make_model(make_params(**changes), make_config(**(config or {})))


def make_odometry(steps=1, **fields):
    filled = {name: np.full(steps, float(value)) for name, value in (STILL | fields).items()}
    return SimpleNamespace(**filled)


def make_frames(frames, columns=3, identity=None, cov=(0.04, 0.01, 0.02), active=None):
    """Measurements from one list of readings per frame."""
    shape = (len(frames), columns)
    m = SimpleNamespace(
        value=np.zeros((*shape, 2)),
        cov=np.zeros((*shape, 3)),
        identity=np.full(shape, -1),
        valid=np.zeros(shape, bool),
        active=np.ones(len(frames), bool) if active is None else np.array(active),
    )
    for t, frame in enumerate(frames):
        for k, reading in enumerate(frame):
            m.value[t, k, : np.size(reading)] = reading
            m.cov[t, k], m.valid[t, k] = cov, True
            m.identity[t, k] = k if identity is None else identity[t][k]
    return m


def go(frames, config=None, params=None, particles=1, pose=(1.0, 2.0, 0.5), seed=0, **fields):
    """Run from a start known exactly; `fields` are the odometry of every step."""
    draw = np.random.default_rng(seed)
    steps = len(frames.valid)
    return fastslam.run(
        make_odometry(steps, **fields),
        frames,
        params or make_params(),
        config or make_config(),
        np.array(pose),
        np.zeros((3, 3)),
        draw.normal(size=(3, particles)),
        draw.normal(size=(steps, 3, particles)),
        draw.uniform(size=steps),
    )


def make_landmark(mean, cov=((0.05, 0.01), (0.01, 0.02)), anchor=(0.0, 0.0), log_odds=1.0):
    return ekf.Landmark(np.array(mean), np.array(cov), np.array(anchor), 1, log_odds, 0)


def make_reading(value, k=0, identity=0):
    return SimpleNamespace(k=k, value=np.array(value), cov=0.04 * np.eye(2), identity=identity)


def log_normal(x, cov):
    x, cov = np.atleast_1d(x), np.atleast_2d(cov)
    return -0.5 * (x @ np.linalg.solve(cov, x) + np.linalg.slogdet(2 * np.pi * cov)[1])


def test_standing_robot_is_a_kalman_filter():
    """`position` from a known pose is linear: mean, covariance and evidence in closed form."""
    draw = np.random.default_rng(1)
    r = np.array([[0.04, 0.01], [0.01, 0.02]])
    z = draw.multivariate_normal([2.0, 1.0], r, size=6)
    frames = make_frames([[reading] for reading in z], identity=[[0]] * 6)
    config = make_config(sensor="position", association="known", clutter=False)
    result = go(frames, config, make_params(position_scale=2.0))

    s = ekf.sensor_pose(np.array([1.0, 2.0, 0.5]), make_model())
    np.testing.assert_allclose(s[2], 0.8)
    turn = ekf.rotation(s[2])
    ((slot, mean, cov),) = fastslam.map_of(result.particles[0], "position")
    assert slot == 0
    np.testing.assert_allclose(mean, s[:2] + turn @ z.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(cov, turn @ (4 * r / 6) @ turn.T, atol=1e-14)
    # readings share the landmark; the first only creates it: p(z_2..6 | z_1) * density
    shared = np.kron(np.ones((5, 5)), 4 * r) + np.kron(np.eye(5), 4 * r)
    expected = log_normal((z[1:] - z[0]).ravel(), shared) + math.log(0.1)
    assert result.log_evidence.sum() == pytest.approx(expected, abs=1e-10)


def test_shared_landmark_is_weighed_as_it_is_after_the_first_match():
    """Not exclusive: the second reading of a frame meets the landmark the first has moved."""
    config = make_config(sensor="position", exclusive=False, clutter=False)
    result = go(make_frames([[(2.0, 1.0)], [(2.1, 1.0), (1.9, 1.1)]]), config)
    r = np.array([[0.04, 0.01], [0.01, 0.02]])
    first = log_normal(np.array([0.1, 0.0]), 2 * r)
    second = log_normal(np.array([1.9, 1.1]) - [2.05, 1.0], 1.5 * r)
    assert result.match[1, 0].tolist() == [0, 0, fastslam.PADDING]
    assert result.log_evidence[1] == pytest.approx(first + second)
    assert result.particles[0].landmarks[0].count == 3


def test_known_identities_match_create_call_clutter_and_overflow():
    config = make_config(association="known", landmarks=3)
    frames = make_frames(
        [[(2.0, 0.1), (3.0, 1.0)], [(2.0, 0.1), (9.0, -1.9), (4.0, 0.0)]],
        identity=[[2, 0], [2, 0, 3]],
    )
    result = go(frames, config)
    assert result.match[:, 0].tolist() == [[-1, -1, -3], [2, -2, -1]]
    assert result.slot[:, 0].tolist() == [[2, 0, -1], [2, -1, -1]]
    assert (result.births[:, 0].tolist(), result.overflow[:, 0].tolist()) == ([2, 0], [0, 1])
    marks = result.particles[0].landmarks
    assert marks[1] is None
    assert (marks[0].landmark_id, marks[2].landmark_id) == (1, 0)
    model = make_model()
    expected = math.log(0.02 / 40) + math.log(0.98 * 0.1 * 4)  # clutter, and new without a slot
    view = ekf.predict(marks[2], ekf.sensor_pose(np.array([1, 2, 0.5]), model), model)
    s = 2 * np.diag([0.1**2, 0.05**2 + (0.03 / view.range) ** 2])
    expected += math.log(0.98) + log_normal([0.0, 0.0], s)
    assert result.log_evidence[1] == pytest.approx(expected, abs=1e-9)


def test_known_without_identity_is_refused():
    frames = make_frames([[(2.0, 0.1)]], identity=[[-1]])
    with pytest.raises(ValueError, match="frame 0, measurement 0: identity -1"):
        go(frames, make_config(association="known"))


# Slots and existence


def test_births_take_the_lowest_slot_and_a_full_map_overflows():
    frames = make_frames([[(2.0, -1.0)], [(2.0, 0.0), (2.0, 1.0), (4.0, -1.0)]])
    result = go(frames, make_config(landmarks=2))
    assert result.match[:, 0].tolist() == [[-1, -3, -3], [-1, -1, -1]]
    assert result.slot[:, 0].tolist() == [[0, -1, -1], [1, -1, -1]]
    assert (result.births[:, 0].tolist(), result.overflow[:, 0].tolist()) == ([1, 1], [0, 2])
    assert [mark.landmark_id for mark in result.particles[0].landmarks] == [0, 3]
    expected = 3 * math.log(0.98 * 0.1) + math.log(2 * 2 * 4)
    assert result.log_evidence[1] == pytest.approx(expected)


def test_frame_number_counts_from_first_step():
    draws = np.zeros((3, 1)), np.zeros((1, 3, 1)), np.zeros(1)
    frames, start = make_frames([[(2.0, -1.0), (2.0, 1.0)]]), (np.zeros(3), np.zeros((3, 3)))
    seen = []
    result = fastslam.run(
        make_odometry(),
        frames,
        make_params(),
        make_config(),
        *start,
        *draws,
        5,
        lambda *x: seen.append(x),
    )
    assert [mark.landmark_id for mark in result.particles[0].landmarks[:2]] == [15, 16]
    assert seen == [(1, 1)]


def test_existence_by_hand():
    """Seen: raised up to the cap. In view and missed: lowered by what a miss tells. Else kept."""
    miss = math.log1p(-0.9 * (1 - 4.0 / 10))
    model = make_model({"forgetting": True}, existence_max=1.2)
    xy = [(2.0, 0.0), (0.0, 4.0), (-4.0, 0.0), (11.0, 0.0), (4.0, 0.0)]
    odds = [1.0, -miss + 0.1, 1.0, 1.0, -miss - 0.1]
    marks = [make_landmark(p, log_odds=o) for p, o in zip(xy, odds, strict=True)]
    particle = fastslam.Particle(np.zeros(3), [*marks, None], 0.0)
    freed = fastslam.forget(particle, range(5), [0], np.zeros(3), model)
    assert freed == 1
    assert particle.landmarks[4:] == [None, None]
    assert [mark.log_odds for mark in marks[:4]] == pytest.approx([1.2, 0.1, 1.0, 1.0])


@pytest.mark.parametrize("sensor", SENSORS)
def test_unseen_landmark_is_forgotten_and_its_slot_used_after_the_frame(sensor):
    near = {"position": (1.0, 0.0), "bearing": (0.0,)}.get(sensor, (1.0, 0.0))
    other = {"position": (0.0, 1.0), "bearing": (1.5,)}.get(sensor, (1.0, 1.5))
    third = {"position": (1.0, -1.4), "bearing": (-1.0,)}.get(sensor, (2.0, -1.0))
    frames = make_frames([[near], [other], [other, third]])
    params = make_params(existence_new=0.2, inv_depth_mean=0.7, inv_depth_sd=0.1)
    result = go(frames, make_config(sensor=sensor, forgetting=True), params)
    assert result.freed[:, 0].tolist() == [0, 1, 0]
    assert result.slot[:, 0, :2].tolist() == [[0, -1], [1, -1], [1, 0]]
    assert result.match[2, 0].tolist() == [1, -1, -3]
    assert result.particles[0].landmarks[1].log_odds == pytest.approx(0.7)
    kept = go(frames, make_config(sensor=sensor), params)
    assert kept.freed.sum() == 0
    assert kept.slot[2, 0, :2].tolist() == [1, 2]


def test_inactive_frame_only_moves():
    """An active frame without readings is evidence of absence; one not looked at is not."""
    frames = make_frames([[(2.0, 0.0)], [], []], active=[True, False, True])
    config = make_config(forgetting=True, resample_threshold=1.0)
    result = go(frames, config, make_params(existence_new=0.5), dx=0.1, distance=0.1)
    assert result.resampled.tolist() == [True, False, True]
    assert result.freed[:, 0].tolist() == [0, 0, 1]
    assert result.log_evidence[1:].tolist() == [0.0, 0.0]
    np.testing.assert_allclose(result.poses[:, 0, 0], 1 + 0.1 * math.cos(0.5) * np.arange(1, 4))


def test_no_weight_left_is_flagged_and_made_uniform():
    params = make_params(density_new=0.0)  # a birth is impossible, and clutter is off
    result = go(make_frames([[(2.0, 0.1)]]), make_config(clutter=False), params, particles=3)
    assert (result.degenerate[0], result.nonfinite[0]) == (True, 3)
    assert result.log_evidence[0] == -np.inf
    np.testing.assert_allclose(result.log_weight[0], -math.log(3))


def test_map_of_skips_empty_slots():
    landmark = make_landmark([2.0, 0.5], anchor=(1.0, -1.0))
    particle = fastslam.Particle(np.zeros(3), [None, landmark, None], 0.0)
    ((slot, mean, _),) = fastslam.map_of(particle, "bearing")
    assert slot == 1
    np.testing.assert_allclose(mean, [1 + 2 * math.cos(2), -1 + 2 * math.sin(2)])


# The whole


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("association", ["known", "maximum_likelihood"])
def test_small_world(sensor, association):
    """A quarter circle among four tubes: weights sum to one, the map and the path come out."""
    draw, steps, n = np.random.default_rng(3), 40, 12
    marks = np.array([[4.0, 0.0], [4.0, 3.0], [2.0, 5.0], [-1.0, 3.0]])
    model = make_model({"sensor": sensor})
    pose, frames, truth = np.zeros(3), [], []
    drive = {"dx": 0.1, "dtheta": 0.03, "distance": 0.1, "turn": 0.03, "duration": 0.1}
    for _ in range(steps):
        pose = fastslam.move(pose, SimpleNamespace(**STILL | drive), np.zeros(3), model)
        s = ekf.sensor_pose(pose, model)
        d = (marks - s[:2]) @ ekf.rotation(s[2])
        r, b = np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0])
        b += draw.normal(0, 0.02, 4)
        r += draw.normal(0, 0.05, 4)
        point = np.column_stack([r * np.cos(b), r * np.sin(b)])
        polar = np.column_stack([r, b])
        frames.append({"position": point, "range_bearing": polar, "bearing": b}[sensor])
        truth.append(pose)
    params = make_params(
        err_tran=0.05, err_rot=0.03, floor_tran=0.003, floor_rot=0.003, landmark_extent=0
    )
    rules = {"sensor": sensor, "association": association, "resample_threshold": 0.5}
    config = make_config(**rules, landmarks=6, forgetting=association != "known")
    cov = (0.02, 0.0, 0.02)
    result = go(make_frames(frames, 4, cov=cov), config, params, n, (0.0, 0.0, 0.0), **drive)

    np.testing.assert_allclose(np.exp(result.log_weight).sum(axis=1), 1, atol=1e-12)
    assert np.all((result.ess >= 1 - 1e-9) & (result.ess <= n + 1e-9))
    assert result.resampled.any()
    assert not result.resampled.all()
    same = np.all(result.ancestors == np.arange(n), axis=1)
    assert np.all(same[~result.resampled])
    assert not np.any(same[result.resampled])
    assert np.all(np.linalg.eigvalsh(result.cov) > -1e-12)
    assert not result.degenerate.any()
    error = np.linalg.norm(result.pose_mean[:, :2] - np.array(truth)[:, :2], axis=1)
    assert error.max() < 0.4
    best = result.particles[int(np.argmax(result.log_weight[-1]))]
    points = np.array([mean for _, mean, _ in fastslam.map_of(best, sensor)])
    nearest = np.linalg.norm(points[:, None] - marks, axis=2).min(axis=0)
    if sensor == "bearing":  # the one straight ahead may have no depth yet
        assert np.sort(nearest)[:3].max() < 1.0
    else:
        assert nearest.max() < 0.4
    if association == "known":
        assert len(points) == 4
        assert result.births.sum(axis=0).tolist() == [4] * n


@pytest.mark.parametrize("sensor", ["range_bearing", "bearing"])
def test_correlated_and_further_errors_as_in_the_filter(sensor):
    log = planar.planar(length_m=4.0, landmarks=12, seed=3)
    config = Config(sensor=sensor, particles=4, measurements=6, landmarks=10)
    plain = default_params(sensor, log)._replace(correlation=0.0, extra_bearing_noise=0.0)

    def check(**noise):
        found = compare.agreement(log, config, plain._replace(**noise), seed=1)
        assert found.same == found.steps
        assert max(found.pose, found.log_weight, found.landmarks) <= 1e-9
        return found.pose_filter

    white, correlated = check(), check(correlation=0.3)
    assert np.abs(correlated - white).max() > 1e-3
    assert np.abs(check(extra_bearing_noise=0.1) - white).max() > 1e-3
    assert np.abs(check(correlation=0.3, extra_bearing_noise=0.1) - correlated).max() > 1e-3
