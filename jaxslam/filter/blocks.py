"""A block's share of some slots of the map, read and put back."""

import jax
import jax.numpy as jnp

from jaxslam.filter.xla import rounds


def renamed(measurements, slots, total):
    """The measurements with the places of their slots among `slots` [S] as identities; S: none."""
    size, given = len(slots), measurements.identity
    local = jnp.full(total, size, jnp.int32)
    local = local.at[slots].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    there = (given >= 0) & (given < total)
    identity = jnp.where(there, local[jnp.clip(given, 0, total - 1)], size)
    return measurements._replace(identity=identity)


def taken(world, slots, rows, start, width):
    """Of `slots` [S] the `rows` listed (indices, and how many), of `width` particles from `start`
    on; the others are empty. None: all slots."""
    if rows is None:
        return jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, width, -1),
            world,
        )

    which, count = rows

    def one(i, parts):
        def take(leaf, part):
            at = corner(leaf, slots[which[i]], start)
            row = jax.lax.dynamic_slice(leaf, at, (*leaf.shape[:-2], 1, width))
            return jax.lax.dynamic_update_slice_in_dim(part, row, which[i], leaf.ndim - 2)

        return jax.tree.map(take, world, parts)

    empty = jax.tree.map(
        lambda leaf: jnp.zeros((*leaf.shape[:-2], len(slots), width), leaf.dtype),
        world,
    )
    return rounds(count, one, empty)


def corner(leaf, slot, start, *before):
    """Where a slot's row begins, at places `before` (0: all); indices of one type, also in double
    precision."""
    before = before or (0,) * (leaf.ndim - 2)
    return tuple(jnp.asarray(i, jnp.int32) for i in (*before, slot, start))


def put(world, part, slots, rows, start):
    """The map with what `taken` took replaced."""
    if rows is None:
        return jax.tree.map(
            lambda leaf, new: jax.lax.dynamic_update_slice_in_dim(leaf, new, start, -1),
            world,
            part,
        )

    which, count = rows

    def one(i, leaves):
        def put(leaf, new):
            row = jax.lax.dynamic_slice_in_dim(new, which[i], 1, new.ndim - 2)
            at = corner(leaf, slots[which[i]], start)
            return jax.lax.dynamic_update_slice(leaf, row, at)

        return jax.tree.map(put, leaves, part)

    return rounds(count, one, world)
