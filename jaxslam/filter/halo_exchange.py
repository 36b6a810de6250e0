"""Ancestors nearby: what a device needs of its neighbours' particles, when that is little.

Systematic resampling keeps particles in order, and so does one after the other: what a device's
particles continue is its own, but for a stretch at either end. If on every device these stretches,
and what they continue, fit into borders of an eighth of its particles, only the borders travel.
"""

import jax
import jax.numpy as jnp

from jaxslam.filter import sharding
from jaxslam.filter.xla import barrier, row_start

SHARE = 8  # of a device's particles one in so many belongs to a border


def width(config):
    """Particles [b] of a border; 0: there are none."""
    return 0 if config.devices == 1 else config.particles // config.devices // SHARE


def suffices(index, config):
    """Whether borders suffice, on every device, for `index` [.., N], ancestors in order: [..]."""
    n, b = config.particles // config.devices, width(config)
    index = index.reshape(*index.shape[:-1], config.devices, n)
    low = jnp.arange(config.devices, dtype=index.dtype) * n
    near = (index[..., 0] >= low - b) & (index[..., -1] < low + n + b)
    return (near & (index[..., b] >= low) & (index[..., n - 1 - b] < low + n)).all(-1)


def exchange_halos(world, slots, config):
    """The neighbours' borders of landmarks in the slots, a list of S, in one message: of every leaf
    [.., M, n] the last b of the particles before one's own, and the first b of those after them
    [.., S, 2 b]."""
    b, leaves, kind = width(config), *jax.tree.flatten(world)

    def ends(leaf, slot):
        first, last = (
            jax.lax.dynamic_slice(leaf, row_start(leaf, slot, start), (*leaf.shape[:-2], 1, b))
            for start in (0, leaf.shape[-1] - b)
        )
        return jnp.concatenate([first, last], -1)

    found = [jnp.concatenate([ends(leaf, slot) for slot in slots], -2) for leaf in leaves]
    return jax.tree.unflatten(kind, barrier(sharding.exchange_with_neighbours(found, b, config)))


def gather_row(leaf, border, slot, index, config):
    """A leaf [.., M, n] with the slot's landmarks taken at `index` [n] of all particles, of its own
    and its neighbours' `border` [.., 2 b]."""
    n, b = leaf.shape[-1], width(config)
    own = index - jax.lax.axis_index(sharding.AXIS) * n
    head, tail = own[:b], own[n - b :]
    rows = leaf.reshape(-1, *leaf.shape[-2:])
    for i, side in enumerate(border.reshape(-1, 2 * b)):
        row = jax.lax.dynamic_slice(rows, row_start(rows, slot, 0, i), (1, 1, n))[0, 0]
        # Pinned: joined with what is put, reading would need a copy of the map.
        inside = barrier(_at(row, own, 0, n))
        parts = (
            inside,
            jnp.where(head < 0, _at(side, head + b, 0, b), inside[:b]),
            jnp.where(tail >= n, _at(side, tail - n + b, b, 2 * b), inside[n - b :]),
        )
        for start, part in zip((0, 0, n - b), barrier(parts), strict=True):
            rows = jax.lax.dynamic_update_slice(
                rows, part[None, None], row_start(rows, slot, start, i)
            )
    return rows.reshape(leaf.shape)


def _at(row, index, low, high):
    """Of a row, what is at the indices; those out of [low, high) get anything."""
    return row.at[jnp.clip(index, low, high - 1)].get(mode="promise_in_bounds")
