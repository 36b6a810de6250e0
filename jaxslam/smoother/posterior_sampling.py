"""Draw particles from the refined posterior: paths from its Gaussian, each with its map.

The filter needs the last pose and the map only. Both are linear in a path drawn from the Gaussian,
so their joint normal is computed once and sampled directly. A particle's landmarks are then
independent, as in any Rao-Blackwellised filter: each has its mean and covariance given the path.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_solve_banded

from jaxslam.filter import appearance, candidate_slots, landmarks
from jaxslam.filter.step import fresh_state, make_on_devices
from jaxslam.filter.xla import barrier
from jaxslam.models.geometry import norm, wrap

STREAM = 2**31 - 2  # separates these random numbers from those of the steps
NONE, POINT, UNKNOWN_DEPTH = 0, 1, 2  # kinds of a slot's content


class Joint(NamedTuple):
    """Joint normal of the last pose and of the points of M slots, and the slots' other content.

    `pose` [3]; `root` [3 + 2 M, 3 + 2 M], of which `used` columns count: a square root of the
    covariance of the pose and of the points' means given the path. `kind` [M]: `NONE` (a free
    slot), `POINT` (a world point), or `UNKNOWN_DEPTH` (direction and inverse depth, moved with the
    pose). `mean` [2, M], `factor` [3, M] (given the path), `anchor` [2, M]: in the world, or of
    `UNKNOWN_DEPTH` in the robot's frame; `log_odds`, `count`, `landmark_id` [M] as in `Landmarks`.
    Float32 arrays.
    """

    pose: np.ndarray
    root: np.ndarray
    used: np.ndarray
    kind: np.ndarray
    mean: np.ndarray
    factor: np.ndarray
    anchor: np.ndarray
    log_odds: np.ndarray
    count: np.ndarray
    landmark_id: np.ndarray


def empty_joint(slots):
    """Make a `Joint` without landmarks, to be filled in."""
    size = 3 + 2 * slots
    return Joint(
        pose=np.zeros(3, np.float32),
        root=np.zeros((size, size), np.float32),
        used=np.int32(3),
        kind=np.zeros(slots, np.int32),
        mean=np.zeros((2, slots), np.float32),
        factor=np.zeros((3, slots), np.float32),
        anchor=np.zeros((2, slots), np.float32),
        log_odds=np.zeros(slots, np.float32),
        count=np.zeros(slots, np.int32),
        landmark_id=np.zeros(slots, np.int32),
    )


def covariance(fit):
    """Compute the covariance [3 + 2 L, 3 + 2 L] of last pose and points' means given the path.

    With the blocks A, B, C of `normal_equations`, P the points' part of the inverse and
    S = B A^-1 B' = C - P^-1: a path's error d has the covariance A^-1 + A^-1 B' P B A^-1, and moves
    the points' means by -C^-1 B d.
    """
    chain, inverse_border, points = fit.factor
    size = len(fit.points)
    last = np.zeros((len(inverse_border), 3))
    last[-3:] = np.eye(3)
    own = cho_solve_banded((chain, True), last, check_finite=False)[-3:]
    end = inverse_border[-3:]
    block = np.arange(2 * size).reshape(size, 2)
    corner, inverse = np.zeros((2, 2 * size, 2 * size))
    corner[block[:, :, None], block[:, None, :]] = fit.information
    inverse[block[:, :, None], block[:, None, :]] = np.linalg.inv(fit.information)
    s = corner - np.linalg.inv(points)
    cross = -(end + end @ points @ s) @ inverse
    spread = inverse @ (s + s @ points @ s) @ inverse
    joint = np.block([[own + end @ points @ end.T, cross], [cross.T, spread]])
    return (joint + joint.T) / 2


def factor_of(cov):
    """Compute a square root of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return vectors * np.sqrt(np.maximum(values, 0))


def draw_state(key, joint, step, config, known=None):
    """Draw a `State` at `step`, N particles of equal weight, from a `Joint`; `known`: `Appearances`
    of the state before, or None."""
    return make_on_devices(_draw, config, key, joint, jnp.int32(step), known)


@partial(jax.jit, static_argnames="config")
def _draw(key, joint, step, known, config):
    n, slots = config.particles, config.landmarks
    key = jax.random.fold_in(jax.random.fold_in(key, STREAM), step)

    def add_column(j, off):
        # Column by column: the order of a matrix product's sums depends on the devices.
        normal = barrier(jax.random.normal(jax.random.fold_in(key, j), (n,), float))
        return off + barrier(joint.root[:, j, None] * normal)

    off = jax.lax.fori_loop(0, joint.used, add_column, jnp.zeros((len(joint.root), n), float))
    pose = joint.pose[:, None] + off[:3]
    pose = barrier(pose.at[2].set(wrap(pose[2])))
    world = _draw_landmarks(joint, pose, off[3:].reshape(slots, 2, n), config)
    state = fresh_state(pose, world, step, candidate_slots.bounds_of(world), config)
    return (
        state
        if known is None
        else state._replace(appearances=appearance.reorder_slots(known, joint.landmark_id))
    )


def _draw_landmarks(joint, pose, off, config):
    """`Landmarks` of particles at `pose` [3, N], with points `off` [M, 2, N] from the means."""
    shape = config.landmarks, config.particles
    kind = joint.kind[:, None]
    mean = joint.mean[:, :, None] + jnp.where(kind == POINT, off.transpose(1, 0, 2), 0.0)
    factor = jnp.broadcast_to(joint.factor[:, :, None], (3, *shape))
    anchor = None
    if config.sensor == "bearing":
        anchor = jnp.broadcast_to(joint.anchor[:, :, None], (2, *shape))
        ray, ray_factor = _to_inverse_depth(mean - anchor, factor)
        moved, moved_anchor = _to_world(mean, anchor, pose)
        mean = jnp.where(kind == POINT, ray, moved)
        factor = jnp.where(kind == POINT, ray_factor, factor)
        anchor = jnp.where(kind == POINT, anchor, moved_anchor)
    used = kind != NONE
    return landmarks.Landmarks(
        mean=barrier(jnp.where(used, mean, 0.0)),
        factor=barrier(jnp.where(used, factor, 0.0)),
        anchor=None if anchor is None else barrier(jnp.where(used, anchor, 0.0)),
        log_odds=jnp.broadcast_to(joint.log_odds[:, None], shape) if config.forgetting else None,
        count=jnp.broadcast_to(joint.count[:, None], shape),
        landmark_id=jnp.broadcast_to(joint.landmark_id[:, None], shape),
    )


def _to_inverse_depth(away, factor):
    """Convert points [2, M, N] relative to their anchors to direction and inverse depth, and their
    lower covariance factors to first order."""
    r = norm(away[0], away[1])
    c, s = away[0] / r, away[1] / r
    l11, l21, l22 = factor
    # Rows of the Jacobian times L: across the ray over r, along it over -r^2.
    a1, a2 = (-s * l11 + c * l21) / r, c * l22 / r
    b1, b2 = -(c * l11 + s * l21) / r**2, -s * l22 / r**2
    top = norm(a1, a2, 1e-12)
    side = (a1 * b1 + a2 * b2) / top
    low = jnp.abs(a1 * b2 - a2 * b1) / top
    return jnp.stack([jnp.arctan2(away[1], away[0]), 1 / r]), jnp.stack([top, side, low])


def _to_world(mean, anchor, pose):
    """Transform directions and anchors from the robot's frame to the world."""
    x, y, heading = pose
    c, s = jnp.cos(heading), jnp.sin(heading)
    moved = jnp.stack([x + c * anchor[0] - s * anchor[1], y + s * anchor[0] + c * anchor[1]])
    return jnp.stack([wrap(mean[0] + heading), jnp.broadcast_to(mean[1], moved[0].shape)]), moved
