"""Particles redrawn from the refined past: the Gaussian, the draws, and whole runs."""

import dataclasses

import jax
import numpy as np
import pytest
from test_refine import births, room

from jaxslam import run
from jaxslam.config import Config
from jaxslam.filter import map_estimate
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.odometry import Odometry
from jaxslam.results.events import list_events
from jaxslam.results.metrics import compute_errors
from jaxslam.runs import compiled
from jaxslam.runs import run as runner
from jaxslam.simulation.planar import planar
from jaxslam.smoother import (
    least_squares,
    posterior_sampling,
    reassociation,
    refine,
    rejuvenation,
)
from jaxslam.smoother.events import DROPPED, FAILED, FOUND, MERGED


def odometry(distance):
    zero = np.zeros(len(distance))
    return Odometry(**dict.fromkeys(Odometry._fields, zero) | {"distance": np.array(distance)})


def test_it_is_due_after_metres_and_later_after_a_share_of_the_path():
    assert rejuvenation.due_frames(odometry([1.0] * 10), 3.0) == [3, 6, 9]
    assert rejuvenation.due_frames(odometry([1.0, 0.0, 0.0, 2.0, 5.0, 1.0]), 3.0) == [4, 5]
    assert rejuvenation.due_frames(odometry([1.0] * 10), 0.0) == []
    times = rejuvenation.due_frames(odometry([1.0] * 400), 3.0)
    assert times[0] == 3 and times[-1] - times[-2] == np.ceil(rejuvenation.GROWTH * times[-2]) > 10
    # Never at the very end, where nothing would come of it.
    assert rejuvenation.due_frames(odometry([1.0, 1.0, 1.0]), 3.0) == []


@pytest.fixture(scope="module")
def solved():
    """A refined past of bearings, and its problem."""
    log, data, params, true, _ = room("bearing", False)
    landmark_id, _ = births(log, data)
    with jax.enable_x64(True):
        problem, flat_index = least_squares.make_problem(
            data, log.start_pose, np.eye(3) * 1e-4, params, "bearing"
        )
        found = refine.solve_and_reassociate(
            problem, flat_index, true, landmark_id.ravel()[flat_index], False, again=True
        )
    return problem, found


def test_pose_and_points_are_those_of_the_whole_inverse(solved):
    """Against a dense inverse of the whole normal matrix, and of its part with the path given."""
    problem, found = solved
    fit = found.fit
    rows, which = reassociation.index_mapped(found.groups)
    size, poses = len(rows), 3 * len(fit.path)
    with jax.enable_x64(True):
        linear = least_squares._linearise(problem, fit.path, fit.points, which)
        normal = least_squares._assemble(
            problem, linear, fit.weight * problem.tempering, which, size, 0.0
        )
    whole = np.zeros((poses + 2 * size,) * 2)
    for t, block in enumerate(normal.diagonal):
        whole[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] = block
    for t, block in enumerate(normal.off):
        whole[3 * t : 3 * t + 3, 3 * t + 3 : 3 * t + 6] = block
        whole[3 * t + 3 : 3 * t + 6, 3 * t : 3 * t + 3] = block.T
    border = normal.border.toarray()
    whole[poses:, :poses], whole[:poses, poses:] = border, border.T
    for i, block in enumerate(normal.corner):
        at = slice(poses + 2 * i, poses + 2 * i + 2)
        whole[at, at] = block
    path = np.linalg.inv(whole)[:poses, :poses]
    # The points' means, given a path, are linear in it.
    slope = -np.linalg.solve(whole[poses:, poses:], border)
    linear = np.vstack([np.eye(poses)[-3:], slope])
    expected = linear @ path @ linear.T
    got = posterior_sampling.covariance(fit)
    assert np.abs(got - expected).max() < 1e-6 * np.abs(expected).max()
    # With what each point has of its own, the points' marginal.
    marginal = got[3:, 3:] + np.linalg.inv(whole[poses:, poses:])
    assert np.allclose(marginal, fit.factor.points, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("sensor", ["bearing", "range_bearing"])
def test_drawn_particles_have_the_moments_asked_for(sensor):
    config = Config(sensor=sensor, particles=40_000, landmarks=4, association="known")
    config = dataclasses.replace(config, forgetting=True)
    joint, draw = posterior_sampling.empty_joint(4), np.random.default_rng(0)
    root = np.tril(0.02 * draw.normal(size=(7, 7))).astype(np.float32)
    index = np.array([0, 1, 2, 3, 4, 7, 8])  # slots 0 and 2
    joint.root[index[:, None], np.arange(7)] = root
    joint.pose[:] = 1.0, -2.0, 3.1
    joint.kind[[0, 2, 3]] = (
        posterior_sampling.POINT,
        posterior_sampling.POINT,
        posterior_sampling.UNKNOWN_DEPTH,
    )
    joint.mean[:, [0, 2]] = np.array([[3.0, 1.0], [-1.0, 2.0]]).T
    joint.anchor[:, [0, 2]] = np.array([[1.0, 0.5], [0.2, -1.0]]).T
    joint.factor[:, [0, 2]] = np.array([[0.03, 0.01, 0.02], [0.05, -0.02, 0.01]]).T
    joint.mean[:, 3], joint.anchor[:, 3], joint.factor[:, 3] = (
        (0.4, 0.5),
        (-0.3, 0.1),
        (0.1, 0, 0.2),
    )
    joint.count[[0, 2, 3]], joint.landmark_id[[0, 2, 3]] = (5, 6, 7), (10, 20, 30)
    state = posterior_sampling.draw_state(
        jax.random.key(1), joint._replace(used=np.int32(7)), 12, config
    )
    assert state.step == 12 and np.allclose(np.exp(state.log_weight).sum(), 1)
    pose, world = np.asarray(state.pose, float), jax.tree.map(np.asarray, state.landmarks)
    assert (np.abs(pose[2]) <= np.pi + 1e-6).all()
    off = np.vstack([pose - joint.pose[:, None]])
    off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
    assert world.count[:, 0].tolist() == [5, 0, 6, 7]
    assert world.landmark_id[:, 0].tolist() == [10, 0, 20, 30]
    for slot in (0, 2):
        mean = world.mean[:, slot].astype(float)
        if sensor == "bearing":
            ray = np.stack([np.cos(mean[0]), np.sin(mean[0])]) / mean[1]
            mean = world.anchor[:, slot] + ray
            _, cov, known = map_estimate.to_world("bearing", world)
            l11, l21, l22 = joint.factor[:, slot]
            exact = l11**2, l11 * l21, l21**2 + l22**2
            assert known[slot].all()
            assert np.allclose([part[slot].mean() for part in cov], exact, rtol=0.02, atol=1e-5)
        else:
            assert (world.factor[:, slot] == joint.factor[:, slot, None]).all()
        off = np.vstack([off, mean - joint.mean[:, slot, None]])
    cov = off @ off.T / off.shape[1]
    expected = root @ root.T
    assert np.abs(off.mean(1)).max() < 5 * np.sqrt(np.diag(expected).max() / 40_000)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((cov - expected) / scale).max() < 0.03
    if sensor == "bearing":  # what has no depth goes with the pose
        c, s = np.cos(pose[2]), np.sin(pose[2])
        assert np.allclose(world.anchor[0, 3], pose[0] + c * -0.3 - s * 0.1, atol=1e-5)
        turned = world.mean[0, 3] - pose[2] - 0.4
        assert np.abs(np.sin(turned)).max() < 1e-5 and (world.mean[1, 3] == 0.5).all()


@pytest.fixture(scope="module")
def log():
    return planar(
        "room", 3, landmarks=20, length_m=20.0, speed=0.5, rate_hz=2.5, odometry_hz=5,
        sigma_bearing=0.0175, detection=0.95, outlier=0.01, view=(-np.pi, np.pi, 6.0),
    )  # fmt: skip


SETTINGS = dict(sensor="bearing", particles=200, landmarks=48)


@pytest.fixture(scope="module")
def found(log):
    return run(log, runner.config_for(log, **SETTINGS), seed=1)


def test_hidden_bearings_become_the_map(log, found):
    got = compute_errors(found)
    assert got["ate_refined_rmse_m"] < 0.05
    assert got["landmarks_refined_missed"] <= 1 and got["landmarks_refined_spurious"] <= 1
    assert got["association_accuracy"] > 0.9
    # The filter's own map, too: it is redrawn from the refined one.
    assert got["ate_filtered_rmse_m"] < 0.15
    plain = dataclasses.replace(found.config, rejuvenate=0.0)
    plain = run(log, plain, seed=1, refine=False)
    assert plain.events is None


def test_events_say_what_became_of_the_map(found):
    done, kind, label, into = found.events.T
    assert set(done) <= set(rejuvenation.due_frames(frames_from_log(
        found.log, found.config, found.params).odometry, found.config.rejuvenate))  # fmt: skip
    held = set()
    for which, a, b in zip(kind, label, into, strict=True):
        assert (a in held) == (which != FOUND) or which == MERGED
        assert (b >= 0) == (which == MERGED)
        (held.add if which == FOUND else held.discard)(a)
    assert {*kind} <= {MERGED, DROPPED, FOUND} and len(held) >= 15


def test_the_past_is_whole(found):
    frames = len(found.time)
    assert found.lineage.pose.shape == (frames, 3)
    assert found.lineage.landmark_id.shape == found.landmark_id.shape
    assert found.ancestral.pose.shape == (frames, 3)
    assert np.isfinite(found.ancestral.cov).all()
    assert (np.linalg.eigvalsh(found.ancestral.cov)[:, 0] > -1e-9).all()
    assert found.ancestral.distinct[0] == found.config.particles


def test_maps_that_disagree_are_said_to_be_warped(found):
    assert not any("warped" in line for line in found.advice)
    bent = found.landmarks._replace(mean=found.landmarks.mean + 0.5)
    (line,) = [x for x in dataclasses.replace(found, landmarks=bent).advice if "warped" in x]
    assert line.startswith("the filter's map and the refined one differ by 0.7")


def test_a_past_that_cannot_be_refined_stays(log, found, monkeypatch):
    def fail(*_, **__):
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    monkeypatch.setattr(refine, "solve_and_reassociate", fail)
    without = run(log, found.config, seed=1, refine=False)
    assert without.events[:, 1].tolist() == [FAILED] * len(without.events) != []
    assert any("could not be refined" in line for line in without.advice)
    monkeypatch.undo()
    solved, times = refine.solve_and_reassociate, []

    def fail_at_last(*problem, **told):
        times.append(0)
        return (fail if len(times) == len(without.events) else solved)(*problem, **told)

    monkeypatch.setattr(refine, "solve_and_reassociate", fail_at_last)
    last = run(log, found.config, seed=1, refine=False)
    assert np.sum(last.events[:, 1] == FAILED) == 1
    assert last.ancestral.cov.shape == (len(last.time), 3, 3)
    monkeypatch.undo()
    plain = dataclasses.replace(found.config, rejuvenate=0.0)
    assert np.array_equal(without.pose, run(log, plain, seed=1, refine=False).pose)
    assert {"failed": True} in [event.get("rejuvenated") for event in list_events(without)]


def same(one, other):
    for name in ("pose", "cov", "log_evidence", "match", "landmarks", "lineage", "events"):
        parts = jax.tree.leaves(getattr(one, name)), jax.tree.leaves(getattr(other, name))
        for a, b in zip(*parts, strict=True):
            assert np.array_equal(a, b), name


def test_chunks_make_no_difference(log, found, monkeypatch):
    monkeypatch.setattr(compiled, "CHUNK", 7)
    same(found, run(log, found.config, seed=1, refine=False))


def test_it_goes_on_from_a_checkpoint_with_the_same_bits(log, found, tmp_path):
    from jaxslam.runs import checkpoints

    class Stopped(checkpoints.Checkpoints):
        def save_if_due(self, at, total, line):
            super().save_if_due(at, total, line)
            if at.done >= total // 2:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Stopped(tmp_path / "run", 0.0, False, False) as kept:
        run(log, found.config, seed=1, refine=False, checkpoints=kept)
    with checkpoints.Checkpoints(tmp_path / "run", 0.0, True, False) as kept:
        again = run(log, found.config, seed=1, refine=False, checkpoints=kept)
    same(found, again)


def test_known_identities_can_be_rejuvenated(log):
    settings = SETTINGS | dict(association="known", landmarks=20, rejuvenate=3.0)
    got = compute_errors(run(log, runner.config_for(log, **settings), seed=2))
    assert got["ate_refined_rmse_m"] < 0.05
    assert got["landmarks_refined_matched"] >= 19


@pytest.mark.parametrize("sensor", ["range_bearing", "position"])
@pytest.mark.slow
def test_points_can_be_rejuvenated(log, sensor):
    settings = SETTINGS | dict(sensor=sensor, rejuvenate=3.0)
    got = compute_errors(run(log, runner.config_for(log, **settings), seed=2))
    assert got["ate_refined_rmse_m"] < 0.06
    assert got["landmarks_refined_missed"] <= 1


def test_landmarks_without_a_slot_are_counted(log):
    result = run(log, runner.config_for(log, **SETTINGS | dict(landmarks=8)), seed=1)
    assert result.overflow.sum() > 0
    assert any("the map was full" in line for line in result.flags)
