"""What a run found, from where its filter ended: `Result`."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import map_estimate, sharding
from jaxslam.filter import step as fastslam
from jaxslam.logs.odometry import dead_reckoning
from jaxslam.results.result import MapEstimate, Result
from jaxslam.smoother.genealogy import Ancestral, Lineage, Tree, smooth_ancestral, trace_lineage
from jaxslam.smoother.rejuvenation import SharedPast


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
    landmark_id: jax.Array
    survivor: jax.Array


class ParticleHistory(NamedTuple):
    """What the genealogy needs of every step, of all particles (`filter.Info`)."""

    pose: jax.Array
    landmark_id: jax.Array
    ancestors: jax.Array


class RunProgress(NamedTuple):
    """How far the filter has come: its `state`, a `Summary` of every chunk (on the host), the
    genealogy (None: too large, or of another process) since the `past` that all share (None:
    none), frames `done`, and `seconds` that took; `entropy` of every chunk (`ambiguity`)."""

    state: fastslam.State
    summaries: list
    tree: Tree | None
    done: int
    seconds: float
    past: SharedPast | None
    entropy: list


def local_origin(log):
    """A local origin [3], which keeps coordinates small: float32 has 7 digits."""
    return np.array([*log.start_pose[:2], 0.0])


def assemble_result(at, log, config, params, seed, data, compile_seconds):
    """The `Result` of a filter that is done (`Filtered`), not refined."""
    numbers = jax.tree.map(jnp.asarray, params)
    return Result(
        log=log,
        config=config,
        params=params,
        seed=seed,
        time=data.time,
        row=data.row,
        dead_reckoning=dead_reckoning(data.odometry, log.start_pose),
        compile_seconds=compile_seconds,
        dropped=data.dropped,
        **_filter_fields(at, numbers, config, data.identities, local_origin(log)),
    )


def _filter_fields(at, params, config, identities, origin):
    """The fields of `Result` that the filter found, in the world's frame."""
    begin = time.perf_counter()
    summary = Summary(*(np.concatenate(parts) for parts in zip(*at.summaries, strict=True)))
    best, n = int(summary.survivor[-1]), config.particles
    state = settle_donated(at.state, config)
    found = _genealogy_fields(at, sharding.to_host(state.log_weight), best, origin)
    return found | dict(
        pose=summary.pose + origin,
        entropy=np.concatenate(at.entropy),
        overflow=summary.overflow / n,
        outliers=summary.outliers / n,
        forgotten=summary.forgotten / n,
        landmark_id=summary.landmark_id.astype(np.int64),
        landmarks=_map(state, best, params, config, identities, origin),
        seconds=at.seconds + time.perf_counter() - begin,
        **{name: getattr(summary, name) for name in (
            "cov", "ess", "resampled", "new", "log_evidence", "nonfinite", "degenerate")},
    )  # fmt: skip


def _genealogy_fields(at, log_weight, best, origin):
    """`Result.ancestral` and `Result.lineage`, in the world's frame, and the past's events."""
    if at.tree is None:
        return dict(events=None if at.past is None else at.past.event)
    whole, past, before = (
        smooth_ancestral(at.tree, log_weight),
        trace_lineage(at.tree, best),
        at.past,
    )
    if before is not None:
        # Every particle has drawn a path of its own there.
        alone, cov = np.full(len(before.pose), len(log_weight)), before.cov
        if len(cov) < len(alone):  # the last time failed: as if there were one ancestor
            alone, cov = np.ones_like(alone), np.zeros((len(alone), 3, 3))
        whole = _concatenate(Ancestral(before.pose, cov, alone), whole)
        past = _concatenate(Lineage(before.pose, before.landmark_id), past)
    return dict(
        ancestral=whole._replace(pose=whole.pose + origin),
        lineage=Lineage(past.pose + origin, past.landmark_id),
        events=None if before is None else before.event,
    )


def _concatenate(before, after):
    """Columns of one stretch of frames and of the next."""
    return type(after)(*map(np.concatenate, zip(before, after, strict=True)))


def logged_identity(dense, identities):
    """The log's identities of dense ones; -1 stays."""
    return np.append(identities, -1)[np.asarray(dense, np.int64)]


def _map(state, best, params, config, identities, origin):
    """`MapEstimate`: the best particle's confirmed landmarks, averaged over all particles."""
    table = map_estimate.summarise(state.landmarks, jnp.exp(state.log_weight), best, params, config)
    table = jax.tree.map(np.asarray, table)
    kept = np.flatnonzero(table.kept)
    # Known identities are slots; without them no slot has one.
    identity = logged_identity(np.where(kept < len(identities), kept, -1), identities)
    return MapEstimate(
        id=table.landmark_id[kept].astype(np.int64),
        mean=table.mean[:, kept].T + origin[:2],
        cov=table.cov[:, kept].T.astype(float),
        n=table.count[kept].astype(np.int64),
        identity=identity,
    )


settle_donated = jax.jit(fastslam.settle, static_argnames="config", donate_argnames="state")
