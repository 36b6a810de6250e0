"""FastSLAM with many measurements per step (paper, section III-D), vectorised.

Each of N particles carries a pose and M landmark EKFs (eq. 6). A step moves the particles (eqs. 2
and 4), from the motion alone (FastSLAM 1.0, as in the paper) or informed by the measurements (2.0);
associates, weighs and updates with every measurement of the frame (eqs. 3 and 5: `observation`);
and resamples. All arrays have fixed sizes and the particles last; `step` and `run` are pure and
jitted. With several devices each has its share of the particles (`devices`).
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import (
    appearance,
    blocks,
    candidate_slots,
    landmarks,
    lazy_resampling,
    new_landmarks,
    resampling,
    sharding,
)
from jaxslam.filter.appearance import Appearances
from jaxslam.filter.association import CLUTTER, NEW
from jaxslam.filter.block_update import RandomNumbers
from jaxslam.filter.landmarks import Landmarks
from jaxslam.filter.lazy_resampling import Ancestry
from jaxslam.filter.weights import Estimate, estimate_pose, weigh
from jaxslam.filter.xla import barrier
from jaxslam.models.geometry import wrap


class State(NamedTuple):
    """What the next step needs: `pose` [3, N] (x, y, heading), the map, log weights [N], `step`;
    bounds of the slots; where landmarks are resampled lazily, what `settled` makes good; and how
    landmarks look, where that is told."""

    pose: jax.Array
    landmarks: Landmarks
    log_weight: jax.Array
    step: jax.Array
    bounds: candidate_slots.SlotBounds
    ancestry: Ancestry | None
    appearances: Appearances | None


class Info(NamedTuple):
    """What is known about one step; counts are over all particles.

    `pose` [3, N] and `log_weight` [N] of all particles, before resampling. `match` [K, N]: slot
    matched, or -1 new, -2 clutter, -3 padding. `landmark_id` [K, N]: the same as births
    (`Landmarks.landmark_id`) of the landmarks matched. `log_choice` [N]: log probability with which the
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
    landmark_id: jax.Array
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
    Raises `ValueError` where there are fewer devices than `Config.devices`.
    """
    cov = np.zeros((3, 3)) if cov is None else cov
    return make_on_devices(_start, config, key, pose, cov, landmarks_given)


def make_on_devices(make, config, *given):
    """The `State` of a jitted function (*given, config), made where it belongs: it may fit no one
    device."""
    if config.devices == 1:
        return make(*given, config)
    make = partial(make, config=config)
    specs = layout(jax.eval_shape(make, *given))
    return jax.jit(make, out_shardings=sharding.shardings(specs, config))(*given)


def fresh_state(pose, world, step, bounds, config):
    """`State` of particles of equal weight, with nothing to catch up with."""
    n = config.particles
    return State(
        pose=pose,
        landmarks=world,
        log_weight=jnp.full(n, -jnp.log(n), pose.dtype),
        step=jnp.asarray(step, jnp.int32),
        bounds=bounds,
        ancestry=lazy_resampling.empty_ancestry(config)
        if config.lazy and config.resample_threshold
        else None,
        appearances=appearance.empty(config, pose.dtype),
    )


@partial(jax.jit, static_argnames="config")
def _start(key, pose, cov, landmarks_given, config):
    n = config.particles
    pose = jnp.asarray(pose, float)
    root = matrix_square_root(jnp.asarray(cov, float))
    # Products one by one: a matrix product rounds by the device.
    normals = draw_start(key, config).astype(pose.dtype)
    drawn = pose[:, None] + sum(root[:, i, None] * normals[i] for i in range(3))
    one = landmarks.empty(dataclasses.replace(config, particles=1, devices=1), pose.dtype)
    if landmarks_given is not None:
        one = new_landmarks.place_given(one, landmarks_given)
    world = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], n)), one)
    return fresh_state(
        drawn.at[2].set(wrap(drawn[2])), world, 0, candidate_slots.bounds_of(one), config
    )


@partial(jax.jit, static_argnames="config")
def settle(state, config):
    """The state with every landmark where its particle is: to read the map, not to go on faster."""
    if state.ancestry is None:
        return state

    def update(world, past):
        return lazy_resampling.apply_ancestry(world, past, True, config)

    specs = layout(state)
    specs = specs.landmarks, specs.ancestry
    world, past = sharding.shard_map(update, specs, specs, config)(state.landmarks, state.ancestry)
    return state._replace(landmarks=world, ancestry=past)


def matrix_square_root(cov):
    """A square root of a covariance: Cholesky's, or the symmetric eigenvectors' if singular."""
    factor = jnp.linalg.cholesky(cov)
    values, vectors = jnp.linalg.eigh(cov)
    return jnp.where(jnp.isfinite(factor).all(), factor, vectors * jnp.sqrt(jnp.maximum(values, 0)))


def draw_start(key, config):
    """Standard normals [3, N] behind the start poses."""
    return jax.random.normal(jax.random.fold_in(key, 2**31 - 1), (3, config.particles), float)


def draw_random_numbers(key, step, config):
    """`Chance` of a step, set by its absolute number alone."""
    move, choose = jax.random.split(jax.random.fold_in(key, step))
    normals = jax.random.normal(move, (3, config.particles), float)
    uniform = jax.random.uniform(choose, (), float)
    if config.association != "sampled":
        return RandomNumbers(normals, uniform)
    shape = config.measurements, config.particles
    return RandomNumbers(
        normals, uniform, jax.random.uniform(jax.random.fold_in(choose, 1), shape, float)
    )


def layout(state):
    """How the leaves of a `State` lie on several devices."""
    return sharding.replicated(state)._replace(
        pose=sharding.particle_sharded(state.pose),
        landmarks=sharding.particle_sharded(state.landmarks),
        log_weight=sharding.particle_sharded(state.log_weight),
    )


@partial(jax.jit, static_argnames="config")
def step(key, state, odometry, measurements, params, config):
    """One step: move, associate and weigh, update, resample. Returns (State, Info)."""
    given = draw_random_numbers(key, state.step, config), state, odometry, measurements, params
    if config.devices == 1:
        return advance(*given, config)
    rest = sharding.ALL
    chance = sharding.particle_sharded(given[0]._replace(uniform=None))._replace(uniform=rest)
    return sharding.shard_map(
        partial(advance, config=config),
        (chance, layout(state), rest, rest, rest),
        (layout(state), _info_specs()),
        config,
    )(*given)


def _info_specs():
    row, table = jax.ShapeDtypeStruct((1,), float), jax.ShapeDtypeStruct((1, 1), float)
    shared = sharding.particle_sharded(
        dict(pose=table, log_weight=row, match=table, landmark_id=table, log_choice=row)
    )
    return Info(**dict.fromkeys(Info._fields, sharding.ALL) | shared)


def advance(chance, state, odometry, measurements, params, config):
    """`step` with its random numbers given: `chance` is that of `draws`."""
    seen = blocks.observe(state, chance, odometry, measurements, params, config)
    return weigh_and_resample(chance, state, seen, measurements, config)


def weigh_and_resample(chance, state, seen, measurements, config):
    """The second half of a step: weights of what was `seen` (`Observed`), estimate, resampling."""
    # Of all particles: every device works out the same from the same.
    pose, density, before = sharding.all_gather((seen.pose, seen.density, state.log_weight), config)
    # A pose that is not a number fits nothing, which would count as new landmarks: no weight.
    sound = jnp.isfinite(pose).all(0)
    density = jnp.where(sound, density, jnp.nan)
    log_weight, log_evidence, flags = weigh(before, density)
    weight = barrier(jnp.exp(log_weight))
    estimate = estimate_pose(jnp.where(sound, pose, 0), weight)
    ess = 1 / jnp.sum(weight**2)
    threshold = config.resample_threshold
    wanted = measurements.active & ((ess < threshold * config.particles) | (threshold >= 1))
    match, landmark_id = sharding.select_particle(
        (seen.match, seen.landmark_id), estimate.best, config
    )
    moved = State(
        pose,
        seen.landmarks,
        log_weight,
        state.step + 1,
        seen.bounds,
        seen.ancestry,
        None
        if seen.appearances is None
        else appearance.update_appearances(
            seen.appearances, match, landmark_id, seen.free, state.step, measurements
        ),
    )
    resampled, ancestors = _resample(moved, wanted, chance.uniform, config)
    overflow, forgotten, outliers = sharding.all_sum(
        jnp.stack([*seen.counts.sum(1), jnp.sum(seen.match == CLUTTER, dtype=jnp.int32)]), config
    )
    info = Info(
        pose=seen.pose,
        log_weight=sharding.local_shard(log_weight, config),
        estimate=estimate,
        ess=ess,
        log_evidence=log_evidence,
        resampled=wanted,
        ancestors=ancestors,
        match=seen.match,
        landmark_id=seen.landmark_id,
        log_choice=seen.log_choice,
        new=jnp.sum(match == NEW),
        outliers=outliers,
        overflow=overflow,
        forgotten=forgotten,
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


def _resample(state, wanted, uniform, config):
    """Systematic resampling of poses and maps where wanted; also the ancestors [N].

    Poses and weights given are of all particles; those that come back are of a device's own.
    """
    n = config.particles
    ancestors = jnp.arange(n, dtype=jnp.int32)
    pose, log_weight = state.pose, state.log_weight
    world, past = state.landmarks, state.ancestry
    if config.resample_threshold:
        chosen = barrier(resampling.systematic(log_weight, uniform))
        ancestors = jnp.where(wanted, chosen, ancestors)
        pose = pose[:, ancestors]
        log_weight = jnp.where(wanted, -jnp.log(n), log_weight)
        if past is None:
            world = resampling.gather(world, ancestors, wanted, config)
        else:
            past = lazy_resampling.compose(past, ancestors, wanted)
    pose, log_weight = sharding.local_shard((pose, log_weight), config)
    state = state._replace(pose=pose, landmarks=world, log_weight=log_weight, ancestry=past)
    return state, ancestors
