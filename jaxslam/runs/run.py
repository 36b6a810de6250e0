"""A whole run: a `Log` in, a `Result` out."""

import dataclasses
import time
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config import Config, default_params
from jaxslam.filter import sharding
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames
from jaxslam.logs.appearance_space import space
from jaxslam.parameter_file import validate
from jaxslam.results.events import entropy
from jaxslam.runs import memory as capacity
from jaxslam.runs.assemble import (
    Filtered,
    identity_of,
    origin_of,
    result_of,
    settled,
)
from jaxslam.runs.compiled import TREE_BYTES, chunks, compiled, needed, shapes
from jaxslam.smoother.genealogy import Tree, lineage
from jaxslam.smoother.rejuvenation import Rejuvenation


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
