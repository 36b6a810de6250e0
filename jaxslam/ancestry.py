"""Lazy resampling: landmarks stay where they are, and are read through their ancestors when needed.

Resampling replaces every particle by a copy of its ancestor, map and all. Copying the whole map
costs more than all else once the map is large, and most of it is not even in view. So only the
ancestors are recorded. Slots that were last brought up to date between the same two resamplings
share a chain, which is composed as it grows: `chains[g, i]` is the particle that held then what
belongs to particle i now. There are few chains; when a new one is needed and all are in use, the
slots of the oldest are brought up to date.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

CURRENT = -1


class Ancestry(NamedTuple):
    """`chains` [G, N] of particles; `begun` [G]: number of the resampling each began with;
    `chain` [M]: that of every slot, or `CURRENT`; `count` []: resamplings so far."""

    chains: jax.Array
    begun: jax.Array
    chain: jax.Array
    count: jax.Array


def new(config):
    """Nothing to catch up with."""
    size = min(config.chains, config.landmarks)
    return Ancestry(
        chains=jnp.zeros((size, config.particles), jnp.int32),
        begun=jnp.zeros(size, jnp.int32),
        chain=jnp.full(config.landmarks, CURRENT, jnp.int32),
        count=jnp.zeros((), jnp.int32),
    )


def update(world, ancestry, wanted):
    """The map with the slots `wanted` [M] (or all: True) brought up to date.

    In place, row by row: a `take` of the whole map would need a second copy of it.
    """
    behind = (ancestry.chain != CURRENT) & wanted
    slots = jnp.nonzero(behind, size=len(behind), fill_value=0)[0]

    def one(i, leaves):
        slot = slots[i]
        index = jax.lax.dynamic_index_in_dim(ancestry.chains, ancestry.chain[slot], keepdims=False)

        def row(leaf):
            old = jax.lax.dynamic_index_in_dim(leaf, slot, leaf.ndim - 2, keepdims=False)
            fresh = old.at[..., index].get(mode="promise_in_bounds")
            return jax.lax.dynamic_update_index_in_dim(leaf, fresh, slot, leaf.ndim - 2)

        return jax.tree.map(row, leaves)

    leaves = jax.lax.fori_loop(0, behind.sum(), one, world)
    chain = jnp.where(behind, CURRENT, ancestry.chain)
    return leaves, ancestry._replace(chain=chain)


def last_of(ancestry):
    """Slots [M] of the oldest chain, if all chains are in use: they are due before resampling."""
    used = _used(ancestry)
    return used.all() & (ancestry.chain == jnp.argmin(ancestry.begun))


def _used(ancestry):
    return (ancestry.chain == jnp.arange(len(ancestry.begun))[:, None]).any(1)


def resampled(ancestry, ancestors, wanted):
    """`Ancestry` of particles that continue `ancestors` [N] if resampling was `wanted`.

    There must be a chain that is not in use (`last_of`).
    """
    free = jnp.argmin(_used(ancestry)).astype(jnp.int32)
    chains = jax.lax.cond(
        wanted,
        lambda chains: chains[:, ancestors].at[free].set(ancestors),
        lambda chains: chains,
        ancestry.chains,
    )
    count = ancestry.count + wanted
    return Ancestry(
        chains=chains,
        begun=jnp.where(wanted, ancestry.begun.at[free].set(count), ancestry.begun),
        chain=jnp.where(wanted & (ancestry.chain == CURRENT), free, ancestry.chain),
        count=count,
    )
