"""A whole run: a `Log` in, a `Result` out."""

import dataclasses
import time
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config import Config
from jaxslam.filter import sharding
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.appearance_space import fit_appearance_space
from jaxslam.parameter_file import validate
from jaxslam.parameters import default_params
from jaxslam.results.events import association_entropy
from jaxslam.runs import compiled
from jaxslam.runs import memory as capacity
from jaxslam.runs.assemble import (
    RunProgress,
    assemble_result,
    local_origin,
    logged_identity,
    settle_donated,
)
from jaxslam.runs.compiled import (
    compile_loop,
    estimate_memory,
    split_into_chunks,
    state_shapes,
)
from jaxslam.smoother.genealogy import Tree, trace_lineage
from jaxslam.smoother.rejuvenation import Rejuvenator


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
        settings["descriptors"] = len(fit_appearance_space(log).within)
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
    data = frames_of(log, config, params)
    if progress:
        progress(0, len(data.time), "")
    numbers = jax.tree.map(jnp.asarray, params)
    capacity.check_memory(
        estimate_memory(config, len(data.time)), config
    )  # before compiling, which takes long
    if checkpoints:
        checkpoints.begin(log, config, params, seed)

    total, key = len(data.time), jax.random.key(seed)
    at, steps, compile_seconds = (
        checkpoints and checkpoints.restore(state_shapes(config)),
        None,
        0.0,
    )
    if not at or at.done < total:
        begin = time.perf_counter()
        steps = compile_loop(config, next(iter(split_into_chunks(data, config)))[1], numbers)
        compile_seconds = time.perf_counter() - begin
        capacity.trim_heap()
        need = capacity.memory_of_compiled(steps, estimate_memory(config, total), config)
        if sharding.is_leader() and (checkpoints or need.total > 1e9):
            capacity.print_memory(need)
        if not at:
            capacity.check_memory(need, config)
    if checkpoints:
        checkpoints.claim()
    if not at:
        state = initial_state(log, config, key)
        at = RunProgress(state, [], Tree() if sharding.is_leader() else None, 0, 0.0, None, [])
    renewal = Rejuvenator(data, log, local_origin(log), params, config)
    at = _filter(steps, key, at, data, numbers, config, renewal, progress, checkpoints)
    result = assemble_result(at, log, config, params, seed, data, compile_seconds)
    return refine_result(result) if refine else result


def initial_state(log, config, key):
    """The `State` before a log's first frame."""
    return fastslam.init(config, key, log.start_pose - local_origin(log), log.start_cov)


def refine_result(result, progress=None):
    """The result with its best particle's lineage refined (`refine.refine`); as it is if it has no
    finite lineage, or (with `refine_seconds`, and a flag) if that takes too much memory or has no
    solution. `progress`: called with (iterations done, None)."""
    from jaxslam.smoother.refine import refine  # here: the filter alone does without it

    past, log, config = result.lineage, result.log, result.config
    if past is None or not np.isfinite(past.pose).all():
        return result
    begin = time.perf_counter()
    data = frames_of(log, dataclasses.replace(config, descriptors=0), result.params)
    try:
        found = refine(
            data, past.pose, past.landmark_id, log.start_pose, log.start_cov, result.params,
            config.sensor, known=config.association == "known",
            progress=progress and (lambda done, _: progress(done, None)),
        )  # fmt: skip
    except (MemoryError, np.linalg.LinAlgError):  # what was filtered is not lost with it
        return dataclasses.replace(result, refine_seconds=time.perf_counter() - begin)
    found = found._replace(identity=logged_identity(found.identity, data.identities))
    return dataclasses.replace(result, refined=found, refine_seconds=time.perf_counter() - begin)


def frames_of(log, config, params):
    """`Frames` of a log, as a configuration asks for them."""
    known = config.association == "known"
    sizes = config.measurements, params, known, config.descriptors
    return frames_from_log(log, config.sensor, *sizes)


def _filter(steps, key, at, data, params, config, renewal, progress, checkpoints):
    """`Filtered` at the end: from where it is `at`, the compiled `steps` over all chunks."""
    total, start, begin = len(data.time), at.done, time.perf_counter() - at.seconds
    session = time.perf_counter()
    with checkpoints.watching() if checkpoints else nullcontext():
        for count, chunk in split_into_chunks(data, config, at.done, renewal.due):
            if at.done in renewal.due:
                at = _rejuvenate(renewal, key, at, config)
            state = _run_chunk(steps, (key, at.state, jnp.int32(count), *chunk, params), at, count)
            spent = time.perf_counter() - begin
            tree = at.tree
            if (
                tree is not None
                and tree.nodes * 4 * (config.measurements + 4) > compiled.TREE_BYTES
            ):
                tree = None
            at = at._replace(state=state, tree=tree, done=at.done + count, seconds=spent)
            speed = (at.done - start) / (time.perf_counter() - session)
            # All processes work this out, or none; it is one of them that says it.
            line = (
                _progress_line(at, speed)
                if progress or checkpoints or jax.process_count() > 1
                else ""
            )
            if progress:
                progress(at.done, total, line)
            if checkpoints:
                checkpoints.reached(at, total, line)
    return at


def _rejuvenate(renewal, key, at, config):
    """Where the filter is with its past refined and its particles drawn anew; as it is if the
    genealogy was given up."""
    if not sharding.broadcast_int(int(at.tree is not None)):
        return at
    best = int(at.summaries[-1].survivor[-1])
    since = trace_lineage(at.tree, best) if at.tree is not None else None
    state = settle_donated(at.state, config)
    state, past, lost = renewal.rejuvenated(key, state, at.past, since, at.done, best)
    if lost is None:
        return at._replace(state=state, past=past)
    last = at.summaries[-1]
    overflow = np.array(last.overflow)
    overflow[-1] += lost * config.particles
    summaries = [*at.summaries[:-1], last._replace(overflow=overflow)]
    return at._replace(
        state=state, summaries=summaries, tree=Tree() if sharding.is_leader() else None, past=past
    )


def _run_chunk(steps, given, at, count):
    """One chunk's steps, added to what there is; gives the state after it."""
    state, found = steps(*given)
    # The last chunk is filled up.
    summary, past = jax.tree.map(lambda leaf: sharding.to_host(leaf)[:count], found)
    at.summaries.append(summary)
    at.entropy.append(association_entropy(past.landmark_id, past.ancestors))
    if at.tree is not None:
        at.tree.extend(*past)
    return state


def _progress_line(at, speed):
    """One line on how it goes: speed, effective sample size, the best particle's landmarks."""
    last = at.summaries[-1]
    held = int(_count_landmarks(at.state, last.survivor[-1]))
    size = capacity.resident_bytes()
    memory = "" if size is None else f", {size / 1e9:.1f} GB"
    return f"{speed:.3g} steps/s, ESS {last.ess[-1]:.0f}, {held} landmarks{memory}"


@jax.jit
def _count_landmarks(state, particle):
    """How many landmarks one particle has."""
    at, past = particle, state.ancestry
    count = state.landmarks.count
    if past is not None:  # each slot's are where the particle's ancestor was
        at = jnp.where(past.chain < 0, particle, past.chains[past.chain, particle])
    return jnp.sum(count[jnp.arange(len(count)), at] > 0)
