"""A whole run: a `Log` in, a `Result` out."""

import time
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import filter as fastslam
from jaxslam import landmarks as maps
from jaxslam.config import Config, Params, default_params
from jaxslam.frames import frames
from jaxslam.log import NOT_USED, Log
from jaxslam.odometry import dead_reckoning
from jaxslam.paramfile import validate

CHUNK = 256  # frames per compiled scan: one compilation serves logs of every length


class MapEstimate(NamedTuple):
    """L landmarks: `id` [L], world `mean` [L, 2] m and `cov` [L, 3] (xx, xy, yy) m^2, times seen
    `n` [L], and the log's `identity` [L] (-1 where identities were hidden)."""

    id: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    n: np.ndarray
    identity: np.ndarray


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


@dataclass(frozen=True)
class Result:
    """A run's estimates, frame by frame, T frames.

    `time` int64 [T] ns. `pose` [T, 3] (x, y, heading): filtered mean, m and rad, in the frame of
    the log's start pose; `cov` [T, 3, 3]. `ess` [T]; `resampled` [T]; `new` [T]: landmarks begun by
    the best particle; `overflow`, `forgotten`, `outliers` [T]: mean number per particle;
    `log_evidence` [T]; `nonfinite`, `degenerate` [T]: flags of `filter.Info`. `match` [T, K]: what
    the best particle took each measurement for (frame * K + k of the measurement that began the
    landmark, or -1 new, -2 clutter, -3 padding), `row` [T, K]: the measurement's row in the log.
    `landmarks`: the map at the end. `dead_reckoning` [T, 3]: odometry alone. `dropped`: rows left
    out, by reason.
    """

    log: Log
    config: Config
    params: Params
    seed: int
    time: np.ndarray
    pose: np.ndarray
    cov: np.ndarray
    ess: np.ndarray
    resampled: np.ndarray
    new: np.ndarray
    overflow: np.ndarray
    outliers: np.ndarray
    forgotten: np.ndarray
    log_evidence: np.ndarray
    nonfinite: np.ndarray
    degenerate: np.ndarray
    match: np.ndarray
    row: np.ndarray
    landmarks: MapEstimate
    dead_reckoning: np.ndarray
    seconds: float
    compile_seconds: float
    dropped: dict[str, int]

    @property
    def log_likelihood(self):
        """Log evidence of the whole log, nats."""
        return float(np.sum(self.log_evidence, dtype=float))

    @cached_property
    def flags(self):
        """One line for everything that was lost or went wrong; empty when nothing did."""
        lines = [f"{count} measurements left out: {why}" for why, count in self.dropped.items()]
        lines += [
            f"{count} rows skipped by the reader: {why}"
            for why, count in self.log.skipped.items()
            if not why.startswith(NOT_USED)
        ]
        lost = float(np.sum(self.overflow))
        if lost > 0:
            frame = int(np.flatnonzero(self.overflow)[0])
            lines.append(
                f"the map was full from frame {frame} on: {lost:.1f} landmarks lost per particle; "
                f"more than {self.config.landmarks} landmark slots are needed"
            )
        if np.any(self.nonfinite):
            lines.append(f"{int(np.sum(self.nonfinite))} particle weights were not finite")
        if np.any(self.degenerate):
            lines.append(f"all weights were zero in {int(np.sum(self.degenerate))} frames")
        if not (np.isfinite(self.pose).all() and np.isfinite(self.cov).all()):
            lines.append("the pose estimate is not finite")
        return lines

    def save(self, directory, overwrite=False, log_source=None):
        """Write the run's folder (`report.save`); without a `log_source` the log is copied too."""
        from jaxslam import report

        report.save(self, directory, overwrite=overwrite, log_source=log_source)


def config_for(log, sensor=None, association="maximum_likelihood", **settings):
    """A `Config` whose sensor and sizes fit the log; `settings` are further `Config` fields."""
    if sensor is None:
        sensor = next(s for s in ("range_bearing", "position", "bearing") if log.has(s))
    settings.setdefault("measurements", max(1, int(np.bincount(log.frame, minlength=1).max())))
    if association == "known" and log.identity is not None:
        settings.setdefault("landmarks", max(1, len(np.unique(log.identity[log.identity >= 0]))))
    return Config(sensor=sensor, association=association, **settings)


def run(log, config=None, params=None, seed=0, progress=None):
    """Filter a whole log.

    `config`: None for `config_for(log)`; `params`: None for `default_params`; `progress`: called
    with (frames done, frames in all) now and then, first with (0, T) before compiling. Raises
    `ValueError` when the log can't supply what the configuration asks.
    """
    config = config_for(log) if config is None else config
    params = default_params(config.sensor, log) if params is None else params
    params = validate(params, "params")
    known = config.association == "known"
    data = frames(log, config.sensor, config.measurements, params, known)
    total = len(data.time)
    if progress:
        progress(0, total)
    # A local origin keeps coordinates small: float32 has 7 digits.
    origin = np.array([*log.start_pose[:2], 0.0])
    key = jax.random.key(seed)
    state = fastslam.init(config, key, log.start_pose - origin, log.start_cov)
    numbers = jax.tree.map(jnp.asarray, params)
    chunks = _chunks(data, config)
    begin = time.perf_counter()
    steps = _scan.lower(key, state, *next(iter(chunks)), numbers, config).compile()
    compile_seconds = time.perf_counter() - begin
    kept = []
    for i, chunk in enumerate(_chunks(data, config)):
        state, summary = steps(key, state, *chunk, numbers)
        kept.append(jax.tree.map(np.asarray, summary))
        if progress:
            progress(min((i + 1) * CHUNK, total), total)
    summary = Summary(*(np.concatenate(parts)[:total] for parts in zip(*kept, strict=True)))
    world = _map(state, int(summary.survivor[-1]), numbers, config, data.identities, origin)
    seconds = time.perf_counter() - begin - compile_seconds
    n = config.particles
    return Result(
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
        **{name: getattr(summary, name) for name in (
            "cov", "ess", "resampled", "new", "log_evidence", "nonfinite", "degenerate")},
    )  # fmt: skip


def _summarise(info):
    # After resampling all weights are equal: the best particle lives on in its first child.
    survivor = jnp.argmax(info.ancestors == info.estimate.best)
    return Summary(
        pose=info.estimate.mean,
        cov=info.estimate.cov,
        match=info.birth[:, info.estimate.best],
        survivor=survivor,
        **{name: getattr(info, name) for name in Summary._fields if hasattr(info, name)
           and name not in ("pose", "match")},
    )  # fmt: skip


def _steps(key, state, odometry, measurements, params, config):
    return fastslam.run(key, state, odometry, measurements, params, config, _summarise)


# The state is given up to the scan (donated): no second copy of the map.
_scan = jax.jit(_steps, static_argnames="config", donate_argnames="state")


def _chunks(data, config):
    """The frames in chunks of `CHUNK`, the last one filled up with frames of nothing."""
    real = jnp.zeros(()).dtype
    total = len(data.time)
    for start in range(0, total, CHUNK):
        part = jax.tree.map(
            lambda leaf, start=start: leaf[start : start + CHUNK],
            (data.odometry, data.measurements),
        )
        missing = CHUNK - len(part[0].dx)

        def fill(leaf, missing=missing):
            leaf = np.pad(leaf, [(0, missing), *[(0, 0)] * (leaf.ndim - 1)])
            return jnp.asarray(leaf.astype(real) if leaf.dtype.kind == "f" else leaf)

        yield jax.tree.map(fill, part)


def _map(state, best, params, config, identities, origin):
    """`MapEstimate`: the best particle's confirmed landmarks, averaged over all particles."""
    table = maps.summarise(state.landmarks, jnp.exp(state.log_weight), best, params, config)
    table = jax.tree.map(np.asarray, table)
    kept = np.flatnonzero(table.kept)
    slots = len(identities)
    identity = np.array([identities[i] if i < slots else -1 for i in kept], dtype=np.int64)
    return MapEstimate(
        id=table.birth[kept].astype(np.int64),
        mean=table.mean[:, kept].T + origin[:2],
        cov=table.cov[:, kept].T.astype(float),
        n=table.count[kept].astype(np.int64),
        identity=identity,
    )
