"""Sharding of particles over several devices, of one process or of several.

Each device moves, associates and updates its own particles. What concerns all (weights, ancestors,
bounds) is computed on every device from the same numbers in the same order, so that the result is
that of one device, bit for bit. Only log weights, poses, and landmarks of other devices that are
needed in candidate slots are sent (`halo_exchange`).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from jaxslam.filter.xla import barrier

AXIS = "particles"
ALL = PartitionSpec()  # replicated
PIECE = 2**26  # bytes of an array that are replicated at once


def mesh(config):
    """Mesh of the devices that share the particles; raises `ValueError` if there are too few."""
    return mesh_of(config.devices)


def mesh_of(count):
    """Mesh of `count` devices; raises `ValueError` if there are too few."""
    processes = jax.process_count()
    # Every process has the same number of them.
    share = -(-count // processes)
    found = [jax.local_devices(i)[:share] for i in range(processes)]
    found = [device for part in found for device in part]
    if len(found) != count:
        raise ValueError(
            f"Config.devices: {count}, but JAX has {len(jax.devices())} in {processes} "
            f"{'process' if processes == 1 else 'processes'}; on a CPU set jax_num_cpu_devices, "
            "or XLA_FLAGS, before JAX is first used"
        )
    return jax.sharding.Mesh(np.array(found), (AXIS,), (AxisType.Auto,))


def to_host(leaf):
    """Copy an array to this host; all processes that share it must call this, and get it.

    On a CPU it may be the device's memory: do not keep it, or the device cannot work in place.
    """
    if leaf.is_fully_replicated:
        return np.asarray(leaf)
    whole = np.empty(leaf.shape, leaf.dtype)
    if leaf.is_fully_addressable:
        # No `np.asarray`, as the array would keep that copy.
        for shard in leaf.addressable_shards:
            whole[shard.index] = shard.data
        return whole
    rows = whole.reshape(-1, leaf.shape[-1])
    some = min(len(rows), max(1, PIECE // rows[:1].nbytes))
    for start in range(0, len(rows), some):
        start = min(start, len(rows) - some)
        part = _rows(leaf, start, some, NamedSharding(leaf.sharding.mesh, ALL))
        rows[start : start + some] = np.asarray(part)
    return whole


@partial(jax.jit, static_argnames=("some", "sharding"))
def _rows(leaf, start, some, sharding):
    """Rows of an array [.., N], replicated."""
    part = jax.lax.dynamic_slice_in_dim(leaf.reshape(-1, leaf.shape[-1]), start, some)
    return jax.lax.with_sharding_constraint(part, sharding)


def to_devices(array, shape):
    """Copy a NumPy array to the devices, sharded as `shape` (`ShapeDtypeStruct`) says."""
    if shape.sharding is None:
        return jnp.array(array)
    return jax.make_array_from_callback(
        shape.shape, shape.sharding, lambda index: jnp.array(array[index])
    )


def broadcast_int(number):
    """Broadcast an integer of process 0; all processes must call this."""
    if jax.process_count() == 1:
        return number
    return int(multihost_utils.broadcast_one_to_all(np.int32(number)))


def broadcast(tree):
    """Broadcast arrays of process 0 (of others only shapes count); all processes must call this."""
    if jax.process_count() == 1:
        return tree
    return jax.tree.map(np.asarray, multihost_utils.broadcast_one_to_all(tree))


def is_leader():
    """Whether this process prints and writes for all."""
    return jax.process_index() == 0


def particle_sharded(tree):
    """`PartitionSpec` of every leaf [.., N] of a tree, sharded on the last axis."""
    return jax.tree.map(lambda leaf: PartitionSpec(*[None] * (leaf.ndim - 1), AXIS), tree)


def replicated(tree):
    """`PartitionSpec` of every leaf of a tree, replicated."""
    return jax.tree.map(lambda leaf: ALL, tree)


def shardings(specs, config):
    """`NamedSharding`s of a tree of `PartitionSpec`s; None for one device."""
    if config.devices == 1:
        return None
    over = mesh(config)
    return jax.tree.map(
        lambda spec: NamedSharding(over, spec),
        specs,
        is_leaf=lambda x: isinstance(x, PartitionSpec),
    )


def shard_map(function, specs, outcome, config):
    """Map a function over the devices (`jax.shard_map`); unchanged for one device."""
    if config.devices == 1:
        return function
    # The check does not know that gathered arrays are replicated.
    return jax.shard_map(
        function, mesh=mesh(config), in_specs=specs, out_specs=outcome, check_vma=False
    )


def all_gather(tree, config):
    """All-gather leaves [.., n] of the device's particles to [.., N] of all, in few messages."""
    if config.devices == 1:
        return barrier(tree)
    leaves, kind = jax.tree.flatten(tree)
    found = list(leaves)
    for every, rows in _gather_packed(leaves):
        every = jnp.moveaxis(every, 0, 1).reshape(every.shape[1], -1)
        for i, begin, end in rows:
            part = every[begin:end].reshape(*leaves[i].shape[:-1], -1)
            found[i] = jax.lax.bitcast_convert_type(part, leaves[i].dtype)
    return barrier(jax.tree.unflatten(kind, found))


def gather(trees, indices, config):
    """Gather each tree's leaves [.., n] at its `indices` [n] of all particles, on any device."""
    leaves, kind = jax.tree.flatten(trees)
    each, found = len(leaves) // len(indices), list(leaves)
    if config.devices == 1:
        for i, leaf in enumerate(leaves):
            rows = np.arange(leaf.size // leaf.shape[-1], dtype=np.int32).reshape(leaf.shape[:-1])
            found[i] = _at(leaf, rows, indices[i // each])
        return jax.tree.unflatten(kind, found)
    for every, parts in _gather_packed(leaves):
        count, n = every.shape[1:]
        # Of a particle's first number, in the order of the gathered array.
        first = barrier([index // n * (count * n) + index % n for index in indices])
        for i, begin, end in parts:
            rows = np.arange(begin, end, dtype=np.int32).reshape(leaves[i].shape[:-1])
            part = _at(every, rows, first[i // each])
            found[i] = jax.lax.bitcast_convert_type(part, leaves[i].dtype)
    return jax.tree.unflatten(kind, found)


def _at(array, rows, index):
    """Numbers of an array [.., n] at rows [..] and `index` [n], as if it were one row."""
    at = rows[..., None] * array.shape[-1] + index
    return array.reshape(-1).at[at].get(mode="promise_in_bounds")


def _gather_packed(leaves):
    """All-gather leaves [.., n] in few large messages (a small one costs as much as ten thousand
    numbers): for every item size an array [devices, rows, n], and its rows (leaf, from, to)."""
    for rows, whose in _pack(leaves):
        yield jax.lax.all_gather(rows, AXIS), whose


def _pack(leaves):
    """Pack leaves [.., n] of one item size into an array [rows, n]; with its (leaf, from, to)."""
    n = leaves[0].shape[-1]
    for size in sorted({leaf.dtype.itemsize for leaf in leaves}):
        number = {4: jnp.uint32, 8: jnp.uint64}[size]
        these = [i for i, leaf in enumerate(leaves) if leaf.dtype.itemsize == size]
        rows = [jax.lax.bitcast_convert_type(leaves[i], number).reshape(-1, n) for i in these]
        ends = np.cumsum([0, *map(len, rows)])
        yield jnp.concatenate(rows), list(zip(these, ends[:-1], ends[1:], strict=True))


def exchange_with_neighbours(leaves, b, config):
    """Exchange leaves [.., 2 b], a device's first and last b: returns the last b of the device
    before and the first b of the device after (zeros where there is none)."""
    found, pairs = list(leaves), range(config.devices - 1)
    for rows, whose in _pack(leaves):
        before = jax.lax.ppermute(rows[:, b:], AXIS, [(i, i + 1) for i in pairs])
        after = jax.lax.ppermute(rows[:, :b], AXIS, [(i + 1, i) for i in pairs])
        both = jnp.concatenate([before, after], 1)
        for i, begin, end in whose:
            part = both[begin:end].reshape(leaves[i].shape)
            found[i] = jax.lax.bitcast_convert_type(part, leaves[i].dtype)
    return found


def local_shard(tree, config):
    """Leaves [.., n] of the device's own particles, of leaves [.., N] of all."""
    if config.devices == 1:
        return tree
    n = config.particles // config.devices
    start = jax.lax.axis_index(AXIS) * n
    return jax.tree.map(
        lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, n, leaf.ndim - 1), tree
    )


def all_min(values, config):
    """Elementwise minimum over the devices; NaN stays."""
    if config.devices == 1:
        return values
    return jax.lax.all_gather(values, AXIS).min(0)


def all_sum(counts, config):
    """Sum of integers over the devices."""
    return counts if config.devices == 1 else jax.lax.psum(counts, AXIS)


def select_particle(tree, lane, config):
    """Leaves [..] of one particle of all, of leaves [.., n] of the device's own."""
    if config.devices == 1:
        return jax.tree.map(lambda leaf: leaf[..., lane], tree)
    holder, at = jnp.divmod(lane, config.particles // config.devices)
    return jax.tree.map(lambda leaf: jax.lax.all_gather(leaf[..., at], AXIS)[holder], tree)


def map_over_devices(function, items, count):
    """Map a function over items (first axis), sharded over `count` devices, in turn on each."""
    total = len(jax.tree.leaves(items)[0])
    if count == 1 or total == 1:
        return jax.lax.map(function, items)
    # Filled up with the first items, so that all devices have equally many.
    index = np.arange(-(-total // count) * count) % total
    share = PartitionSpec(AXIS)
    mapped = jax.shard_map(
        lambda part: jax.lax.map(function, part),
        mesh=mesh_of(count), in_specs=share, out_specs=share, check_vma=False,
    )  # fmt: skip
    found = mapped(jax.tree.map(lambda leaf: leaf[index], items))
    return jax.tree.map(lambda leaf: leaf[:total], found)
