"""Estimate of the map over all particles: Cartesian means and covariances of landmarks."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter import sharding
from jaxslam.filter.xla import barrier
from jaxslam.models import geometry


class LandmarkTable(NamedTuple):
    """One map for all particles, in M slots: world `mean` [2, M] (m), `cov` [3, M] (xx, xy, yy),
    `count`, `landmark_id`, and whether it is `kept`: occupied, confirmed, and of known depth."""

    mean: jax.Array
    cov: jax.Array
    count: jax.Array
    landmark_id: jax.Array
    kept: jax.Array


@partial(jax.jit, static_argnames="config")
def summarise(world, weight, best, params, config):
    """`LandmarkTable` of particle `best`, each landmark averaged over all particles that hold it.

    The covariance is the mixture's: the mean of the particles' own, plus the spread of their means.
    """
    shared = sharding.replicated((best, params))
    specs = sharding.particle_sharded(world), sharding.particle_sharded(weight), *shared
    summary = sharding.shard_map(partial(_summarise, config=config), specs, sharding.ALL, config)
    return summary(world, weight, best, params)


def _summarise(world, weight, best, params, config):
    best_map = sharding.select_particle(world, best, config)
    centre, _, depth_known = to_world(config.sensor, best_map)
    confirmed = True if best_map.log_odds is None else best_map.log_odds >= params.existence_confirm

    slots, lane = jnp.arange(len(best_map.landmark_id)), jnp.arange(len(weight))

    def average(landmark_id, centre):
        # New landmarks of one frame may be in other slots where a particle had more of them.
        same = (world.landmark_id == landmark_id) & (world.count > 0)
        at = jnp.where(same, slots[:, None], -1).max(0)
        row = jax.tree.map(lambda leaf: leaf[..., jnp.maximum(at, 0), lane], world)
        row, share = sharding.all_gather((row, weight * (at >= 0)), config)
        point, cov, known = to_world(config.sensor, row)
        share = jnp.where(known, share, 0)
        # A barrier: fused with what precedes, sums would be rounded by the number of devices.
        share = barrier(share / barrier(share).sum())
        dx, dy = (jnp.where(known, p - c, 0) for p, c in zip(point, centre, strict=True))
        mx, my = barrier(jnp.stack([share * dx, share * dy])).sum(1)
        spread = ((dx - mx) ** 2, (dx - mx) * (dy - my), (dy - my) ** 2)
        parts = [
            jnp.where(share > 0, share * (own + between), 0)
            for own, between in zip(cov, spread, strict=True)
        ]
        return jnp.stack([centre[0] + mx, centre[1] + my]), barrier(jnp.stack(parts)).sum(1)

    mean, cov = jax.lax.map(
        lambda args: average(*args), (best_map.landmark_id, jnp.stack(centre, -1))
    )
    kept = (best_map.count > 0) & confirmed & depth_known
    return LandmarkTable(mean.T, cov.T, best_map.count, best_map.landmark_id, kept)


def to_world(sensor, world):
    """World points (x, y), covariances (xx, xy, yy) and whether depths are known, of every slot.

    An inverse depth counts as known when it is three standard deviations from zero.
    """
    if sensor != "bearing":
        return (
            tuple(world.mean),
            geometry.covariance(world.factor),
            jnp.full(world.count.shape, True),
        )
    (angle, depth), (pp, pd, dd) = world.mean, geometry.covariance(world.factor)
    known = depth > 3 * jnp.sqrt(dd)
    depth = jnp.where(known, depth, 1.0)
    c, s = jnp.cos(angle), jnp.sin(angle)
    # Columns of the Jacobian: by direction, by inverse depth.
    ax, ay, bx, by = -s / depth, c / depth, -c / depth**2, -s / depth**2
    cov = (
        ax * ax * pp + 2 * ax * bx * pd + bx * bx * dd,
        ax * ay * pp + (ax * by + ay * bx) * pd + bx * by * dd,
        ay * ay * pp + 2 * ay * by * pd + by * by * dd,
    )
    return (world.anchor[0] + c / depth, world.anchor[1] + s / depth), cov, known
