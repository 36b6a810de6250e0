"""The batch reference (GTSAM) against an independent least-squares solution of the same problem."""

from dataclasses import replace

import batch
import numpy as np
import pytest
import worlds
from scipy.optimize import least_squares

from jaxslam import config_for, default_params
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.odometry import moments
from jaxslam.logs.truth import truth_at, wrap
from jaxslam.simulation.planar import planar


@pytest.fixture
def log():
    """A short drive of little clutter, the sensor off the robot's centre and turned."""
    noise = dict(sigma_bearing=0.02, err_tran=0.05, err_rot=0.05, err_drift=0.05)
    return planar(
        seed=3, landmarks=8, length_m=3.0, odometry_hz=10, rate_hz=5, outlier=0.0, detection=1.0,
        view=(-np.pi, np.pi, 30.0), mounting=(0.2, -0.1, 0.5), floor_tran=0.01, floor_rot=0.01,
        landmark_extent=0.03, start_cov=np.diag([0.01, 0.02, 0.03]) ** 2, **noise,
    )  # fmt: skip


def independent(log, params, variance, weight):
    """Robot poses and landmarks by SciPy, with residuals of its own, for given weights.

    The chain is in the robot's poses here, in the sensor's there; `moments` is the motion's closed
    form, here in the frame at the intervals' start.
    """
    data = frames_from_log(log, config_for(log, "bearing", "known"), params)
    frame, slot = np.nonzero(data.measurements.valid)
    who, bearing = data.measurements.identity[frame, slot], data.measurements.value[frame, slot, 0]
    mean, cov = moments(data.odometry, params)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    count, (mx, my, yaw) = len(mean), log.mounting
    start, cut = np.diag(1 / np.sqrt(np.diag(log.start_cov))), [3 * count + 3]

    def residuals(values):
        pose, points = (
            values[: 3 * count + 3].reshape(-1, 3),
            values[3 * count + 3 :].reshape(-1, 2),
        )
        c, s = np.cos(pose[:-1, 2]), np.sin(pose[:-1, 2])
        dx, dy, turn = np.diff(pose, axis=0).T
        step = np.column_stack([c * dx + s * dy, c * dy - s * dx, turn]) - mean
        step[:, 2] = wrap(step[:, 2])
        x, y, heading = pose[1:][frame].T
        c, s = np.cos(heading), np.sin(heading)
        dx, dy = points[who, 0] - (x + c * mx - s * my), points[who, 1] - (y + s * mx + c * my)
        off = wrap(np.arctan2(dy, dx) - heading - yaw - bearing)
        first = start @ (pose[0] - log.start_pose)
        moved = (whiten @ step[:, :, None]).ravel()
        return np.concatenate([first, moved, off * np.sqrt(weight / variance)])

    pose = np.vstack([log.start_pose, truth_at(log.truth, data.time)])
    begin = np.concatenate([pose.ravel(), log.truth.landmarks[data.identities].ravel()])
    found = least_squares(residuals, begin, xtol=1e-12, ftol=1e-12, gtol=1e-10).x
    return found[3 : cut[0]].reshape(-1, 3), found[cut[0] :].reshape(-1, 2)


def test_same_solution_as_scipy(log):
    pytest.importorskip("gtsam", reason="GTSAM is not installed: the optional reference")
    params = default_params("bearing", log)._replace(outlier=0.02, correlation=0.0)
    wrong = log.bearing.copy()
    wrong[5] += 1.0  # one outlier
    log = replace(log, bearing=wrong)
    found = batch.solve(log, params, rounds=50)
    assert found.settled
    data = frames_from_log(log, config_for(log, "bearing", "known"), params)
    frame, slot = np.nonzero(data.measurements.valid)
    who = data.measurements.identity[frame, slot]
    sensor = batch.compose(found.pose, batch.mounting(params))
    square = ((found.landmarks[who] - sensor[frame, :2]) ** 2).sum(1)
    variance = params.sigma_bearing**2 + params.landmark_extent**2 / square
    pose, landmarks = independent(log, params, variance, found.weight)
    np.testing.assert_allclose(found.pose[:, :2], pose[:, :2], atol=2e-3)
    np.testing.assert_allclose(wrap(found.pose[:, 2] - pose[:, 2]), 0, atol=2e-3)
    np.testing.assert_allclose(found.landmarks, landmarks, atol=5e-3)
    assert np.argmin(found.weight) == 5
    assert found.weight[5] < 1e-3
    assert np.sort(found.weight)[1] > 0.5


def test_gains_reach_the_chain_and_a_wrong_one_costs(log):
    pytest.importorskip("gtsam", reason="GTSAM is not installed: the optional reference")
    params = default_params("bearing", log)
    right, wrong = (batch.solve(log, params._replace(gain_rot=gain)) for gain in (1.0, 0.5))
    assert wrong.cost > right.cost + 1


def test_room_shows_the_nearest():
    log = worlds.room(0, length_m=4.0)
    assert np.all(np.bincount(log.frame) == worlds.NEAREST)
    pose = truth_at(log.truth, log.frame_time)
    distance = np.hypot(*(log.truth.landmarks[None] - pose[:, None, :2]).transpose(2, 0, 1))
    for t, each in enumerate(distance):
        assert set(log.identity[log.frame == t]) == set(np.argsort(each)[: worlds.NEAREST])
    off = log.truth.landmarks[log.identity] - pose[log.frame, :2]
    error = wrap(np.arctan2(off[:, 1], off[:, 0]) - pose[log.frame, 2] - log.bearing)
    assert 0.9 < error.std() / np.radians(1) < 1.1
