"""A whole run: a `Log` in, a `Result` out."""

import dataclasses
import time
from contextlib import nullcontext
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config import Config, default_params
from jaxslam.filter import sharding
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames
from jaxslam.logs.appearance_space import space
from jaxslam.parameter_file import validate
from jaxslam.results.ambiguity import entropy
from jaxslam.runs import memory as capacity
from jaxslam.runs.assemble import (
    Filtered,
    Leaves,
    Summary,
    identity_of,
    origin_of,
    result_of,
    settled,
)
from jaxslam.smoother.genealogy import Tree, lineage
from jaxslam.smoother.rejuvenation import Rejuvenation

CHUNK = 256  # frames per compiled loop, at most: one compilation serves logs of every length
CHUNK_BYTES = 2**28  # what a chunk may hand over, at most
TREE_BYTES = 2**31  # what the genealogy may take; beyond that it is given up


def config_for(log, sensor=None, association="maximum_likelihood", **settings):
    """A `Config` whose sensor and sizes fit the log; `settings` are further `Config` fields.

    Hidden bearings get the informed proposal unless told otherwise, and looks help to associate
    them as far as the log's descriptors tell landmarks apart.
    """
    if sensor is None:
        sensor = next(s for s in ("range_bearing", "position", "bearing") if log.has(s))
    settings.setdefault("measurements", max(1, int(np.bincount(log.frame, minlength=1).max())))
    if association == "known" and log.identity is not None:
        settings.setdefault("landmarks", max(1, len(np.unique(log.identity[log.identity >= 0]))))
    if sensor == "bearing" and association == "maximum_likelihood":
        settings.setdefault("proposal", "informed")
    if sensor == "bearing" and association != "known" and "descriptors" not in settings:
        settings["descriptors"] = len(space(log).within)
    return Config(sensor=sensor, association=association, **settings)


def run(log, config=None, params=None, seed=0, progress=None, refine=True, checkpoints=None):
    """Filter a whole log, and refine what it found.

    `config`: None for `config_for(log)`; `params`: None for `default_params`; `progress`: called
    with (frames done, frames in all, a line about how it goes) now and then, first with (0, T, "")
    before compiling. `refine`: improve the best particle's path and map by least squares
    (`refined`). `checkpoints`: an `offline.Checkpoints` that has been entered, to go on from and to
    write to. Raises `ValueError` when the log can't supply what the configuration asks, or memory
    does not suffice.
    """
    config = config_for(log) if config is None else config
    params = default_params(config.sensor, log) if params is None else params
    params = validate(params, "params")
    data = framed(log, config, params)
    if progress:
        progress(0, len(data.time), "")
    numbers = jax.tree.map(jnp.asarray, params)
    capacity.check(needed(config, len(data.time)), config)  # before compiling, which takes long
    if checkpoints:
        checkpoints.begin(log, config, params, seed)

    total, key = len(data.time), jax.random.key(seed)
    at, steps, compile_seconds = checkpoints and checkpoints.restore(shapes(config)), None, 0.0
    if not at or at.done < total:
        begin = time.perf_counter()
        steps = compiled(config, next(iter(chunks(data, config)))[1], numbers)
        compile_seconds = time.perf_counter() - begin
        capacity.give_back()
        need = capacity.of_compiled(steps, needed(config, total), config)
        if sharding.leads() and (checkpoints or need.total > 1e9):
            capacity.tell(need)
        if not at:
            capacity.check(need, config)
    if checkpoints:
        checkpoints.claim()
    if not at:
        state = started(log, config, key)
        at = Filtered(state, [], Tree() if sharding.leads() else None, 0, 0.0, None, [])
    renewal = Rejuvenation(data, log, origin_of(log), params, config)
    at = _filtered(steps, key, at, data, numbers, config, renewal, progress, checkpoints)
    result = result_of(at, log, config, params, seed, data, compile_seconds)
    return refined(result) if refine else result


def started(log, config, key):
    """The `State` before a log's first frame."""
    return fastslam.init(config, key, log.start_pose - origin_of(log), log.start_cov)


def refined(result, progress=None):
    """The result with its best particle's lineage refined (`refine.refine`); as it is if it has no
    finite lineage, or (with `refine_seconds`, and a flag) if that takes too much memory or has no
    solution. `progress`: called with (iterations done, None)."""
    from jaxslam.smoother.refine import refine  # here: the filter alone does without it

    past, log, config = result.lineage, result.log, result.config
    if past is None or not np.isfinite(past.pose).all():
        return result
    begin = time.perf_counter()
    data = framed(log, dataclasses.replace(config, descriptors=0), result.params)
    try:
        found = refine(
            data, past.pose, past.birth, log.start_pose, log.start_cov, result.params,
            config.sensor, known=config.association == "known",
            progress=progress and (lambda done, _: progress(done, None)),
        )  # fmt: skip
    except (MemoryError, np.linalg.LinAlgError):  # what was filtered is not lost with it
        return dataclasses.replace(result, refine_seconds=time.perf_counter() - begin)
    found = found._replace(identity=identity_of(found.identity, data.identities))
    return dataclasses.replace(result, refined=found, refine_seconds=time.perf_counter() - begin)


def framed(log, config, params):
    """`Frames` of a log, as a configuration asks for them."""
    known = config.association == "known"
    sizes = config.measurements, params, known, config.descriptors
    return frames(log, config.sensor, *sizes)


def shapes(config):
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


def compiled(config, chunk, params):
    """The compiled loop over a chunk of frames; the state need not be there yet."""
    shapes_of = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), jnp.result_type(leaf)), (*chunk, params)
    )
    leaves, kind = jax.tree.flatten(shapes_of)
    return _compiled(config, tuple(leaves), kind)


@lru_cache(maxsize=2)
def _compiled(config, leaves, kind):
    given = shapes(config), jnp.int32(0), *jax.tree.unflatten(kind, leaves)
    # The state is given up (donated): no second copy of the map.
    steps = jax.jit(
        filter_frames,
        static_argnames="config",
        donate_argnames="state",
        out_shardings=_places(config),
    )
    return steps.lower(jax.random.key(0), *given, config).compile()


def _places(config):
    """Where what `filter_frames` gives belongs: its state is to fit the next chunk's."""
    if config.devices == 1:
        return None
    lanes = jax.sharding.PartitionSpec(None, None, sharding.AXIS)
    past = Leaves(pose=lanes, birth=lanes, ancestors=sharding.ALL)
    places = Summary(*[sharding.ALL] * len(Summary._fields)), past
    return jax.tree.map(lambda leaf: leaf.sharding, shapes(config)), sharding.shardings(
        places, config
    )


def needed(config, steps):
    """`capacity.Memory` of a run of so many steps, as far as it is known before compiling."""
    row = 4 * (config.measurements + 4)  # bytes of a node of the genealogy, or of `Leaves`
    chunk = min(steps, chunk_size(config)) * row * config.particles
    if config.rejuvenate:  # the draws, and what becomes of them
        chunk = max(chunk, 3 * 4 * (3 + 2 * config.landmarks) * config.particles)
    tree = min(TREE_BYTES, steps * row * config.particles)
    return capacity.Memory(capacity.of_arrays(shapes(config)), chunk, tree, 0)


def _filtered(steps, key, at, data, params, config, renewal, progress, checkpoints):
    """`Filtered` at the end: from where it is `at`, the compiled `steps` over all chunks."""
    total, start, begin = len(data.time), at.done, time.perf_counter() - at.seconds
    session = time.perf_counter()
    with checkpoints.watching() if checkpoints else nullcontext():
        for count, chunk in chunks(data, config, at.done, renewal.due):
            if at.done in renewal.due:
                at = _rejuvenated(renewal, key, at, config)
            state = _chunk(steps, (key, at.state, jnp.int32(count), *chunk, params), at, count)
            spent = time.perf_counter() - begin
            tree = at.tree
            if tree is not None and tree.nodes * 4 * (config.measurements + 4) > TREE_BYTES:
                tree = None
            at = at._replace(state=state, tree=tree, done=at.done + count, seconds=spent)
            speed = (at.done - start) / (time.perf_counter() - session)
            # All processes work this out, or none; it is one of them that says it.
            line = _told(at, speed) if progress or checkpoints or jax.process_count() > 1 else ""
            if progress:
                progress(at.done, total, line)
            if checkpoints:
                checkpoints.reached(at, total, line)
    return at


def _rejuvenated(renewal, key, at, config):
    """Where the filter is with its past refined and its particles drawn anew; as it is if the
    genealogy was given up."""
    if not sharding.agreed(int(at.tree is not None)):
        return at
    best = int(at.summaries[-1].survivor[-1])
    since = lineage(at.tree, best) if at.tree is not None else None
    state = settled(at.state, config)
    state, past, lost = renewal.rejuvenated(key, state, at.past, since, at.done, best)
    if lost is None:
        return at._replace(state=state, past=past)
    last = at.summaries[-1]
    overflow = np.array(last.overflow)
    overflow[-1] += lost * config.particles
    summaries = [*at.summaries[:-1], last._replace(overflow=overflow)]
    return at._replace(
        state=state, summaries=summaries, tree=Tree() if sharding.leads() else None, past=past
    )


def _chunk(steps, given, at, count):
    """One chunk's steps, added to what there is; gives the state after it."""
    state, found = steps(*given)
    # The last chunk is filled up.
    summary, past = jax.tree.map(lambda leaf: sharding.fetched(leaf)[:count], found)
    at.summaries.append(summary)
    at.entropy.append(entropy(past.birth, past.ancestors))
    if at.tree is not None:
        at.tree.extend(*past)
    return state


def _told(at, speed):
    """One line on how it goes: speed, effective sample size, the best particle's landmarks."""
    last = at.summaries[-1]
    held = int(_held(at.state, last.survivor[-1]))
    size = capacity.resident()
    memory = "" if size is None else f", {size / 1e9:.1f} GB"
    return f"{speed:.3g} steps/s, ESS {last.ess[-1]:.0f}, {held} landmarks{memory}"


@jax.jit
def _held(state, particle):
    """How many landmarks one particle has."""
    at, past = particle, state.ancestry
    count = state.landmarks.count
    if past is not None:  # each slot's are where the particle's ancestor was
        at = jnp.where(past.chain < 0, particle, past.chains[past.chain, particle])
    return jnp.sum(count[jnp.arange(len(count)), at] > 0)


def _summarise(info):
    # After resampling all weights are equal: the best particle lives on in its first child.
    survivor = jnp.argmax(info.ancestors == info.estimate.best)
    summary = Summary(
        pose=info.estimate.mean,
        cov=info.estimate.cov,
        match=info.birth[:, info.estimate.best],
        survivor=survivor,
        **{name: getattr(info, name) for name in Summary._fields if hasattr(info, name)
           and name not in ("pose", "match")},
    )  # fmt: skip
    return summary, Leaves(info.pose, info.birth, info.ancestors)


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


def chunks(data, config, start=0, stops=()):
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
