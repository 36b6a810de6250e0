"""Systematic resampling (Carpenter, Clifford and Fearnhead 1999)."""

import jax
import jax.numpy as jnp


def systematic(log_weight, uniform):
    """Ancestors [N] (int32) for log weights [N] and one uniform draw in [0, 1).

    Particle j is chosen N w_j times, rounded up or down; one of weight zero never is.
    """
    n = len(log_weight)
    weight = jnp.exp(log_weight - log_weight.max())
    cumulative = jnp.cumsum(weight)
    cumulative = cumulative / cumulative[-1]
    position = (jnp.arange(n, dtype=weight.dtype) + uniform) / n
    # By rounding the last position can reach 1, where no particle is.
    position = jnp.minimum(position, jnp.nextafter(jnp.ones((), weight.dtype), 0.0))
    # side="right": the first j whose cumulative weight exceeds the position, so its own is > 0.
    return jnp.searchsorted(cumulative, position, side="right", method="scan").astype(jnp.int32)


def gather(tree, ancestors, wanted):
    """Every leaf [..., N] with its last axis taken at `ancestors`, if `wanted`.

    Row by row and in place: a row fits the cache, while a whole `take` would need a second copy of
    the map and run at a fraction of the speed. Unwanted is a loop of no rounds, where a `cond`
    would copy the map.
    """

    def one(i, rows):
        row = jax.lax.dynamic_index_in_dim(rows, i, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(rows, row[ancestors], i, 0)

    def gather_leaf(leaf):
        rows = leaf.reshape(-1, leaf.shape[-1])
        return jax.lax.fori_loop(0, jnp.where(wanted, len(rows), 0), one, rows).reshape(leaf.shape)

    return jax.tree.map(gather_leaf, tree)
