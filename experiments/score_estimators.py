"""Scores that are compared with Fisher's: `pathwise` and `plain` differentiation of the filter.

`plain` is what automatic differentiation of the filter gives: the weights after resampling are
constants, so it is biased, whatever the number of particles. `pathwise`: the weights keep their
derivative through resampling (Scibior and Wood 2021, "Differentiable particle filtering without
modifying the forward pass"). In both the paths move with the parameters. No derivative flows
through the choice of ancestors. Used by experiments/gradients.py and by tests/learning.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp

from jaxslam.filter import blocks
from jaxslam.filter import step as fastslam
from jaxslam.learning import likelihood

ESTIMATORS = ("fisher", "pathwise", "plain")


def score(params, data, key, config, names, estimator="fisher", discount=likelihood.DISCOUNT):
    """`likelihood.Score` of `Data` by any of the `ESTIMATORS`; `discount` is `fisher`'s alone.

    Not compiled. Raises `ValueError` for an estimator that is not there.
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator: {estimator!r} is not one of {', '.join(ESTIMATORS)}")
    if estimator == "fisher":
        fisher = likelihood.score_and_value.__wrapped__
        return fisher(params, data, key, config, names, discount)
    of = partial(_log_evidence, params, data, key, config, names, estimator == "pathwise")
    at = jnp.array([getattr(params, name) for name in names])
    steps, (log_evidence, ess) = jax.jacfwd(of, has_aux=True)(at)
    return likelihood.Score(steps.sum(0), log_evidence.sum(), steps, log_evidence, ess.min())


def _log_evidence(params, data, key, config, names, keep, values):
    """Log evidence [T] of every step, and as auxiliary output the same with the effective sample
    sizes [T]; `keep`: weights keep their derivative through resampling."""
    params = params._replace(**dict(zip(names, values, strict=True)))
    config = dataclasses.replace(config, lazy=False)
    start, key = jax.random.split(key)
    hold = jax.lax.stop_gradient

    def step(state, frame):
        chance = likelihood.draw_for_frame(key, state.step, config)
        seen = blocks.observe(state, chance, *frame, params, config)
        after, info = fastslam.weigh_and_resample(chance, *hold((state, seen)), frame[1], config)
        log_weight = state.log_weight + seen.density
        # What has no weight has no say, not even as 0 times NaN.
        alive = jnp.exp(info.log_weight) > 0
        log_weight = jnp.where(alive, log_weight, -jnp.inf)
        log_evidence = jax.nn.logsumexp(log_weight)
        own = log_weight - log_evidence
        slope = jnp.where(alive & (keep | ~info.resampled), own - hold(own), 0.0)  # 0 by value
        pose, world, slope = jax.tree.map(
            lambda leaf: leaf[..., info.ancestors], (seen.pose, seen.landmarks, slope)
        )
        after = after._replace(pose=pose, landmarks=world, log_weight=after.log_weight + slope)
        log_evidence += likelihood.frame_terms(frame[1], params)
        return after, (log_evidence, info.ess)

    state = fastslam.init(config, start, data.start_pose, data.start_cov, data.landmarks_given)
    _, found = jax.lax.scan(step, state, (data.odometry, data.measurements))
    return found[0], found
