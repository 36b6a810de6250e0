"""Update the landmarks that a frame's measurements are matched to, all measurements together."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter.landmarks import update
from jaxslam.filter.xla import nonzero_indices, ordered_sum, repeat


class KnownSlots(NamedTuple):
    """Slots of measurements with known identities: `slot` [K], valid where `there` [K]; `first`
    [K]: the first measurement of the same slot; `earlier` [K]: number of measurements of it before.
    """

    slot: jax.Array
    there: jax.Array
    first: jax.Array
    earlier: jax.Array


def uses_known_slots(config):
    """Whether a frame concerns the slots of the measured identities alone (`KnownSlots`)."""
    return config.association == "known" and not config.forgetting


def known_slots(measurements, slots):
    """`KnownSlots` of a frame, in a map of so many slots."""
    slot = measurements.identity
    there = measurements.valid & (slot >= 0) & (slot < slots)
    same = (slot[:, None] == slot) & there[:, None] & there
    earlier = jnp.tril(same, -1).sum(1, dtype=jnp.int32)
    slot = jnp.where(there, slot, slots).astype(jnp.int32)
    return KnownSlots(slot, there, jnp.argmax(same, 1).astype(jnp.int32), earlier)


def fit_known(sensor, sensor_pose, world, measurements, params):
    """Update landmark k [K, n] by measurement k: mean, factor, log predictive density."""
    value, cov = (tuple(part.T[:, :, None]) for part in map(jnp.asarray, measurements[:2]))
    anchor = None if world.anchor is None else tuple(world.anchor)
    return update(
        sensor, sensor_pose, tuple(world.mean), tuple(world.factor), anchor, value, cov, params
    )


def update_known(sensor, sensor_pose, world, known, match, measurements, params, fit):
    """Update landmarks of `KnownSlots` [K, n] where matched: `Landmarks`, and log densities [n].

    `fit`: what `fit_known` returned. Further measurements of a landmark follow, one at a time.
    """
    inlier = jnp.log1p(-params.outlier)

    def update_where(matched, world, fit):
        mean, factor, log_density = fit

        def select(old, new):
            return jnp.stack([jnp.where(matched, b, a) for a, b in zip(old, new, strict=True)])

        updated = world._replace(
            mean=select(world.mean, mean),
            factor=select(world.factor, factor),
            count=world.count + matched,
        )
        return updated, ordered_sum(jnp.where(matched, inlier + log_density, 0.0))

    def update_again(carry):
        i, world, density = carry
        same = known.first == jnp.arange(len(match))[:, None]
        here = same & (known.earlier == i) & known.there
        k = jnp.argmax(here, 1)
        repeated = jax.tree.map(lambda leaf: leaf[k] if leaf.ndim else leaf, measurements)
        fit = fit_known(sensor, sensor_pose, world, repeated, params)
        world, more = update_where(here.any(1)[:, None] & (match[k] >= 0), world, fit)
        return i + 1, world, density + more

    first = update_where((match >= 0) & (known.earlier == 0)[:, None], world, fit)
    most = known.earlier.max()
    return jax.lax.while_loop(lambda carry: carry[0] <= most, update_again, (1, *first))[1:]


def update_matched(sensor, sensor_pose, world, match, measurements, params, repeated):
    """Update the slots that measurements match [K, n]: `Landmarks`, and log densities [n].

    Only the matched slots are read and written, all at once; `repeated`: several measurements of a
    frame may match a slot, and then update it one after the other. The count of a matched slot
    comes back negative, as a mark for `update_existence` (to compare with the old counts instead
    would keep the old map alive, and XLA would copy all of it for every block);
    `landmarks.unmark_matched` removes the marks.
    """
    inlier = jnp.log1p(-params.outlier)
    value, cov = (tuple(part.T[:, :, None]) for part in map(jnp.asarray, measurements[:2]))
    earlier = _earlier_matches(match) if repeated else jnp.zeros_like(match)

    def update_round(carry):
        i, world, density = carry
        slot = jnp.where(earlier == i, match, -1)
        old = _read(world, slot)
        anchor = None if old.anchor is None else tuple(old.anchor)
        mean, factor, log_density = update(
            sensor, sensor_pose, tuple(old.mean), tuple(old.factor), anchor, value, cov, params
        )
        new = jnp.stack(mean), jnp.stack(factor), -1 - jnp.abs(old.count)
        world = _write(world, slot, new)
        return i + 1, world, density + ordered_sum(jnp.where(slot >= 0, inlier + log_density, 0.0))

    start = 0, world, jnp.zeros_like(sensor_pose[0])
    if not repeated:
        return update_round(start)[1:]
    return jax.lax.while_loop(lambda carry: carry[0] <= earlier.max(), update_round, start)[1:]


def _earlier_matches(match):
    """Number of earlier measurements of the frame with the same match [K, n]."""

    def count(k, earlier):
        more = (match == match[k]) & (match >= 0) & (jnp.arange(len(match))[:, None] > k)
        return earlier + more

    return jax.lax.fori_loop(0, len(match), count, jnp.zeros_like(match))


def _shared(slot):
    """Of slots [K, n], -1 for none: the largest [K]; the measurements that all particles match to
    one slot, and those that they do not (indices [K], and how many)."""
    top = slot.max(1)
    shared = ((slot == top[:, None]) | (slot < 0)).all(1)
    return top, nonzero_indices(shared & (top >= 0)), nonzero_indices(~shared)


def _read(world, slot):
    """Landmarks [.., K, n] in the slots [K, n] of each particle; -1: anything."""
    parts = world._replace(log_odds=None, landmark_id=None)
    particle = jnp.arange(slot.shape[1])
    top, (shared, shared_count), (mixed, mixed_count) = _shared(slot)

    def put(matched, k, row):
        return jax.tree.map(
            lambda leaf, new: jax.lax.dynamic_update_index_in_dim(leaf, new, k, leaf.ndim - 2),
            matched,
            row,
        )

    def read_shared(i, matched):
        k = shared[i]
        return put(matched, k, jax.tree.map(lambda leaf: leaf[..., top[k], :], parts))

    def read_mixed(i, matched):
        k = mixed[i]
        at = jnp.maximum(slot[k], 0)
        return put(matched, k, jax.tree.map(lambda leaf: leaf[..., at, particle], parts))

    matched = jax.tree.map(
        lambda leaf: jnp.ones((*leaf.shape[:-2], *slot.shape), leaf.dtype), parts
    )
    matched = repeat(shared_count, read_shared, matched)
    return repeat(mixed_count, read_mixed, matched)


def _write(world, slot, new):
    """The map with means, factors and counts [.., K, n] written into the slots [K, n]; -1: none.

    Most often all particles of a block match the same slot: then it is one row.
    """
    particle = jnp.arange(slot.shape[1])
    top, (shared, shared_count), (mixed, mixed_count) = _shared(slot)

    def write_shared(i, leaves):
        k = shared[i]

        def put(leaf, new):
            # For particles without the match: another measurement may have been written there.
            held = jax.lax.dynamic_index_in_dim(leaf, top[k], leaf.ndim - 2, keepdims=False)
            row = jnp.where(slot[k] >= 0, new[..., k, :], held)
            return jax.lax.dynamic_update_index_in_dim(leaf, row, top[k], leaf.ndim - 2)

        return jax.tree.map(put, leaves, new)

    def write_mixed(i, leaves):
        k = mixed[i]
        to = jnp.where(slot[k] >= 0, slot[k], world.count.shape[0])  # beyond: dropped
        return jax.tree.map(
            lambda leaf, new: leaf.at[..., to, particle].set(
                new[..., k, :], mode="drop", unique_indices=True
            ),
            leaves,
            new,
        )

    leaves = repeat(shared_count, write_shared, (world.mean, world.factor, world.count))
    mean, factor, count = repeat(mixed_count, write_mixed, leaves)
    return world._replace(mean=mean, factor=factor, count=count)
