"""Assemble the `Result` of a run from the records of its steps."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import map_estimate, sharding
from jaxslam.filter import step as fastslam
from jaxslam.logs.odometry import dead_reckoning
from jaxslam.results.events import association_entropy
from jaxslam.results.result import MapEstimate, Result
from jaxslam.smoother.genealogy import Ancestral, Lineage, Tree, smooth_ancestral, trace_lineage
from jaxslam.smoother.rejuvenation import SharedPast


class Summary(NamedTuple):
    """Record of a step of the best particle, and of sums over all (see `step.Info`).

    `survivor`: the best particle's first descendant after resampling.
    """

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


OF_ALL = "pose", "landmark_id"  # fields of `step.Info` that are those of all particles
# Fields that `Summary` and `Result` take from `step.Info` as they are: a new diagnostic is a field
# of each of the three.
COPIED = tuple(f for f in Summary._fields if f in fastslam.Info._fields and f not in OF_ALL)
COUNTS = "overflow", "outliers", "forgotten"  # over all particles; in `Result` the mean


class ParticleHistory(NamedTuple):
    """Record of a step of all particles, for the genealogy (see `step.Info`)."""

    pose: jax.Array
    landmark_id: jax.Array
    ancestors: jax.Array


class RunProgress(NamedTuple):
    """Progress of a run: `state` after `done` frames, which took `seconds`.

    Of every chunk, on the host: `summaries` (`Summary`) and `entropy` (`association_entropy`).
    `tree`: genealogy since the `shared_past` (None: no rejuvenation yet); None if it became too
    large, and on processes other than the leader.
    """

    state: fastslam.State
    summaries: list
    tree: Tree | None
    done: int
    seconds: float
    shared_past: SharedPast | None
    entropy: list

    def add_chunk(self, summary, history):
        """Append a chunk's `Summary` and `ParticleHistory` to the lists and the genealogy."""
        self.summaries.append(summary)
        self.entropy.append(association_entropy(history.landmark_id, history.ancestors))
        if self.tree is not None:
            self.tree.extend(*history)


def local_origin(log):
    """Return the filter's origin [3], near the start: float32 has 7 digits."""
    return np.array([*log.start_pose[:2], 0.0])


def assemble_result(so_far, log, config, params, seed, data, compile_seconds):
    """Assemble the `Result`, not refined, from the `RunProgress` at the end of a log."""
    begin, origin = time.perf_counter(), local_origin(log)
    summary = Summary(*(np.concatenate(parts) for parts in zip(*so_far.summaries, strict=True)))
    best, state = int(summary.survivor[-1]), settle_donated(so_far.state, config)
    fields = _genealogy_fields(so_far, sharding.to_host(state.log_weight), best, origin)
    fields |= {name: getattr(summary, name) for name in COPIED}
    fields |= {name: fields[name] / config.particles for name in COUNTS}
    numbers = jax.tree.map(jnp.asarray, params)
    return Result(
        log=log,
        config=config,
        params=params,
        seed=seed,
        time=data.time,
        pose=summary.pose + origin,
        cov=summary.cov,
        entropy=np.concatenate(so_far.entropy),
        landmark_id=summary.landmark_id.astype(np.int64),
        row=data.row,
        landmarks=_estimate_map(state, best, numbers, config, data.identities, origin),
        dead_reckoning=dead_reckoning(data.odometry, log.start_pose),
        dropped=data.dropped,
        **fields,
        compile_seconds=compile_seconds,
        seconds=so_far.seconds + time.perf_counter() - begin,
    )


def _genealogy_fields(so_far, log_weight, best, origin):
    """Return the `Result`'s `ancestral` and `lineage`, in the world frame, and `events`."""
    shared = so_far.shared_past
    events = None if shared is None else shared.event
    if so_far.tree is None:
        return dict(events=events)
    ancestral = smooth_ancestral(so_far.tree, log_weight)
    lineage = trace_lineage(so_far.tree, best)
    if shared is not None:
        # Each particle has drawn its own path there.
        distinct, cov = np.full(len(shared.pose), len(log_weight)), shared.cov
        if len(cov) < len(distinct):  # the last refinement failed: as if there were one ancestor
            distinct, cov = np.ones_like(distinct), np.zeros((len(distinct), 3, 3))
        ancestral = _concatenate(Ancestral(shared.pose, cov, distinct), ancestral)
        lineage = _concatenate(Lineage(shared.pose, shared.landmark_id), lineage)
    return dict(
        ancestral=ancestral._replace(pose=ancestral.pose + origin),
        lineage=Lineage(lineage.pose + origin, lineage.landmark_id),
        events=events,
    )


def _concatenate(before, after):
    """Concatenate the fields of two consecutive stretches of frames."""
    return type(after)(*map(np.concatenate, zip(before, after, strict=True)))


def logged_identity(dense, identities):
    """Look up the log's identities of dense ones; -1 stays."""
    return np.append(identities, -1)[np.asarray(dense, np.int64)]


def _estimate_map(state, best, params, config, identities, origin):
    """Average the best particle's confirmed landmarks over all particles (`MapEstimate`)."""
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
