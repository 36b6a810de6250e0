"""The informed proposal and drawn associations: derivatives, exact answers, and the prior proposal
with very many particles."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_exact import START, START_COV, problem

from jaxslam.config import SENSORS, Config
from jaxslam.filter import proposal
from jaxslam.filter import step as fastslam
from jaxslam.filter.association import CLUTTER, NEW
from jaxslam.logs.odometry import Odometry
from jaxslam.models import motion, sensors
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params

ODOMETRY = Odometry(0.3, 0.05, 0.2, 0.32, 0.25, 0.5, 0.4, 0.1)


@pytest.mark.parametrize("sensor", SENSORS)
def test_rows_are_the_derivatives_by_the_motions_normals(x64, sensor):
    params = default_params(sensor)._replace(mount_x=0.2, mount_y=-0.1, mount_yaw=0.3)
    before = (0.4, -0.3, 0.7)
    mean = (0.9, 0.35) if sensor == "bearing" else (2.0, 1.5)
    anchor = (-0.6, 0.2) if sensor == "bearing" else None

    def pose_of(u):
        return motion.sample(before, ODOMETRY, params, u)

    def predicted(u):
        sensor_pose = sensors.sensor_pose_of(pose_of(u), params)
        return jnp.stack(sensors.observe(sensor, sensor_pose, mean, anchor, params).value)

    zero = jnp.zeros(3)
    sensor_pose = sensors.sensor_pose_of(pose_of(zero), params)
    axes = proposal.motion_axes(before, pose_of(zero), sensor_pose, ODOMETRY, params)
    found = proposal.pose_jacobian(sensor, sensor_pose, axes, mean, anchor, predicted(zero))
    np.testing.assert_allclose(np.array(found), jax.jacobian(predicted)(zero), atol=1e-12)


def test_the_normal_after_updates_is_bayes_rule(x64):
    rng = np.random.default_rng(0)
    n, count = 4, 5
    h, rest = rng.normal(size=(count, 3, n)), rng.normal(size=(count, n))
    variance = rng.uniform(0.01, 2.0, (count, n))
    zero, one = jnp.zeros(n), jnp.ones(n)
    whitened = proposal.Whitened(
        (zero,) * 3, ((one, zero, zero), (zero, one, zero), (zero, zero, one)), zero
    )
    for k in range(count):
        matched = jnp.asarray(k != 2)
        whitened = proposal._update(whitened, tuple(h[k]), rest[k], variance[k], matched)
    for i in range(n):
        used = [0, 1, 3, 4]
        information = np.eye(3) + sum(
            np.outer(h[k, :, i], h[k, :, i]) / variance[k, i] for k in used
        )
        cov = np.linalg.inv(information)
        mean = cov @ sum(h[k, :, i] * rest[k, i] / variance[k, i] for k in used)
        root = np.array(whitened.root)[..., i]
        np.testing.assert_allclose(np.array(whitened.mean)[:, i], mean, atol=1e-12)
        np.testing.assert_allclose(root @ root.T, cov, atol=1e-12)
        assert whitened.log_det[i] == pytest.approx(0.5 * np.log(np.linalg.det(cov)), abs=1e-12)


def enumerated(
    odometry, measurements, params, steps, begin=(START[:2], START_COV[:2, :2]), identified=False
):
    """log Z of every association there can be [B], each by a joint Kalman filter.

    A measurement is of any landmark begun so far that no other of its frame is of, or begins one,
    or is clutter. `begin`: mean and covariance of the start's position and of a given map.
    `identified`: of the landmark of its identity or clutter, or new if there is none yet.
    """
    new = np.log1p(-params.outlier) + np.log(params.density_new)
    clutter = float(sensors.log_clutter_density("position", params))
    heading = START[2] + np.concatenate([[0.0], np.cumsum(odometry.dtheta)])
    branches = [(0.0, *begin)]
    for t in range(steps):
        o = Odometry(*(float(part[t]) for part in odometry))
        angle = heading[t] + np.arctan2(o.dy, o.dx)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        floor = params.floor_tran**2 * o.duration
        noise = turn @ np.diag([params.err_tran**2 * o.distance + floor, floor]) @ turn.T
        c, s = np.cos(heading[t + 1]), np.sin(heading[t + 1])
        rotation = np.array([[c, s], [-s, c]])
        ks, grown = np.flatnonzero(measurements.valid[t]), []
        for log_z, mean, cov in branches:
            mean, cov = mean.copy(), cov.copy()
            mean[:2] += turn @ [params.gain_tran * np.hypot(o.dx, o.dy), 0]
            cov[:2, :2] += noise
            known = len(mean) // 2 - 1
            options = [[*range(known), NEW, CLUTTER]] * len(ks)
            if identified:
                own = measurements.identity[t, ks]
                options = [[i, CLUTTER] if i < known else [NEW] for i in own]
            for choice in product(*options):
                taken = [c for c in choice if c >= 0]
                if len(set(taken)) == len(taken):
                    grown.append(branch(log_z, mean, cov, choice, ks, t, rotation, measurements,
                                        params, new, clutter))  # fmt: skip
        branches = grown
    return np.array([log_z for log_z, *_ in branches])


def branch(log_z, mean, cov, choice, ks, t, rotation, measurements, params, new, clutter):
    for k, slot in zip(ks, choice, strict=True):
        z = measurements.value[t, k]
        xx, xy, yy = measurements.cov[t, k] * params.position_scale**2
        noise = np.array([[xx, xy], [xy, yy]])
        if slot == CLUTTER:
            log_z += clutter
        elif slot == NEW:
            log_z += new
            size = len(mean)
            grow = np.vstack([np.eye(size), np.eye(2, size)])
            mean = np.concatenate([mean, mean[:2] + rotation.T @ z])
            cov = grow @ cov @ grow.T
            cov[size:, size:] += rotation.T @ noise @ rotation
        else:
            h = np.zeros((2, len(mean)))
            h[:, 2 * slot + 2 : 2 * slot + 4], h[:, :2] = rotation, -rotation
            rest, s = z - h @ mean, h @ cov @ h.T + noise
            gain = cov @ h.T @ np.linalg.inv(s)
            log_z += np.log1p(-params.outlier) - 0.5 * (
                rest @ np.linalg.solve(s, rest) + np.log(np.linalg.det(2 * np.pi * s))
            )
            mean, cov = mean + gain @ rest, cov - gain @ h @ cov
    return log_z, mean, cov


@pytest.mark.parametrize("kind", ["prior", "informed"])
def test_drawn_associations_give_the_evidence_of_all(x64, kind):
    odometry, measurements, params = problem()
    steps, runs = 3, 30_000
    odometry, measurements = jax.tree.map(lambda leaf: leaf[:steps], (odometry, measurements))
    params = params._replace(outlier=0.2, density_new=0.05, view_range=4.0)
    config = Config(
        sensor="position", association="sampled", proposal=kind, particles=6, landmarks=6,
        measurements=2, resample_threshold=0.7, forgetting=False,
    )  # fmt: skip
    log_z = np.logaddexp.reduce(enumerated(odometry, measurements, params, steps))
    data = jax.tree.map(jnp.asarray, (odometry, measurements, params))

    @jax.jit
    @jax.vmap
    def evidence(key):
        start_key, key = jax.random.split(key)
        state = fastslam.init(config, start_key, START, START_COV)
        state, info = fastslam.run(key, state, *data, config)
        mixed = (info.match[-1, 0] != info.match[-1, 0, 0]).any()
        return info.log_evidence.sum(), info.overflow.sum(), mixed, info.log_choice.min()

    found = evidence(jax.random.split(jax.random.key(5), runs))
    log_zhat, overflow, mixed, log_choice = map(np.asarray, found)
    assert overflow.sum() == 0 and mixed.mean() > 0.3 and log_choice.min() < -1
    ratio = np.exp(log_zhat - log_z)
    error = ratio.std() / np.sqrt(runs)
    assert abs(ratio.mean() - 1) < 4 * error and error < 0.01


def drive_among_marks(sensor, steps=5):
    """Odometry, measurements of four landmarks, parameters, and the landmarks as a given map."""
    rng, marks = np.random.default_rng(2), np.array([[2, 1], [1, -1.5], [3, -0.5], [-1, 1.5]])
    k, ahead, turn = len(marks), np.full(steps, 0.4), np.full(steps, 0.25)
    full = np.full(steps, 1.0)
    odometry = Odometry(ahead, 0 * full, turn, ahead, turn, full, full / 2, full / 12)
    params = default_params(sensor)._replace(
        err_tran=0.15, err_rot=0.2, err_drift=0.1, sigma_bearing=0.04, landmark_extent=0.0,
        sigma_range=0.1, correlation=0.0, extra_bearing_noise=0.0,
    )  # fmt: skip
    pose, values = np.zeros(3), []
    for t in range(steps):
        row = Odometry(*(part[t] for part in odometry))
        pose = np.array(motion.sample(pose, row, params, rng.normal(size=3)))
        off = marks - pose[:2]
        bearing = np.arctan2(off[:, 1], off[:, 0]) - pose[2] + 0.04 * rng.normal(size=k)
        r = np.hypot(*off.T) + 0.1 * rng.normal(size=k)
        columns = (bearing, np.zeros(k)) if sensor == "bearing" else (r, bearing)
        values.append(np.stack(columns, 1))
    identity = np.tile(np.arange(k, dtype=np.int32), (steps, 1))
    measurements = Measurements(
        np.array(values), np.zeros((steps, k, 3)), identity, identity >= 0, full > 0
    )
    factor = np.tile([[0.02], [0.0], [0.02]], (1, k))
    given = marks.T, factor
    if sensor == "bearing":
        polar = np.stack([np.arctan2(*marks.T[::-1]), 1 / np.hypot(*marks.T)])
        given = polar, factor, np.zeros((2, k))
    return (odometry, measurements, params), given


@pytest.mark.parametrize("sensor", ["bearing", "range_bearing"])
@pytest.mark.slow
def test_few_informed_particles_agree_with_very_many_of_the_prior(x64, sensor):
    """Where nothing is linear: evidence Z and mean pose within what sampling allows.

    E[Zhat] = Z and E[Zhat mean] = Z E[x | data] for any number of particles: many runs of few
    particles are as good as one of very many.
    """
    data, given = drive_among_marks(sensor)
    data, k = jax.tree.map(jnp.asarray, data), given[0].shape[1]

    def runs(kind, count):
        config = Config(
            sensor=sensor, association="known", proposal=kind, particles=250, landmarks=k,
            measurements=k, clutter=False, resample_threshold=0.5,
        )  # fmt: skip

        def one(key):
            state = fastslam.init(config, key, landmarks_given=given)
            state, info = fastslam.run(key, state, *data, config)
            return info.log_evidence.sum(), info.estimate.mean[-1], info.ess.mean()

        keys = jax.random.split(jax.random.key(1), count)
        log_z, pose, ess = map(np.array, jax.jit(lambda keys: jax.lax.map(one, keys))(keys))
        return log_z, pose, ess.mean()

    def averages(log_z, pose):
        """log Z and the mean pose, and their standard errors."""
        ratio = np.exp(log_z - log_z.max())
        share = ratio / ratio.mean()
        mean = (share[:, None] * pose).mean(0)
        root = np.sqrt(len(share))
        error = share.std() / root, (share[:, None] * (pose - mean)).std(0) / root
        return log_z.max() + np.log(ratio.mean()), mean, *error

    (prior_z, prior_pose, prior_ess) = runs("prior", 1200)
    (informed_z, informed_pose, ess) = runs("informed", 60)
    one, other = averages(prior_z, prior_pose), averages(informed_z, informed_pose)
    error, spread = np.hypot(one[2], other[2]), np.hypot(one[3], other[3])
    assert abs(one[0] - other[0]) < 4 * error and error < 0.1
    assert (np.abs(one[1] - other[1]) < 4 * spread + 1e-4).all()
    assert spread.max() < 0.01
    # The prior with as few particles is far worse: it is not all the same.
    assert prior_z.std() > 2 * informed_z.std() and prior_ess < ess / 2
