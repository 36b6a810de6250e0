"""Triangulate points from two bearings and the motion between (paper, section III-B), with errors.

A point X lies on two rays. In the frame of the second sensor the ray of the second bearing b2 has
direction u2 = (cos b2, sin b2) and starts at zero; that of the first has direction u1 at angle
b1 - theta and starts at the first sensor, p = -R(-theta) t, for the motion (t, theta). With the
ranges r1, r2 along them, and n = (-sin, cos) the normal of a ray,

    r2 = p x u1 / sin(b1 - theta - b2),    r1 = p x u2 / sin(b1 - theta - b2),

and turning a ray by d(angle) moves its point at range r by r d(angle) along n, so that

    n2 . dX = r2 db2,    n1 . (dX - dp) = r1 (db1 - dtheta),    dp = -R(-theta) dt + J' p dtheta

with J' p = (p_y, -p_x): two linear equations for dX, the first-order error used here.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

OK, STILL, PARALLEL, BEHIND, NEAR, FAR = range(6)
REASONS = (
    "triangulated",
    "no baseline (a pure turn, or the robot stood)",
    "rays nearly parallel",
    "rays meet behind the sensor",
    "nearer than allowed",
    "farther than allowed",
)


@dataclass(frozen=True)
class TriangulationSettings:
    """Limits: `least_baseline` m of the motion; `parallax`: least angle between the rays, in
    standard deviations; `nearest` and `farthest` m, of the ranges."""

    least_baseline: float = 0.03
    parallax: float = 4.0
    nearest: float = 0.15
    farthest: float = 15.0


class Points(NamedTuple):
    """m points in the frame of the second sensor, NaN where rejected.

    `point` [m, 2] m; `cov` [m, 3] (xx, xy, yy) m^2 from white noise of both bearings and of the
    motion. `by_bias` [m, 2] m/rad: derivative of the point by an error common to both bearings (a
    camera turned on its mount, a calibration's bias); it repeats from pair to pair, doesn't average
    out, and is not part of `cov`. `parallax` [m]: angle between the rays in standard deviations.
    `reason` [m]: index into `REASONS`; `ok` [m].
    """

    point: np.ndarray
    cov: np.ndarray
    by_bias: np.ndarray
    parallax: np.ndarray
    reason: np.ndarray

    @property
    def ok(self):
        return self.reason == OK


def triangulate(bearing, sigma, motion, motion_cov, settings=None):
    """Triangulate m lines: `Points`.

    `bearing` [m, 2] rad in the first and second sensor frame; `sigma`, [m, 2] or a number, their
    standard deviations; `motion` [3] or [m, 3]: pose (x, y, heading) of the second sensor in the
    frame of the first; `motion_cov` [3, 3] or [m, 3, 3]. All errors are assumed independent.
    """
    settings = TriangulationSettings() if settings is None else settings
    bearing = np.asarray(bearing, float).reshape(-1, 2)
    count = len(bearing)
    sigma = np.broadcast_to(np.asarray(sigma, float), (count, 2))
    motion = np.broadcast_to(np.asarray(motion, float), (count, 3))
    motion_cov = np.broadcast_to(np.asarray(motion_cov, float), (count, 3, 3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        point, jacobian, ranges = _intersect(bearing, motion)
        # Columns of the Jacobian: b1, b2, tx, ty, theta.
        by_bearing, by_motion = jacobian[..., :2], jacobian[..., 2:]
        cov = np.einsum("mij,mj,mkj->mik", by_bearing, sigma**2, by_bearing)
        cov += np.einsum("mij,mjl,mkl->mik", by_motion, motion_cov, by_motion)
        # Range is proportional to 1 / sin(angle between the rays), so to first order the relative
        # errors of range and angle are equal. This includes the motion's error.
        ray = np.column_stack([np.cos(bearing[:, 1]), np.sin(bearing[:, 1])])
        along = np.sqrt(np.einsum("mi,mij,mj->m", ray, cov, ray))
        parallax = np.abs(ranges[:, 1]) / along
    reason = _reasons(ranges, parallax, np.hypot(*motion[:, :2].T), settings)
    good = (reason == OK)[:, None]
    return Points(
        point=np.where(good, point, np.nan),
        cov=np.where(good, cov[:, [0, 0, 1], [0, 1, 1]], np.nan),
        by_bias=np.where(good, by_bearing.sum(axis=-1), np.nan),
        parallax=parallax,
        reason=reason,
    )


def _intersect(bearing, motion):
    """Intersections [m, 2], derivatives [m, 2, 5] by (b1, b2, tx, ty, theta), ranges [m, 2]."""
    theta = motion[:, 2]
    c, s = np.cos(theta), np.sin(theta)
    back = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], 1)  # R(-theta)
    px, py = -np.einsum("mij,mj->im", back, motion[:, :2])
    first, second = bearing[:, 0] - theta, bearing[:, 1]
    c1, s1, c2, s2 = np.cos(first), np.sin(first), np.cos(second), np.sin(second)
    angle = np.sin(first - second)
    r1, r2 = (px * s2 - py * c2) / angle, (px * s1 - py * c1) / angle
    point = r2[:, None] * np.column_stack([c2, s2])
    # Right-hand sides of the two equations, per unknown; then the inverse of the rows n2, n1.
    zero = np.zeros_like(r1)
    normal = np.column_stack([-s1, c1])
    of_translation = -np.einsum("mi,mij->mj", normal, back)
    of_turn = -r1 + normal[:, 0] * py - normal[:, 1] * px
    second_row = np.stack([zero, r2, zero, zero, zero], -1)
    first_row = np.column_stack([r1, zero, of_translation, of_turn])
    inverse = np.stack([np.stack([c1, -c2], -1), np.stack([s1, -s2], -1)], 1)
    inverse = inverse / angle[:, None, None]
    jacobian = inverse @ np.stack([second_row, first_row], 1)
    return point, jacobian, np.column_stack([r1, r2])


def _reasons(ranges, parallax, baseline, settings):
    """Index [m] of the first of `REASONS` that applies."""
    still, parallel = baseline < settings.least_baseline, ~(parallax >= settings.parallax)
    behind, near = ~(ranges.min(axis=1) > 0), ranges[:, 1] < settings.nearest
    far = ranges.max(axis=1) > settings.farthest
    conditions = [still, parallel, behind, near, far]
    return np.select(conditions, [STILL, PARALLEL, BEHIND, NEAR, FAR], OK)


def compose(first, first_cov, second, second_cov):
    """Compose motions `first` [w, 3] and `second` [3] with independent errors; mean, covariance."""
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    x, y, turn = second
    ahead = np.column_stack([c * x - s * y, s * x + c * y])
    mean = np.column_stack([first[:, :2] + ahead, first[:, 2] + turn])
    by_first = np.tile(np.eye(3), (len(first), 1, 1))
    by_first[:, :2, 2] = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    by_second = np.tile(np.eye(3), (len(first), 1, 1))
    by_second[:, 0, 0] = by_second[:, 1, 1] = c
    by_second[:, 0, 1], by_second[:, 1, 0] = -s, s
    cov = by_first @ first_cov @ by_first.transpose(0, 2, 1)
    cov += by_second @ second_cov @ by_second.transpose(0, 2, 1)
    return mean, cov


def sensor_motion(mean, cov, mounting):
    """Motion [T, 3] of a sensor mounted at (x, y, yaw) and its covariance, from the robot's."""
    mx, my, yaw = mounting
    c, s = np.cos(mean[:, 2]), np.sin(mean[:, 2])
    # Displacement of the sensor, in the axes of its first pose.
    swung = np.column_stack([c * mx - s * my, s * mx + c * my])
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    moved = (mean[:, :2] + swung - (mx, my)) @ axes.T
    jacobian = np.zeros((len(mean), 3, 3))
    jacobian[:, :2, :2] = axes
    jacobian[:, :2, 2] = np.column_stack([-swung[:, 1], swung[:, 0]]) @ axes.T
    jacobian[:, 2, 2] = 1
    return np.column_stack([moved, mean[:, 2]]), jacobian @ cov @ jacobian.transpose(0, 2, 1)
