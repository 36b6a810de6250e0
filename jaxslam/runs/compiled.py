"""Compile the loop over a chunk of frames, and estimate its memory."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import sharding
from jaxslam.filter import step as fastslam
from jaxslam.runs import memory
from jaxslam.runs.assemble import COPIED, ParticleHistory, Summary

CHUNK = 256  # frames of a chunk, at most: one compilation serves logs of every length
CHUNK_BYTES = 2**28  # of what a chunk hands over, at most
TREE_BYTES = 2**31  # of the genealogy; a larger one is given up


def state_shapes(config):
    """Return shapes, types and shardings of the `State` without making it."""
    state = jax.eval_shape(lambda key: fastslam.init(config, key), jax.random.key(0))
    state = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), state)
    if config.devices == 1:
        return state
    return jax.tree.map(
        lambda leaf, spec: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=spec),
        state,
        sharding.shardings(fastslam.layout(state), config),
    )


def compile_loop(config, chunk, params):
    """Compile `filter_frames` for a chunk (odometry, measurements) without making the state."""
    shapes = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), jnp.result_type(leaf)), (*chunk, params)
    )
    leaves, structure = jax.tree.flatten(shapes)
    return _compile(config, tuple(leaves), structure)


@lru_cache(maxsize=2)
def _compile(config, leaves, structure):
    shapes = state_shapes(config), jnp.int32(0), *jax.tree.unflatten(structure, leaves)
    filter_chunk = jax.jit(
        filter_frames,
        static_argnames="config",
        donate_argnames="state",  # no second copy of the map
        out_shardings=_output_shardings(config),
    )
    return filter_chunk.lower(jax.random.key(0), *shapes, config).compile()


def _output_shardings(config):
    """Return the shardings of what `filter_frames` returns; the state's are those of its input."""
    if config.devices == 1:
        return None
    sharded = jax.sharding.PartitionSpec(None, None, sharding.AXIS)
    history = ParticleHistory(pose=sharded, landmark_id=sharded, ancestors=sharding.ALL)
    kept = Summary(*[sharding.ALL] * len(Summary._fields)), history
    state = jax.tree.map(lambda leaf: leaf.sharding, state_shapes(config))
    return state, sharding.shardings(kept, config)


def node_bytes(config):
    """Bytes of a node of the genealogy, or of one particle in a frame's `ParticleHistory`."""
    return 4 * (config.measurements + 4)


def estimate_memory(config, steps):
    """Estimate the `Memory` of a run of so many steps, as far as it is known before compiling."""
    frame = node_bytes(config) * config.particles
    chunk = min(steps, chunk_size(config)) * frame
    if config.rejuvenate:  # the draws, and what is computed from them
        chunk = max(chunk, 3 * 4 * (3 + 2 * config.landmarks) * config.particles)
    tree = min(TREE_BYTES, steps * frame)
    return memory.Memory(memory.bytes_of(state_shapes(config)), chunk, tree, 0)


def _summarise(info):
    # After resampling all weights are equal: the best particle continues as its first descendant.
    survivor = jnp.argmax(info.ancestors == info.estimate.best)
    summary = Summary(
        pose=info.estimate.mean,
        cov=info.estimate.cov,
        landmark_id=info.landmark_id[:, info.estimate.best],
        survivor=survivor,
        **{name: getattr(info, name) for name in COPIED},
    )
    return summary, ParticleHistory(info.pose, info.landmark_id, info.ancestors)


def filter_frames(key, state, count, odometry, measurements, params, config):
    """Filter the first `count` frames of a chunk; return state, `Summary` and `ParticleHistory`.

    No `lax.scan`: with a length known to the compiler, a loop of one step would be compiled
    differently, and the padding of the last chunk would be filtered too. Both change last bits.
    """

    def filter_frame(state, i):
        frame = jax.tree.map(
            lambda leaf: jax.lax.dynamic_index_in_dim(leaf, i, keepdims=False),
            (odometry, measurements),
        )
        state, info = fastslam.step(key, state, *frame, params, config)
        return state, _summarise(info)

    def body(i, carry):
        state, kept = carry
        state, new = filter_frame(state, i)
        put = jax.lax.dynamic_update_index_in_dim
        return state, jax.tree.map(lambda column, entry: put(column, entry, i, 0), kept, new)

    kept = jax.tree.map(
        lambda leaf: jnp.zeros((len(odometry.dx), *leaf.shape), leaf.dtype),
        jax.eval_shape(filter_frame, state, 0)[1],
    )
    return jax.lax.fori_loop(0, count, body, (state, kept))


def chunk_size(config):
    """Number of frames of a chunk; at least two: an axis of length 1 is compiled differently."""
    return max(2, min(CHUNK, CHUNK_BYTES // (node_bytes(config) * config.particles)))


def split_into_chunks(data, config, start=0, stops=()):
    """Yield the frames from `start` on as (number of frames, chunk), all padded to one length.

    A chunk ends where the number of frames done is one of the `stops`.
    """
    real = jnp.zeros(()).dtype
    size, begin = chunk_size(config), start
    while begin < len(data.time):
        end = next((i for i in range(begin + 1, begin + size) if i in stops), begin + size)
        part = jax.tree.map(
            lambda leaf, begin=begin, end=end: leaf[begin:end], (data.odometry, data.measurements)
        )
        count = len(part[0].dx)
        begin += count

        def fill(leaf, missing=size - count):
            leaf = np.pad(leaf, [(0, missing), *[(0, 0)] * (leaf.ndim - 1)])
            return jnp.asarray(leaf.astype(real) if leaf.dtype.kind == "f" else leaf)

        yield count, jax.tree.map(fill, part)
