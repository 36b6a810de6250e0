"""A frame's matched measurements: the landmarks they change, read, updated and written together."""

import jax
import jax.numpy as jnp

from jaxslam.landmarks import update
from jaxslam.listing import listed, rounds


def updated(sensor, sensor_pose, world, match, measurements, params, again):
    """The map after the frame's matched measurements, in their order, and log densities [n].

    Only the matched slots are read and written, all at once; `again`: the measurements of a frame
    may match a slot more than once, then one after the other. The count of a matched slot comes
    back negative, as a mark for `existence` (to compare with the old counts instead would keep the
    old map alive, and XLA would copy all of it for every block); `settle` ends it.
    """
    inlier = jnp.log1p(-params.outlier)
    value, cov = (tuple(part.T[:, :, None]) for part in map(jnp.asarray, measurements[:2]))
    times = _times(match) if again else jnp.zeros_like(match)

    def some(carry):
        i, world, density = carry
        slot = jnp.where(times == i, match, -1)
        old = _read(world, slot)
        anchor = None if old.anchor is None else tuple(old.anchor)
        mean, factor, log_density = update(
            sensor, sensor_pose, tuple(old.mean), tuple(old.factor), anchor, value, cov, params
        )
        new = jnp.stack(mean), jnp.stack(factor), -1 - jnp.abs(old.count)
        world = _write(world, slot, new)
        return i + 1, world, density + jnp.where(slot >= 0, inlier + log_density, 0).sum(0)

    start = 0, world, jnp.zeros_like(sensor_pose[0])
    if not again:
        return some(start)[1:]
    return jax.lax.while_loop(lambda carry: carry[0] <= times.max(), some, start)[1:]


def _times(match):
    """How often the slot of a match [K, n] was matched before in the frame."""

    def one(k, times):
        more = (match == match[k]) & (match >= 0) & (jnp.arange(len(match))[:, None] > k)
        return times + more

    return jax.lax.fori_loop(0, len(match), one, jnp.zeros_like(match))


def _shared(slot):
    """Of slots [K, n], -1 for none: the largest [K]; which rows [K] and how many have no other, and
    the same of those that have."""
    top = slot.max(1)
    alike = ((slot == top[:, None]) | (slot < 0)).all(1)
    return top, listed(alike & (top >= 0)), listed(~alike)


def _read(world, slot):
    """The landmarks [.., K, n] in the slots [K, n] of each particle; -1: any."""
    parts = world._replace(log_odds=None, birth=None)
    lane = jnp.arange(slot.shape[1])
    top, (rows, count), (others, rest) = _shared(slot)

    def put(found, k, row):
        return jax.tree.map(
            lambda leaf, new: jax.lax.dynamic_update_index_in_dim(leaf, new, k, leaf.ndim - 2),
            found,
            row,
        )

    def one(i, found):
        k = rows[i]
        return put(found, k, jax.tree.map(lambda leaf: leaf[..., top[k], :], parts))

    def other(i, found):
        k = others[i]
        at = jnp.maximum(slot[k], 0)
        return put(found, k, jax.tree.map(lambda leaf: leaf[..., at, lane], parts))

    found = jax.tree.map(lambda leaf: jnp.ones((*leaf.shape[:-2], *slot.shape), leaf.dtype), parts)
    found = rounds(count, one, found)
    return rounds(rest, other, found)


def _write(world, slot, new):
    """The map with means, factors and counts [.., K, n] put into the slots [K, n]; -1: none.

    Most often all particles of a block match the same slot: then it is a row.
    """
    lane = jnp.arange(slot.shape[1])
    top, (rows, count), (others, rest) = _shared(slot)

    def one(i, leaves):
        k = rows[i]

        def put(leaf, new):
            # Of the others: another measurement may have been put there meanwhile.
            held = jax.lax.dynamic_index_in_dim(leaf, top[k], leaf.ndim - 2, keepdims=False)
            row = jnp.where(slot[k] >= 0, new[..., k, :], held)
            return jax.lax.dynamic_update_index_in_dim(leaf, row, top[k], leaf.ndim - 2)

        return jax.tree.map(put, leaves, new)

    def other(i, leaves):
        k = others[i]
        to = jnp.where(slot[k] >= 0, slot[k], world.count.shape[0])  # beyond: dropped
        return jax.tree.map(
            lambda leaf, new: leaf.at[..., to, lane].set(
                new[..., k, :], mode="drop", unique_indices=True
            ),
            leaves,
            new,
        )

    leaves = rounds(count, one, (world.mean, world.factor, world.count))
    mean, factor, count = rounds(rest, other, leaves)
    return world._replace(mean=mean, factor=factor, count=count)
