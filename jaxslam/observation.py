"""One frame's look: propose poses, associate, weigh and update, block by block of particles.

A block's temporaries stay in cache; the arrays of all particles are read and written once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln

from jaxslam import association, geometry, landmarks, motion, proposal, sensors
from jaxslam.association import CLUTTER, NEW
from jaxslam.landmarks import Landmarks


class Chance(NamedTuple):
    """Random numbers of one step: standard normals [3, N] behind the poses, the uniform behind
    resampling, and uniforms [K, N] behind associations (None: these are not drawn)."""

    normals: jax.Array
    uniform: jax.Array
    picks: jax.Array | None = None


class Observed(NamedTuple):
    """Particles after a frame: `pose` [3, N] and map; `density` [N], log of motion x measurements
    over what pose and associations were drawn from; `match` [K, N]; `log_choice` [N], log
    probability of its draw; `counts` [2, N]: landmarks lost for want of a slot, and forgotten;
    `u` [3, N]: the normals that `motion.sample` made the poses of."""

    pose: jax.Array
    landmarks: Landmarks
    density: jax.Array
    match: jax.Array
    log_choice: jax.Array
    counts: jax.Array
    u: jax.Array


def observe(pose, world, chance, odometry, measurements, params, config, number, frozen=False):
    """`Observed` of N particles; `pose` [3, N] is from before the motion, `number` the step's.

    `frozen`: for derivatives by `params` poses are what was drawn, whatever drew them, and the
    density's derivative is that of the measurements alone (see `likelihood`).
    """
    hold = jax.lax.stop_gradient if frozen else lambda value: value
    n, size = config.particles, block_size(config)
    measurements = sensors.rescaled(measurements, params)
    params = params._replace(sigma_bearing=geometry.norm(params.sigma_bearing, params.caution))
    if not config.clutter:
        params = params._replace(outlier=jnp.zeros(()))
    # Outside the loop: XLA would work out cosine and sine again for every landmark.
    u = jnp.zeros_like(pose) if config.proposal == "informed" else chance.normals
    predicted = hold(jnp.stack(motion.sample(pose, odometry, params, u)))
    sensor_pose = jnp.stack(sensors.pose_of(tuple(predicted), params))
    particles = pose, predicted, sensor_pose, chance.normals, chance.picks
    frame = odometry, measurements, params, number

    def block(i, carry):
        mine = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, i * size, size, -1),
            (particles, carry.landmarks),
        )
        # Inside a branch the slices are arrays of their own. Fused into the arithmetic, in-place
        # reading and writing of the large arrays stops its vectorisation: ten times slower.
        done = jax.lax.cond(
            measurements.active,
            lambda mine: _look(*mine, *frame, config, hold),
            lambda mine: _nothing(*mine, *frame, config, hold),
            mine,
        )
        return jax.tree.map(
            lambda whole, new: jax.lax.dynamic_update_slice_in_dim(whole, new, i * size, -1),
            carry,
            done,
        )

    match = jnp.full((config.measurements, n), association.PADDING, jnp.int32)
    zero = jnp.zeros(n, pose.dtype)
    counts = jnp.zeros((2, n), jnp.int32)
    start = Observed(predicted, world, zero, match, zero, counts, chance.normals)
    return jax.lax.fori_loop(0, n // size, block, start)


def block_size(config):
    """The largest divisor of the number of particles that is no larger than the block."""
    n = config.particles
    return next(size for size in range(min(config.block, n), 0, -1) if n % size == 0)


def _nothing(particles, world, odometry, measurements, params, number, config, hold):
    """`Observed` of a block in a frame without a look: it moves."""
    pose, predicted, _, normals, _ = particles
    if config.proposal == "informed":
        predicted = hold(jnp.stack(motion.sample(pose, odometry, params, normals)))
    size = pose.shape[1]
    match = jnp.full((config.measurements, size), association.PADDING, jnp.int32)
    zero = jnp.zeros(size, pose.dtype)
    counts = jnp.zeros((2, size), jnp.int32)
    return Observed(predicted, world, zero, match, zero, counts, normals)


def _look(particles, before, odometry, measurements, params, number, config, hold):
    """`Observed` of a block: associate, move (when informed), weigh and update, create, forget."""
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
    match, log_choice = association.associate(
        config, scorer, measurements, new, clutter, params, picks
    )
    log_ratio, u = 0.0, normals
    if informed:
        whitened = proposal.inform(sensor, sensor_pose, axes, before, match, measurements, noise)
        u, log_ratio = hold(proposal.draw(whitened, normals))
        predicted = hold(jnp.stack(motion.sample(pose, odometry, params, u)))
        sensor_pose = jnp.stack(sensors.pose_of(tuple(predicted), params))
    world, density = landmarks.update_matched(
        sensor, tuple(sensor_pose), before, match, measurements, noise
    )
    density = density + jnp.where(match == NEW, new[:, None], 0).sum(0)
    if config.clutter:
        density = density + jnp.where(match == CLUTTER, clutter, 0).sum(0)
    if config.even:
        density = density - _orders(count, (match >= 0).sum(0))
    world, overflow = landmarks.create(
        config, tuple(sensor_pose), world, match, measurements, params, number
    )
    forgotten = jnp.zeros_like(overflow)
    if config.forgetting:
        world, forgotten = landmarks.existence(world, seen, params)
    counts = jnp.stack([overflow, forgotten]).astype(jnp.int32)
    density = density + log_ratio - log_choice
    world = landmarks.settle(world)
    return Observed(predicted, world, density, match, log_choice, counts, u)


def _orders(count, matched):
    """Log of in how many ways as many landmarks as `matched` [n] are picked from `count` [n]."""
    count = jnp.maximum(count, matched) + 1.0
    return gammaln(count) - gammaln(count - matched)
