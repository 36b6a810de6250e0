"""Run the filter over a log: a `Log` in, a `Result` out."""

import dataclasses
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config import SENSORS, Config
from jaxslam.filter import sharding
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.log import Log
from jaxslam.parameter_file import validate
from jaxslam.parameters import Params, default_params
from jaxslam.results.result import Result
from jaxslam.runs import assemble, compiled, memory
from jaxslam.runs.assemble import RunProgress
from jaxslam.smoother.genealogy import Tree, trace_lineage
from jaxslam.smoother.rejuvenation import Rejuvenator

if TYPE_CHECKING:
    from jaxslam.runs.checkpoints import Checkpoints, FollowerCheckpoints


def config_for(
    log: Log, sensor: str | None = None, association: str = "maximum_likelihood", **settings: Any
) -> Config:
    """Return a `Config` whose sensor and sizes fit the log; `settings`: further `Config` fields.

    Bearings with unknown association get the informed proposal, unless `settings` name another, and
    as many descriptors as tell the log's landmarks apart.
    """
    if sensor is None:
        sensor = next(s for s in SENSORS if log.has(s))
    settings.setdefault("measurements", max(1, int(np.bincount(log.frame, minlength=1).max())))
    if association == "known" and log.identity is not None:
        settings.setdefault("landmarks", max(1, len(np.unique(log.identity[log.identity >= 0]))))
    if sensor == "bearing" and association == "maximum_likelihood":
        settings.setdefault("proposal", "informed")
    if sensor == "bearing" and association != "known" and "descriptors" not in settings:
        settings["descriptors"] = len(log.appearance_space.within)
    return Config(sensor=sensor, association=association, **settings)


def run(
    log: Log,
    config: Config | None = None,
    params: Params | None = None,
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
    refine: bool = True,
    checkpoints: "Checkpoints | FollowerCheckpoints | None" = None,
) -> Result:
    """Filter a log and refine the best particle's path and map.

    `config`: None for `config_for(log)`. `params`: None for `default_params`. `progress`: called
    after every chunk with (frames done, number of frames, a line of text), first with (0, T, "")
    before compiling. `refine`: improve path and map by least squares (`Result.refined`).
    `checkpoints`: `checkpoints.Checkpoints` that have been entered, to resume from and to write to.
    Raises `ValueError` if the log lacks what the configuration needs, or memory does not suffice.
    """
    config = config_for(log) if config is None else config
    params = default_params(config.sensor, log) if params is None else params
    params = validate(params, "params")
    data = frames_from_log(log, config, params)
    if progress:
        progress(0, len(data.time), "")
    # Before compiling, which takes long.
    memory.check_memory(compiled.estimate_memory(config, len(data.time)), config)

    so_far = None
    if checkpoints:
        checkpoints.check_fingerprint(log, config, params, seed)
        so_far = checkpoints.restore(compiled.state_shapes(config))
    filter_chunk, compile_seconds = None, 0.0
    if so_far is None or so_far.done < len(data.time):
        begin, chunks = time.perf_counter(), compiled.split_into_chunks(data, config)
        numbers = jax.tree.map(jnp.asarray, params)
        filter_chunk = compiled.compile_loop(config, next(chunks)[1], numbers)
        compile_seconds = time.perf_counter() - begin
        _check_compiled(filter_chunk, len(data.time), config, so_far, checkpoints)
    if checkpoints:
        checkpoints.take_over_folder()

    key = jax.random.key(seed)
    if so_far is None:
        tree = Tree() if sharding.is_leader() else None
        so_far = RunProgress(initial_state(log, config, key), [], tree, 0, 0.0, None, [])
    rejuvenator = Rejuvenator(data, log, assemble.local_origin(log), params, config)
    so_far = _filter(
        filter_chunk, key, so_far, data, params, config, rejuvenator, progress, checkpoints
    )
    result = assemble.assemble_result(so_far, log, config, params, seed, data, compile_seconds)
    return refine_result(result) if refine else result


def _check_compiled(filter_chunk, frames, config, so_far, checkpoints):
    """Print the memory that a large run needs; raise `ValueError` if a new run does not fit."""
    memory.trim_heap()
    need = memory.memory_of_compiled(filter_chunk, compiled.estimate_memory(config, frames), config)
    if sharding.is_leader() and (checkpoints or need.total > 1e9):
        memory.print_memory(need)
    if so_far is None:
        memory.check_memory(need, config)


def initial_state(log, config, key):
    """Make the `State` before a log's first frame."""
    return fastslam.init(config, key, log.start_pose - assemble.local_origin(log), log.start_cov)


def refine_result(result, progress=None):
    """Refine the best particle's lineage and return the result with it.

    Returned as it is without a finite lineage, and with `refine_seconds` only (which raises a flag)
    if refinement takes too much memory or has no solution. `progress`: called with (iterations
    done, None).
    """
    from jaxslam.smoother.refine import refine  # here: the filter alone does without it

    lineage, log, config = result.lineage, result.log, result.config
    if lineage is None or not np.isfinite(lineage.pose).all():
        return result
    begin = time.perf_counter()
    data = frames_from_log(log, dataclasses.replace(config, descriptors=0), result.params)
    try:
        refined = refine(
            data, lineage.pose, lineage.landmark_id, log.start_pose, log.start_cov, result.params,
            config.sensor, known=config.association == "known",
            progress=progress and (lambda done, _: progress(done, None)),
        )  # fmt: skip
        identity = assemble.logged_identity(refined.identity, data.identities)
        refined = refined._replace(identity=identity)
    except (MemoryError, np.linalg.LinAlgError):  # keep what was filtered
        refined = result.refined
    return dataclasses.replace(result, refined=refined, refine_seconds=time.perf_counter() - begin)


def _filter(filter_chunk, key, so_far, data, params, config, rejuvenator, progress, checkpoints):
    """Filter the frames after `so_far` chunk by chunk; return the `RunProgress` at the end."""
    total, params = len(data.time), jax.tree.map(jnp.asarray, params)
    start, before, begin = so_far.done, so_far.seconds, time.perf_counter()
    with checkpoints.catch_signals() if checkpoints else nullcontext():
        for count, chunk in compiled.split_into_chunks(data, config, start, rejuvenator.due):
            if so_far.done in rejuvenator.due:
                so_far = _rejuvenate(rejuvenator, key, so_far, config)
            state = _run_chunk(
                filter_chunk, (key, so_far.state, jnp.int32(count), *chunk, params), so_far, count
            )
            elapsed, tree = time.perf_counter() - begin, so_far.tree
            if tree is not None and tree.nodes * compiled.node_bytes(config) > compiled.TREE_BYTES:
                tree = None
            so_far = so_far._replace(
                state=state, tree=tree, done=so_far.done + count, seconds=before + elapsed
            )
            line = ""
            # The state is on all processes, so each of them computes the line, or none.
            if progress or checkpoints or jax.process_count() > 1:
                line = _progress_line(so_far, (so_far.done - start) / elapsed)
            if progress:
                progress(so_far.done, total, line)
            if checkpoints:
                checkpoints.save_if_due(so_far, total, line)
    return so_far


def _rejuvenate(rejuvenator, key, so_far, config):
    """Refine the best particle's lineage and redraw all particles; no change if the genealogy was
    given up."""
    if not sharding.broadcast_int(int(so_far.tree is not None)):
        return so_far
    last = so_far.summaries[-1]
    best = int(last.survivor[-1])
    lineage = trace_lineage(so_far.tree, best) if so_far.tree is not None else None
    state, shared_past, lost = rejuvenator.rejuvenate(
        key,
        assemble.settle_donated(so_far.state, config),
        so_far.shared_past,
        lineage,
        so_far.done,
        best,
    )
    so_far = so_far._replace(state=state, shared_past=shared_past)
    if lost is None:
        return so_far
    overflow = np.array(last.overflow)
    overflow[-1] += lost * config.particles
    return so_far._replace(
        summaries=[*so_far.summaries[:-1], last._replace(overflow=overflow)],
        tree=Tree() if sharding.is_leader() else None,
    )


def _run_chunk(filter_chunk, arguments, so_far, count):
    """Filter a chunk, append its `count` steps to `so_far`, and return the state after it."""
    state, kept = filter_chunk(*arguments)
    # The last chunk is padded.
    so_far.add_chunk(*jax.tree.map(lambda leaf: sharding.to_host(leaf)[:count], kept))
    return state


def _progress_line(so_far, speed):
    """Format speed, effective sample size, number of the best particle's landmarks, and memory."""
    last = so_far.summaries[-1]
    landmarks = int(_count_landmarks(so_far.state, last.survivor[-1]))
    size = memory.resident_bytes()
    text = "" if size is None else f", {size / 1e9:.1f} GB"
    return f"{speed:.3g} steps/s, ESS {last.ess[-1]:.0f}, {landmarks} landmarks{text}"


@jax.jit
def _count_landmarks(state, particle):
    """Count the landmarks of one particle."""
    ancestor, ancestry = particle, state.ancestry
    count = state.landmarks.count
    if ancestry is not None:  # each slot is still where the particle's ancestor was
        composed = ancestry.chains[ancestry.chain, particle]
        ancestor = jnp.where(ancestry.chain < 0, particle, composed)
    return jnp.sum(count[jnp.arange(len(count)), ancestor] > 0)
