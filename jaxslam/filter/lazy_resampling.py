"""Lazy resampling: landmarks are resampled through composed ancestors when next used.

Copying the whole map at every resampling costs more than all else once the map is large, and most
of it is not in view. So only ancestors are recorded. Slots that were last resampled between the
same two resamplings share a chain: `chains[g, i]` is the particle that held then what belongs to
particle i now. There are few chains; when a new one is needed and all are in use, the slots of the
oldest are resampled.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.filter import halo_exchange, sharding
from jaxslam.filter.xla import nonzero_indices, repeat

CURRENT = -1
TOGETHER = 2**18  # particles of all rows of one message


class Ancestry(NamedTuple):
    """Resampling still to be done: `chains` [G, N] of composed ancestors; `begun` [G]: number of
    the resampling that began each; `chain` [M] of every slot, or `CURRENT`; `count` [] so far."""

    chains: jax.Array
    begun: jax.Array
    chain: jax.Array
    count: jax.Array


def empty_ancestry(config):
    """`Ancestry` of a map that is resampled already."""
    size = min(config.chains, config.landmarks)
    return Ancestry(
        chains=jnp.zeros((size, config.particles), jnp.int32),
        begun=jnp.zeros(size, jnp.int32),
        chain=jnp.full(config.landmarks, CURRENT, jnp.int32),
        count=jnp.zeros((), jnp.int32),
    )


def apply_ancestry(world, ancestry, wanted, config):
    """Resample the slots `wanted` [M] (True: all): the map, and its `Ancestry`.

    In place, row by row: a `take` of the map would need a second copy of it.
    """
    behind = (ancestry.chain != CURRENT) & wanted
    slots, count = jnp.nonzero(behind, size=len(behind), fill_value=0)[0], behind.sum()
    near = 0
    if halo_exchange.width(config):
        used = (ancestry.chain == jnp.arange(len(ancestry.begun))[:, None]) & behind
        enough = halo_exchange.suffices(ancestry.chains, config) | ~used.any(1)
        # One of two loops has no rounds: a `cond` would copy the map.
        near = jnp.where(enough.all(), count, 0)
        world = _apply_near(world, ancestry, slots, near, config)
    world = _apply(world, ancestry, slots, count - near, config)
    return world, ancestry._replace(chain=jnp.where(behind, CURRENT, ancestry.chain))


def _apply(world, ancestry, slots, count, config):
    """The map with the first `count` of the slots resampled."""
    # Devices exchange several rows in one message.
    size = 1 if config.devices == 1 else max(1, min(8, TOGETHER // config.particles))

    def update_rows(i, world):
        # The last may come again, which does no harm: all are read before any is written.
        at = [slots[jnp.minimum(i * size + j, count - 1)] for j in range(size)]
        rows = [jax.tree.map(partial(_row, slot=slot), world) for slot in at]
        indices = [_index(ancestry, slot, config) for slot in at]
        for slot, new in zip(at, sharding.gather(rows, indices, config), strict=True):
            world = jax.tree.map(partial(_put, slot=slot), world, new)
        return world

    return repeat(-(-count // size), update_rows, world)


def _apply_near(world, ancestry, slots, count, config):
    """`_apply` where a device needs no more of others than its neighbours' halos."""
    size = max(1, min(8, TOGETHER // (2 * halo_exchange.width(config))))

    def update_rows(i, world):
        first = i * size
        at = [slots[jnp.minimum(first + j, count - 1)] for j in range(size)]
        halos = halo_exchange.exchange_halos(world, at, config)

        def update_one(j, world):
            slot = slots[first + j]
            gather_row = partial(
                halo_exchange.gather_row, slot=slot, index=_index(ancestry, slot, config)
            )
            side = jax.tree.map(partial(_row, slot=j), halos)
            return jax.tree.map(partial(gather_row, config=config), world, side)

        return repeat(jnp.minimum(size, count - first), update_one, world)

    return repeat(-(-count // size), update_rows, world)


def _index(ancestry, slot, config):
    """Ancestors of the device's particles in a slot, among all particles."""
    return sharding.local_shard(_row(ancestry.chains, ancestry.chain[slot]), config)


def _row(leaf, slot):
    return jax.lax.dynamic_index_in_dim(leaf, slot, leaf.ndim - 2, keepdims=False)


def _put(leaf, new, slot):
    return jax.lax.dynamic_update_index_in_dim(leaf, new, slot, leaf.ndim - 2)


def oldest_slots(ancestry):
    """Slots [M] of the oldest chain if all chains are in use: due before the next resampling."""
    used = _used(ancestry)
    return used.all() & (ancestry.chain == jnp.argmin(ancestry.begun))


def _used(ancestry):
    return (ancestry.chain == jnp.arange(len(ancestry.begun))[:, None]).any(1)


def compose(ancestry, ancestors, wanted):
    """Compose the chains with `ancestors` [N] if resampling was `wanted`.

    There must be a chain that is not in use (see `oldest_slots`).
    """
    used = _used(ancestry)
    free = jnp.argmin(used).astype(jnp.int32)

    def follow(i, chains):
        new = _row(chains, which[i]).at[ancestors].get(mode="promise_in_bounds")
        return _put(chains, new, which[i])

    which, count = nonzero_indices(used)
    chains = repeat(jnp.where(wanted, count, 0), follow, ancestry.chains)
    chains = _put(chains, jnp.where(wanted, ancestors, _row(chains, free)), free)
    count = ancestry.count + wanted
    return Ancestry(
        chains=chains,
        begun=jnp.where(wanted, ancestry.begun.at[free].set(count), ancestry.begun),
        chain=jnp.where(wanted & (ancestry.chain == CURRENT), free, ancestry.chain),
        count=count,
    )
