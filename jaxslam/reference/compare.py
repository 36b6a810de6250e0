"""Compare the filter with the NumPy baseline on the same draws: agreement, accuracy and time.

In float64 both must make the same decisions and differ by rounding only. In float32 a near tie is
decided differently sooner or later; from then on they are two independent runs.
"""

import dataclasses
import time
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.slicing import select_frames
from jaxslam.logs.truth import truth_at, wrap
from jaxslam.models import geometry
from jaxslam.parameters import Params, default_params
from jaxslam.reference import ekf
from jaxslam.reference import fastslam as baseline
from jaxslam.results.metrics import ate


class Agreement(NamedTuple):
    """Both filters over T steps, N particles.

    - `same`: how many first steps have equal ancestors and associations of all particles.
    - Largest absolute differences over these steps and all particles of `pose` [m, rad] and
      `log_weight`; of `landmarks` (means and covariances) at the end (inf if only one filter has a
      landmark; NaN if `same` < T).
    - Counts in the baseline: steps `resampled`; per particle landmarks `begun`, `forgotten` and
      lost in `overflow`, and measurements taken for `clutter`.
    - Mean poses [T, 3] and seconds of both, without `compile_seconds`; `map_baseline` of the
      baseline's best particle.
    """

    steps: int
    particles: int
    same: int
    pose: float
    log_weight: float
    landmarks: float
    resampled: int
    begun: float
    forgotten: float
    overflow: float
    clutter: float
    pose_baseline: np.ndarray
    pose_filter: np.ndarray
    seconds_baseline: float
    seconds_filter: float
    compile_seconds: float
    map_baseline: "PointMap"


class PointMap(NamedTuple):
    """World points `mean` [L, 2], m, and the log's `identity` [L] (-1: unknown)."""

    mean: np.ndarray
    identity: np.ndarray


class Comparison(NamedTuple):
    """Agreement in `double` and `single` precision, and unaligned ATE [m] of both filters in single
    precision (NaN without truth), for one number of particles."""

    double: Agreement
    single: Agreement
    ate_baseline: float
    ate_filter: float


def compare(log, config, params=None, seed=0, steps=200, every=None, progress=None):
    """Compare both filters over `steps` frames of the log, every `every`-th from the first on.

    Returns a `Comparison`. `every` None: cover a tenth of the log, if possible. `progress`: as for
    `agreement`, which is run in float64 and in float32. The baseline has only the prior proposal
    and no appearance, so the filter is configured likewise.
    """
    config = dataclasses.replace(config, proposal="prior", rejuvenate=0.0, descriptors=0)
    log = select_frames(log, thin(log, steps, every))
    double = agreement(log, config, params, seed, steps, True, progress)
    single = agreement(log, config, params, seed, steps, False, progress)
    true = truth_at(log.truth, log.frame_time)
    errors = [ate(p, true, align=False)[0] for p in (single.pose_baseline, single.pose_filter)]
    return Comparison(double, single, *errors)


def thin(log, steps, every=None):
    """Numbers of `steps` frames, every `every`-th from the first on (None: a tenth of the log)."""
    if every is None:
        every = max(1, len(log.frame_time) // (10 * steps))
    return np.arange(0, len(log.frame_time), every)[:steps]


def agreement(log, config, params=None, seed=0, steps=None, double=True, progress=None):
    """Run both filters over the log's first `steps` frames (None: all); returns `Agreement`.

    `double`: the filter in float64, without changing JAX's global settings; otherwise in float32.
    The baseline is always in float64, and gets the filter's draws. `progress`: called with
    (done, total), first with (0, total) before compiling. Raises `ValueError` for a `config` that
    the baseline can't follow.
    """
    if config.proposal != "prior" or config.association == "sampled":
        raise ValueError(
            "compare: the baseline has the prior proposal, and maximum_likelihood or known"
        )
    params = default_params(config.sensor, log) if params is None else params
    params = Params(*map(float, params))
    if steps is not None:
        log = select_frames(log, np.arange(min(steps, len(log.frame_time))))
    data = frames_from_log(log, config, params)
    if progress:
        progress(0, len(data.time))
    # A local origin, as in runs: float32 has 7 digits.
    origin = np.array([*log.start_pose[:2], 0.0])
    start = log.start_pose - origin
    with jax.enable_x64(double):
        state, trace, draws, compiled, ran = _run_filter(data, config, params, seed, start, log)
    begin = time.perf_counter()
    reference = baseline.run(
        data.odometry, data.measurements, params, config, start, log.start_cov, *draws,
        progress=progress,
    )  # fmt: skip
    spent = time.perf_counter() - begin
    return Agreement(
        len(data.time),
        config.particles,
        *_differences(state, trace, reference),
        resampled=int(reference.resampled.sum()),
        begun=float(reference.births.sum() / config.particles),
        forgotten=float(reference.freed.sum() / config.particles),
        overflow=float(reference.overflow.sum() / config.particles),
        clutter=float((reference.match == baseline.CLUTTER).sum() / config.particles),
        pose_baseline=reference.pose_mean + origin,
        pose_filter=trace.mean + origin,
        seconds_baseline=spent,
        seconds_filter=ran,
        compile_seconds=compiled,
        map_baseline=_map_of_best(reference, params, config, data.identities, origin),
    )


def table(comparisons):
    """Format a table as text, with a column per `Comparison`."""
    rows = [
        ("", "{0.particles} particles"),
        ("float64: same decisions", "{0.same} of {0.steps} steps"),
        ("  largest difference, poses", "{0.pose:.1e} m, rad"),
        ("  log weights", "{0.log_weight:.1e}"),
        ("  landmarks at the end", "{0.landmarks:.1e}"),
        ("  resampled", "{0.resampled} steps"),
        ("  landmarks begun, forgotten", "{0.begun:.1f}, {0.forgotten:.1f}"),
        ("float32: same decisions", "{1.same} of {1.steps} steps"),
        ("  largest difference, poses", "{1.pose:.1e} m, rad"),
        ("path error, baseline", "{2.ate_baseline:.3f} m RMSE"),
        ("path error, filter", "{2.ate_filter:.3f} m RMSE"),
        ("time per step, baseline", "{3[0]:.4g} ms"),
        ("  filter, first run, compiling", "{3[1]:.4g} ms"),
        ("  filter", "{3[2]:.4g} ms"),
        ("  baseline / filter, compiling", "{3[3]:.4g} times"),
        ("  baseline / filter", "{3[4]:.4g} times"),
    ]
    lines = []
    for name, cell in rows:
        cells = [cell.format(row.double, row.single, row, _times(row)) for row in comparisons]
        lines.append(f"{name:32}" + "".join(f"{text:>20}" for text in cells))
    return "\n".join(lines)


def _times(row):
    """Milliseconds per step of baseline, compiling filter and filter, and the two ratios."""
    both = row.double, row.single  # the baseline is the same in both
    slow = sum(part.seconds_baseline for part in both) / 2
    fast = row.single.seconds_filter
    first = fast + row.single.compile_seconds
    per_step = [1e3 * seconds / row.single.steps for seconds in (slow, first, fast)]
    return *per_step, slow / first, slow / fast


class _Trace(NamedTuple):
    """Every step's poses [T, 3, N], log weights [T, N], ancestors [T, N], landmark ids matched
    [T, K, N] and mean pose [T, 3]."""

    pose: np.ndarray
    log_weight: np.ndarray
    ancestors: np.ndarray
    landmark_id: np.ndarray
    mean: np.ndarray


@partial(jax.jit, static_argnames="config")
def _scan_steps(key, state, odometry, measurements, params, config):
    def body(state, frame):
        state, info = fastslam.step(key, state, *frame, params, config)
        kept = state.pose, state.log_weight, info.ancestors, info.landmark_id, info.estimate.mean
        return state, _Trace(*kept)

    return jax.lax.scan(body, state, (odometry, measurements))


def _run_filter(data, config, params, seed, start, log):
    """Run the filter: final state, `_Trace`, draws for the baseline, seconds to compile and run."""
    key = jax.random.key(seed)
    state = fastslam.init(config, key, start, log.start_cov)
    given = jax.tree.map(jnp.asarray, (data.odometry, data.measurements, params))
    begin = time.perf_counter()
    steps = _scan_steps.lower(key, state, *given, config).compile()
    compiled = time.perf_counter()
    jax.block_until_ready(steps(key, state, *given))  # to warm up
    begin, compiled = time.perf_counter(), compiled - begin
    final, trace = jax.block_until_ready(steps(key, state, *given))
    final = fastslam.settle(final, config)
    ran = time.perf_counter() - begin
    numbers = jnp.arange(len(data.time), dtype=jnp.int32)
    chance = jax.vmap(lambda step: fastslam.draw_random_numbers(key, step, config))(numbers)
    draws = fastslam.draw_start(key, config), chance.normals, chance.uniform
    host = [jax.tree.map(np.asarray, tree) for tree in (final, trace, draws)]
    return *host, compiled, ran


def _map_of_best(reference, params, config, identities, origin):
    """`PointMap` of the best particle's landmarks that are confirmed and have a depth."""
    # After resampling all weights are equal: take the first child of the best particle.
    child = int(np.argmax(reference.ancestors[-1] == reference.best[-1]))
    particle = reference.particles[child]
    points, ids = [], []
    for slot, landmark in enumerate(particle.landmarks):
        if landmark is None or (config.forgetting and landmark.log_odds < params.existence_confirm):
            continue
        if config.sensor == "bearing" and not landmark.mean[1] > 3 * np.sqrt(landmark.cov[1, 1]):
            continue  # no depth
        points.append(ekf.point_of(landmark, config.sensor)[0] + origin[:2])
        ids.append(identities[slot] if slot < len(identities) else -1)
    return PointMap(np.reshape(points, (-1, 2)), np.array(ids, np.int64))


def _differences(state, trace, reference):
    """Fields `same`, `pose`, `log_weight` and `landmarks` of `Agreement`."""
    equal = (trace.ancestors == reference.ancestors).all(1)
    equal &= (np.swapaxes(trace.landmark_id, 1, 2) == reference.landmark_id).all((1, 2))
    total = len(equal)
    same = total if equal.all() else int(np.argmin(equal))
    if same == 0:
        return 0, np.nan, np.nan, np.nan
    pose = (trace.pose - reference.poses)[:same]
    pose[:, 2] = wrap(pose[:, 2])
    weight, other = trace.log_weight[:same], reference.log_weight[:same]
    apart = np.zeros(weight.shape)  # also where both are -inf
    np.subtract(weight, other, out=apart, where=weight != other)
    far = _map_difference(state.landmarks, reference.particles) if same == total else np.nan
    return same, float(np.abs(pose).max()), float(np.abs(apart).max()), far


def _map_difference(world, particles):
    """Largest difference in any landmark of any particle; inf if they have different landmarks."""
    cov = np.stack(geometry.covariance(world.factor.astype(float)))
    largest = 0.0
    for i, particle in enumerate(particles):
        marks = sorted(
            (m for m in particle.landmarks if m is not None), key=lambda m: m.landmark_id
        )
        slots = np.flatnonzero(world.count[:, i])
        slots = slots[np.argsort(world.landmark_id[slots, i])]
        ids = [(m.landmark_id, m.count) for m in marks]
        if ids != list(zip(world.landmark_id[slots, i], world.count[slots, i], strict=True)):
            return np.inf
        for slot, landmark in zip(slots, marks, strict=True):
            (xx, xy), (_, yy) = landmark.cov
            pairs = [(world.mean, landmark.mean), (cov, (xx, xy, yy))]
            pairs += [(world.anchor, landmark.anchor)] if world.anchor is not None else []
            pairs += (
                [(world.log_odds[None], landmark.log_odds)] if world.log_odds is not None else []
            )
            for values, other in pairs:
                largest = max(largest, float(np.abs(values[:, slot, i] - other).max()))
    return largest
