"""One frame's look: propose poses, associate, weigh and update, block by block of particles.

A block's temporaries stay in cache; the arrays of all particles are read and written once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln

from jaxslam.filter import (
    association,
    candidate_slots,
    landmark_updates,
    landmarks,
    proposal,
)
from jaxslam.filter.appearance import Appearances
from jaxslam.filter.association import CLUTTER, NEW
from jaxslam.filter.landmarks import Landmarks
from jaxslam.filter.lazy_resampling import Ancestry
from jaxslam.filter.xla import compute_once, ordered_sum
from jaxslam.models import motion, sensors


class RandomNumbers(NamedTuple):
    """Random numbers of one step: standard normals [3, N] behind the poses, the uniform behind
    resampling, and uniforms [K, N] behind associations (None: these are not drawn)."""

    normals: jax.Array
    uniform: jax.Array
    picks: jax.Array | None = None


class Observed(NamedTuple):
    """Particles after a frame: `pose` [3, N] and map; `density` [N], log of motion x measurements
    over what pose and associations were drawn from; `match` and `landmark_id` [K, N] (`filter.Info`);
    `log_choice` [N], log probability of the draw; `counts` [2, N]: landmarks lost for want of a
    slot, and forgotten; `u` [3, N]: the normals that `motion.sample` made the poses of; and what
    belongs to the map (None of a block of particles alone); slots `free` [K] for what was new."""

    pose: jax.Array
    landmarks: Landmarks
    density: jax.Array
    match: jax.Array
    landmark_id: jax.Array
    log_choice: jax.Array
    counts: jax.Array
    u: jax.Array
    bounds: candidate_slots.SlotBounds | None = None
    ancestry: Ancestry | None = None
    appearances: Appearances | None = None
    free: jax.Array | None = None


def move_block(particles, before, odometry, params, config, hold):
    """`Observed` in a frame without a look: it moves."""
    pose, predicted, _, normals, _ = particles
    if config.proposal == "informed":
        predicted = hold(jnp.stack(motion.sample(pose, odometry, params, normals)))
    size = pose.shape[1]
    match = jnp.full((config.measurements, size), association.PADDING, jnp.int32)
    zero = jnp.zeros(size, pose.dtype)
    counts = jnp.zeros((2, size), jnp.int32)
    return Observed(predicted, before, zero, match, match, zero, counts, normals)


def update_block(particles, before, rows, odometry, measurements, alike, params, config, hold):
    """`Observed`: associate, move (when informed), weigh and update, forget.

    `rows`: `matched.Rows` where these are the landmarks `before`, else None. `alike` [K, M]: log
    likelihood ratios of looks, or None.
    """
    pose, predicted, sensor_pose, normals, picks = particles
    sensor, informed = config.sensor, config.proposal == "informed"
    noise = sensors.correlated_noise(params, odometry)
    anchor = tuple(before.anchor) if before.anchor is not None else None
    seen = sensors.observe(sensor, tuple(sensor_pose), tuple(before.mean), anchor, params)
    axes, by_u = None, None
    if informed:
        axes = proposal.motion_axes(pose, predicted, sensor_pose, odometry, params)
        by_u = proposal.pose_jacobian(sensor, sensor_pose, axes, before.mean, anchor, seen.value)
    count = (
        (landmarks.in_view(seen, params) & (before.count > 0)).sum(0)
        if config.uniform_association_prior
        else 1
    )
    inlier = jnp.log1p(-params.outlier) - jnp.log(jnp.maximum(count, 1))
    scorer = landmarks.make_scorer(sensor, seen, before, inlier, by_u)
    new = sensors.log_new_density(sensor, tuple(measurements.value.T), params)
    clutter = sensors.log_clutter_density(sensor, params)
    if rows is None:
        match, log_choice = association.associate(
            config, scorer, measurements, new, clutter, params, picks, alike
        )
    else:
        fit = _fit_known(sensor, sensor_pose, before, rows, measurements, noise)
        own = _score_known(sensor, sensor_pose, before, inlier, by_u, measurements, params, fit)
        match, log_choice = association.associate_known_slots(
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
        sensor_pose = jnp.stack(sensors.sensor_pose_of(tuple(predicted), params))
    if rows is None:
        again = config.association == "known" or not config.exclusive
        world, density = landmark_updates.update_matched(
            sensor, tuple(sensor_pose), before, match, measurements, noise, again
        )
    else:
        if informed:
            fit = _fit_known(sensor, sensor_pose, before, rows, measurements, noise)
        world, density = landmark_updates.update_known(
            sensor, tuple(sensor_pose), before, rows, match, measurements, noise, fit
        )
    density = _add_unmatched(config, density, match, new, clutter, count)
    if alike is not None:
        own = jnp.take_along_axis(alike, jnp.maximum(match, 0), 1)
        density = density + ordered_sum(jnp.where(match >= 0, own, 0.0))
    forgotten = jnp.zeros_like(match[0])
    if config.forgetting:
        world, forgotten = landmarks.update_existence(world, seen, params)
    counts = jnp.stack([jnp.zeros_like(forgotten), forgotten]).astype(jnp.int32)
    density = density + log_ratio - log_choice
    landmark_id = world.landmark_id
    if rows is None:
        world = landmarks.unmark_matched(world)
        landmark_id = jnp.take_along_axis(landmark_id, jnp.maximum(match, 0), 0)
    landmark_id = jnp.where(match >= 0, landmark_id, match)
    return Observed(predicted, world, density, match, landmark_id, log_choice, counts, u)


def _score_known(sensor, sensor_pose, before, inlier, by_u, measurements, params, fit):
    """Log densities [K, n] of measurements under the landmarks of their rows, to associate by.

    With the pose exact and errors independent from frame to frame the update has them already.
    """

    def scored():
        anchor = tuple(before.anchor) if before.anchor is not None else None
        seen = sensors.observe(sensor, tuple(sensor_pose), tuple(before.mean), anchor, params)
        scorer = landmarks.make_scorer(sensor, seen, before, inlier, by_u)
        return landmarks.log_likelihoods(
            sensor, scorer, *association.measurement_columns(measurements), params
        )

    if sensor == "bearing" or by_u is not None:
        return scored()
    return jax.lax.cond(params.correlation > 0, scored, lambda: inlier + fit[2])


def _fit_known(sensor, sensor_pose, before, rows, measurements, params):
    """`matched.fitted`, as arrays."""
    given = sensor, tuple(sensor_pose), before, measurements, params
    return compute_once(rows.earlier[0] >= 0, lambda: landmark_updates.fit_known(*given))


def _add_unmatched(config, density, match, new, clutter, count):
    """Log densities [n] of a frame's matches, with what is new or clutter, and `uniform_association_prior`'s orders."""
    density = density + ordered_sum(jnp.where(match == NEW, new[:, None], 0.0))
    if config.clutter:
        density = density + ordered_sum(jnp.where(match == CLUTTER, clutter, 0.0))
    if config.uniform_association_prior:
        density = density - _log_orders(count, (match >= 0).sum(0))
    return density


def _log_orders(count, matched):
    """Log of in how many ways as many landmarks as `matched` [n] are picked from `count` [n]."""
    count = jnp.maximum(count, matched) + 1.0
    return gammaln(count) - gammaln(count - matched)
