"""Weights of all particles: normalise them, estimate the pose."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter.xla import barrier
from jaxslam.models.geometry import wrap


class Estimate(NamedTuple):
    """`mean` pose [3] (m, m, rad), its `cov` [3, 3], and the `best` (heaviest) particle."""

    mean: jax.Array
    cov: jax.Array
    best: jax.Array


def weigh(log_weight, density):
    """Weigh particles by log densities [N] (eq. 5): normalised log weights, log evidence, and
    (number of new non-finite weights, whether none was finite)."""
    raw = barrier(log_weight + density)
    finite = jnp.isfinite(raw)
    # A particle that had no weight before is not counted again.
    nonfinite = jnp.sum(~finite & (log_weight > -jnp.inf))
    degenerate = ~finite.any()
    log_evidence = jax.nn.logsumexp(jnp.where(finite, raw, -jnp.inf))
    even = jnp.full_like(raw, -jnp.log(len(raw)))
    normalised = jnp.where(finite, raw - log_evidence, -jnp.inf)
    log_weight = barrier(jnp.where(degenerate, even, normalised))
    return log_weight, log_evidence, (nonfinite, degenerate)


def estimate_pose(pose, weight):
    """`Estimate` from poses [3, N] and weights [N]; the mean heading is circular."""
    # Sums, not matrix products: how these add up depends on the number of threads.
    x, y, heading = pose
    parts = jnp.stack([x, y, jnp.sin(heading), jnp.cos(heading)])
    x_mean, y_mean, s, c = barrier(parts * weight).sum(1)
    mean = jnp.stack([x_mean, y_mean, jnp.arctan2(s, c)])
    off = barrier(jnp.stack([x - mean[0], y - mean[1], wrap(heading - mean[2])]))
    cov = barrier(off[:, None] * (off * weight)).sum(2)
    return Estimate(mean, cov, jnp.argmax(weight))
