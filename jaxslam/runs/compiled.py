"""The compiled loop over a chunk of frames, and what it needs."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import sharding
from jaxslam.filter import step as fastslam
from jaxslam.runs import memory as capacity
from jaxslam.runs.assemble import ParticleHistory, Summary

CHUNK = 256  # frames per compiled loop, at most: one compilation serves logs of every length
CHUNK_BYTES = 2**28  # what a chunk may hand over, at most
TREE_BYTES = 2**31  # what the genealogy may take; beyond that it is given up


def state_shapes(config):
    """Shapes, types and places of the `State`, none of it made."""
    state = jax.eval_shape(lambda key: fastslam.init(config, key), jax.random.key(0))
    state = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), state)
    if config.devices == 1:
        return state
    return jax.tree.map(
        lambda leaf, place: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place),
        state,
        sharding.shardings(fastslam.layout(state), config),
    )


def compile_loop(config, chunk, params):
    """The compiled loop over a chunk of frames; the state need not be there yet."""
    shapes_of = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), jnp.result_type(leaf)), (*chunk, params)
    )
    leaves, kind = jax.tree.flatten(shapes_of)
    return _compile(config, tuple(leaves), kind)


@lru_cache(maxsize=2)
def _compile(config, leaves, kind):
    given = state_shapes(config), jnp.int32(0), *jax.tree.unflatten(kind, leaves)
    # The state is given up (donated): no second copy of the map.
    steps = jax.jit(
        filter_frames,
        static_argnames="config",
        donate_argnames="state",
        out_shardings=_output_shardings(config),
    )
    return steps.lower(jax.random.key(0), *given, config).compile()


def _output_shardings(config):
    """Where what `filter_frames` gives belongs: its state is to fit the next chunk's."""
    if config.devices == 1:
        return None
    lanes = jax.sharding.PartitionSpec(None, None, sharding.AXIS)
    past = ParticleHistory(pose=lanes, landmark_id=lanes, ancestors=sharding.ALL)
    places = Summary(*[sharding.ALL] * len(Summary._fields)), past
    return jax.tree.map(lambda leaf: leaf.sharding, state_shapes(config)), sharding.shardings(
        places, config
    )


def estimate_memory(config, steps):
    """`capacity.Memory` of a run of so many steps, as far as it is known before compiling."""
    row = 4 * (config.measurements + 4)  # bytes of a node of the genealogy, or of `Leaves`
    chunk = min(steps, chunk_size(config)) * row * config.particles
    if config.rejuvenate:  # the draws, and what becomes of them
        chunk = max(chunk, 3 * 4 * (3 + 2 * config.landmarks) * config.particles)
    tree = min(TREE_BYTES, steps * row * config.particles)
    return capacity.Memory(capacity.bytes_of(state_shapes(config)), chunk, tree, 0)


def _summarise(info):
    # After resampling all weights are equal: the best particle lives on in its first child.
    survivor = jnp.argmax(info.ancestors == info.estimate.best)
    summary = Summary(
        pose=info.estimate.mean,
        cov=info.estimate.cov,
        landmark_id=info.landmark_id[:, info.estimate.best],
        survivor=survivor,
        **{name: getattr(info, name) for name in Summary._fields if hasattr(info, name)
           and name not in ("pose", "landmark_id")},
    )  # fmt: skip
    return summary, ParticleHistory(info.pose, info.landmark_id, info.ancestors)


def filter_frames(key, state, count, odometry, measurements, params, config):
    """The first `count` steps of a chunk of frames, and what is kept of each.

    No `lax.scan`: if the compiler knew the length, a loop of one step would be compiled otherwise,
    and frames of nothing that fill up the last chunk would be filtered too. Both change last bits.
    """

    def one(state, i):
        frame = jax.tree.map(
            lambda leaf: jax.lax.dynamic_index_in_dim(leaf, i, keepdims=False),
            (odometry, measurements),
        )
        state, info = fastslam.step(key, state, *frame, params, config)
        return state, _summarise(info)

    def body(i, carry):
        state, kept = carry
        state, found = one(state, i)
        put = jax.lax.dynamic_update_index_in_dim
        return state, jax.tree.map(lambda whole, part: put(whole, part, i, 0), kept, found)

    kept = jax.tree.map(
        lambda leaf: jnp.zeros((len(odometry.dx), *leaf.shape), leaf.dtype),
        jax.eval_shape(one, state, 0)[1],
    )
    return jax.lax.fori_loop(0, count, body, (state, kept))


def chunk_size(config):
    """Frames of a chunk; at least two, since an axis of length 1 would be compiled otherwise."""
    frame = 4 * (config.measurements + 4) * config.particles  # bytes of a frame's `Leaves`
    return max(2, min(CHUNK, CHUNK_BYTES // frame))


def split_into_chunks(data, config, start=0, stops=()):
    """The frames from `start` on in chunks of one length: how many, and what is short filled up.
    None goes beyond one of the `stops`, numbers of frames done."""
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
