"""Standard errors: their parts against what is known exactly, and their verdicts."""

import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.learning import fit as learn
from jaxslam.learning import transforms, uncertainty
from jaxslam.parameters import TABLE, default_params

INFORMATION = np.array([[40.0, 10.0], [10.0, 20.0]])


def test_noise_of_the_particles_is_no_information():
    """Scores of the data alone have the information; each seed adds noise of its own, as large."""
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(INFORMATION / 100)
    logs, seeds, steps = 60, 4, 100
    told = rng.standard_normal((logs, 1, steps, 2)) @ root.T
    noisy = told + rng.standard_normal((logs, seeds, steps, 2)) @ root.T
    found = uncertainty.outer_products(noisy) / logs
    np.testing.assert_allclose(found, INFORMATION, rtol=0.15, atol=1)
    plain = np.einsum("lstp,lstq->pq", noisy, noisy) / logs / seeds
    assert plain[0, 0] > 1.7 * INFORMATION[0, 0]


def test_slope_of_a_score_that_is_linear():
    widths = np.array([0.1, 0.2])
    rng = np.random.default_rng(1)
    offset = rng.standard_normal((5, 2))  # of each seed, the same on both sides
    low, high = (
        np.array([-(INFORMATION @ (side * w * axis)) + offset
                  for w, axis in zip(widths, np.eye(2), strict=True)])
        for side in (-1, 1)
    )  # fmt: skip
    slope, noise = uncertainty.curvature_at(low, high, widths)
    np.testing.assert_allclose(slope, INFORMATION, rtol=1e-12)
    assert noise.max() < 1e-12


def test_a_newton_step_ends_at_the_root_but_goes_no_farther_than_two_errors():
    error = np.sqrt(np.diag(np.linalg.inv(INFORMATION)))
    near = np.array([0.05, -0.1])  # within two errors
    np.testing.assert_allclose(
        uncertainty.newton_step(INFORMATION, INFORMATION @ near), near, rtol=0.02
    )
    far = uncertainty.newton_step(INFORMATION, INFORMATION @ np.array([3.0, 0.0]))
    assert far[0] == pytest.approx(2 * error[0], rel=0.02)


def test_both_agree_or_the_sandwich():
    nothing = np.zeros((2, 2))
    covariance, agreement, made = uncertainty.combine_covariances(INFORMATION, INFORMATION, nothing)
    assert made == "both"
    np.testing.assert_allclose(covariance, np.linalg.inv(INFORMATION), rtol=0.02)
    np.testing.assert_allclose(agreement, 1, rtol=1e-12)
    # Scores four times as varied as the slope tells: the estimate's errors are twice as large.
    covariance, agreement, made = uncertainty.combine_covariances(
        4 * INFORMATION, INFORMATION, nothing
    )
    assert made == "sandwich"
    np.testing.assert_allclose(covariance, 4 * np.linalg.inv(INFORMATION), rtol=0.03)
    np.testing.assert_allclose(agreement, 0.5, rtol=0.02)
    # A slope that few seeds leave open says nothing against the outer products.
    lost = np.full((2, 2), 30.0)
    covariance, _, made = uncertainty.combine_covariances(INFORMATION, -INFORMATION, lost)
    assert made == "outer"
    np.testing.assert_allclose(covariance, np.linalg.inv(INFORMATION), rtol=0.02)


def test_combinations_that_a_log_leaves_open_are_named():
    names = ("err_rot", "err_drift", "sigma_range")
    # The sum of the first two is known well, their difference hardly.
    axis = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    other = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    information = 0.2 * np.outer(axis, axis) + 100 * np.outer(other, other)
    information[2, 2] = 400.0
    verdict, sentences = uncertainty.judge(names, uncertainty.invert(information), np.ones(3))
    assert verdict == (
        "not resolved (with err_drift)", "not resolved (with err_rot)", "resolved",
    )  # fmt: skip
    (sentence,) = sentences
    assert sentence.startswith("not resolved: err_rot with err_drift (the log turns too little")
    verdict, sentences = uncertainty.judge(names, np.diag([0.01, 0.2, 0.01]), np.array([1, 1, 4]))
    assert verdict == ("resolved", "weak", "the two standard errors disagree")
    assert not sentences


def test_what_nothing_is_known_of_stays_finite():
    covariance = uncertainty.invert(np.diag([25.0, 0.0]))
    assert covariance[1, 1] == pytest.approx(uncertainty.PRIOR**2)
    assert covariance[0, 0] == pytest.approx(0.04, rel=0.01)
    widths = uncertainty.half_widths(np.diag([25.0, 0.0]))
    np.testing.assert_allclose(widths, [0.1, 0.25], rtol=0.01)


def test_the_step_after_a_fit_is_taken_on_the_free_scale():
    params = default_params()._replace(err_rot=0.1, mount_yaw=0.0)
    names, none = ("err_rot", "mount_yaw"), np.empty(0)
    free = transforms.free_vector(params, names)
    fit = learn.Fit(
        names, params, params, free, learn.History(*[none] * 8), "done", Config(), 0, 1, 0.0
    )
    one = np.ones(2)
    errors = uncertainty.Uncertainty(
        names, free, np.eye(2), one, one, one, np.eye(2), np.eye(2), one, "both",
        np.array([np.log(2), 0.5]), 0.1, {}, ("weak", "weak"), (),
    )  # fmt: skip
    found = uncertainty.improve(fit, errors).params
    assert found.err_rot == pytest.approx(0.2)
    assert found.mount_yaw == pytest.approx(0.5 * TABLE["mount_yaw"].step)
    assert found.err_drift == params.err_drift
