"""FastSLAM with many measurements per step (paper, section III-D), vectorised.

Each of N particles carries a pose and M landmark EKFs (eq. 6). A step moves the particles (eqs. 2
and 4), from the motion alone (FastSLAM 1.0, as in the paper) or informed by the measurements (2.0);
associates, weighs and updates with every measurement of the frame (eqs. 3 and 5: `observation`);
and resamples. All arrays have fixed sizes and the particles last; `step` and `run` are pure and
jitted.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam import ancestry, births, gate, landmarks, observation, resampling
from jaxslam.ancestry import Ancestry
from jaxslam.association import CLUTTER, NEW
from jaxslam.geometry import wrap
from jaxslam.landmarks import Landmarks
from jaxslam.observation import Chance


class State(NamedTuple):
    """What the next step needs: `pose` [3, N] (x, y, heading), the map, log weights [N], `step`;
    bounds of the slots; and where landmarks are resampled lazily, what `settled` makes good."""

    pose: jax.Array
    landmarks: Landmarks
    log_weight: jax.Array
    step: jax.Array
    bounds: gate.Bounds
    ancestry: Ancestry | None


class Estimate(NamedTuple):
    """Mean pose [3], its covariance [3, 3], and the particle of greatest weight."""

    mean: jax.Array
    cov: jax.Array
    best: jax.Array


class Info(NamedTuple):
    """What is known about one step; counts are over all particles.

    `pose` [3, N] and `log_weight` [N] of all particles, before resampling. `match` [K, N]: slot
    matched, or -1 new, -2 clutter, -3 padding. `birth` [K, N]: the same as births
    (`Landmarks.birth`) of the landmarks matched. `log_choice` [N]: log probability with which the
    matches were drawn (0: they were not). `ancestors` [N]: which of these particles each particle
    after resampling continues. `new`: landmarks that the best particle began. `overflow`: landmarks
    lost for want of a slot. `nonfinite`: particles whose weight became NaN or infinite.
    `degenerate`: no weight was left, all were made equal.
    """

    pose: jax.Array
    log_weight: jax.Array
    estimate: Estimate
    ess: jax.Array
    log_evidence: jax.Array
    resampled: jax.Array
    ancestors: jax.Array
    match: jax.Array
    birth: jax.Array
    log_choice: jax.Array
    new: jax.Array
    outliers: jax.Array
    overflow: jax.Array
    forgotten: jax.Array
    nonfinite: jax.Array
    degenerate: jax.Array


def init(config, key, pose=(0.0, 0.0, 0.0), cov=None, landmarks_given=None):
    """`State` before the first step: poses drawn from N(pose, cov), map empty or given.

    `pose` (x, y, heading), `cov` [3, 3] (None: known exactly). `landmarks_given`: mean [2, L] and
    factor [3, L] of a map that all particles share (for `bearing` also anchor [2, L]), as a tuple.
    """
    n = config.particles
    pose = jnp.asarray(pose, float)
    root = jnp.zeros((3, 3)) if cov is None else square_root(jnp.asarray(cov, float))
    drawn = pose[:, None] + root @ start_draws(key, config).astype(pose.dtype)
    world = landmarks.empty(config, pose.dtype)
    if landmarks_given is not None:
        world = births.given(world, landmarks_given)
    return State(
        pose=drawn.at[2].set(wrap(drawn[2])),
        landmarks=world,
        log_weight=jnp.full(n, -jnp.log(n), pose.dtype),
        step=jnp.zeros((), jnp.int32),
        bounds=gate.of_rows(world),
        ancestry=ancestry.new(config) if config.lazy and config.resample_threshold else None,
    )


def settled(state):
    """The state with every landmark where its particle is: to read the map, not to go on faster."""
    if state.ancestry is None:
        return state
    world, past = ancestry.update(state.landmarks, state.ancestry, True)
    return state._replace(landmarks=world, ancestry=past)


def square_root(cov):
    """A square root of a covariance: Cholesky's, or the symmetric eigenvectors' if singular."""
    factor = jnp.linalg.cholesky(cov)
    values, vectors = jnp.linalg.eigh(cov)
    return jnp.where(jnp.isfinite(factor).all(), factor, vectors * jnp.sqrt(jnp.maximum(values, 0)))


def start_draws(key, config):
    """Standard normals [3, N] behind the start poses."""
    return jax.random.normal(jax.random.fold_in(key, 2**31 - 1), (3, config.particles), float)


def draws(key, step, config):
    """`Chance` of a step, set by its absolute number alone."""
    move, choose = jax.random.split(jax.random.fold_in(key, step))
    normals = jax.random.normal(move, (3, config.particles), float)
    uniform = jax.random.uniform(choose, (), float)
    if config.association != "sampled":
        return Chance(normals, uniform)
    shape = config.measurements, config.particles
    return Chance(normals, uniform, jax.random.uniform(jax.random.fold_in(choose, 1), shape, float))


@partial(jax.jit, static_argnames="config")
def step(key, state, odometry, measurements, params, config):
    """One step: move, associate and weigh, update, resample. Returns (State, Info)."""
    chance = draws(key, state.step, config)
    return advance(chance, state, odometry, measurements, params, config)


def advance(chance, state, odometry, measurements, params, config):
    """`step` with its random numbers given: `chance` is that of `draws`."""
    seen = observation.observe(state, chance, odometry, measurements, params, config)
    return conclude(chance, state, seen, measurements.active, config)


def conclude(chance, state, seen, active, config):
    """The second half of a step: weights of what was `seen` (`Observed`), estimate, resampling."""
    pose, density, match = seen.pose, seen.density, seen.match
    # A pose that is not a number fits nothing, which would count as new landmarks: no weight.
    sound = jnp.isfinite(pose).all(0)
    density = jnp.where(sound, density, jnp.nan)
    log_weight, log_evidence, flags = _weigh(state.log_weight, density)
    weight = jnp.exp(log_weight)
    estimate = _estimate(jnp.where(sound, pose, 0), weight)
    ess = 1 / jnp.sum(weight**2)
    threshold = config.resample_threshold
    wanted = active & ((ess < threshold * config.particles) | (threshold >= 1))
    moved = State(pose, seen.landmarks, log_weight, state.step + 1, seen.bounds, seen.ancestry)
    resampled, ancestors = _resample(moved, wanted, chance.uniform, config)
    info = Info(
        pose=pose,
        log_weight=log_weight,
        estimate=estimate,
        ess=ess,
        log_evidence=log_evidence,
        resampled=wanted,
        ancestors=ancestors,
        match=match,
        birth=seen.birth,
        log_choice=seen.log_choice,
        new=jnp.sum(match[:, estimate.best] == NEW),
        outliers=jnp.sum(match == CLUTTER),
        overflow=seen.counts[0].sum(),
        forgotten=seen.counts[1].sum(),
        nonfinite=flags[0],
        degenerate=flags[1],
    )
    return resampled, info


@partial(jax.jit, static_argnames=("config", "summarise"))
def run(key, state, odometry, measurements, params, config, summarise=lambda info: info):
    """Steps over T frames in one scan; `summarise` says what of each `Info` is kept and stacked."""

    def body(state, frame):
        state, info = step(key, state, *frame, params, config)
        return state, summarise(info)

    return jax.lax.scan(body, state, (odometry, measurements))


def _weigh(log_weight, density):
    """Normalised log weights, log evidence of the step, and flags (non-finite, degenerate)."""
    raw = log_weight + density
    finite = jnp.isfinite(raw)
    # A particle that already had no weight is not news.
    nonfinite = jnp.sum(~finite & (log_weight > -jnp.inf))
    degenerate = ~finite.any()
    log_evidence = jax.nn.logsumexp(jnp.where(finite, raw, -jnp.inf))
    even = jnp.full_like(raw, -jnp.log(len(raw)))
    normalised = jnp.where(finite, raw - log_evidence, -jnp.inf)
    return jnp.where(degenerate, even, normalised), log_evidence, (nonfinite, degenerate)


def _estimate(pose, weight):
    """Weighted mean (circular in heading) and covariance of the poses, and the heaviest one."""
    x, y, heading = pose
    mean = jnp.stack(
        [
            weight @ x,
            weight @ y,
            jnp.arctan2(weight @ jnp.sin(heading), weight @ jnp.cos(heading)),
        ]
    )
    off = jnp.stack([x - mean[0], y - mean[1], wrap(heading - mean[2])])
    return Estimate(mean, (off * weight) @ off.T, jnp.argmax(weight))


def _resample(state, wanted, uniform, config):
    """Systematic resampling of poses and maps where wanted; also the ancestors."""
    n = config.particles
    same = jnp.arange(n, dtype=jnp.int32)
    if config.resample_threshold == 0:
        return state, same

    ancestors = jnp.where(wanted, resampling.systematic(state.log_weight, uniform), same)
    pose = resampling.gather(state.pose, ancestors, wanted)
    log_weight = jnp.where(wanted, -jnp.log(n), state.log_weight)
    world, past = state.landmarks, state.ancestry
    if past is None:
        world = resampling.gather(world, ancestors, wanted)
    else:
        past = ancestry.resampled(past, ancestors, wanted)
    state = state._replace(pose=pose, landmarks=world, log_weight=log_weight, ancestry=past)
    return state, ancestors
