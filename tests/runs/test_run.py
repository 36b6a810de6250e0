"""Whole runs: shapes, types, seeds, places, and that nothing lost stays unsaid."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter import new_landmarks
from jaxslam.filter import step as fastslam
from jaxslam.parameters import default_params
from jaxslam.results.metrics import ate
from jaxslam.runs import assemble, compiled
from jaxslam.runs import run as runner
from jaxslam.runs.run import config_for, refine_result
from jaxslam.simulation.planar import planar

SIZES = dict(particles=30, landmarks=30, measurements=10)  # test_offline's: compiled once


def run(*given, **named):
    """Without refinement, which most of these tests are not about."""
    return runner.run(*given, refine=False, **named)


@pytest.fixture(scope="module")
def log():
    return planar("field", 5, landmarks=25, length_m=12.0, rate_hz=2.0, outlier=0.05)


@pytest.fixture(scope="module")
def config(log):
    return config_for(log, **SIZES)


@pytest.fixture(scope="module")
def calls():
    return []


@pytest.fixture(scope="module")
def result(log, config, calls):
    return run(log, config, seed=3, progress=lambda *args: calls.append(args))


def test_result_has_a_row_for_every_frame(log, config, result):
    t, k = len(log.frame_time), config.measurements
    rows = {
        "time": ((), np.int64),
        "pose": ((3,), np.float64),
        "cov": ((3, 3), np.float32),
        "ess": ((), np.float32),
        "resampled": ((), np.bool_),
        "new": ((), np.int32),
        "overflow": ((), np.float64),
        "outliers": ((), np.float64),
        "forgotten": ((), np.float64),
        "log_evidence": ((), np.float32),
        "nonfinite": ((), np.int32),
        "degenerate": ((), np.bool_),
        "match": ((k,), np.int64),
        "row": ((k,), np.int64),
        "dead_reckoning": ((3,), np.float64),
    }
    for name, (shape, dtype) in rows.items():
        value = getattr(result, name)
        assert isinstance(value, np.ndarray), name
        assert value.shape == (t, *shape), name
        assert value.dtype == dtype, name
    np.testing.assert_array_equal(result.time, log.frame_time)
    assert result.log is log and result.config is config and result.seed == 3
    assert result.params == default_params(config.sensor, log)


def test_landmarks_are_a_table(result):
    world = result.landmarks
    count = len(world.id)
    assert count > 5
    shapes = {"id": (count,), "mean": (count, 2), "cov": (count, 3), "n": (count,)}
    for name, shape in (shapes | {"identity": (count,)}).items():
        assert getattr(world, name).shape == shape
        assert getattr(world, name).dtype == (np.float64 if name in ("mean", "cov") else np.int64)
    assert len(np.unique(world.id)) == count
    assert (world.n >= 1).all()
    np.testing.assert_array_equal(world.identity, -1)  # identities were hidden
    assert (world.cov[:, 0] * world.cov[:, 2] > world.cov[:, 1] ** 2).all()


def test_landmarks_without_a_depth_stay_out_of_the_map():
    config = Config(sensor="bearing", particles=2, landmarks=3, measurements=1, forgetting=False)
    state = fastslam.init(config, jax.random.key(0))
    depth, sd = jnp.array([0.5, 0.5, 0.5]), jnp.array([0.01, 0.25, 0.01])
    given = jnp.stack([jnp.zeros(3), depth]), jnp.stack([jnp.full(3, 0.01), jnp.zeros(3), sd])
    world = new_landmarks.place_given(state.landmarks, (*given, jnp.ones((2, 3))))
    # The third slot is empty.
    world = world._replace(
        count=world.count.at[2].set(0), landmark_id=jnp.array([[7, 7], [8, 8], [9, 9]], jnp.int32)
    )
    params = default_params("bearing")
    found = assemble._estimate_map(
        state._replace(landmarks=world), 0, params, config, np.empty(0, int), np.array([5.0, 0, 0])
    )
    np.testing.assert_array_equal(found.id, [7])
    np.testing.assert_allclose(found.mean, [[5 + 1 + 2, 1]], atol=1e-5)


def test_result_means_something(log, config, result):
    true = log.truth.pose
    off = np.hypot(*(result.pose - true)[:, :2].T)
    assert off.max() < 0.5
    assert (result.ess >= 1).all() and (result.ess <= config.particles * 1.0001).all()
    assert result.resampled.any() and not result.resampled.all()
    assert result.new.sum() >= len(result.landmarks.id)
    assert result.log_likelihood == pytest.approx(np.sum(result.log_evidence), rel=1e-5)
    assert not result.degenerate.any() and not result.nonfinite.any()
    assert result.seconds > 0 and result.compile_seconds > 0
    nearest = np.hypot(*(result.landmarks.mean[:, None] - log.truth.landmarks).T).min(0)
    assert np.median(nearest) < 0.2


def test_matches_tell_which_measurement_began_the_landmark(log, config, result):
    # Every measurement in its slot, padding elsewhere.
    np.testing.assert_array_equal(result.landmark_id == -3, result.row == -1)
    np.testing.assert_array_equal(np.sort(result.row[result.row >= 0]), np.arange(len(log.frame)))
    assert ((result.landmark_id >= -3) & (result.landmark_id < result.landmark_id.size)).all()
    frame, _ = np.nonzero(result.landmark_id >= 0)
    births = result.landmark_id[result.landmark_id >= 0]
    assert (births < frame * config.measurements).all()  # from an earlier frame
    # What is matched was measured there: a landmark's measurements are of one true landmark.
    began = result.row[np.divmod(births, config.measurements)]
    again = result.row[result.landmark_id >= 0]
    identity = log.truth.identity
    assert np.mean(identity[began] == identity[again]) > 0.95
    assert set(result.landmarks.id) <= set(births) | set(np.flatnonzero(result.landmark_id == -1))


def test_progress_is_told_from_the_start_to_the_end(log, result, calls):
    total = len(log.frame_time)
    assert calls[0] == (0, total, "") and calls[-1][:2] == (total, total)
    done = [d for d, *_ in calls]
    assert done == sorted(done) and {t for _, t, _ in calls} == {total}
    assert re.fullmatch(r"[\d.e+]+ steps/s, ESS \d+, \d+ landmarks, [\d.]+ GB", calls[-1][2])


def same(a, b):
    for name in ("pose", "cov", "ess", "match", "log_evidence", "dead_reckoning"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for one, two in zip(a.landmarks, b.landmarks, strict=True):
        np.testing.assert_array_equal(one, two)


def test_the_past_is_that_of_the_living(log, config, result):
    found, past = result.ancestral, result.lineage
    t, k = len(log.frame_time), config.measurements
    assert (found.pose.shape, found.cov.shape, found.distinct.shape) == ((t, 3), (t, 3, 3), (t,))
    assert (past.pose.shape, past.landmark_id.shape) == ((t, 3), (t, k))
    assert (np.diff(found.distinct) >= 0).all() and found.distinct[-1] <= config.particles
    assert found.distinct[0] == 1 < found.distinct[-1]
    true = log.truth.pose
    assert ate(found.pose, true, align=False)[0] < 1.1 * ate(result.pose, true, align=False)[0]
    np.testing.assert_allclose(found.pose[0], past.pose[0], atol=1e-6)
    # Most of what one particle took measurements for is what the best one did, frame by frame.
    assert np.mean(past.landmark_id == result.landmark_id) > 0.9
    np.testing.assert_array_equal(past.landmark_id == -3, result.row == -1)
    (line,) = result.advice
    assert line.startswith("all particles share one past up to ")
    assert result.refined is result.landmarks_refined is None


def test_a_chunks_length_changes_nothing(log, config, result, monkeypatch):
    # Eight frames hand over this much; one fewer fits.
    monkeypatch.setattr(compiled, "CHUNK_BYTES", 32 * (config.measurements + 4) * 30 - 1)
    other = run(log, config, seed=3)
    same(other, result)
    for one, two in zip(
        (*other.ancestral, *other.lineage), (*result.ancestral, *result.lineage), strict=True
    ):
        np.testing.assert_array_equal(one, two)


def test_a_genealogy_that_takes_too_much_memory_is_given_up(log, config, monkeypatch):
    monkeypatch.setattr(compiled, "TREE_BYTES", 1000)
    found = runner.run(log, config, seed=3)
    assert found.ancestral is found.lineage is found.refined is found.refine_seconds is None
    assert found.flags == []
    assert "too much memory" in found.advice[0]


def test_refining_is_told_and_comes_near_the_truth(log, result):
    calls = []
    found = refine_result(result, lambda *args: calls.append(args))
    assert len(calls) > 1 and {total for _, total in calls} == {None}
    assert found.refine_seconds > 0
    true = log.truth.pose
    better = ate(found.refined.pose, true, align=False)[0]
    assert better < 0.9 * ate(result.pose, true, align=False)[0]
    world = found.landmarks_refined
    assert world._fields == result.landmarks._fields
    assert world.mean.shape == (len(world.id), 2) and world.cov.shape == (len(world.id), 3)
    nearest = np.hypot(*(world.mean[:, None] - log.truth.landmarks).T).min(0)
    assert np.median(nearest) < 0.1


def test_one_seed_gives_the_same_bits_with_truth_or_without(log, config, result):
    same(result, run(replace(log, truth=None), config, seed=3))


def test_seeds_differ_and_agree_on_the_world(log, config, result):
    other = run(log, config, seed=4)
    assert not np.array_equal(other.pose, result.pose)
    assert np.abs(other.pose - result.pose)[:, :2].max() < 0.5


def test_far_from_the_origin_is_the_same(log, config, result):
    shift = np.array([1e5, -1e5, 0.0])
    far = run(replace(log, start_pose=log.start_pose + shift), config, seed=3)
    np.testing.assert_allclose(far.pose - shift, result.pose, atol=1e-3)
    np.testing.assert_allclose(far.dead_reckoning - shift, result.dead_reckoning, atol=1e-3)
    np.testing.assert_allclose(far.landmarks.mean - shift[:2], result.landmarks.mean, atol=1e-3)
    np.testing.assert_array_equal(far.landmark_id, result.landmark_id)


def test_what_was_lost_is_flagged(config, result):
    assert result.flags == []
    crowded = planar("room", 6, landmarks=120, length_m=12.0, rate_hz=2.0)
    full = run(replace(crowded, skipped={"not a number": 7}), config)
    lost = np.maximum(np.bincount(crowded.frame) - config.measurements, 0).sum()
    assert full.dropped == {"no measurement slot": lost}
    assert lost > 0 and (full.row >= 0).sum() == len(crowded.frame) - lost
    first = np.flatnonzero(full.overflow)[0]
    overflow = float(full.overflow.sum())
    assert full.flags == [
        f"{lost} measurements left out: no measurement slot",
        "7 rows skipped by the reader: not a number",
        f"the map was full from frame {first} on: {overflow:.1f} landmarks lost per particle; "
        "more than 30 landmark slots are needed",
    ]


def test_flags_of_what_went_wrong(log, result):
    nothing, frames = np.zeros(len(log.frame_time)), np.arange(len(log.frame_time))
    pose = np.array(result.pose)
    pose[4] = np.nan
    broken = replace(
        result, pose=pose, nonfinite=nothing + (frames == 2) * 9, degenerate=frames < 2
    )
    assert broken.flags == [
        "9 particle weights were not finite",
        "all weights were zero in 2 frames",
        "the pose estimate is not finite",
    ]


def test_known_identities_name_the_landmarks(log):
    config = config_for(log, association="known", particles=30)
    assert config.landmarks == len(np.unique(log.identity[log.identity >= 0]))
    result = runner.run(log, config)  # and refines
    clutter = int((log.identity < 0).sum())
    assert result.dropped["no identity"] == clutter > 0
    for world, most in ((result.landmarks, 0.5), (result.landmarks_refined, 0.3)):
        assert len(np.unique(world.identity)) == len(world.identity) > 10
        true = log.truth.landmarks[np.searchsorted(log.truth.landmark_id, world.identity)]
        assert np.hypot(*(world.mean - true).T).max() < most


def test_a_sensor_or_identities_that_the_log_lacks_are_named(log):
    only = replace(log, range=None, identity=None)
    said = []
    with pytest.raises(ValueError, match="sensor 'range_bearing' is not in this log; it has bear"):
        run(only, Config(**SIZES), progress=lambda *args: said.append(args))
    with pytest.raises(ValueError, match="'known' needs identities; this log has none"):
        run(only, Config(sensor="bearing", association="known", **SIZES))
    assert not said


def test_config_fits_the_log(log):
    fullest = np.bincount(log.frame).max()
    config = config_for(log)
    assert (config.sensor, config.measurements) == ("range_bearing", fullest)
    assert config.landmarks == Config().landmarks
    assert config_for(log, measurements=5, landmarks=7) == Config(measurements=5, landmarks=7)
    assert config_for(log, "position").sensor == "position"
    assert config_for(replace(log, range=None)).sensor == "bearing"
    points = np.column_stack([log.range, log.bearing])
    cov = np.tile([1.0, 0.0, 1.0], (len(points), 1))
    only_points = replace(log, range=None, bearing=None, point=points, point_cov=cov)
    assert config_for(only_points).sensor == "position"
    empty = replace(log, frame=np.empty(0, int), bearing=np.empty(0), range=np.empty(0),
                    identity=np.empty(0, int), truth=None)  # fmt: skip
    assert config_for(empty).measurements == 1
    assert config_for(empty, association="known").landmarks == 1
