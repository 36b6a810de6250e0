"""The filter against the baseline, fed the same draws; and the comparison itself."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import SENSORS, Config
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.log_file import load_log
from jaxslam.parameters import default_params
from jaxslam.reference import compare, fastslam
from jaxslam.runs.run import config_for
from jaxslam.simulation import planar

STEPS, PARTICLES = 200, 20
# More than one block, a map that can fill up, and frames with more measurements than slots.
SIZES = {"particles": PARTICLES, "measurements": 4, "landmarks": 20, "block": 10}
SIZES |= {"proposal": "prior"}  # the only one the baseline has
# Landmarks are either crowded, or so rare that nearby (range below 2 m) clutter is likelier.
DENSITY_NEW = {"position": 0.5, "range_bearing": 1e-3, "bearing": 0.05}


@pytest.fixture(scope="module")
def woods():
    """Two minutes of the bundled log: the robot starts, drives and turns."""
    log = load_log("lost-in-the-woods")
    return compare.select_frames(log, np.arange(0, 6 * STEPS, 6))


def assert_agree(log, config):
    params = default_params(config.sensor, log)
    # Short-lived landmarks, so that some are forgotten and found anew.
    params = params._replace(existence_new=0.3, existence_seen=0.2, existence_miss=0.5)
    params = params._replace(outlier=0.05, density_new=DENSITY_NEW[config.sensor])
    found = compare.agreement(log, config, params, seed=1)
    assert found.same == found.steps == STEPS
    assert max(found.pose, found.log_weight, found.landmarks) <= 1e-9
    assert found.resampled >= 10
    assert found.begun >= 5
    assert found.forgotten >= 1 or not config.forgetting
    assert jnp.ones(1).dtype == jnp.float32  # float64 was not left switched on
    return found


@pytest.mark.parametrize("association", ["maximum_likelihood", "known"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_baseline_and_filter_agree(woods, sensor, association):
    config = Config(sensor=sensor, association=association, forgetting=True, **SIZES)
    found = assert_agree(woods, config)
    assert found.clutter > 0 or (association == "maximum_likelihood" and sensor != "range_bearing")


def test_baseline_and_filter_agree_on_points_that_rest_on_odometry(woods):
    f = frames_from_log(woods, config_for(woods, "position"))
    cov = np.full((len(woods.frame), 3), np.nan)
    point, base = cov[:, :2].copy(), cov[:, 0].copy()
    rows = f.row[f.row >= 0]
    value, cov[rows] = f.measurements.value[f.row >= 0], f.measurements.cov[f.row >= 0]
    point[rows] = value / 1.05  # as triangles over odometry that is 5 % short
    base[rows[::2]] = 0.4
    point[rows[::7]], cov[rows[::7]], base[rows[::7]] = np.nan, np.nan, np.nan
    log = replace(woods, point=point, point_cov=cov, point_baseline=base)
    config = Config(sensor="position", forgetting=True, **SIZES)
    plain = assert_agree(log, config)
    scaled = assert_agree(replace(log, noise={"gain_tran": 1.05}), config)
    assert np.abs(plain.pose_filter - scaled.pose_filter).max() > 0.01


def test_baseline_and_filter_agree_on_the_papers_rules(woods):
    found = assert_agree(woods, Config.paper(**SIZES))
    assert found.forgotten == found.clutter == 0


def small(steps=12):
    log = planar.planar(length_m=steps * 0.1, landmarks=12, outlier=0.2, seed=3)
    return log, Config(particles=4, measurements=4, landmarks=3, proposal="prior")


@pytest.mark.slow
def test_comparison_in_both_precisions():
    log, config = small()
    calls = []
    row = compare.compare(log, config, steps=10, progress=lambda *call: calls.append(call))
    assert row.double.same == row.single.same == row.double.steps == 10
    assert row.double.landmarks <= 1e-12 < row.single.landmarks <= 1e-3
    assert row.double.overflow > 0  # three slots were too few, and both lost the same landmarks
    assert 0 < row.ate_baseline < 1
    assert row.double.map_baseline.mean.shape == (0, 2)  # none confirmed so soon
    assert row.ate_filter == pytest.approx(row.ate_baseline, abs=1e-5)
    assert min(row.double.seconds_baseline, row.single.seconds_filter) > 0
    assert calls[0] == (0, 10)
    assert calls[-1] == (10, 10)
    text = compare.table([row, row])
    assert "10 of 10 steps" in text
    assert len({len(line) for line in text.splitlines()}) == 1


def test_the_baseline_refuses_what_it_has_not():
    log, config = small()
    for other in ({"proposal": "informed"}, {"association": "sampled"}):
        with pytest.raises(ValueError, match="the baseline has the prior proposal"):
            compare.agreement(log, replace(config, **other))


def test_the_baselines_map_is_what_its_best_particle_is_sure_of():
    def mark(x, y, log_odds=9.0, variance=0.01):
        return SimpleNamespace(
            mean=np.array([x, y]), cov=np.eye(2) * variance, log_odds=log_odds, anchor=np.ones(2)
        )

    marks = [mark(0.0, 0.5), None, mark(7.0, 7.0, 1.0), mark(0.0, 0.5, variance=0.04)]
    particles = [SimpleNamespace(landmarks=[]), SimpleNamespace(landmarks=marks)]
    # The best one, 3, lives on as its child 1.
    reference = SimpleNamespace(ancestors=[[2, 3, 3]], best=[3], particles=particles)
    reference.ancestors = np.array(reference.ancestors)
    params = SimpleNamespace(existence_confirm=5.0)

    def found(sensor, **rules):
        config = Config(sensor=sensor, **rules)
        given = reference, params, config, np.array([40, 41, 42]), np.array([10.0, 20, 0])
        return [column.tolist() for column in compare._map_of_best(*given)]

    assert found("position") == [[[10.0, 20.5], [10.0, 20.5]], [40, -1]]
    assert len(found("position", forgetting=False)[0]) == 3
    assert found("bearing") == [[[13.0, 21.0]], [40]]  # 2 m from its anchor; the last: no depth


def traces(steps=3, particles=2):
    """A trace and a baseline's result that agree, and a map of one landmark each."""
    pose = np.zeros((steps, 3, particles))
    weight = np.full((steps, particles), -np.log(2.0))
    weight[1, 1] = -np.inf
    ancestors = np.tile(np.arange(particles), (steps, 1))
    landmark_id = np.zeros((steps, 1, particles), int)
    trace = compare._Trace(pose, weight, ancestors, landmark_id, pose[:, :, 0])
    mark = SimpleNamespace(
        mean=[1.0, 2.0], cov=[[4.0, 2.0], [2.0, 10.0]], count=3, landmark_id=0, log_odds=1.0
    )
    reference = SimpleNamespace(
        poses=pose.copy(),
        log_weight=weight.copy(),
        ancestors=ancestors.copy(),
        landmark_id=np.swapaxes(landmark_id, 1, 2).copy(),
        particles=[SimpleNamespace(landmarks=[mark, None])] * particles,
    )
    world = SimpleNamespace(
        mean=np.tile([[[1.0], [0.0]], [[2.0], [0.0]]], particles),
        factor=np.tile([[[2.0], [0.0]], [[1.0], [0.0]], [[3.0], [0.0]]], particles),
        anchor=None,
        log_odds=np.tile([[1.0], [0.0]], particles),
        count=np.tile([[3], [0]], particles),
        landmark_id=np.zeros((2, particles), int),
    )
    return SimpleNamespace(landmarks=world), trace, reference


def test_differences_of_equal_runs_are_zero():
    assert compare._differences(*traces()) == (3, 0.0, 0.0, 0.0)


def test_differences_stop_where_the_decisions_part():
    state, trace, reference = traces()
    reference.landmark_id[2, 1, 0] = fastslam.NEW
    reference.poses[1, 2, 0] += 2 * np.pi + 0.25  # a full turn is no difference
    reference.poses[2] += 5
    same, pose, _, landmarks = compare._differences(state, trace, reference)
    assert (same, np.isnan(landmarks)) == (2, True)
    assert pose == pytest.approx(0.25)
    reference.ancestors[0, 0] = 1
    assert compare._differences(state, trace, reference)[0] == 0


@pytest.mark.parametrize("name", ["mean", "factor", "log_odds"])
def test_every_number_of_a_landmark_counts(name):
    state, trace, reference = traces()
    getattr(state.landmarks, name)[..., 0, 1] += 1
    assert compare._differences(state, trace, reference)[3] >= 1


def test_different_sets_of_landmarks_are_infinitely_apart():
    state, trace, reference = traces()
    state.landmarks.count[1, 1] = 1
    assert compare._differences(state, trace, reference)[3] == np.inf
    state, trace, reference = traces()
    state.landmarks.landmark_id[0, 1] = 1
    assert compare._differences(state, trace, reference)[3] == np.inf


def test_selected_frames_keep_their_measurements():
    log = planar.planar(length_m=3.0, seed=2)
    kept = np.arange(1, len(log.frame_time), 3)
    part = compare.select_frames(log, kept)
    assert np.array_equal(part.frame_time, log.frame_time[kept])
    assert part.start == log.start  # the odometry is all there
    for new, old in enumerate(kept):
        for name in ("bearing", "range", "identity"):
            mine = getattr(part, name)[part.frame == new]
            assert np.array_equal(mine, getattr(log, name)[log.frame == old])
        assert np.array_equal(
            part.truth.identity[part.frame == new], log.truth.identity[log.frame == old]
        )
