"""A whole run: a `Log` in, a `Result` out."""

import dataclasses
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import filter as fastslam
from jaxslam import landmarks as maps
from jaxslam.config import Config, default_params
from jaxslam.frames import frames
from jaxslam.odometry import dead_reckoning
from jaxslam.paramfile import validate
from jaxslam.result import MapEstimate, Result
from jaxslam.smoothing import Lineage, Tree, ancestral, lineage

CHUNK = 256  # frames per compiled scan, at most: one compilation serves logs of every length
CHUNK_BYTES = 2**28  # what a chunk may hand over, at most
TREE_BYTES = 2**31  # what the genealogy may take; beyond that it is given up


class Summary(NamedTuple):
    """What a run keeps of every step (`filter.Info` has the meanings)."""

    pose: jax.Array
    cov: jax.Array
    ess: jax.Array
    resampled: jax.Array
    new: jax.Array
    overflow: jax.Array
    outliers: jax.Array
    forgotten: jax.Array
    log_evidence: jax.Array
    nonfinite: jax.Array
    degenerate: jax.Array
    match: jax.Array
    survivor: jax.Array


class Past(NamedTuple):
    """What the genealogy needs of every step, of all particles (`filter.Info`)."""

    pose: jax.Array
    birth: jax.Array
    ancestors: jax.Array


def config_for(log, sensor=None, association="maximum_likelihood", **settings):
    """A `Config` whose sensor and sizes fit the log; `settings` are further `Config` fields."""
    if sensor is None:
        sensor = next(s for s in ("range_bearing", "position", "bearing") if log.has(s))
    settings.setdefault("measurements", max(1, int(np.bincount(log.frame, minlength=1).max())))
    if association == "known" and log.identity is not None:
        settings.setdefault("landmarks", max(1, len(np.unique(log.identity[log.identity >= 0]))))
    return Config(sensor=sensor, association=association, **settings)


def run(log, config=None, params=None, seed=0, progress=None, refine=True):
    """Filter a whole log, and refine what it found.

    `config`: None for `config_for(log)`; `params`: None for `default_params`; `progress`: called
    with (frames done, frames in all) now and then, first with (0, T) before compiling. `refine`:
    improve the best particle's path and map by least squares (`refined`). Raises `ValueError` when
    the log can't supply what the configuration asks.
    """
    config = config_for(log) if config is None else config
    params = default_params(config.sensor, log) if params is None else params
    params = validate(params, "params")
    data = _frames(log, config, params)
    if progress:
        progress(0, len(data.time))
    # A local origin keeps coordinates small: float32 has 7 digits.
    origin = np.array([*log.start_pose[:2], 0.0])
    key = jax.random.key(seed)
    state = fastslam.init(config, key, log.start_pose - origin, log.start_cov)
    numbers = jax.tree.map(jnp.asarray, params)
    begin = time.perf_counter()
    first = next(iter(_chunks(data, config)))
    steps = _scan.lower(key, state, *first, numbers, config).compile()
    compile_seconds = time.perf_counter() - begin
    state, summary, tree = _filtered(steps, key, state, data, numbers, config, progress)
    best = int(summary.survivor[-1])
    state = fastslam.settled(state)
    world = _map(state, best, numbers, config, data.identities, origin)
    looking_back = _looking_back(tree, state.log_weight, best, origin)
    seconds = time.perf_counter() - begin - compile_seconds
    n = config.particles
    result = Result(
        log=log,
        config=config,
        params=params,
        seed=seed,
        time=data.time,
        pose=summary.pose + origin,
        overflow=summary.overflow / n,
        outliers=summary.outliers / n,
        forgotten=summary.forgotten / n,
        match=summary.match.astype(np.int64),
        row=data.row,
        landmarks=world,
        dead_reckoning=dead_reckoning(data.odometry, log.start_pose),
        seconds=seconds,
        compile_seconds=compile_seconds,
        dropped=data.dropped,
        **looking_back,
        **{name: getattr(summary, name) for name in (
            "cov", "ess", "resampled", "new", "log_evidence", "nonfinite", "degenerate")},
    )  # fmt: skip
    return refined(result) if refine else result


def refined(result, progress=None):
    """The result with its best particle's lineage refined (`refine.refine`); as it is if it has no
    finite lineage. `progress`: called with (iterations done, None)."""
    from jaxslam.refine import refine  # here: the filter alone does without it

    past, log, config = result.lineage, result.log, result.config
    if past is None or not np.isfinite(past.pose).all():
        return result
    begin = time.perf_counter()
    data = _frames(log, config, result.params)
    found = refine(
        data, past.pose, past.birth, log.start_pose, log.start_cov, result.params, config.sensor,
        known=config.association == "known",
        progress=progress and (lambda done, _: progress(done, None)),
    )  # fmt: skip
    found = found._replace(identity=_identity(found.identity, data.identities))
    return dataclasses.replace(result, refined=found, refine_seconds=time.perf_counter() - begin)


def _identity(dense, identities):
    """The log's identities of dense ones; -1 stays."""
    return np.append(identities, -1)[np.asarray(dense, np.int64)]


def _frames(log, config, params):
    known = config.association == "known"
    return frames(log, config.sensor, config.measurements, params, known)


def _filtered(steps, key, state, data, params, config, progress):
    """The compiled `steps` over all chunks: last state, `Summary`, genealogy (None: too large)."""
    total, kept, tree = len(data.time), [], Tree()
    row = 4 * (config.measurements + 4)  # bytes of a node
    done = 0
    for chunk in _chunks(data, config):
        state, (summary, past) = steps(key, state, *chunk, params)
        kept.append(jax.tree.map(np.asarray, summary))
        length = min(len(past.ancestors), total - done)  # without what fills up the last one
        if tree is not None:
            tree.extend(*(np.asarray(part)[:length] for part in past))
            tree = tree if tree.nodes * row <= TREE_BYTES else None
        done += length
        if progress:
            progress(done, total)
    summary = Summary(*(np.concatenate(parts)[:total] for parts in zip(*kept, strict=True)))
    return state, summary, tree


def _looking_back(tree, log_weight, best, origin):
    """`Result.ancestral` and `Result.lineage`, in the world's frame."""
    if tree is None:
        return {}
    whole, past = ancestral(tree, np.asarray(log_weight)), lineage(tree, best)
    return dict(
        ancestral=whole._replace(pose=whole.pose + origin),
        lineage=Lineage(past.pose + origin, past.birth),
    )


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
    return summary, Past(info.pose, info.birth, info.ancestors)


def _steps(key, state, odometry, measurements, params, config):
    return fastslam.run(key, state, odometry, measurements, params, config, _summarise)


# The state is given up to the scan (donated): no second copy of the map.
_scan = jax.jit(_steps, static_argnames="config", donate_argnames="state")


def _chunks(data, config):
    """The frames in chunks of one length, the last one filled up with frames of nothing."""
    real = jnp.zeros(()).dtype
    total = len(data.time)
    frame = 4 * (config.measurements + 4) * config.particles  # bytes of a frame's `Past`
    size = max(1, min(CHUNK, CHUNK_BYTES // frame))
    for start in range(0, total, size):
        part = jax.tree.map(
            lambda leaf, start=start: leaf[start : start + size],
            (data.odometry, data.measurements),
        )
        missing = size - len(part[0].dx)

        def fill(leaf, missing=missing):
            leaf = np.pad(leaf, [(0, missing), *[(0, 0)] * (leaf.ndim - 1)])
            return jnp.asarray(leaf.astype(real) if leaf.dtype.kind == "f" else leaf)

        yield jax.tree.map(fill, part)


def _map(state, best, params, config, identities, origin):
    """`MapEstimate`: the best particle's confirmed landmarks, averaged over all particles."""
    table = maps.summarise(state.landmarks, jnp.exp(state.log_weight), best, params, config)
    table = jax.tree.map(np.asarray, table)
    kept = np.flatnonzero(table.kept)
    # Known identities are slots; without them no slot has one.
    identity = _identity(np.where(kept < len(identities), kept, -1), identities)
    return MapEstimate(
        id=table.birth[kept].astype(np.int64),
        mean=table.mean[:, kept].T + origin[:2],
        cov=table.cov[:, kept].T.astype(float),
        n=table.count[kept].astype(np.int64),
        identity=identity,
    )
