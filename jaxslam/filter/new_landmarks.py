"""Create new landmarks, and maps given at the start.

New landmarks take slots that no particle uses, the lowest first: what all particles begin goes to
the same slot in all of them.
"""

import jax
import jax.numpy as jnp

from jaxslam.filter.association import NEW
from jaxslam.filter.landmarks import Landmarks
from jaxslam.filter.xla import barrier, nonzero_indices
from jaxslam.models import sensors

AT_ONCE = 16  # particles served by one round


def occupied(world):
    """Slots [M] in which some particle holds a landmark."""
    return (world.count > 0).any(-1)


def create(config, world, start, sensor_pose, match, free, measurements, params, step_number):
    """Create a landmark for every measurement that the n particles from `start` on match as `NEW`:
    the map, the slots [M] with new landmarks, and how many were lost [n] because none was free.

    A particle's new landmarks go to `free` [K] in the measurements' order (beyond the map: none
    left); identity i takes slot i. They are rare, and of few particles: each round serves `AT_ONCE`
    particles.
    """
    total, slots, width = len(match), world.count.shape[0], match.shape[1]
    slot, particles, count, touched, lost = jax.lax.cond(
        (match == NEW).any(),
        lambda *given: _plan(config, slots, *given),
        lambda *given: jax.tree.map(
            lambda part: jnp.zeros(part.shape, part.dtype),
            jax.eval_shape(lambda *given: _plan(config, slots, *given), *given),
        ),
        match,
        free,
        measurements.identity,
    )
    value, cov = (tuple(part.T[:, :, None]) for part in map(jnp.asarray, measurements[:2]))
    forgetting = world.log_odds is not None
    odds = jnp.minimum(params.existence_new, params.existence_max)
    landmark_id = (step_number * total + jnp.arange(total))[:, None].astype(jnp.int32)

    def some(carry):
        i, world = carry
        particle = jax.lax.dynamic_slice_in_dim(particles, i * AT_ONCE, AT_ONCE)
        there, particle = particle < width, jnp.minimum(particle, width - 1)
        to = jnp.where(there, slot[:, particle], slots)  # beyond: dropped
        # A barrier: fused, their rounding would depend on the shape of the block.
        here = barrier(tuple(part[particle] for part in sensor_pose))
        mean, factor, anchor = sensors.locate(config.sensor, here, value, cov, params)

        def broadcast(parts):
            return jnp.stack([jnp.broadcast_to(part, to.shape) for part in parts])

        fresh = Landmarks(
            mean=broadcast(mean),
            factor=broadcast(factor),
            anchor=None if world.anchor is None else broadcast(anchor),
            log_odds=odds if forgetting else None,
            # With negative log-odds from the start it is forgotten at once.
            count=(odds >= 0).astype(jnp.int32) if forgetting else 1,
            landmark_id=jnp.broadcast_to(landmark_id, to.shape),
        )

        def put(leaf, new):
            return leaf.at[..., to, start + particle].set(new, mode="drop", unique_indices=True)

        return i + 1, jax.tree.map(put, world, fresh)

    _, world = jax.lax.while_loop(lambda carry: carry[0] * AT_ONCE < count, some, (0, world))
    return world, touched, lost


def _plan(config, slots, match, free, identity):
    """Slots [K, n] of new landmarks; indices of the particles that have any, and how many; whether
    a slot gets one [M]; and how many get no slot [n]."""
    new = match == NEW
    if config.association == "known":
        some = new.any(0)
        slot = jnp.where(identity >= 0, identity, slots)
        taken = jnp.where(new.any(1), slot, slots)
        slot = slot[:, None]
    else:
        total = len(match)
        rank = jnp.tril(jnp.ones((total, total), jnp.float32)) @ new.astype(jnp.float32)
        rank = rank.astype(jnp.int32)
        some = rank[-1] > 0
        taken = jnp.where(jnp.arange(total) < rank[-1].max(), free, slots)
        slot = free[jnp.maximum(rank - 1, 0)]
    slot = jnp.where(new, slot, slots).astype(jnp.int32)
    particles, count = nonzero_indices(some)
    particles = jnp.pad(particles, (0, AT_ONCE), constant_values=match.shape[1])
    touched = (taken[:, None] == jnp.arange(slots)).any(0)
    return slot, particles, count, touched, (new & (slot >= slots)).sum(0).astype(jnp.int32)


def place_given(world, known):
    """Place a given map in the first slots: mean [2, L], factor [3, L] (`bearing`: anchor [2, L]).

    A given landmark is certain to exist until it has been seen. Raises `ValueError` where there are
    fewer slots.
    """
    parts = dict(zip(("mean", "factor", "anchor"), known, strict=False))
    size = jnp.shape(parts["mean"])[1]
    if size > world.count.shape[0]:
        raise ValueError(f"{size} landmarks given, but the map has {world.count.shape[0]} slots")
    return world._replace(
        count=world.count.at[:size].set(1),
        landmark_id=world.landmark_id.at[:size].set(
            -jnp.arange(4, 4 + size, dtype=jnp.int32)[:, None]
        ),
        log_odds=None if world.log_odds is None else world.log_odds.at[:size].set(jnp.inf),
        **{
            name: getattr(world, name).at[:, :size].set(jnp.asarray(value)[:, :, None])
            for name, value in parts.items()
        },
    )
