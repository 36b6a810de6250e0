"""A frame's matched measurements: the landmarks they change, read, updated and written together."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter.landmarks import update
from jaxslam.filter.xla import nonzero_indices, ordered_sum, repeat


class KnownSlots(NamedTuple):
    """Where identities are known, and nothing else is looked at: a block's landmarks, one of every
    measurement. The `slot` [K] of each, if it is `there` [K]; the measurement that was the `first`
    [K] to name it; and how many `earlier` [K] ones did."""

    slot: jax.Array
    there: jax.Array
    first: jax.Array
    earlier: jax.Array


def uses_known_slots(config):
    """Whether a look concerns the slots of the measured identities alone (`Rows`)."""
    return config.association == "known" and not config.forgetting


def known_slots(measurements, slots):
    """`Rows` of a frame, in a map of so many slots."""
    slot = measurements.identity
    there = measurements.valid & (slot >= 0) & (slot < slots)
    same = (slot[:, None] == slot) & there[:, None] & there
    earlier = jnp.tril(same, -1).sum(1, dtype=jnp.int32)
    slot = jnp.where(there, slot, slots).astype(jnp.int32)
    return KnownSlots(slot, there, jnp.argmax(same, 1).astype(jnp.int32), earlier)


def fit_known(sensor, sensor_pose, world, measurements, params):
    """Every row's landmark [K, n] updated by its measurement: mean, factor, log density."""
    value, cov = (tuple(part.T[:, :, None]) for part in map(jnp.asarray, measurements[:2]))
    anchor = None if world.anchor is None else tuple(world.anchor)
    return update(
        sensor, sensor_pose, tuple(world.mean), tuple(world.factor), anchor, value, cov, params
    )


def update_known(sensor, sensor_pose, world, rows, match, measurements, params, fit):
    """`updated` of a block whose landmarks are `Rows`, `fit` as `fitted` says; counts are not
    marked.

    Measurements that name a landmark again come after, one at a time.
    """
    inlier = jnp.log1p(-params.outlier)

    def some(world, fit, matched):
        mean, factor, log_density = fit

        def put(old, new):
            return jnp.stack([jnp.where(matched, b, a) for a, b in zip(old, new, strict=True)])

        after = world._replace(
            mean=put(world.mean, mean),
            factor=put(world.factor, factor),
            count=world.count + matched,
        )
        return after, ordered_sum(jnp.where(matched, inlier + log_density, 0.0))

    def again(carry):
        i, world, density = carry
        here = (rows.first == jnp.arange(len(match))[:, None]) & (rows.earlier == i) & rows.there
        k = jnp.argmax(here, 1)
        given = jax.tree.map(lambda leaf: leaf[k] if leaf.ndim else leaf, measurements)
        fit = fit_known(sensor, sensor_pose, world, given, params)
        world, more = some(world, fit, here.any(1)[:, None] & (match[k] >= 0))
        return i + 1, world, density + more

    first = some(world, fit, (match >= 0) & (rows.earlier == 0)[:, None])
    most = rows.earlier.max()
    return jax.lax.while_loop(lambda carry: carry[0] <= most, again, (1, *first))[1:]


def update_matched(sensor, sensor_pose, world, match, measurements, params, again):
    """The map after the frame's matched measurements, in their order, and log densities [n].

    Only the matched slots are read and written, all at once; `again`: the measurements of a frame
    may match a slot more than once, then one after the other. The count of a matched slot comes
    back negative, as a mark for `existence` (to compare with the old counts instead would keep the
    old map alive, and XLA would copy all of it for every block); `settle` ends it.
    """
    inlier = jnp.log1p(-params.outlier)
    value, cov = (tuple(part.T[:, :, None]) for part in map(jnp.asarray, measurements[:2]))
    times = _earlier_matches(match) if again else jnp.zeros_like(match)

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
        return i + 1, world, density + ordered_sum(jnp.where(slot >= 0, inlier + log_density, 0.0))

    start = 0, world, jnp.zeros_like(sensor_pose[0])
    if not again:
        return some(start)[1:]
    return jax.lax.while_loop(lambda carry: carry[0] <= times.max(), some, start)[1:]


def _earlier_matches(match):
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
    return top, nonzero_indices(alike & (top >= 0)), nonzero_indices(~alike)


def _read(world, slot):
    """The landmarks [.., K, n] in the slots [K, n] of each particle; -1: any."""
    parts = world._replace(log_odds=None, landmark_id=None)
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
    found = repeat(count, one, found)
    return repeat(rest, other, found)


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

    leaves = repeat(count, one, (world.mean, world.factor, world.count))
    mean, factor, count = repeat(rest, other, leaves)
    return world._replace(mean=mean, factor=factor, count=count)
