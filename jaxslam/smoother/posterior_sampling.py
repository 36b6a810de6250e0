"""Particles drawn anew: whole paths from the refined Gaussian, each with the map that it implies.

What the filter goes on from is the last pose and the map. Of a path drawn from the Gaussian of the
whole past, both are linear in the draw; so their joint normal is worked out once, and drawn from
directly. A particle's landmarks are then independent, as in any Rao-Blackwellised filter: each has
the mean that its path implies, and the covariance it would have were the path known.
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

STREAM = 2**31 - 2  # sets these random numbers apart from those of the steps
NONE, POINT, UNKNOWN_DEPTH = 0, 1, 2  # kinds of a slot


class Joint(NamedTuple):
    """Normal of the last pose and of M slots' points, and what else the slots hold; float32 arrays.

    `pose` [3]; `root` [3 + 2 M, 3 + 2 M] with only `used` columns: a square root of the covariance
    of the pose and of the points' conditional means. `kind` [M]: `NONE`, a world `POINT` whose
    depth is known, or `YOUNG`: a direction and inverse depth, carried along with the pose. `mean`
    [2, M], `factor` [3, M] (the path known), `anchor` [2, M] (`YOUNG`: all as seen from the robot);
    `log_odds`, `count`, `landmark_id` [M] as `landmarks.Landmarks`.
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
    """`Joint` of no landmarks, to be filled in."""
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
    """Covariance [3 + 2 L, 3 + 2 L] of the last pose and of the points' means given the path.

    With A the poses' part of the normal matrix, B the border, C the points' blocks, P the points'
    part of the inverse and S = B A^-1 B' = C - P^-1: a path's error d has the covariance
    A^-1 + A^-1 B' P B A^-1, and moves the points' means by -C^-1 B d.
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
    whole = np.block([[own + end @ points @ end.T, cross], [cross.T, spread]])
    return (whole + whole.T) / 2


def factor_of(cov):
    """A square root of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return vectors * np.sqrt(np.maximum(values, 0))


def draw_state(key, joint, step, config, known=None):
    """`State` at `step`: N particles of equal weight drawn from a `Joint`; `known`: `looks.Looks`
    of the state before, or None."""
    return make_on_devices(_draw, config, key, joint, jnp.int32(step), known)


@partial(jax.jit, static_argnames="config")
def _draw(key, joint, step, known, config):
    n, slots = config.particles, config.landmarks
    key = jax.random.fold_in(jax.random.fold_in(key, STREAM), step)

    def more(j, off):
        # One column after the other: how a matrix product adds up depends on the devices.
        normal = barrier(jax.random.normal(jax.random.fold_in(key, j), (n,), float))
        return off + barrier(joint.root[:, j, None] * normal)

    off = jax.lax.fori_loop(0, joint.used, more, jnp.zeros((len(joint.root), n), float))
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
    """`Landmarks` of particles at `pose` [3, N] whose points are `off` [M, 2, N] from the means."""
    shape = config.landmarks, config.particles
    kind = joint.kind[:, None]
    mean = joint.mean[:, :, None] + jnp.where(kind == POINT, off.transpose(1, 0, 2), 0.0)
    factor = jnp.broadcast_to(joint.factor[:, :, None], (3, *shape))
    anchor = None
    if config.sensor == "bearing":
        anchor = jnp.broadcast_to(joint.anchor[:, :, None], (2, *shape))
        ray, narrow = _to_inverse_depth(mean - anchor, factor)
        carried, place = _to_world(mean, anchor, pose)
        mean = jnp.where(kind == POINT, ray, carried)
        factor = jnp.where(kind == POINT, narrow, factor)
        anchor = jnp.where(kind == POINT, anchor, place)
    there = kind != NONE
    return landmarks.Landmarks(
        mean=barrier(jnp.where(there, mean, 0.0)),
        factor=barrier(jnp.where(there, factor, 0.0)),
        anchor=None if anchor is None else barrier(jnp.where(there, anchor, 0.0)),
        log_odds=jnp.broadcast_to(joint.log_odds[:, None], shape) if config.forgetting else None,
        count=jnp.broadcast_to(joint.count[:, None], shape),
        landmark_id=jnp.broadcast_to(joint.landmark_id[:, None], shape),
    )


def _to_inverse_depth(away, factor):
    """Direction and inverse depth of points [2, M, N] as seen from their anchors, to first order,
    with the lower factor."""
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
    """Directions and anchors as seen from the robot, in the world."""
    x, y, heading = pose
    c, s = jnp.cos(heading), jnp.sin(heading)
    place = jnp.stack([x + c * anchor[0] - s * anchor[1], y + s * anchor[0] + c * anchor[1]])
    return jnp.stack([wrap(mean[0] + heading), jnp.broadcast_to(mean[1], place[0].shape)]), place
