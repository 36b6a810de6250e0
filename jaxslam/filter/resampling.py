"""Systematic resampling (Carpenter, Clifford and Fearnhead 1999)."""

import jax
import jax.numpy as jnp

from jaxslam.filter import sharding

AT_ONCE = 4096  # elements: a round of a loop costs as much as several hundred of them


def systematic(log_weight, uniform):
    """Draw ancestors [N] (int32) for log weights [N] with one uniform in [0, 1).

    Particle j is drawn N w_j times, rounded up or down; never if its weight is zero.
    """
    n = len(log_weight)
    weight = jnp.exp(log_weight - log_weight.max())
    # Sums in parallel round differently from particle to particle: they may step back, or forward
    # at a weight of zero. Hence the maximum, and the move back to the last particle with a weight.
    cumulative = jax.lax.cummax(jnp.cumsum(weight))
    total = cumulative[-1]
    position = (jnp.arange(n, dtype=weight.dtype) + uniform) / n * total
    # By rounding the last position can reach the total, beyond which there is no particle.
    position = jnp.minimum(position, jnp.nextafter(total, jnp.zeros_like(total)))
    # side="right": the first j whose cumulative weight exceeds the position.
    chosen = jnp.searchsorted(cumulative, position, side="right", method="scan")
    index = jnp.arange(n, dtype=jnp.int32)
    last = jax.lax.cummax(jnp.where(weight > 0, index, -1))
    first = jnp.argmax(weight > 0).astype(jnp.int32)
    return jnp.maximum(last[chosen], first)


def gather(tree, ancestors, wanted, config):
    """Gather every leaf [.., N] at `ancestors` along its last axis, if `wanted`.

    A few rows at a time and in place: they fit the cache, while one `take` would need a second copy
    of the map and run at a fraction of the speed. If not wanted, the loop has no rounds, where a
    `cond` would copy the map. On several devices leaves are the device's own.
    """
    ancestors = sharding.local_shard(ancestors, config)

    def gather_part(i, parts):
        part = jax.lax.dynamic_index_in_dim(parts, i, keepdims=False)
        (part,) = sharding.gather([part], [ancestors], config)
        return jax.lax.dynamic_update_index_in_dim(parts, part, i, 0)

    def gather_leaf(leaf):
        if leaf.size == 0:
            return leaf
        rows = leaf.size // leaf.shape[-1]
        most = max(1, min(rows, AT_ONCE // leaf.shape[-1]))
        size = next(size for size in range(most, 0, -1) if rows % size == 0)
        parts = leaf.reshape(-1, size, leaf.shape[-1])
        rounds = jnp.where(wanted, len(parts), 0)
        return jax.lax.fori_loop(0, rounds, gather_part, parts).reshape(leaf.shape)

    return jax.tree.map(gather_leaf, tree)
