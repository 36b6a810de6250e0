"""Update a block of particles with one frame: associate, draw the pose, update, weigh, forget.

Every function takes n particles at once, with arrays [.., n]; `blocks` calls them block by block,
so that a block's temporaries stay in cache.
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
    """Random numbers of one step: standard normals [3, N] behind the poses, the uniform [] behind
    resampling, and uniforms [K, N] behind matches (None: matches are not drawn)."""

    normals: jax.Array
    uniform: jax.Array
    picks: jax.Array | None = None


class Particles(NamedTuple):
    """n particles before a frame's measurements: `pose` [3, n] before the motion; `predicted` and
    `sensor_pose` [3, n] after it, drawn (`prior`) or its mean (`informed`); and their
    `RandomNumbers`."""

    pose: jax.Array
    predicted: jax.Array
    sensor_pose: jax.Array
    normals: jax.Array
    picks: jax.Array | None


class Observed(NamedTuple):
    """Particles after a frame's measurements, not yet resampled.

    `pose` [3, N] (m, m, rad), the map, and `density` [N]: log of motion times measurements over
    what pose and matches were drawn from. `match` and `landmark_id` [K, N] as in
    `step.Info`; `log_choice` [N]: log probability with which the matches were drawn. `counts`
    [2, N]: landmarks lost because no slot was free, and forgotten. `u` [3, N]: the normals from
    which `motion.sample` made the poses. The rest belongs to all particles (None for a block):
    `free` [K] are the slots offered to new landmarks.
    """

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


def move_block(particles, world, odometry, params, config, detach):
    """Move a block in a frame in which the sensor measured nothing: `Observed`."""
    pose, predicted, _, normals, _ = particles
    if config.proposal == "informed":
        predicted = detach(jnp.stack(motion.sample(pose, odometry, params, normals)))
    size = pose.shape[1]
    match = jnp.full((config.measurements, size), association.PADDING, jnp.int32)
    zero = jnp.zeros(size, pose.dtype)
    counts = jnp.zeros((2, size), jnp.int32)
    return Observed(predicted, world, zero, match, match, zero, counts, normals)


def update_general(particles, world, odometry, measurements, ratios, params, config, detach):
    """Update a block with measurements that may be of any of the map's slots: `Observed`.

    `world`: the block's `Landmarks` before the frame, all slots or the candidates. `ratios` [K, M]:
    log-likelihood ratios of appearance, or None. `detach`: `stop_gradient`, or what returns its
    argument.
    """
    sensor, informed = config.sensor, config.proposal == "informed"
    noise = sensors.correlated_noise(params, odometry)
    pose, sensor_pose = particles.predicted, particles.sensor_pose
    u, log_ratio = particles.normals, 0.0

    # Associate (section III-D): what each landmark would measure, against the alternatives.
    prediction, axes, jacobian = _predict(config, particles, world, odometry, params)
    visible = 1
    if config.uniform_association_prior:
        visible = (landmarks.in_view(prediction, params) & (world.count > 0)).sum(0)
    inlier = jnp.log1p(-params.outlier) - jnp.log(jnp.maximum(visible, 1))
    scorer = landmarks.make_scorer(sensor, prediction, world, inlier, jacobian)
    new, clutter = _alternatives(sensor, measurements, params)
    match, log_choice = association.associate(
        config, scorer, measurements, new, clutter, params, particles.picks, ratios
    )

    # Draw the pose from motion times measurements (FastSLAM 2.0); `prior` has drawn it before.
    if informed:
        posterior = proposal.inform(sensor, sensor_pose, axes, world, match, measurements, noise)
        pose, sensor_pose, u, log_ratio = _draw_pose(particles, posterior, odometry, params, detach)

    # Update the matched landmarks' EKFs (eqs. 5 and 6).
    repeated = config.association == "known" or not config.exclusive
    updated, density = landmark_updates.update_matched(
        sensor, tuple(sensor_pose), world, match, measurements, noise, repeated
    )

    # Weigh (eq. 3).
    density = _add_unmatched(config, density, match, new, clutter)
    if config.uniform_association_prior:
        density = density - _log_orders(visible, (match >= 0).sum(0))
    if ratios is not None:
        matched_ratios = jnp.take_along_axis(ratios, jnp.maximum(match, 0), 1)
        density = density + ordered_sum(jnp.where(match >= 0, matched_ratios, 0.0))

    # Forget landmarks that were in view but not matched too often.
    forgotten = jnp.zeros_like(match[0])
    if config.forgetting:
        updated, forgotten = landmarks.update_existence(updated, prediction, params)
    counts = jnp.stack([jnp.zeros_like(forgotten), forgotten]).astype(jnp.int32)

    density = density + log_ratio - log_choice
    landmark_id = updated.landmark_id
    updated = landmarks.unmark_matched(updated)
    landmark_id = jnp.take_along_axis(landmark_id, jnp.maximum(match, 0), 0)
    landmark_id = jnp.where(match >= 0, landmark_id, match)
    return Observed(pose, updated, density, match, landmark_id, log_choice, counts, u)


def update_known_slots(particles, world, odometry, measurements, known, params, config, detach):
    """Update a block with measurements whose slots are known, and nothing is forgotten: `Observed`.

    As `update_general`, but measurement k can be of landmark k of `world` alone, which holds those
    of `known` (`KnownSlots`), one for each of K measurements.
    """
    sensor, informed = config.sensor, config.proposal == "informed"
    noise = sensors.correlated_noise(params, odometry)
    pose, sensor_pose = particles.predicted, particles.sensor_pose
    u, log_ratio = particles.normals, 0.0

    # Associate: the known slot, a new landmark, or clutter.
    _, axes, jacobian = _predict(config, particles, world, odometry, params)
    inlier = jnp.log1p(-params.outlier)
    new, clutter = _alternatives(sensor, measurements, params)
    fit = _fit_known(sensor, sensor_pose, world, known, measurements, noise)
    score = _score_known(sensor, sensor_pose, world, inlier, jacobian, measurements, params, fit)
    match, log_choice = association.associate_known_slots(
        known, world.count > 0, score, measurements, clutter, particles.picks
    )

    # Draw the pose from motion times measurements (FastSLAM 2.0); `prior` has drawn it before.
    if informed:
        row = jnp.where(match >= 0, jnp.arange(len(match))[:, None], match)
        posterior = proposal.inform(sensor, sensor_pose, axes, world, row, measurements, noise)
        pose, sensor_pose, u, log_ratio = _draw_pose(particles, posterior, odometry, params, detach)
        fit = _fit_known(sensor, sensor_pose, world, known, measurements, noise)

    # Update the matched landmarks' EKFs (eqs. 5 and 6).
    updated, density = landmark_updates.update_known(
        sensor, tuple(sensor_pose), world, known, match, measurements, noise, fit
    )

    # Weigh (eq. 3).
    density = _add_unmatched(config, density, match, new, clutter)
    density = density + log_ratio - log_choice
    counts = jnp.zeros((2, match.shape[1]), jnp.int32)
    landmark_id = jnp.where(match >= 0, updated.landmark_id, match)
    return Observed(pose, updated, density, match, landmark_id, log_choice, counts, u)


def _predict(config, particles, world, odometry, params):
    """`sensors.Prediction` of every landmark; under the informed proposal also the derivatives of
    the sensor's pose and of the predictions by the motion's normals u (else None)."""
    pose, predicted, sensor_pose, _, _ = particles
    anchor = tuple(world.anchor) if world.anchor is not None else None
    prediction = sensors.observe(
        config.sensor, tuple(sensor_pose), tuple(world.mean), anchor, params
    )
    if config.proposal != "informed":
        return prediction, None, None
    axes = proposal.motion_axes(pose, predicted, sensor_pose, odometry, params)
    jacobian = proposal.pose_jacobian(
        config.sensor, sensor_pose, axes, world.mean, anchor, prediction.value
    )
    return prediction, axes, jacobian


def _alternatives(sensor, measurements, params):
    """Log densities of the measurements as new landmarks [K] and as clutter []."""
    new = sensors.log_new_density(sensor, tuple(measurements.value.T), params)
    return new, sensors.log_clutter_density(sensor, params)


def _draw_pose(particles, posterior, odometry, params, detach):
    """Poses and sensor poses [3, n] drawn from `posterior` (`proposal.Whitened`), their normals u
    [3, n], and the log [n] of the motion's density over the posterior's."""
    u, log_ratio = detach(proposal.draw(posterior, particles.normals))
    pose = detach(jnp.stack(motion.sample(particles.pose, odometry, params, u)))
    return pose, jnp.stack(sensors.sensor_pose_of(tuple(pose), params)), u, log_ratio


def _score_known(sensor, sensor_pose, world, inlier, jacobian, measurements, params, fit):
    """Log densities [K, n] of measurements under the landmarks of their known slots.

    With the pose exact and errors independent from frame to frame the update has them already.
    """

    def score():
        anchor = tuple(world.anchor) if world.anchor is not None else None
        prediction = sensors.observe(sensor, tuple(sensor_pose), tuple(world.mean), anchor, params)
        scorer = landmarks.make_scorer(sensor, prediction, world, inlier, jacobian)
        return landmarks.log_likelihoods(
            sensor, scorer, *association.measurement_columns(measurements), params
        )

    if sensor == "bearing" or jacobian is not None:
        return score()
    return jax.lax.cond(params.correlation > 0, score, lambda: inlier + fit[2])


def _fit_known(sensor, sensor_pose, world, known, measurements, params):
    """`landmark_updates.fit_known`, computed once for all that uses it."""
    arguments = sensor, tuple(sensor_pose), world, measurements, params
    return compute_once(known.earlier[0] >= 0, lambda: landmark_updates.fit_known(*arguments))


def _add_unmatched(config, density, match, new, clutter):
    """Log densities [n] of a frame's matches with those of its new landmarks and clutter added."""
    density = density + ordered_sum(jnp.where(match == NEW, new[:, None], 0.0))
    if config.clutter:
        density = density + ordered_sum(jnp.where(match == CLUTTER, clutter, 0.0))
    return density


def _log_orders(visible, matched):
    """Log of the number of ways to pick `matched` [n] landmarks in order from `visible` [n]."""
    visible = jnp.maximum(visible, matched) + 1.0
    return gammaln(visible) - gammaln(visible - matched)
