"""The genealogy tree against keeping every particle's whole past."""

import numpy as np
import pytest

from jaxslam.smoother.genealogy import Tree, smooth_ancestral, trace_lineage

N, K = 40, 3


def history(steps, resample_every, seed=0, n=N):
    """Poses [T, 3, n], births [T, K, n] and ancestors [T, n] of a made-up particle filter."""
    rng = np.random.default_rng(seed)
    pose = rng.normal(0, [[1.0], [2.0], [9.0]], (steps, 3, n)).astype(np.float32)
    landmark_id = rng.integers(-3, 99, (steps, K, n), np.int32)
    ancestors = np.tile(np.arange(n, dtype=np.int32), (steps, 1))
    if resample_every:
        chosen = ancestors[resample_every - 1 :: resample_every]
        chosen[:] = np.sort(rng.integers(0, n, chosen.shape), 1)
    return pose, landmark_id, ancestors


def grown(history, chunk):
    tree = Tree()
    for start in range(0, len(history[0]), chunk):
        tree.extend(*(part[start : start + chunk] for part in history))
    return tree


def all_pasts(pose, landmark_id, ancestors):
    """Every living particle's path [n, T, 3] and births [n, T, K], by following each one back."""
    place = np.arange(pose.shape[2])
    path, births = [], []
    for t in reversed(range(len(pose))):
        place = ancestors[t][place]
        path.append(pose[t][:, place].T)
        births.append(landmark_id[t][:, place].T)
    return np.stack(path[::-1], 1).astype(float), np.stack(births[::-1], 1)


@pytest.mark.parametrize("chunk", [1, 7, 64])
@pytest.mark.parametrize("resample_every", [0, 1, 5])
def test_the_tree_is_what_following_every_particle_back_gives(resample_every, chunk):
    told = history(50, resample_every)
    tree = grown(told, chunk)
    path, births = all_pasts(*told)
    log_weight = np.random.default_rng(1).normal(0, 2, N) + 1000.0
    log_weight[::4] = -np.inf
    found = smooth_ancestral(tree, log_weight)
    weight = np.exp(log_weight - 1000)
    weight /= weight.sum()
    turn = np.angle(np.einsum("n,nt->t", weight, np.exp(1j * path[..., 2])))
    np.testing.assert_allclose(found.pose[:, :2], np.einsum("n,ntc->tc", weight, path[..., :2]))
    np.testing.assert_allclose(np.exp(1j * found.pose[:, 2]), np.exp(1j * turn), atol=1e-9)
    off = path - found.pose
    off[..., 2] = np.angle(np.exp(1j * off[..., 2]))
    np.testing.assert_allclose(found.cov, np.einsum("n,nti,ntj->tij", weight, off, off), atol=1e-9)
    heavy = np.isfinite(log_weight)
    for t in range(50):
        assert found.distinct[t] == len(np.unique(path[heavy, t], axis=0))
        assert len(tree.pose[t]) == len(np.unique(path[:, t], axis=0))  # and nothing dead is kept
    for particle in (0, 7, N - 1):
        one = trace_lineage(tree, particle)
        np.testing.assert_array_equal(one.pose, path[particle])
        np.testing.assert_array_equal(one.landmark_id, births[particle])


def test_without_resampling_nothing_is_lost():
    tree = grown(history(30, 0), 7)
    assert tree.nodes == 30 * N
    assert (smooth_ancestral(tree, np.zeros(N)).distinct == N).all()


def test_memory_does_not_grow_as_steps_times_particles():
    n = 200
    stored = [grown(history(steps, 1, n=n), 32).nodes for steps in (500, 1000, 2000)]
    # Jacob, Murray and Rubenthaler: T nodes and a crown of the order of N log N.
    crown = np.array(stored) - [500, 1000, 2000]
    assert (crown < 2 * n * np.log(n)).all()
    assert stored[2] < 2000 * n / 50


def test_a_pose_that_is_not_a_number_has_no_weight_and_does_no_harm():
    pose, landmark_id, ancestors = history(4, 0)
    pose[:, :, 3] = np.nan
    log_weight = np.zeros(N)
    log_weight[3] = -np.inf
    found = smooth_ancestral(grown((pose, landmark_id, ancestors), 2), log_weight)
    assert np.isfinite(found.pose).all() and np.isfinite(found.cov).all()
    assert (found.distinct == N - 1).all()
