"""One frame's look: propose poses, associate, weigh and update, block by block of particles.

A block's temporaries stay in cache; the arrays of all particles are read and written once.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln

from jaxslam.filter import (
    appearance,
    association,
    candidate_slots,
    landmark_updates,
    landmarks,
    lazy_resampling,
    new_landmarks,
    proposal,
)
from jaxslam.filter import blocks as excerpt
from jaxslam.filter.appearance import Looks
from jaxslam.filter.association import CLUTTER, NEW
from jaxslam.filter.landmarks import Landmarks
from jaxslam.filter.lazy_resampling import Ancestry
from jaxslam.filter.xla import added, listed, once, pinned, rounds
from jaxslam.models import geometry, motion, sensors

SWEEP = 16  # steps
SMALLEST = (
    candidate_slots.FEW
)  # slots of which a block takes copies; four times as many, and so on, or all


class Chance(NamedTuple):
    """Random numbers of one step: standard normals [3, N] behind the poses, the uniform behind
    resampling, and uniforms [K, N] behind associations (None: these are not drawn)."""

    normals: jax.Array
    uniform: jax.Array
    picks: jax.Array | None = None


class Observed(NamedTuple):
    """Particles after a frame: `pose` [3, N] and map; `density` [N], log of motion x measurements
    over what pose and associations were drawn from; `match` and `birth` [K, N] (`filter.Info`);
    `log_choice` [N], log probability of the draw; `counts` [2, N]: landmarks lost for want of a
    slot, and forgotten; `u` [3, N]: the normals that `motion.sample` made the poses of; and what
    belongs to the map (None of a block of particles alone); slots `free` [K] for what was new."""

    pose: jax.Array
    landmarks: Landmarks
    density: jax.Array
    match: jax.Array
    birth: jax.Array
    log_choice: jax.Array
    counts: jax.Array
    u: jax.Array
    bounds: candidate_slots.Bounds | None = None
    ancestry: Ancestry | None = None
    looks: Looks | None = None
    free: jax.Array | None = None


def observe(state, chance, odometry, measurements, params, config, frozen=False):
    """`Observed` of the N particles of a `filter.State` from before the motion.

    `frozen`: for derivatives by `params` poses are what was drawn, whatever drew them, and the
    density's derivative is that of the measurements alone (see `likelihood`).
    """
    hold = jax.lax.stop_gradient if frozen else lambda value: value
    pose, n = state.pose, state.pose.shape[1]
    measurements = sensors.rescaled(measurements, params)
    params = params._replace(sigma_bearing=geometry.norm(params.sigma_bearing, params.caution))
    if config.sensor == "bearing" and config.association == "maximum_likelihood":
        params = sensors.at_most_one_new(params)
    if not config.clutter:
        params = params._replace(outlier=jnp.zeros(()))
    # Outside the loop: XLA would work out cosine and sine again for every landmark.
    sure = state.step >= 0
    chance = chance._replace(normals=once(sure, lambda: chance.normals))
    u = jnp.zeros_like(pose) if config.proposal == "informed" else chance.normals
    # Pinned: worked out again where it is used, it would be rounded otherwise.
    predicted = once(sure, lambda: motion.sample(pose, odometry, params, u))
    predicted = pinned(hold(jnp.stack(predicted)))
    sensor_pose = once(sure, lambda: sensors.pose_of(tuple(predicted), params))
    sensor_pose = pinned(jnp.stack(sensor_pose))
    alike = None if state.looks is None else appearance.gain(state.looks, measurements)
    rows = _concerned(state, predicted, sensor_pose, odometry, measurements, alike, params, config)
    rows &= measurements.active
    world, past, rows = _caught_up(state, rows, config)
    free = jnp.nonzero(~state.bounds.used, size=config.measurements, fill_value=config.landmarks)[0]
    particles = pose, predicted, sensor_pose, chance.normals, chance.picks
    frame = odometry, measurements, alike, params, free, state.step
    match = jnp.full((config.measurements, n), association.PADDING, jnp.int32)
    zero = jnp.zeros(n, pose.dtype)
    counts = jnp.zeros((2, n), jnp.int32)
    seen = Observed(predicted, world, zero, match, match, zero, counts, chance.normals)
    seen = seen, jax.lax.stop_gradient(candidate_slots.nowhere(config, pose.dtype))
    for size, chosen in _sizes(config, rows.sum()):
        seen = _blocks(seen, particles, rows, frame, config, hold, size, chosen)
    seen, found = seen
    found = candidate_slots.joined(found, config)
    if past is not None:  # what was free has nothing to catch up with
        past = past._replace(
            chain=jnp.where(found.used & ~state.bounds.used, lazy_resampling.CURRENT, past.chain)
        )
    looked = state.looks
    if looked is not None:
        looked = appearance.without(looked, found.used & ~state.bounds.used)
    touched = rows | found.used
    if landmark_updates.by_name(config):  # no bounds are asked for
        bounds = candidate_slots.unlimited(state.bounds, found.used | (rows & state.bounds.used))
    else:
        bounds = jax.tree.map(lambda new, old: jnp.where(touched, new, old), found, state.bounds)
    return seen._replace(bounds=bounds, ancestry=past, looks=looked, free=free)


def _concerned(state, predicted, sensor_pose, odometry, measurements, alike, params, config):
    """Slots [M] to look at."""
    extra = 0.0
    if config.proposal == "informed":
        axes = proposal.axes(state.pose, predicted, sensor_pose, odometry, params)
        extra = jnp.max(sum(x * x + y * y for x, y, _ in axes))
    given = state.bounds, sensor_pose, measurements, alike, params, extra
    return candidate_slots.concerned(config, *jax.lax.stop_gradient(given))


def _caught_up(state, rows, config):
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
        world, past = lazy_resampling.update(
            world, past, looked | lazy_resampling.last_of(past), config
        )
    return world, past, looked


def _sizes(config, count):
    """Numbers of slots that a block may look at, and which to go with: the smallest that `count`
    fits in."""
    total, size, sizes = config.landmarks, SMALLEST, []
    if landmark_updates.by_name(config):
        yield config.measurements, True
        return
    while size < total:
        sizes.append(size)
        size *= 4
    least = -1
    for size in (*sizes, total):
        yield size, (least < count) & (count <= size)
        least = size


def _widths(n, most):
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
    if landmark_updates.by_name(config):
        own = landmark_updates.rows_of(measurements, total)
        slots, taken, put = own.slot, listed(own.there), listed(own.there & (own.earlier == 0))
    elif size < total:
        slots = jnp.nonzero(rows, size=size, fill_value=total)[0].astype(jnp.int32)
        measurements = excerpt.renamed(measurements, slots, total)
        if alike is not None:
            alike = jnp.pad(alike, ((0, 0), (0, 1)))[:, slots]

    def block(i, carry, first, width):
        carry, bounds = carry
        start = first + i * width
        mine = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, width, -1), particles
        )
        before = excerpt.taken(carry.landmarks, slots, taken, start, width)
        # Inside a branch the slices are arrays of their own. Fused into the arithmetic, in-place
        # reading and writing of the large arrays stops its vectorisation: ten times slower.
        done = jax.lax.cond(
            measurements.active,
            lambda *mine: _look(*mine, own, odometry, measurements, alike, params, config, hold),
            lambda *mine: _nothing(*mine, odometry, params, config, hold),
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
        fixed = dict(anchor=None, birth=None)  # what a look leaves as it is
        world = excerpt.put(
            carry.landmarks._replace(**fixed), done.landmarks._replace(**fixed), slots, put, start,
        )._replace(anchor=carry.landmarks.anchor, birth=carry.landmarks.birth)  # fmt: skip
        at = tuple(sensors.pose_of(tuple(done.pose), params))
        if own is None:
            bounds = candidate_slots.widened(bounds, jax.lax.stop_gradient(done.landmarks), slots)
        world, born, lost = new_landmarks.create(
            config, world, start, at, done.match, free, named, params, number
        )
        counts = jax.lax.dynamic_update_slice_in_dim(rest.counts, lost[None], start, -1)
        return rest._replace(landmarks=world, counts=counts), candidate_slots.unlimited(
            bounds, born
        )

    for first, width, blocks in _widths(particles[0].shape[1], config.block):
        # A number that XLA does not know: it would open up a loop of one round, and fuse and round
        # otherwise than in a loop of many.
        count = pinned(jnp.where(chosen, blocks, 0))
        whole = rounds(count, partial(block, first=first, width=width), whole)
    return whole


def _nothing(particles, before, odometry, params, config, hold):
    """`Observed` in a frame without a look: it moves."""
    pose, predicted, _, normals, _ = particles
    if config.proposal == "informed":
        predicted = hold(jnp.stack(motion.sample(pose, odometry, params, normals)))
    size = pose.shape[1]
    match = jnp.full((config.measurements, size), association.PADDING, jnp.int32)
    zero = jnp.zeros(size, pose.dtype)
    counts = jnp.zeros((2, size), jnp.int32)
    return Observed(predicted, before, zero, match, match, zero, counts, normals)


def _look(particles, before, rows, odometry, measurements, alike, params, config, hold):
    """`Observed`: associate, move (when informed), weigh and update, forget.

    `rows`: `matched.Rows` where these are the landmarks `before`, else None. `alike` [K, M]: log
    likelihood ratios of looks, or None.
    """
    pose, predicted, sensor_pose, normals, picks = particles
    sensor, informed = config.sensor, config.proposal == "informed"
    noise = sensors.correlated(params, odometry)
    anchor = tuple(before.anchor) if before.anchor is not None else None
    seen = sensors.observe(sensor, tuple(sensor_pose), tuple(before.mean), anchor, params)
    axes, by_u = None, None
    if informed:
        axes = proposal.axes(pose, predicted, sensor_pose, odometry, params)
        by_u = proposal.rows(sensor, sensor_pose, axes, before.mean, anchor, seen.value)
    count = (landmarks.in_view(seen, params) & (before.count > 0)).sum(0) if config.even else 1
    inlier = jnp.log1p(-params.outlier) - jnp.log(jnp.maximum(count, 1))
    scorer = landmarks.scorer(sensor, seen, before, inlier, by_u)
    new = sensors.log_new_density(sensor, tuple(measurements.value.T), params)
    clutter = sensors.log_clutter_density(sensor, params)
    if rows is None:
        match, log_choice = association.associate(
            config, scorer, measurements, new, clutter, params, picks, alike
        )
    else:
        fit = _fit(sensor, sensor_pose, before, rows, measurements, noise)
        own = _densities(sensor, sensor_pose, before, inlier, by_u, measurements, params, fit)
        match, log_choice = association.named(
            rows, before.count > 0, own, measurements, clutter, picks
        )
    log_ratio, u = 0.0, normals
    if informed:
        row = (
            match if rows is None else jnp.where(match >= 0, jnp.arange(len(match))[:, None], match)
        )
        whitened = proposal.inform(sensor, sensor_pose, axes, before, row, measurements, noise)
        u, log_ratio = hold(proposal.draw(whitened, normals))
        predicted = hold(jnp.stack(motion.sample(pose, odometry, params, u)))
        sensor_pose = jnp.stack(sensors.pose_of(tuple(predicted), params))
    if rows is None:
        again = config.association == "known" or not config.exclusive
        world, density = landmark_updates.updated(
            sensor, tuple(sensor_pose), before, match, measurements, noise, again
        )
    else:
        if informed:
            fit = _fit(sensor, sensor_pose, before, rows, measurements, noise)
        world, density = landmark_updates.updated_rows(
            sensor, tuple(sensor_pose), before, rows, match, measurements, noise, fit
        )
    density = _with_unmatched(config, density, match, new, clutter, count)
    if alike is not None:
        own = jnp.take_along_axis(alike, jnp.maximum(match, 0), 1)
        density = density + added(jnp.where(match >= 0, own, 0.0))
    forgotten = jnp.zeros_like(match[0])
    if config.forgetting:
        world, forgotten = landmarks.existence(world, seen, params)
    counts = jnp.stack([jnp.zeros_like(forgotten), forgotten]).astype(jnp.int32)
    density = density + log_ratio - log_choice
    birth = world.birth
    if rows is None:
        world = landmarks.settle(world)
        birth = jnp.take_along_axis(birth, jnp.maximum(match, 0), 0)
    birth = jnp.where(match >= 0, birth, match)
    return Observed(predicted, world, density, match, birth, log_choice, counts, u)


def _densities(sensor, sensor_pose, before, inlier, by_u, measurements, params, fit):
    """Log densities [K, n] of measurements under the landmarks of their rows, to associate by.

    With the pose exact and errors independent from frame to frame the update has them already.
    """

    def scored():
        anchor = tuple(before.anchor) if before.anchor is not None else None
        seen = sensors.observe(sensor, tuple(sensor_pose), tuple(before.mean), anchor, params)
        scorer = landmarks.scorer(sensor, seen, before, inlier, by_u)
        return landmarks.score(sensor, scorer, *association.columns(measurements), params)

    if sensor == "bearing" or by_u is not None:
        return scored()
    return jax.lax.cond(params.correlation > 0, scored, lambda: inlier + fit[2])


def _fit(sensor, sensor_pose, before, rows, measurements, params):
    """`matched.fitted`, as arrays."""
    given = sensor, tuple(sensor_pose), before, measurements, params
    return once(rows.earlier[0] >= 0, lambda: landmark_updates.fitted(*given))


def _with_unmatched(config, density, match, new, clutter, count):
    """Log densities [n] of a frame's matches, with what is new or clutter, and `even`'s orders."""
    density = density + added(jnp.where(match == NEW, new[:, None], 0.0))
    if config.clutter:
        density = density + added(jnp.where(match == CLUTTER, clutter, 0.0))
    if config.even:
        density = density - _orders(count, (match >= 0).sum(0))
    return density


def _orders(count, matched):
    """Log of in how many ways as many landmarks as `matched` [n] are picked from `count` [n]."""
    count = jnp.maximum(count, matched) + 1.0
    return gammaln(count) - gammaln(count - matched)
