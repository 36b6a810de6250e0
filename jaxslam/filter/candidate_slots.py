"""Which slots a frame can concern: judged once, for all particles together, before any of them
looks at a landmark.

Every slot has bounds that hold for all its particles. A slot is passed over only if in no particle
it can be in view, nor match any measurement: the result is that of looking at every slot.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter import new_landmarks, sharding
from jaxslam.models import geometry, sensors

FEW = 32  # slots are all looked at


class SlotBounds(NamedTuple):
    """Of every slot: the box `low`, `high` [2, M] of its means, the largest trace `spread` [M] of
    their covariances, and whether any particle has `used` [M] it. Never too narrow."""

    low: jax.Array
    high: jax.Array
    spread: jax.Array
    used: jax.Array


def bounds_of(world):
    """`Bounds` of these landmarks [.., M, N]."""
    there = world.count > 0
    l11, l21, l22 = world.factor
    return SlotBounds(
        jnp.where(there, world.mean, jnp.inf).min(-1),
        jnp.where(there, world.mean, -jnp.inf).max(-1),
        jnp.where(there, l11 * l11 + l21 * l21 + l22 * l22, 0.0).max(-1),
        new_landmarks.occupied(world),
    )


def empty_bounds(config, dtype):
    """`Bounds` of no landmarks at all."""
    low = jnp.full((2, config.landmarks), jnp.inf, dtype)
    return SlotBounds(low, -low, jnp.zeros_like(low[0]), jnp.zeros(low.shape[1], bool))


def widen(bounds, world, slots):
    """The bounds, wide enough for more landmarks [.., S, n] in these slots [S]."""
    low, high, spread, used = bounds_of(world)
    at = bounds.low.at[:, slots], bounds.high.at[:, slots]
    return SlotBounds(
        at[0].min(low, mode="drop"),
        at[1].max(high, mode="drop"),
        bounds.spread.at[slots].max(spread, mode="drop"),
        bounds.used.at[slots].max(used, mode="drop"),
    )


def merge_devices(bounds, config):
    """The bounds that hold on every device, from its own."""
    used = jnp.where(bounds.used, -1.0, 0.0).astype(bounds.spread.dtype)
    low, high, spread, used = jnp.split(
        sharding.all_min(
            jnp.concatenate([bounds.low, -bounds.high, -bounds.spread[None], used[None]]), config
        ),
        [2, 4, 5],
    )
    return SlotBounds(low, -high, -spread[0], used[0] < 0)


def lift(bounds, born):
    """The bounds without any for slots [M] in which landmarks were `born`, until next looked at."""
    return SlotBounds(
        jnp.where(born, -jnp.inf, bounds.low),
        jnp.where(born, jnp.inf, bounds.high),
        jnp.where(born, jnp.inf, bounds.spread),
        bounds.used | born,
    )


def select_candidates(config, bounds, sensor_pose, measurements, alike, params, extra):
    """Slots [M] that some particle's look may concern.

    `known`: those named, and if landmarks are forgotten all that may be in view. Bearings alone
    reach any distance, and what is `sampled` may be drawn at any: all slots in use (also with
    positions under the informed proposal). Else those that
    some particle may have in view or match. A density is at most the normaliser of the
    measurement's own noise, less half the square of the range's innovation over its variance.
    `alike` [K, M]: log likelihood ratios of looks, or None. `extra`: variance that the pose adds to
    a range, at most.
    """
    used = bounds.used
    if config.landmarks <= FEW and config.association != "known":
        return used
    slots = jnp.arange(len(used))
    known = config.association == "known"
    if known:
        named = (measurements.identity[:, None] == slots) & measurements.valid[:, None]
        if not config.forgetting:
            return named.any(0)
        used = used | named.any(0)
    informed_position = config.sensor == "position" and config.proposal == "informed"
    if config.sensor == "bearing" or config.association == "sampled" or informed_position:
        return used
    x, y = sensor_pose[0], sensor_pose[1]
    ends = jnp.stack([x.min(), y.min(), -x.max(), -y.max(), -jnp.asarray(extra, x.dtype)])
    ends = sharding.all_min(ends, config)
    here_low, here_high, extra = ends[:2], -ends[2:4], -ends[4]
    gap = jnp.maximum(bounds.low - here_high[:, None], here_low[:, None] - bounds.high)
    nearest = jnp.hypot(*jnp.maximum(gap, 0.0)) * 0.9999
    concerns = ~(nearest >= params.view_range)  # what is not a number concerns
    if known:
        return (used & concerns) | named.any(0)
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
    if alike is not None:
        bound = bound + alike
    matches = ~(bound <= threshold[:, None]) & measurements.valid[:, None]
    return used & (concerns | matches.any(0))


def _thresholds(config, measurements, params):
    """Values [K, 2], and log densities [K] that a match has to beat."""
    new = sensors.log_new_density(config.sensor, tuple(measurements.value.T), params)
    clutter = sensors.log_clutter_density(config.sensor, params)
    return measurements.value, jnp.maximum(new, clutter) - 1e-3
