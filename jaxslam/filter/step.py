"""FastSLAM with many measurements per step (paper, section III), for all particles at once.

The posterior of path and map (eq. 1) is held by N weighted particles: a pose, and one EKF for each
of M landmarks (eq. 6). `step` is the algorithm:

- Move every particle (eqs. 2 and 4): by the motion alone (FastSLAM 1.0, as in the paper), or by
  motion and measurements (2.0).
- Associate each measurement of the frame with a landmark, and weigh the particle by it (eq. 3).
- Update the matched landmarks (eq. 5).
- Resample the particles by their weights.

The first three treat each particle alone: `blocks.observe`, and `block_update` for one block of
particles. All arrays have fixed sizes and the particles on the last axis; `step` and `run` are pure
and jitted. Several devices share the particles (`sharding`).
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxslam.config import Config
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
from jaxslam.logs.odometry import Odometry
from jaxslam.models.geometry import wrap
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import Params


class State(NamedTuple):
    """Particles between two steps (eq. 1).

    `pose` [3, N]: x, y (m), heading (rad). `landmarks`: the maps. `log_weight` [N], normalised.
    `step` []: number of steps done. `bounds`: where each slot's landmarks are, over all particles.
    `ancestry`: resampling of the maps that is still to be done (None: `lazy` is off).
    `appearances`: what the landmarks look like (None: no descriptors).
    """

    pose: jax.Array
    landmarks: Landmarks
    log_weight: jax.Array
    step: jax.Array
    bounds: candidate_slots.SlotBounds
    ancestry: Ancestry | None
    appearances: Appearances | None


class Info(NamedTuple):
    """Outcome of one step; counts are over all particles.

    Before resampling: `pose` [3, N] (m, m, rad), `log_weight` [N], normalised, `match` [K, N]
    (slot, or `NEW`, `CLUTTER`, `PADDING`), `landmark_id` [K, N] of the landmarks matched (else as
    `match`), `log_choice` [N]: log probability with which the matches were drawn (0: not drawn).
    `estimate`: mean pose. `ess`: effective sample size. `log_evidence`: log of eq. 5's denominator.
    `ancestors` [N]: the particle that each particle after resampling continues. `new`: landmarks
    begun by the best particle. `outliers`: measurements matched to clutter. `overflow`: landmarks
    lost because no slot was free. `forgotten`: landmarks whose existence became improbable.
    `nonfinite`: particles whose weight became NaN or infinite. `degenerate`: no particle had a
    weight, so that all were made equal.
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


@partial(jax.jit, static_argnames="config")
def step(
    key: jax.Array,
    state: State,
    odometry: Odometry,
    measurements: Measurements,
    params: Params,
    config: Config,
) -> tuple[State, Info]:
    """Filter one frame: move, associate and weigh, update, resample. Returns (`State`, `Info`).

    `key` is that of the run; `odometry` of the interval that ends with the frame, `measurements` of
    the frame (`Frames` has both, stacked), `params`: `Params`.
    """
    random_numbers = draw_random_numbers(key, state.step, config)
    arguments = random_numbers, state, odometry, measurements, params
    if config.devices == 1:
        return advance(*arguments, config)
    rest = sharding.ALL
    numbers_specs = sharding.particle_sharded(random_numbers._replace(uniform=None))
    return sharding.shard_map(
        partial(advance, config=config),
        (numbers_specs._replace(uniform=rest), layout(state), rest, rest, rest),
        (layout(state), _info_specs()),
        config,
    )(*arguments)


def advance(random_numbers, state, odometry, measurements, params, config):
    """Advance particles by one step with its `RandomNumbers`; on several devices each its own."""
    # Move (eqs. 2 and 4), associate, weigh (eq. 3), update (eq. 5): each particle alone.
    observed = blocks.observe(state, random_numbers, odometry, measurements, params, config)
    # Normalise the weights (eq. 5), estimate, resample: all particles together.
    return weigh_and_resample(random_numbers, state, observed, measurements, config)


def weigh_and_resample(random_numbers, state, observed, measurements, config):
    """Finish a step: `State` and `Info` from the particles as `Observed`."""
    # Of all particles: every device computes the same from the same numbers.
    pose, density, log_prior = sharding.all_gather(
        (observed.pose, observed.density, state.log_weight), config
    )

    # Weigh (eqs. 3 and 5). A NaN pose fits no landmark, which would count as new ones: no weight.
    finite = jnp.isfinite(pose).all(0)
    density = jnp.where(finite, density, jnp.nan)
    log_weight, log_evidence, flags = weigh(log_prior, density)
    weight = barrier(jnp.exp(log_weight))
    estimate = estimate_pose(jnp.where(finite, pose, 0), weight)
    ess = 1 / jnp.sum(weight**2)
    threshold = config.resample_threshold
    wanted = measurements.active & ((ess < threshold * config.particles) | (threshold >= 1))

    match, landmark_id = sharding.select_particle(
        (observed.match, observed.landmark_id), estimate.best, config
    )
    weighted = State(
        pose,
        observed.landmarks,
        log_weight,
        state.step + 1,
        observed.bounds,
        observed.ancestry,
        observed.appearances,
    )
    if weighted.appearances is not None:  # one for all particles, by the best one's matches
        appearances = appearance.update_appearances(
            weighted.appearances, match, landmark_id, observed.free, state.step, measurements
        )
        weighted = weighted._replace(appearances=appearances)

    # Resample.
    resampled, ancestors = _resample(weighted, wanted, random_numbers.uniform, config)

    counts = [*observed.counts.sum(1), jnp.sum(observed.match == CLUTTER, dtype=jnp.int32)]
    overflow, forgotten, outliers = sharding.all_sum(jnp.stack(counts), config)
    info = Info(
        pose=observed.pose,
        log_weight=sharding.local_shard(log_weight, config),
        estimate=estimate,
        ess=ess,
        log_evidence=log_evidence,
        resampled=wanted,
        ancestors=ancestors,
        match=observed.match,
        landmark_id=observed.landmark_id,
        log_choice=observed.log_choice,
        new=jnp.sum(match == NEW),
        outliers=outliers,
        overflow=overflow,
        forgotten=forgotten,
        nonfinite=flags[0],
        degenerate=flags[1],
    )
    return resampled, info


def _resample(state, wanted, uniform, config):
    """Resample poses and maps if `wanted`: the `State`, and the ancestors [N].

    Takes poses and weights of all particles, and returns those of the device's own.
    """
    n = config.particles
    ancestors = jnp.arange(n, dtype=jnp.int32)
    pose, log_weight = state.pose, state.log_weight
    world, ancestry = state.landmarks, state.ancestry
    if config.resample_threshold:
        drawn = barrier(resampling.systematic(log_weight, uniform))
        ancestors = jnp.where(wanted, drawn, ancestors)
        pose = pose[:, ancestors]
        log_weight = jnp.where(wanted, -jnp.log(n), log_weight)
        if ancestry is None:
            world = resampling.gather(world, ancestors, wanted, config)
        else:
            ancestry = lazy_resampling.compose(ancestry, ancestors, wanted)
    pose, log_weight = sharding.local_shard((pose, log_weight), config)
    state = state._replace(pose=pose, landmarks=world, log_weight=log_weight, ancestry=ancestry)
    return state, ancestors


@partial(jax.jit, static_argnames=("config", "summarise"))
def run(key, state, odometry, measurements, params, config, summarise=lambda info: info):
    """Filter T frames in one scan: the last `State`, and what `summarise` keeps of every `Info`,
    stacked."""

    def body(state, frame):
        state, info = step(key, state, *frame, params, config)
        return state, summarise(info)

    return jax.lax.scan(body, state, (odometry, measurements))


@partial(jax.jit, static_argnames="config")
def settle(state, config):
    """Resample all landmarks that are due (`lazy_resampling`), so that slot and particle of the map
    can be read; the next step does not need it."""
    if state.ancestry is None:
        return state

    def update(world, ancestry):
        return lazy_resampling.apply_ancestry(world, ancestry, True, config)

    specs = layout(state)
    specs = specs.landmarks, specs.ancestry
    settled = sharding.shard_map(update, specs, specs, config)(state.landmarks, state.ancestry)
    return state._replace(landmarks=settled[0], ancestry=settled[1])


def draw_random_numbers(key, step, config):
    """Draw the `RandomNumbers` of a step, which depend on the run's key and the step's number."""
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
    """`PartitionSpec`s of a `State` on several devices."""
    return sharding.replicated(state)._replace(
        pose=sharding.particle_sharded(state.pose),
        landmarks=sharding.particle_sharded(state.landmarks),
        log_weight=sharding.particle_sharded(state.log_weight),
    )


def _info_specs():
    row, table = jax.ShapeDtypeStruct((1,), float), jax.ShapeDtypeStruct((1, 1), float)
    shared = sharding.particle_sharded(
        dict(pose=table, log_weight=row, match=table, landmark_id=table, log_choice=row)
    )
    return Info(**dict.fromkeys(Info._fields, sharding.ALL) | shared)


# Starting states.


def init(
    config: Config,
    key: jax.Array,
    pose: ArrayLike = (0.0, 0.0, 0.0),
    cov: ArrayLike | None = None,
    landmarks_given: tuple[ArrayLike, ...] | None = None,
) -> State:
    """Draw the `State` before the first step from N(pose, cov), with an empty or a given map.

    `pose` (3): x, y (m), heading (rad). `cov` [3, 3] (None: the pose is known exactly).
    `landmarks_given`: a map that all particles share, as a tuple of mean [2, L] and factor [3, L],
    for `bearing` also anchor [2, L]. Raises `ValueError` where there are fewer devices than
    `Config.devices`, or fewer slots than landmarks.
    """
    cov = np.zeros((3, 3)) if cov is None else cov
    return make_on_devices(_start, config, key, pose, cov, landmarks_given)


def make_on_devices(make, config, *arguments):
    """Make the `State` that a jitted function returns for (*arguments, config), on the devices that
    share it: a single one may not hold it."""
    if config.devices == 1:
        return make(*arguments, config)
    make = partial(make, config=config)
    specs = layout(jax.eval_shape(make, *arguments))
    return jax.jit(make, out_shardings=sharding.shardings(specs, config))(*arguments)


@partial(jax.jit, static_argnames="config")
def _start(key, pose, cov, landmarks_given, config):
    n = config.particles
    pose = jnp.asarray(pose, float)
    root = matrix_square_root(jnp.asarray(cov, float))
    # Products one by one: a matrix product rounds by the device.
    normals = draw_start(key, config).astype(pose.dtype)
    drawn = pose[:, None] + sum(root[:, i, None] * normals[i] for i in range(3))
    single = landmarks.empty(dataclasses.replace(config, particles=1, devices=1), pose.dtype)
    if landmarks_given is not None:
        single = new_landmarks.place_given(single, landmarks_given)
    world = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], n)), single)
    return fresh_state(
        drawn.at[2].set(wrap(drawn[2])), world, 0, candidate_slots.bounds_of(single), config
    )


def fresh_state(pose, world, step, bounds, config):
    """`State` of particles of equal weight, whose maps are resampled and without appearances."""
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


def draw_start(key, config):
    """Draw the standard normals [3, N] behind the start poses."""
    return jax.random.normal(jax.random.fold_in(key, 2**31 - 1), (3, config.particles), float)


def matrix_square_root(cov):
    """A square root of a covariance: Cholesky's, or the symmetric eigenvectors' if singular."""
    factor = jnp.linalg.cholesky(cov)
    values, vectors = jnp.linalg.eigh(cov)
    return jnp.where(jnp.isfinite(factor).all(), factor, vectors * jnp.sqrt(jnp.maximum(values, 0)))
