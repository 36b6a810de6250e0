"""The filter against exact answers: with the heading known, SLAM is linear and Gaussian.

A joint Kalman filter over the position and all landmarks then gives the marginal likelihood Z and
the posterior means. For any number of particles E[Zhat] = Z and E[Zhat mean] = Z E[x | data], so
a few particles and many runs make a sharp test.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter import step as fastslam
from jaxslam.models.motion import Odometry, model
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params

STEPS, RUNS, LANDMARKS = 6, 10_000, 3
START = np.array([0.3, -0.2, 0.4])
START_COV = np.diag([0.04, 0.09, 0.0])


def problem():
    """Odometry, measurements and parameters of a short drive past three landmarks."""
    rng = np.random.default_rng(3)
    dtheta = rng.uniform(-0.5, 0.5, STEPS)
    step = rng.uniform(0.2, 0.5, (STEPS, 2)) * [1, 0.2]
    distance = np.hypot(*step.T)
    odometry = Odometry(
        step[:, 0],
        step[:, 1],
        dtheta,
        distance,
        np.abs(dtheta),
        np.full(STEPS, 0.5),
        np.full(STEPS, 0.5),
        np.full(STEPS, 1 / 12),
    )
    valid = rng.uniform(size=(STEPS, 2)) < 0.9
    identity = np.array([rng.permutation(LANDMARKS)[:2] for _ in range(STEPS)], np.int32)
    world = rng.uniform(-1, 3, (LANDMARKS, 2))
    heading = START[2] + np.cumsum(dtheta)
    position = START[:2] + np.cumsum(step, 0)
    rotation = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    offset = world[identity] - position[:, None]
    value = np.einsum("ijt,tkj->tki", rotation, offset) + rng.normal(size=(STEPS, 2, 2)) * 0.3
    cov = np.tile([0.09, 0.02, 0.06], (STEPS, 2, 1))
    measurements = Measurements(value, cov, identity, valid, np.ones(STEPS, bool))
    params = default_params("position")._replace(
        err_tran=0.4, err_rot=0.0, err_drift=0.0, floor_tran=0.25, floor_rot=0.0, correlation=0.0
    )
    return odometry, measurements, params


def kalman(odometry, measurements, params):
    """log Z, and the posterior mean of position and landmarks, by a joint Kalman filter."""
    mean, cov = START[:2].copy(), START_COV[:2, :2].copy()
    slot, heading, log_z = {}, START[2], 0.0
    for t in range(STEPS):
        o = Odometry(*(float(part[t]) for part in odometry))
        angle = heading + np.arctan2(o.dy, o.dx)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        along = params.err_tran**2 * o.distance + params.floor_tran**2 * o.duration
        mean[:2] += turn @ [np.hypot(o.dx, o.dy), 0]
        cov[:2, :2] += turn @ np.diag([along, params.floor_tran**2 * o.duration]) @ turn.T
        heading += o.dtheta
        rotate = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        for k in np.flatnonzero(measurements.valid[t]):
            z, (xx, xy, yy) = measurements.value[t, k], measurements.cov[t, k]
            noise, i = np.array([[xx, xy], [xy, yy]]), int(measurements.identity[t, k])
            if i not in slot:
                slot[i] = len(mean)
                grow = np.vstack([np.eye(len(mean)), np.eye(2, len(mean))])
                mean = np.concatenate([mean, mean[:2] + rotate @ z])
                cov = grow @ cov @ grow.T
                cov[-2:, -2:] += rotate @ noise @ rotate.T
                log_z += np.log(params.density_new)
                continue
            h = np.zeros((2, len(mean)))
            h[:, :2], h[:, slot[i] : slot[i] + 2] = -rotate.T, rotate.T
            innovation = z - h @ mean
            s = h @ cov @ h.T + noise
            gain = cov @ h.T @ np.linalg.inv(s)
            log_z += -0.5 * (
                innovation @ np.linalg.solve(s, innovation) + np.log(np.linalg.det(2 * np.pi * s))
            )
            mean, cov = mean + gain @ innovation, cov - gain @ h @ cov
    landmarks = np.array([mean[slot[i] : slot[i] + 2] for i in range(LANDMARKS)])
    return log_z, np.concatenate([mean[:2], landmarks.ravel()])


@pytest.mark.parametrize(
    ("threshold", "proposal"),
    [(0.0, "prior"), (0.5, "prior"), (0.0, "informed"), (1.0, "informed")],
)
def test_evidence_and_means_against_a_joint_kalman_filter(x64, threshold, proposal):
    odometry, measurements, params = problem()
    config = Config(
        sensor="position",
        association="known",
        proposal=proposal,
        particles=10,
        landmarks=LANDMARKS,
        measurements=2,
        resample_threshold=threshold,
        clutter=False,
    )
    log_z, expected = kalman(odometry, measurements, params)
    data = jax.tree.map(jnp.asarray, (odometry, measurements, params))

    @jax.jit
    @jax.vmap
    def runs(key):
        start_key, key = jax.random.split(key)
        state = fastslam.init(config, start_key, START, START_COV)
        state, info = fastslam.run(key, state, *data, config)
        state = fastslam.settle(state, config)
        weight = jnp.exp(state.log_weight)
        mean = jnp.concatenate([state.pose[:2] @ weight, (state.landmarks.mean @ weight).T.ravel()])
        return info.log_evidence.sum(), mean, info.resampled.sum()

    log_zhat, mean, resampled = map(
        np.asarray, runs(jax.random.split(jax.random.key(int(10 * threshold)), RUNS))
    )
    assert (resampled.mean() > 1) == (threshold > 0)
    ratio = np.exp(log_zhat - log_z)
    # Every quantity's mean is normal over so many runs; 4.2 is one in ten thousand for the dozen.
    assert abs((ratio.mean() - 1) / (ratio.std() / np.sqrt(RUNS))) < 4.2
    off = ratio[:, None] * (mean - expected)
    z = off.mean(0) / (off.std(0) / np.sqrt(RUNS))
    assert np.abs(z).max() < 4.2
    # It is sharp, too: a few per cent of Z, or a few centimetres, would be seen.
    assert ratio.std() / np.sqrt(RUNS) < 0.04
    assert (off.std(0) / np.sqrt(RUNS)).max() < 0.04


def test_model_of_the_oracle_is_the_filters(x64):
    odometry, _, params = problem()
    noise = model(Odometry(*(part[0] for part in odometry)), params)
    assert noise.var_heading == 0
    assert float(noise.var_rest) == pytest.approx(params.floor_tran**2 * 0.5, rel=1e-12)
