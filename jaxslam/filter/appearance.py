"""How landmarks look: descriptors as one more likelihood of a match.

The filter keeps one look a slot for all particles, that of the best particle's associations: a
slot is one place. Looks are compared by the coordinates of `descriptors.space`, of variance 1 over
the log and `within` for one landmark. A landmark's own coordinate is normal with variance
1 - `within` over the landmarks, so that a match is as many times likelier than chance as its
predictive density is larger than that of any row. One never seen before says nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter.association import NEW
from jaxslam.filter.xla import barrier, ordered_sum

CHANGED = 0.1  # probability that a landmark looks like any other: something else is behind it
LATEST = 8.0  # sightings that a look is the mean of, at most: light and background change


class Appearances(NamedTuple):
    """Of every slot: the `mean` [J, M] coordinates of the landmark with this `landmark_id` [M], and their
    `weight` [M], the sightings it is the mean of (0: none)."""

    mean: jax.Array
    weight: jax.Array
    landmark_id: jax.Array


def empty(config, dtype):
    """`Looks` of no landmarks; None where there are no descriptors."""
    if not config.descriptors:
        return None
    slots = config.landmarks
    mean = jnp.zeros((config.descriptors, slots), dtype)
    return Appearances(mean, jnp.zeros(slots, dtype), jnp.full(slots, -1, jnp.int32))


def log_likelihood_ratio(looks, measurements):
    """Log likelihood ratios [K, M]: of the measurements' looks under every slot over that under
    none."""
    found = measurements.descriptor[:, :, None]
    own = measurements.within[:, None]
    # Of the landmark's own coordinate, given the sightings: normal around zero beforehand.
    precision = 1 / (1 - own) + looks.weight / own
    centre = looks.mean * (looks.weight / own) / precision
    variance = own + 1 / precision
    parts = found**2 - (found - centre) ** 2 / variance - jnp.log(variance)
    ratio = 0.5 * ordered_sum(jnp.moveaxis(parts, 1, 0))
    return barrier(jnp.logaddexp(jnp.log1p(-CHANGED) + ratio, jnp.log(CHANGED)))


def update_appearances(looks, match, landmark_id, free, number, measurements):
    """`Looks` after a frame: of the best particle's slots `match` [K] (negative: none), and the
    `landmark_id` [K] of what is in them. What is new has taken the slots `free` [K], in order, in the
    step of this `number` (`births.create`)."""
    new, total = (match == NEW) & measurements.valid, len(match)
    nth = jnp.cumsum(new) - 1
    match = jnp.where(new, free[jnp.maximum(nth, 0)], match)
    landmark_id = jnp.where(new, number * total + jnp.arange(total), landmark_id)
    here = (match[:, None] == jnp.arange(looks.mean.shape[1])) & measurements.valid[:, None]
    born = jnp.where(here, landmark_id[:, None], -(2**31)).max(0)
    seen = here.any(0)
    weight = jnp.where(seen & (born != looks.landmark_id), 0.0, looks.weight)
    more = ordered_sum(here.astype(weight.dtype))
    total = ordered_sum(here[:, None] * measurements.descriptor[:, :, None])
    mean = (weight * looks.mean + total) / jnp.maximum(weight + more, 1.0)
    return Appearances(
        barrier(jnp.where(seen, mean, looks.mean)),
        barrier(jnp.minimum(weight + more, LATEST)),
        jnp.where(seen, born, looks.landmark_id),
    )


def clear_slots(looks, slots):
    """`Looks` with nothing of these slots [M], where there are new landmarks."""
    return looks._replace(weight=jnp.where(slots, 0.0, looks.weight))


def reorder_slots(looks, landmark_id):
    """`Looks` of a map whose slots hold the landmarks of these births [M]; those not found begin
    anew."""
    same = (landmark_id[:, None] == looks.landmark_id) & (looks.weight > 0)
    at = jnp.argmax(same, 1)
    weight = jnp.where(same.any(1), looks.weight[at], 0.0)
    return Appearances(looks.mean[:, at], weight, landmark_id.astype(jnp.int32))
