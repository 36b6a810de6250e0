"""Halo exchange: send only boundary particles to neighbouring devices, where these suffice.

Systematic resampling, also repeated, keeps particles in order: the ancestors of a device's
particles are its own, except near both ends. If on every device these exceptions and their
ancestors fit into halos of an eighth of its particles, only the halos are sent.
"""

import jax
import jax.numpy as jnp

from jaxslam.filter import sharding
from jaxslam.filter.xla import barrier, row_start

SHARE = 8  # one in so many of a device's particles belongs to a halo


def width(config):
    """Number b of particles of a halo; 0: there are none."""
    return 0 if config.devices == 1 else config.particles // config.devices // SHARE


def suffices(index, config):
    """Whether halos suffice, on every device, for sorted ancestors `index` [.., N]: [..]."""
    n, b = config.particles // config.devices, width(config)
    index = index.reshape(*index.shape[:-1], config.devices, n)
    low = jnp.arange(config.devices, dtype=index.dtype) * n
    near = (index[..., 0] >= low - b) & (index[..., -1] < low + n + b)
    return (near & (index[..., b] >= low) & (index[..., n - 1 - b] < low + n)).all(-1)


def exchange_halos(world, slots, config):
    """Exchange halos of landmarks in S slots, in one message: of every leaf [.., M, n] the last b
    particles of the device before and the first b of the device after, [.., S, 2 b]."""
    b, leaves, kind = width(config), *jax.tree.flatten(world)

    def ends(leaf, slot):
        first, last = (
            jax.lax.dynamic_slice(leaf, row_start(leaf, slot, start), (*leaf.shape[:-2], 1, b))
            for start in (0, leaf.shape[-1] - b)
        )
        return jnp.concatenate([first, last], -1)

    halos = [jnp.concatenate([ends(leaf, slot) for slot in slots], -2) for leaf in leaves]
    return jax.tree.unflatten(kind, barrier(sharding.exchange_with_neighbours(halos, b, config)))


def gather_row(leaf, halo, slot, index, config):
    """Gather a slot's landmarks of a leaf [.., M, n] at `index` [n] of all particles, from the
    device's own and the neighbours' `halo` [.., 2 b]."""
    n, b = leaf.shape[-1], width(config)
    local = index - jax.lax.axis_index(sharding.AXIS) * n
    head, tail = local[:b], local[n - b :]
    rows = leaf.reshape(-1, *leaf.shape[-2:])
    for i, side in enumerate(halo.reshape(-1, 2 * b)):
        row = jax.lax.dynamic_slice(rows, row_start(rows, slot, 0, i), (1, 1, n))[0, 0]
        # A barrier: fused with the writing, reading would need a copy of the map.
        inside = barrier(_at(row, local, 0, n))
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
    """Values of a row at indices; those outside [low, high) get anything."""
    return row.at[jnp.clip(index, low, high - 1)].get(mode="promise_in_bounds")
