"""Primitives that XLA compiles well on a CPU and rounds the same for every shape."""

import jax
import jax.numpy as jnp
import numpy as np

WIDTH = 32


def nonzero_indices(mask, size=None):
    """Indices [size] (int32; None: n) where a mask [n] is true, in order, padded with n; and how
    many there are.

    `jnp.nonzero` takes two cumulative sums and a histogram, which cost a block of particles more
    than its arithmetic; here sums are products with triangles of ones, exact below 2**24.
    """
    n = len(mask)
    size = n if size is None else size
    rows = -(-n // WIDTH)
    parts = jnp.pad(mask, (0, rows * WIDTH - n)).reshape(rows, WIDTH).astype(jnp.float32)
    inside = parts @ np.triu(np.ones((WIDTH, WIDTH), np.float32))
    before = np.tril(np.ones((rows, rows), np.float32), -1) @ inside[:, -1]
    place = (inside + before[:, None]).reshape(-1)[:n].astype(jnp.int32) - 1
    count = mask.sum(dtype=jnp.int32)
    to = jnp.where(mask, place, size)
    index = jnp.full(size, n, jnp.int32).at[to].set(jnp.arange(n, dtype=jnp.int32), mode="drop")
    return index, count


def repeat(count, body, start):
    """`jax.lax.fori_loop` from 0 to a computed count."""
    return jax.lax.while_loop(
        lambda carry: carry[0] < count, lambda carry: (carry[0] + 1, body(*carry)), (0, start)
    )[1]


def ordered_sum(rows):
    """Sum over the first axis, from the first row to the last.

    The order of `jnp.sum` depends on the array's shape, and so on how many particles are worked on
    together: results would differ, in the last bit, with blocks and devices.
    """
    start = jnp.zeros_like(rows[0])
    unroll = max(1, min(len(rows), WIDTH))
    return jax.lax.fori_loop(0, len(rows), lambda i, total: total + rows[i], start, unroll=unroll)


def barrier(tree):
    """`jax.lax.optimization_barrier`: compute the arrays here and nowhere else.

    XLA repeats cheap arithmetic in each fusion that uses it, and contracts products and sums there
    into one rounding.
    """
    return jax.lax.optimization_barrier(tree)


def compute_once(true, work):
    """Compute what `work` returns in a branch, which ends fusion; `true` is so, unknown to XLA.

    Else XLA repeats all arithmetic that it takes for cheap (normals, bearings) in everything that
    depends on it, and in a concatenation one number at a time.
    """

    def never():
        return jax.tree.map(
            lambda part: jnp.full(part.shape, jnp.nan, part.dtype), jax.eval_shape(work)
        )

    return jax.lax.cond(true, work, never)


def row_start(leaf, slot, start, *before):
    """Start indices of a slot's row, after leading indices `before` (none: all); int32, also in
    double precision."""
    before = before or (0,) * (leaf.ndim - 2)
    return tuple(jnp.asarray(i, jnp.int32) for i in (*before, slot, start))
