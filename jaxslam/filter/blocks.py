"""A block's share of some slots of the map, read and put back."""

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
    """The measurements with the places of their slots among `slots` [S] as identities; S: none."""
    size, given = len(slots), measurements.identity
    local = jnp.full(total, size, jnp.int32)
    local = local.at[slots].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    there = (given >= 0) & (given < total)
    identity = jnp.where(there, local[jnp.clip(given, 0, total - 1)], size)
    return measurements._replace(identity=identity)


def gather_block(world, slots, rows, start, width):
    """Of `slots` [S] the `rows` listed (indices, and how many), of `width` particles from `start`
    on; the others are empty. None: all slots."""
    if rows is None:
        return jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, width, -1),
            world,
        )

    which, count = rows

    def one(i, parts):
        def take(leaf, part):
            at = row_start(leaf, slots[which[i]], start)
            row = jax.lax.dynamic_slice(leaf, at, (*leaf.shape[:-2], 1, width))
            return jax.lax.dynamic_update_slice_in_dim(part, row, which[i], leaf.ndim - 2)

        return jax.tree.map(take, world, parts)

    empty = jax.tree.map(
        lambda leaf: jnp.zeros((*leaf.shape[:-2], len(slots), width), leaf.dtype),
        world,
    )
    return repeat(count, one, empty)


def scatter_block(world, part, slots, rows, start):
    """The map with what `taken` took replaced."""
    if rows is None:
        return jax.tree.map(
            lambda leaf, new: jax.lax.dynamic_update_slice_in_dim(leaf, new, start, -1),
            world,
            part,
        )

    which, count = rows

    def one(i, leaves):
        def put(leaf, new):
            row = jax.lax.dynamic_slice_in_dim(new, which[i], 1, new.ndim - 2)
            at = row_start(leaf, slots[which[i]], start)
            return jax.lax.dynamic_update_slice(leaf, row, at)

        return jax.tree.map(put, leaves, part)

    return repeat(count, one, world)


SWEEP = 16  # steps
SMALLEST = (
    candidate_slots.FEW
)  # slots of which a block takes copies; four times as many, and so on, or all


def observe(state, chance, odometry, measurements, params, config, frozen=False):
    """`Observed` of the N particles of a `filter.State` from before the motion.

    `frozen`: for derivatives by `params` poses are what was drawn, whatever drew them, and the
    density's derivative is that of the measurements alone (see `likelihood`).
    """
    hold = jax.lax.stop_gradient if frozen else lambda value: value
    pose, n = state.pose, state.pose.shape[1]
    measurements = sensors.apply_position_scale(measurements, params)
    params = params._replace(
        sigma_bearing=geometry.norm(params.sigma_bearing, params.extra_bearing_noise)
    )
    if config.sensor == "bearing" and config.association == "maximum_likelihood":
        params = sensors.cap_new_density(params)
    if not config.clutter:
        params = params._replace(outlier=jnp.zeros(()))
    # Outside the loop: XLA would work out cosine and sine again for every landmark.
    sure = state.step >= 0
    chance = chance._replace(normals=compute_once(sure, lambda: chance.normals))
    u = jnp.zeros_like(pose) if config.proposal == "informed" else chance.normals
    # Pinned: worked out again where it is used, it would be rounded otherwise.
    predicted = compute_once(sure, lambda: motion.sample(pose, odometry, params, u))
    predicted = barrier(hold(jnp.stack(predicted)))
    sensor_pose = compute_once(sure, lambda: sensors.sensor_pose_of(tuple(predicted), params))
    sensor_pose = barrier(jnp.stack(sensor_pose))
    alike = (
        None if state.appearances is None else appearance.log_likelihood_ratio(state.appearances, measurements)
    )
    rows = _select_candidates(
        state, predicted, sensor_pose, odometry, measurements, alike, params, config
    )
    rows &= measurements.active
    world, past, rows = _apply_ancestry(state, rows, config)
    free = jnp.nonzero(~state.bounds.used, size=config.measurements, fill_value=config.landmarks)[0]
    particles = Particles(pose, predicted, sensor_pose, chance.normals, chance.picks)
    frame = odometry, measurements, alike, params, free, state.step
    match = jnp.full((config.measurements, n), association.PADDING, jnp.int32)
    zero = jnp.zeros(n, pose.dtype)
    counts = jnp.zeros((2, n), jnp.int32)
    seen = Observed(predicted, world, zero, match, match, zero, counts, chance.normals)
    seen = seen, jax.lax.stop_gradient(candidate_slots.empty_bounds(config, pose.dtype))
    for size, chosen in _candidate_sizes(config, rows.sum()):
        seen = _blocks(seen, particles, rows, frame, config, hold, size, chosen)
    seen, found = seen
    found = candidate_slots.merge_devices(found, config)
    if past is not None:  # what was free has nothing to catch up with
        past = past._replace(
            chain=jnp.where(found.used & ~state.bounds.used, lazy_resampling.CURRENT, past.chain)
        )
    looked = state.appearances
    if looked is not None:
        looked = appearance.clear_slots(looked, found.used & ~state.bounds.used)
    touched = rows | found.used
    if landmark_updates.uses_known_slots(config):  # no bounds are asked for
        bounds = candidate_slots.lift(state.bounds, found.used | (rows & state.bounds.used))
    else:
        bounds = jax.tree.map(lambda new, old: jnp.where(touched, new, old), found, state.bounds)
    return seen._replace(bounds=bounds, ancestry=past, appearances=looked, free=free)


def _select_candidates(
    state, predicted, sensor_pose, odometry, measurements, alike, params, config
):
    """Slots [M] to look at."""
    extra = 0.0
    if config.proposal == "informed":
        axes = proposal.motion_axes(state.pose, predicted, sensor_pose, odometry, params)
        extra = jnp.max(sum(x * x + y * y for x, y, _ in axes))
    given = state.bounds, sensor_pose, measurements, alike, params, extra
    return candidate_slots.select_candidates(config, *jax.lax.stop_gradient(given))


def _apply_ancestry(state, rows, config):
    """The map with these slots [M] where their particles are, and its ancestry.

    Particles that used a slot out of sight may have no descendants left: when slots run short, now
    and then all are looked at.
    """
    looked = rows
    if config.association != "known":
        short = (~state.bounds.used).sum() < config.measurements
        looked = rows | (state.bounds.used & short & (state.step % SWEEP == 0))
    world, past = state.landmarks, state.ancestry
    if past is not None:
        world, past = lazy_resampling.apply_ancestry(
            world, past, looked | lazy_resampling.oldest_slots(past), config
        )
    return world, past, looked


def _candidate_sizes(config, count):
    """Numbers of slots that a block may look at, and which to go with: the smallest that `count`
    fits in."""
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
    """(start, width, number) of blocks that make up n particles, alike but for one particle.

    A narrow rest would be compiled to other arithmetic, and be rounded otherwise.
    """
    blocks = -(-n // most)
    width, more = divmod(n, blocks)
    yield 0, width, blocks - more
    if more:
        yield n - more * (width + 1), width + 1, more


def _blocks(whole, particles, rows, frame, config, hold, size, chosen):
    """`Observed` of all particles, each with `size` of the slots, if that is `chosen`."""
    total = len(rows)
    odometry, measurements, alike, params, free, number = frame
    named = measurements
    slots = jnp.arange(total, dtype=jnp.int32)
    own, taken = None, None if size == total else (slots[:size], rows.sum())
    put = taken
    if landmark_updates.uses_known_slots(config):
        own = landmark_updates.known_slots(measurements, total)
        slots, taken, put = (
            own.slot,
            nonzero_indices(own.there),
            nonzero_indices(own.there & (own.earlier == 0)),
        )
    elif size < total:
        slots = jnp.nonzero(rows, size=size, fill_value=total)[0].astype(jnp.int32)
        measurements = local_identities(measurements, slots, total)
        if alike is not None:
            alike = jnp.pad(alike, ((0, 0), (0, 1)))[:, slots]

    def block(i, carry, first, width):
        carry, bounds = carry
        start = first + i * width
        mine = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, width, -1), particles
        )
        before = gather_block(carry.landmarks, slots, taken, start, width)
        # Inside a branch the slices are arrays of their own. Fused into the arithmetic, in-place
        # reading and writing of the large arrays stops its vectorisation: ten times slower.
        done = jax.lax.cond(
            measurements.active,
            lambda *mine: (
                update_general(*mine, odometry, measurements, alike, params, config, hold)
                if own is None
                else update_known_slots(*mine, odometry, measurements, own, params, config, hold)
            ),
            lambda *mine: move_block(*mine, odometry, params, config, hold),
            mine,
            before,
        )
        if size < total and own is None:
            at = slots[jnp.clip(done.match, 0, size - 1)]
            done = done._replace(match=jnp.where(done.match >= 0, at, done.match))
        rest = jax.tree.map(
            lambda leaf, new: jax.lax.dynamic_update_slice_in_dim(leaf, new, start, -1),
            carry._replace(landmarks=None),
            done._replace(landmarks=None),
        )
        fixed = dict(anchor=None, landmark_id=None)  # what a look leaves as it is
        world = scatter_block(
            carry.landmarks._replace(**fixed), done.landmarks._replace(**fixed), slots, put, start,
        )._replace(anchor=carry.landmarks.anchor, landmark_id=carry.landmarks.landmark_id)  # fmt: skip
        at = tuple(sensors.sensor_pose_of(tuple(done.pose), params))
        if own is None:
            bounds = candidate_slots.widen(bounds, jax.lax.stop_gradient(done.landmarks), slots)
        world, born, lost = new_landmarks.create(
            config, world, start, at, done.match, free, named, params, number
        )
        counts = jax.lax.dynamic_update_slice_in_dim(rest.counts, lost[None], start, -1)
        return rest._replace(landmarks=world, counts=counts), candidate_slots.lift(bounds, born)

    for first, width, blocks in _block_widths(particles[0].shape[1], config.block):
        # A number that XLA does not know: it would open up a loop of one round, and fuse and round
        # otherwise than in a loop of many.
        count = barrier(jnp.where(chosen, blocks, 0))
        whole = repeat(count, partial(block, first=first, width=width), whole)
    return whole
