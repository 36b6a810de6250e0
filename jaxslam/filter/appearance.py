"""Appearance of landmarks: descriptors as one more likelihood of a match.

All particles share one appearance per slot, which follows the best particle's matches.
Descriptors are compared in the coordinates of `logs/appearance_space.py`, of variance 1 over the
log and `within` for one landmark. A landmark's mean coordinate is normal with variance 1 - `within`
over the landmarks; the likelihood ratio of a match is its predictive density over that of a
measurement of any landmark. A new landmark has the ratio 1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter.association import NEW
from jaxslam.filter.xla import barrier, ordered_sum

CHANGED = 0.1  # probability of an unrelated appearance, as when the background is another
LATEST = 8.0  # measurements averaged, at most: light and background change


class Appearances(NamedTuple):
    """Appearance in every slot: `mean` [J, M] coordinates of the landmark `landmark_id` [M], and
    `weight` [M], the number of measurements averaged (0: none)."""

    mean: jax.Array
    weight: jax.Array
    landmark_id: jax.Array


def empty(config, dtype):
    """`Appearances` of no landmarks; None where there are no descriptors."""
    if not config.descriptors:
        return None
    slots = config.landmarks
    mean = jnp.zeros((config.descriptors, slots), dtype)
    return Appearances(mean, jnp.zeros(slots, dtype), jnp.full(slots, -1, jnp.int32))


def log_likelihood_ratio(appearances, measurements):
    """Log-likelihood ratios [K, M] of the measurements' descriptors under every slot."""
    descriptor = measurements.descriptor[:, :, None]
    within = measurements.within[:, None]
    # Of the landmark's mean coordinate, given its measurements; the prior's mean is zero.
    precision = 1 / (1 - within) + appearances.weight / within
    centre = appearances.mean * (appearances.weight / within) / precision
    variance = within + 1 / precision
    parts = descriptor**2 - (descriptor - centre) ** 2 / variance - jnp.log(variance)
    ratio = 0.5 * ordered_sum(jnp.moveaxis(parts, 1, 0))
    return barrier(jnp.logaddexp(jnp.log1p(-CHANGED) + ratio, jnp.log(CHANGED)))


def update_appearances(appearances, match, landmark_id, free, number, measurements):
    """Average a frame's descriptors into the slots that the best particle matches: `Appearances`.

    `match`, `landmark_id` [K]: as in `step.Info`. New landmarks have taken the slots `free` [K], in
    order, in the step of this `number` (`new_landmarks.create`).
    """
    new, total = (match == NEW) & measurements.valid, len(match)
    nth = jnp.cumsum(new) - 1
    match = jnp.where(new, free[jnp.maximum(nth, 0)], match)
    landmark_id = jnp.where(new, number * total + jnp.arange(total), landmark_id)
    here = (match[:, None] == jnp.arange(appearances.mean.shape[1])) & measurements.valid[:, None]
    matched_id = jnp.where(here, landmark_id[:, None], -(2**31)).max(0)
    seen = here.any(0)
    weight = jnp.where(seen & (matched_id != appearances.landmark_id), 0.0, appearances.weight)
    more = ordered_sum(here.astype(weight.dtype))
    total = ordered_sum(here[:, None] * measurements.descriptor[:, :, None])
    mean = (weight * appearances.mean + total) / jnp.maximum(weight + more, 1.0)
    return Appearances(
        barrier(jnp.where(seen, mean, appearances.mean)),
        barrier(jnp.minimum(weight + more, LATEST)),
        jnp.where(seen, matched_id, appearances.landmark_id),
    )


def clear_slots(appearances, slots):
    """Clear the `Appearances` of these slots [M], where there are new landmarks."""
    return appearances._replace(weight=jnp.where(slots, 0.0, appearances.weight))


def reorder_slots(appearances, landmark_id):
    """`Appearances` of a map whose slots hold the landmarks `landmark_id` [M]; empty where that is
    not among them."""
    same = (landmark_id[:, None] == appearances.landmark_id) & (appearances.weight > 0)
    at = jnp.argmax(same, 1)
    weight = jnp.where(same.any(1), appearances.weight[at], 0.0)
    return Appearances(appearances.mean[:, at], weight, landmark_id.astype(jnp.int32))
