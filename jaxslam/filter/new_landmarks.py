"""New landmarks, and maps given from the start.

A particle's births of a frame take slots that no particle uses, the lowest first. So what all
particles see for the first time goes to one slot in all of them, and a slot stays about one place.
"""

import jax
import jax.numpy as jnp

from jaxslam.filter.association import NEW
from jaxslam.filter.landmarks import Landmarks
from jaxslam.filter.xla import barrier, nonzero_indices
from jaxslam.models import sensors

AT_ONCE = 16


def occupied(world):
    """Slots [M] in which some particle holds a landmark."""
    return (world.count > 0).any(-1)


def create(config, world, start, sensor_pose, match, free, measurements, params, step_number):
    """The map with a landmark for every measurement that the n particles from `start` on matched as
    new; slots [M] in which that was; and how many were lost [n], for want of a slot.

    A particle's births go to `free` [K] in the measurements' order (beyond the map: none left).
    With known identities identity i takes slot i. Births are rare, and of few particles: each round
    serves all of `AT_ONCE` particles.
    """
    total, slots, width = len(match), world.count.shape[0], match.shape[1]
    slot, lanes, count, touched, lost = jax.lax.cond(
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
        lane = jax.lax.dynamic_slice_in_dim(lanes, i * AT_ONCE, AT_ONCE)
        there, lane = lane < width, jnp.minimum(lane, width - 1)
        to = jnp.where(there, slot[:, lane], slots)  # beyond: dropped
        # Arrays of their own: fused, what rounds them would depend on the shape of the block.
        here = barrier(tuple(part[lane] for part in sensor_pose))
        mean, factor, anchor = sensors.locate(config.sensor, here, value, cov, params)

        def whole(parts):
            return jnp.stack([jnp.broadcast_to(part, to.shape) for part in parts])

        fresh = Landmarks(
            mean=whole(mean),
            factor=whole(factor),
            anchor=None if world.anchor is None else whole(anchor),
            log_odds=odds if forgetting else None,
            # With odds against it from the start it is forgotten at once.
            count=(odds >= 0).astype(jnp.int32) if forgetting else 1,
            landmark_id=jnp.broadcast_to(landmark_id, to.shape),
        )

        def put(leaf, new):
            return leaf.at[..., to, start + lane].set(new, mode="drop", unique_indices=True)

        return i + 1, jax.tree.map(put, world, fresh)

    _, world = jax.lax.while_loop(lambda carry: carry[0] * AT_ONCE < count, some, (0, world))
    return world, touched, lost


def _plan(config, slots, match, free, identity):
    """Where births go: slots [K, n]; the particles that have any, listed, and how many; slots [M]
    in which there is one; and how many find none [n]."""
    new = match == NEW
    if config.association == "known":
        some = new.any(0)
        slot = jnp.where(identity >= 0, identity, slots)
        taken = jnp.where(new.any(1), slot, slots)
        slot = slot[:, None]
    else:
        total = len(match)
        nth = jnp.tril(jnp.ones((total, total), jnp.float32)) @ new.astype(jnp.float32)
        nth = nth.astype(jnp.int32)
        some = nth[-1] > 0
        taken = jnp.where(jnp.arange(total) < nth[-1].max(), free, slots)
        slot = free[jnp.maximum(nth - 1, 0)]
    slot = jnp.where(new, slot, slots).astype(jnp.int32)
    lanes, count = nonzero_indices(some)
    lanes = jnp.pad(lanes, (0, AT_ONCE), constant_values=match.shape[1])
    touched = (taken[:, None] == jnp.arange(slots)).any(0)
    return slot, lanes, count, touched, (new & (slot >= slots)).sum(0).astype(jnp.int32)


def place_given(world, known):
    """The map with its first slots set to a given one: mean [2, L], factor [3, L] (, anchor).

    A given landmark is certain to exist until it has been seen.
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
