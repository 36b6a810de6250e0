"""Where masks are true, fast on a CPU; and loops over as many."""

import jax
import jax.numpy as jnp
import numpy as np

WIDTH = 32


def listed(mask, size=None):
    """Indices [size] (int32; None: all that could be) where a mask [n] is true, in order, and how
    many there are; the rest is n.

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


def rounds(count, body, start):
    """`jax.lax.fori_loop` from 0 to a count worked out."""
    return jax.lax.while_loop(
        lambda carry: carry[0] < count, lambda carry: (carry[0] + 1, body(*carry)), (0, start)
    )[1]
