"""p(pose' | pose, odometry): the paper's translation, then rotation (section III-C, fig. 9).

The heading drifts while the robot translates (`err_drift`), then the robot rotates (`err_rot`). An
interval of many small steps keeps the direction of its chord, and has the covariance of the many
steps: heading noise displaces the end sideways, by the lever arm that was still ahead.
`logs/odometry.py:moments` has the same moments in NumPy.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxslam.logs.odometry import Odometry as Odometry
from jaxslam.models.geometry import wrap


class Motion(NamedTuple):
    """Model of one interval: chord (`length`, m; direction `chord`, rad), `turn` (rad), and noise.

    The noise is normal: of variance `var_along` (m^2) along the chord and `var_heading` (rad^2);
    sideways it is `slope` (m) times the heading's, plus independent noise of `var_rest` (m^2).
    """

    length: jax.Array
    chord: jax.Array
    turn: jax.Array
    var_along: jax.Array
    var_heading: jax.Array
    slope: jax.Array
    var_rest: jax.Array


def model(odometry, params):
    """`Motion` of one interval of odometry, with the systematic gains applied.

    Drift accrues evenly along the chord, so its lever has mean 1/2 and variance 1/12; turning noise
    has the odometry's lever. Sideways noise is lever x length x heading noise: the two kinds have
    slope cov(side, heading) / var(heading) together, and the rest of the variance is written as a
    sum, which cannot cancel below zero.
    """
    o = odometry
    moved = (o.dx != 0) | (o.dy != 0)
    raw_length = jnp.where(moved, jnp.hypot(jnp.where(moved, o.dx, 1.0), o.dy), 0.0)
    raw_chord = jnp.where(moved, jnp.arctan2(o.dy, jnp.where(moved, o.dx, 1.0)), 0.0)
    length = params.gain_tran * raw_length
    # Extra turning bends the path: the chord follows by the share that happened before its end.
    bend = o.lever * (params.gain_rot - 1) * o.dtheta + params.bias_drift * o.distance / 2
    floor_side = params.floor_tran**2 * o.duration
    var_drift = params.err_drift**2 * o.distance + params.floor_rot**2 * o.duration
    var_turn = params.err_rot**2 * o.turn
    var_heading = var_drift + var_turn
    turning = var_heading > 0
    per_heading = jnp.where(turning, 1 / jnp.where(turning, var_heading, 1.0), 0.0)
    between = var_drift * var_turn * (o.lever - 0.5) ** 2 * per_heading
    return Motion(
        length=length,
        chord=raw_chord + bend,
        turn=params.gain_rot * o.dtheta + params.bias_drift * o.distance,
        var_along=params.err_tran**2 * o.distance + floor_side,
        var_heading=var_heading,
        slope=length * (var_drift / 2 + o.lever * var_turn) * per_heading,
        var_rest=length**2 * (var_drift / 12 + o.lever_var * var_turn + between) + floor_side,
    )


def sample(pose, odometry, params, normals):
    """Move a pose (x, y, heading) by odometry, with the noise of standard normals (3,) (eq. 2)."""
    m = model(odometry, params)
    x, y, heading = pose
    e_along = _root(m.var_along) * normals[0]
    e_heading = _root(m.var_heading) * normals[1]
    e_side = m.slope * e_heading + _root(m.var_rest) * normals[2]
    c, s = jnp.cos(heading + m.chord), jnp.sin(heading + m.chord)
    ahead = m.length + e_along
    return (
        x + c * ahead - s * e_side,
        y + s * ahead + c * e_side,
        wrap(heading + m.turn + e_heading),
    )


def axes(pose, odometry, params):
    """Derivatives of `sample`'s pose by its three normals, at zero: three (x, y, heading)."""
    m = model(odometry, params)
    c, s = jnp.cos(pose[2] + m.chord), jnp.sin(pose[2] + m.chord)
    along, turn, rest = _root(m.var_along), _root(m.var_heading), _root(m.var_rest)
    side = m.slope * turn
    zero = jnp.zeros_like(c)
    by_along, by_rest = (c * along, s * along, zero), (-s * rest, c * rest, zero)
    return by_along, (-s * side, c * side, turn + zero), by_rest


def log_density(after, before, odometry, params):
    """log p(after | before, odometry) per m^2 rad (eq. 2); needs noise in every direction."""
    m = model(odometry, params)
    c, s = jnp.cos(before[2] + m.chord), jnp.sin(before[2] + m.chord)
    dx, dy = after[0] - before[0], after[1] - before[1]
    e_along, e_side = c * dx + s * dy - m.length, c * dy - s * dx
    e_heading = wrap(after[2] - before[2] - m.turn)
    rest = e_side - m.slope * e_heading
    squares = e_along**2 / m.var_along + e_heading**2 / m.var_heading + rest**2 / m.var_rest
    logs = jnp.log(m.var_along) + jnp.log(m.var_heading) + jnp.log(m.var_rest)
    return -0.5 * (squares + logs + 3 * jnp.log(2 * jnp.pi))


def log_density_of(u, odometry, params, drawn_with):
    """`log_density` under `params` of the poses that `sample` made of normals `u` (3,) under
    `drawn_with`: for derivatives by `params`. Directions without noise are left out.

    Computed from the normals: differences of float32 poses would lose small noise.
    """
    then, now = model(odometry, drawn_with), model(odometry, params)
    e_heading = _root(then.var_heading) * u[1]
    ahead = then.length + _root(then.var_along) * u[0]
    side = then.slope * e_heading + _root(then.var_rest) * u[2]
    c, s = jnp.cos(now.chord - then.chord), jnp.sin(now.chord - then.chord)
    heading = then.turn + e_heading - now.turn
    errors = (
        c * ahead + s * side - now.length,
        heading,
        c * side - s * ahead - now.slope * heading,
    )
    total = 0.0
    for error, at, var in zip(
        errors,
        (then.var_along, then.var_heading, then.var_rest),
        (now.var_along, now.var_heading, now.var_rest),
        strict=True,
    ):
        var = jnp.where(at > 0, var, 1.0)
        square = error**2 / var + jnp.log(2 * jnp.pi * var)
        total -= 0.5 * jnp.where(at > 0, square, 0.0)
    return total


def _root(variance):
    """Square root with gradient zero at zero."""
    positive = variance > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1.0)), 0.0)
