"""Observe a frame with all particles, block by block, in the candidate slots of the map."""

from functools import partial

import jax
import jax.numpy as jnp

from jaxslam.filter import (
    appearance,
    association,
    candidate_slots,
    landmark_updates,
    lazy_resampling,
    new_landmarks,
    proposal,
)
from jaxslam.filter.block_update import (
    Observed,
    Particles,
    move_block,
    update_general,
    update_known_slots,
)
from jaxslam.filter.xla import barrier, compute_once, nonzero_indices, repeat, row_start
from jaxslam.models import geometry, motion, sensors


def local_identities(measurements, slots, total):
    """The measurements with identities as indices into `slots` [S]; S: not among them."""
    size, identity = len(slots), measurements.identity
    local = jnp.full(total, size, jnp.int32)
    local = local.at[slots].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    there = (identity >= 0) & (identity < total)
    identity = jnp.where(there, local[jnp.clip(identity, 0, total - 1)], size)
    return measurements._replace(identity=identity)


def gather_block(world, slots, rows, start, width):
    """Landmarks [.., S, width] of the particles from `start` on in `slots` [S]; of these only the
    `rows` listed (indices, and how many) are read, the others are empty (None: read all)."""
    if rows is None:
        return jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, width, -1),
            world,
        )

    which, count = rows

    def read_row(i, parts):
        def read(leaf, part):
            at = row_start(leaf, slots[which[i]], start)
            row = jax.lax.dynamic_slice(leaf, at, (*leaf.shape[:-2], 1, width))
            return jax.lax.dynamic_update_slice_in_dim(part, row, which[i], leaf.ndim - 2)

        return jax.tree.map(read, world, parts)

    empty = jax.tree.map(
        lambda leaf: jnp.zeros((*leaf.shape[:-2], len(slots), width), leaf.dtype),
        world,
    )
    return repeat(count, read_row, empty)


def scatter_block(world, part, slots, rows, start):
    """The map with what `gather_block` read replaced by `part`."""
    if rows is None:
        return jax.tree.map(
            lambda leaf, new: jax.lax.dynamic_update_slice_in_dim(leaf, new, start, -1),
            world,
            part,
        )

    which, count = rows

    def write_row(i, leaves):
        def write(leaf, new):
            row = jax.lax.dynamic_slice_in_dim(new, which[i], 1, new.ndim - 2)
            at = row_start(leaf, slots[which[i]], start)
            return jax.lax.dynamic_update_slice(leaf, row, at)

        return jax.tree.map(write, leaves, part)

    return repeat(count, write_row, world)


SWEEP = 16  # steps
SMALLEST = candidate_slots.FEW  # slots that a block copies; or four times as many, and so on


def observe(state, random_numbers, odometry, measurements, params, config, frozen=False):
    """Move the N particles of a `State`, associate, weigh and update: `Observed`.

    `frozen`: take poses for constants in derivatives by `params`, so that the density's derivative
    is that of the measurements alone (see `learning/likelihood.py`).
    """
    detach = jax.lax.stop_gradient if frozen else lambda value: value
    pose, n = state.pose, state.pose.shape[1]
    measurements = sensors.apply_position_scale(measurements, params)
    params = params._replace(
        sigma_bearing=geometry.norm(params.sigma_bearing, params.extra_bearing_noise)
    )
    if config.sensor == "bearing" and config.association == "maximum_likelihood":
        params = sensors.cap_new_density(params)
    if not config.clutter:
        params = params._replace(outlier=jnp.zeros(()))
    # Outside the loop: XLA would compute cosine and sine again for every landmark.
    true = state.step >= 0
    normals = compute_once(true, lambda: random_numbers.normals)
    u = jnp.zeros_like(pose) if config.proposal == "informed" else normals
    # A barrier: computed again where it is used, it would be rounded differently.
    predicted = compute_once(true, lambda: motion.sample(pose, odometry, params, u))
    predicted = barrier(detach(jnp.stack(predicted)))
    sensor_pose = compute_once(true, lambda: sensors.sensor_pose_of(tuple(predicted), params))
    sensor_pose = barrier(jnp.stack(sensor_pose))
    ratios = (
        None
        if state.appearances is None
        else appearance.log_likelihood_ratio(state.appearances, measurements)
    )
    candidates = _select_candidates(
        state, predicted, sensor_pose, odometry, measurements, ratios, params, config
    )
    candidates &= measurements.active
    world, ancestry, candidates = _apply_ancestry(state, candidates, config)
    free = jnp.nonzero(~state.bounds.used, size=config.measurements, fill_value=config.landmarks)[0]
    particles = Particles(pose, predicted, sensor_pose, normals, random_numbers.picks)
    frame = odometry, measurements, ratios, params, free, state.step
    match = jnp.full((config.measurements, n), association.PADDING, jnp.int32)
    zero = jnp.zeros(n, pose.dtype)
    counts = jnp.zeros((2, n), jnp.int32)
    observed = Observed(predicted, world, zero, match, match, zero, counts, normals)
    carry = observed, jax.lax.stop_gradient(candidate_slots.empty_bounds(config, pose.dtype))
    for size, chosen in _candidate_sizes(config, candidates.sum()):
        carry = _update_all(carry, particles, candidates, frame, config, detach, size, chosen)
    observed, new_bounds = carry
    new_bounds = candidate_slots.merge_devices(new_bounds, config)
    if ancestry is not None:  # new landmarks are current
        begun = new_bounds.used & ~state.bounds.used
        ancestry = ancestry._replace(
            chain=jnp.where(begun, lazy_resampling.CURRENT, ancestry.chain)
        )
    appearances = state.appearances
    if appearances is not None:
        appearances = appearance.clear_slots(appearances, new_bounds.used & ~state.bounds.used)
    touched = candidates | new_bounds.used
    if landmark_updates.uses_known_slots(config):  # bounds are not used
        bounds = candidate_slots.lift(
            state.bounds, new_bounds.used | (candidates & state.bounds.used)
        )
    else:
        bounds = jax.tree.map(
            lambda new, old: jnp.where(touched, new, old), new_bounds, state.bounds
        )
    return observed._replace(bounds=bounds, ancestry=ancestry, appearances=appearances, free=free)


def _select_candidates(
    state, predicted, sensor_pose, odometry, measurements, ratios, params, config
):
    """Candidate slots [M]."""
    extra = 0.0
    if config.proposal == "informed":
        axes = proposal.motion_axes(state.pose, predicted, sensor_pose, odometry, params)
        extra = jnp.max(sum(x * x + y * y for x, y, _ in axes))
    arguments = state.bounds, sensor_pose, measurements, ratios, params, extra
    return candidate_slots.select_candidates(config, *jax.lax.stop_gradient(arguments))


def _apply_ancestry(state, candidates, config):
    """The map with the candidate slots [M] resampled, its ancestry, and the candidate slots.

    Particles that used a slot out of sight may have no descendants left: when slots run short,
    every `SWEEP` steps all used slots are candidates.
    """
    if config.association != "known":
        short = (~state.bounds.used).sum() < config.measurements
        candidates = candidates | (state.bounds.used & short & (state.step % SWEEP == 0))
    world, ancestry = state.landmarks, state.ancestry
    if ancestry is not None:
        world, ancestry = lazy_resampling.apply_ancestry(
            world, ancestry, candidates | lazy_resampling.oldest_slots(ancestry), config
        )
    return world, ancestry, candidates


def _candidate_sizes(config, count):
    """Pairs of a number of slots and whether it is the smallest that `count` candidates fit in."""
    total, size, sizes = config.landmarks, SMALLEST, []
    if landmark_updates.uses_known_slots(config):
        yield config.measurements, True
        return
    while size < total:
        sizes.append(size)
        size *= 4
    least = -1
    for size in (*sizes, total):
        yield size, (least < count) & (count <= size)
        least = size


def _block_widths(n, most):
    """(start, width, number) of blocks of n particles, whose widths differ by one at most.

    A narrow last block would be compiled to other arithmetic, and be rounded differently.
    """
    blocks = -(-n // most)
    width, more = divmod(n, blocks)
    yield 0, width, blocks - more
    if more:
        yield n - more * (width + 1), width + 1, more


def _update_all(carry, particles, candidates, frame, config, detach, size, chosen):
    """Update all particles in `size` slots, if `chosen`: `Observed` and the new bounds."""
    total = len(candidates)
    odometry, measurements, ratios, params, free, number = frame
    original = measurements
    slots = jnp.arange(total, dtype=jnp.int32)
    known, read = None, None if size == total else (slots[:size], candidates.sum())
    written = read
    if landmark_updates.uses_known_slots(config):
        known = landmark_updates.known_slots(measurements, total)
        slots, read, written = (
            known.slot,
            nonzero_indices(known.there),
            nonzero_indices(known.there & (known.earlier == 0)),
        )
    elif size < total:
        slots = jnp.nonzero(candidates, size=size, fill_value=total)[0].astype(jnp.int32)
        measurements = local_identities(measurements, slots, total)
        if ratios is not None:
            ratios = jnp.pad(ratios, ((0, 0), (0, 1)))[:, slots]

    def update(*block):
        if known is None:
            return update_general(*block, odometry, measurements, ratios, params, config, detach)
        return update_known_slots(*block, odometry, measurements, known, params, config, detach)

    def update_block(i, carry, first, width):
        carry, bounds = carry
        start = first + i * width
        block_particles = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, width, -1), particles
        )
        before = gather_block(carry.landmarks, slots, read, start, width)
        # Inside a branch the slices are separate arrays. Fused into the arithmetic, in-place
        # reading and writing of the large arrays stops its vectorisation: ten times slower.
        new = jax.lax.cond(
            measurements.active,
            update,
            lambda *block: move_block(*block, odometry, params, config, detach),
            block_particles,
            before,
        )
        if size < total and known is None:
            at = slots[jnp.clip(new.match, 0, size - 1)]
            new = new._replace(match=jnp.where(new.match >= 0, at, new.match))
        rest = jax.tree.map(
            lambda leaf, part: jax.lax.dynamic_update_slice_in_dim(leaf, part, start, -1),
            carry._replace(landmarks=None),
            new._replace(landmarks=None),
        )
        fixed = dict(anchor=None, landmark_id=None)  # what a measurement leaves as it is
        world = scatter_block(
            carry.landmarks._replace(**fixed),
            new.landmarks._replace(**fixed),
            slots,
            written,
            start,
        )._replace(anchor=carry.landmarks.anchor, landmark_id=carry.landmarks.landmark_id)
        at = tuple(sensors.sensor_pose_of(tuple(new.pose), params))
        if known is None:
            bounds = candidate_slots.widen(bounds, jax.lax.stop_gradient(new.landmarks), slots)
        world, created, lost = new_landmarks.create(
            config, world, start, at, new.match, free, original, params, number
        )
        counts = jax.lax.dynamic_update_slice_in_dim(rest.counts, lost[None], start, -1)
        return rest._replace(landmarks=world, counts=counts), candidate_slots.lift(bounds, created)

    for first, width, blocks in _block_widths(particles[0].shape[1], config.block):
        # A number that XLA does not know: it would unroll a loop of one round, and fuse and round
        # differently from a loop of many.
        count = barrier(jnp.where(chosen, blocks, 0))
        carry = repeat(count, partial(update_block, first=first, width=width), carry)
    return carry
