"""The exact identity E[Zhat grad log Zhat] = grad Z, for any number of particles.

With the heading known SLAM is linear and Gaussian, so the evidence Z of hidden associations is a
sum of Kalman filters over all of them. Both E[Zhat] = Z and the identity are exact: over many runs
of four particles the mean of Zhat (score - grad log Z) is zero, for the right score alone.
"""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import score_estimators
import test_exact
from test_proposal import enumerated

from jaxslam.config import Config
from jaxslam.filter import association
from jaxslam.learning import likelihood
from jaxslam.logs.odometry import Odometry
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params

NAMES = ("err_tran", "floor_tran", "gain_tran", "position_scale", "outlier", "density_new")
START, START_COV = np.array([0.3, -0.2, 0.4]), np.diag([0.02, 0.03, 0.0])
NOISE, KNOWN_TO = 0.3, 0.1  # m
MARKS = np.array([1.6, 0.4]) + 2 * NOISE * np.array([[0, 0], [0, 1], [0.75**0.5, 0.5]])
GIVEN = MARKS[:2].T, np.tile([[KNOWN_TO], [0.0], [KNOWN_TO]], (1, 2))
QUICK, FULL = 10_000, 400_000  # runs
RESAMPLE = 0.8  # of the particles
OF = ((0,), (1, 2), (2,), (2,))  # the landmark of each frame's measurements
PARAMS = default_params("position")._replace(
    err_tran=0.3, floor_tran=0.15, err_rot=0.0, err_drift=0.0, floor_rot=0.0, gain_tran=1.1,
    correlation=0.0, extra_bearing_noise=0.0, outlier=0.1, density_new=0.03, view_range=2.5,
)  # fmt: skip


def problem():
    """`Data` of a drive past three landmarks two sigma apart, of which two are nearly known.

    Whether the third is taken for new decides how well later frames fit.
    """
    rng, steps = np.random.default_rng(2), len(OF)
    full, ahead, turn = np.ones(steps), np.full(steps, 0.4), np.full(steps, 0.3)
    odometry = Odometry(ahead, 0 * full, turn, ahead, turn, full, full / 2, full / 12)
    value, valid = np.zeros((steps, 2, 2)), np.zeros((steps, 2), bool)
    heading, place = START[2], START[:2].copy()
    for t, marks in enumerate(OF):
        place += 0.4 * np.array([np.cos(heading), np.sin(heading)]) + 0.2 * rng.normal(size=2)
        heading += 0.3
        c, s = np.cos(heading), np.sin(heading)
        for k, mark in enumerate(marks):
            off = MARKS[mark] - place
            value[t, k] = np.array([[c, s], [-s, c]]) @ off + NOISE * rng.normal(size=2)
            valid[t, k] = True
    cov = np.tile(NOISE**2 * np.array([1.0, 0.0, 1.0]), (steps, 2, 1))
    identity = np.array([(*marks, -1)[:2] for marks in OF], np.int32)
    measurements = Measurements(value, cov, identity, valid, full > 0)
    return likelihood.Data(START, START_COV, odometry, measurements, GIVEN)


def exact(data, params, identified=False):
    """log Z, and the log probability of every association there can be."""
    mean = np.concatenate([START[:2], GIVEN[0].T.ravel()])
    cov = np.diag([*np.diag(START_COV)[:2], *[KNOWN_TO**2] * 4])
    odometry, measurements = data.odometry, data.measurements
    branches = enumerated(odometry, measurements, params, len(OF), (mean, cov), identified)
    log_z = np.logaddexp.reduce(branches)
    # No more new landmarks than there were: a Poisson process over the view, at every frame.
    area = (params.view_max - params.view_min) * params.view_range**2 / 2
    return log_z - len(OF) * params.density_new * area, branches - log_z


def exact_gradient(data, identified=False, step=1e-5):
    """Derivatives of log Z by `NAMES`, as central differences."""
    found = []
    for name in NAMES:
        value = getattr(PARAMS, name)
        more, less = (PARAMS._replace(**{name: value * (1 + s)}) for s in (step, -step))
        rise = exact(data, more, identified)[0] - exact(data, less, identified)[0]
        found.append(rise / (2 * step * value))
    return np.array(found)


def off_by(oracle, proposal, estimator, runs, association="sampled"):
    """z [P + 1] of the means of Zhat / Z (score - grad log Z) and of Zhat / Z - 1, and their
    standard errors in units of |grad log Z| and of 1."""
    config = Config(
        sensor="position", association=association, proposal=proposal, particles=4, landmarks=7,
        measurements=2, resample_threshold=RESAMPLE, forgetting=False,
    )  # fmt: skip
    data, log_z, gradient = oracle
    data, params = jax.tree.map(jnp.asarray, (data, PARAMS))

    def one(key):
        # Not the jitted function, whose trace may be from before something was replaced.
        found = score_estimators.score(params, data, key, config, NAMES, estimator, 1.0)
        return found.log_likelihood, found.total, found.min_ess

    many = jax.jit(lambda keys: jax.lax.map(one, keys, batch_size=2000))
    log_zhat, score, ess = map(np.asarray, many(jax.random.split(jax.random.key(1), runs)))
    ratio = np.exp(log_zhat - log_z)[:, None]
    off = np.hstack([ratio * (score - gradient), ratio - 1])
    size = np.abs([*gradient, 1.0])
    # A score may be the same in every run; the differences are good to this.
    error = np.maximum(off.std(0) / np.sqrt(runs), 1e-8 * size)
    assert np.mean(ess < RESAMPLE * 4) > 0.7  # most runs resampled
    return off.mean(0) / error, error / size


@pytest.fixture(scope="module")
def oracle():
    data = problem()
    return data, exact(data, PARAMS)[0], exact_gradient(data)


@pytest.fixture
def without_association_score(monkeypatch):
    """As if weights alone depended on the parameters: derivatives flow into the draws' shares."""
    monkeypatch.setattr(association, "stop_gradient", lambda value: value)


def test_the_problem_is_one_of_hidden_associations():
    data = problem()
    _, log_share = exact(data, PARAMS)
    entropy = -np.sum(np.exp(log_share) * log_share)
    assert entropy / data.measurements.valid.sum() > 0.3
    near = np.linalg.norm(MARKS[:, None] - MARKS, axis=-1)[np.triu_indices(3, 1)]
    np.testing.assert_allclose(near, 2 * NOISE)


@pytest.mark.parametrize("proposal", ["prior", "informed"])
def test_fisher_with_discount_1_is_exact(x64, oracle, proposal):
    z, error = off_by(oracle, proposal, "fisher", QUICK)
    assert np.abs(z).max() < 4
    assert error.max() < 0.06  # sharp


@pytest.mark.slow
def test_plain_differentiation_is_rejected(x64, oracle):
    z, _ = off_by(oracle, "prior", "plain", QUICK)
    assert np.abs(z[:-1]).max() > 8 and abs(z[-1]) < 4


@pytest.mark.slow
def test_without_the_associations_score_it_is_rejected(x64, oracle, without_association_score):
    z, _ = off_by(oracle, "prior", "fisher", QUICK)
    assert np.abs(z[:-1]).max() > 8 and abs(z[-1]) < 4


def test_known_identities_and_drawn_clutter_are_exact(x64):
    data = problem()
    log_z, _ = exact(data, PARAMS, True)
    z, error = off_by(
        (data, log_z, exact_gradient(data, True)), "informed", "fisher", QUICK, "known"
    )
    assert np.abs(z).max() < 4
    assert error.max() < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["prior", "informed"])
def test_fisher_is_exact_over_very_many_runs(x64, oracle, proposal):
    z, error = off_by(oracle, proposal, "fisher", FULL)
    assert np.abs(z).max() < 4
    assert error.max() < 0.03


@pytest.mark.slow
def test_plain_differentiation_of_the_informed_proposal_is_rejected(x64, oracle):
    z, _ = off_by(oracle, "informed", "plain", FULL)
    assert np.abs(z[:-1]).max() > 8 and abs(z[-1]) < 4


@pytest.mark.slow
def test_without_the_associations_score_the_informed_proposal_is_rejected(
    x64, oracle, without_association_score
):
    z, _ = off_by(oracle, "informed", "fisher", FULL)
    assert np.abs(z[:-1]).max() > 8 and abs(z[-1]) < 4


def test_the_experiments_kalman_filter_is_the_other_one(x64):
    experiment = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "gradients.py"))
    odometry, measurements, params = test_exact.problem()
    data = likelihood.Data(test_exact.START, test_exact.START_COV, odometry, measurements)
    gain, scale = 1.1, 1.3
    area = (params.view_max - params.view_min) * params.view_range**2 / 2
    log_z, _ = test_exact.kalman(
        odometry._replace(dx=gain * odometry.dx, dy=gain * odometry.dy),
        measurements._replace(cov=scale**2 * measurements.cov),
        params,
    )
    given = params._replace(gain_tran=gain, position_scale=scale)
    found = experiment["kalman"](given, jax.tree.map(jnp.asarray, data), test_exact.LANDMARKS)
    expected = log_z - test_exact.STEPS * params.density_new * area
    assert float(found) == pytest.approx(expected, rel=1e-12)
