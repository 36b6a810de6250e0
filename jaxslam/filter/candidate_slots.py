"""Select the slots that a frame can concern, once for all particles, from bounds on each slot.

A slot is left out only if in no particle it can be in view or match a measurement: the result is
that of using every slot.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter import new_landmarks, sharding
from jaxslam.models import geometry, sensors

FEW = 32  # slots are all candidates


class SlotBounds(NamedTuple):
    """Bounds on every slot over all particles: the box `low`, `high` [2, M] of means, the largest
    trace `spread` [M] of covariances, and whether any particle has `used` [M] it."""

    low: jax.Array
    high: jax.Array
    spread: jax.Array
    used: jax.Array


def bounds_of(world):
    """`SlotBounds` of landmarks [.., M, N]."""
    there = world.count > 0
    l11, l21, l22 = world.factor
    return SlotBounds(
        jnp.where(there, world.mean, jnp.inf).min(-1),
        jnp.where(there, world.mean, -jnp.inf).max(-1),
        jnp.where(there, l11 * l11 + l21 * l21 + l22 * l22, 0.0).max(-1),
        new_landmarks.occupied(world),
    )


def empty_bounds(config, dtype):
    """`SlotBounds` of no landmarks."""
    low = jnp.full((2, config.landmarks), jnp.inf, dtype)
    return SlotBounds(low, -low, jnp.zeros_like(low[0]), jnp.zeros(low.shape[1], bool))


def widen(bounds, world, slots):
    """Widen the bounds to more landmarks [.., S, n] in these slots [S]."""
    low, high, spread, used = bounds_of(world)
    at = bounds.low.at[:, slots], bounds.high.at[:, slots]
    return SlotBounds(
        at[0].min(low, mode="drop"),
        at[1].max(high, mode="drop"),
        bounds.spread.at[slots].max(spread, mode="drop"),
        bounds.used.at[slots].max(used, mode="drop"),
    )


def merge_devices(bounds, config):
    """Merge the devices' bounds into those of all particles."""
    used = jnp.where(bounds.used, -1.0, 0.0).astype(bounds.spread.dtype)
    low, high, spread, used = jnp.split(
        sharding.all_min(
            jnp.concatenate([bounds.low, -bounds.high, -bounds.spread[None], used[None]]), config
        ),
        [2, 4, 5],
    )
    return SlotBounds(low, -high, -spread[0], used[0] < 0)


def lift(bounds, new):
    """Remove the bounds of slots [M] with `new` landmarks, until these are next updated."""
    return SlotBounds(
        jnp.where(new, -jnp.inf, bounds.low),
        jnp.where(new, jnp.inf, bounds.high),
        jnp.where(new, jnp.inf, bounds.spread),
        bounds.used | new,
    )


def select_candidates(config, bounds, sensor_pose, measurements, ratios, params, extra):
    """Select candidate slots [M].

    `known`: the identities' slots, and if landmarks are forgotten all that may be in view. Bearings
    alone, `sampled` matches, and positions under the informed proposal: all slots in use. Else
    those that some particle may have in view or match: a log density is at most the log normaliser
    of the measurement's noise, minus half the square of the range's innovation over its variance.
    `ratios` [K, M]: log-likelihood ratios of appearance, or None. `extra`: largest variance that
    the pose adds to a range.
    """
    used = bounds.used
    if config.landmarks <= FEW and config.association != "known":
        return used
    slots = jnp.arange(len(used))
    known = config.association == "known"
    if known:
        identified = (measurements.identity[:, None] == slots) & measurements.valid[:, None]
        if not config.forgetting:
            return identified.any(0)
        used = used | identified.any(0)
    informed_position = config.sensor == "position" and config.proposal == "informed"
    if config.sensor == "bearing" or config.association == "sampled" or informed_position:
        return used
    x, y = sensor_pose[0], sensor_pose[1]
    ends = jnp.stack([x.min(), y.min(), -x.max(), -y.max(), -jnp.asarray(extra, x.dtype)])
    ends = sharding.all_min(ends, config)
    here_low, here_high, extra = ends[:2], -ends[2:4], -ends[4]
    gap = jnp.maximum(bounds.low - here_high[:, None], here_low[:, None] - bounds.high)
    nearest = jnp.hypot(*jnp.maximum(gap, 0.0)) * 0.9999
    concerns = ~(nearest >= params.view_range)  # NaN concerns
    if known:
        return (used & concerns) | identified.any(0)
    value, threshold = _thresholds(config, measurements, params)
    if config.sensor == "range_bearing":
        far, variance = value[:, 0], params.sigma_range**2
        normaliser = -jnp.log(params.sigma_range) - jnp.log(params.sigma_bearing)
    else:
        xx, xy, yy = (c * params.position_scale**2 for c in measurements.cov.T)
        far, variance = geometry.norm(*value.T), xx + yy
        normaliser = -0.5 * jnp.log(xx * yy - xy * xy)
    top = jnp.log1p(-params.outlier) - sensors.LOG_2PI + normaliser
    beyond = jnp.maximum(nearest - far[:, None], 0.0)
    variance = jnp.broadcast_to(variance, far.shape)[:, None] + bounds.spread + extra
    bound = jnp.broadcast_to(top, far.shape)[:, None] - 0.499 * beyond**2 / variance
    if ratios is not None:
        bound = bound + ratios
    matches = ~(bound <= threshold[:, None]) & measurements.valid[:, None]
    return used & (concerns | matches.any(0))


def _thresholds(config, measurements, params):
    """Values [K, 2], and log densities [K] that a match has to exceed."""
    new = sensors.log_new_density(config.sensor, tuple(measurements.value.T), params)
    clutter = sensors.log_clutter_density(config.sensor, params)
    return measurements.value, jnp.maximum(new, clutter) - 1e-3
