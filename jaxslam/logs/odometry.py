"""Integrate a log's odometry exactly between frames; NumPy alone.

Odometry may come faster than frames, or slower: a log with fewer frames describes the same motion.
"""

from typing import NamedTuple

import numpy as np


class Odometry(NamedTuple):
    """Odometry of one interval (or of T, stacked).

    `dx, dy` [m] and `dtheta` [rad]: displacement in the robot's frame at the interval's start.
    `distance` [m], `turn` [rad]: sums of absolute values. `duration` [s]. `lever`: mean fraction of
    the path still ahead when the robot turned (0 for translate-then-rotate, 1/2 for an arc);
    `lever_var`: its variance over the turning (0, 1/12).
    """

    dx: np.ndarray
    dy: np.ndarray
    dtheta: np.ndarray
    distance: np.ndarray
    turn: np.ndarray
    duration: np.ndarray
    lever: np.ndarray
    lever_var: np.ndarray

    @classmethod
    def from_displacement(cls, dx: float, dy: float, dtheta: float, duration: float) -> "Odometry":
        """`Odometry` of one interval from its displacement, driven along an arc.

        `dx`, `dy` [m]: in the robot's frame at the interval's start; `dtheta` [rad]: less than a
        full turn; `duration` [s]. For intervals with reversals or stops, sum up `distance` and
        `turn` instead, as `increments` does.
        """
        distance = np.hypot(dx, dy) / np.sinc(dtheta / (2 * np.pi))  # chord to arc
        values = dx, dy, dtheta, distance, abs(dtheta), duration, 0.5, 1 / 12
        return cls(*map(np.asarray, values))


def increments(log):
    """Integrate the odometry to each frame from the one before, the first from `log.start`.

    Returns `Odometry` [T]. Steps of constant velocity are arcs, commands are translations with a
    turn at their end. Sums over the steps of an interval are exact, as are the lever's mean and
    variance: the fraction of the path still ahead is uniform within an arc, and fixed at a
    command's turn.
    """
    bounds = np.concatenate([[log.start], log.frame_time])
    arc = log.odometry_kind == "velocity"
    frame, travel, turn = _arcs(log, bounds) if arc else _commands(log)

    def total(weights):
        return np.bincount(frame, weights, minlength=len(log.frame_time))

    dtheta = total(turn)
    since_start = np.cumsum(turn) - turn - (np.cumsum(dtheta) - dtheta)[frame]
    chord = since_start + turn / 2 if arc else since_start
    length = travel * np.sinc(turn / (2 * np.pi)) if arc else travel
    distance, turned = total(np.abs(travel)), total(np.abs(turn))
    path = np.cumsum(np.abs(travel))
    last = np.searchsorted(frame, frame, side="right") - 1
    whole = np.maximum(distance[frame], 1e-300)
    end = np.clip((path[last] - path) / whole, 0.0, 1.0)
    begin = np.clip(end + np.abs(travel) / whole, 0.0, 1.0) if arc else end
    moving = (distance > 0) & (turned > 0)
    share = np.maximum(turned, 1e-300)
    lever = total(np.abs(turn) * (begin + end) / 2) / share
    square = total(np.abs(turn) * (begin**2 + begin * end + end**2) / 3) / share
    return Odometry(
        dx=total(length * np.cos(chord)),
        dy=total(length * np.sin(chord)),
        dtheta=dtheta,
        distance=distance,
        turn=turned,
        duration=np.diff(bounds) / 1e9,
        lever=np.where(moving, lever, 0.5),
        lever_var=np.where(moving, np.maximum(square - lever**2, 0.0), 1 / 12),
    )


def _arcs(log, bounds):
    """Frame, distance [m] and turn [rad] of every step between stamps of odometry or frames."""
    edges, held = held_velocities(log)
    cuts = np.union1d(edges, bounds)
    cuts = cuts[(cuts >= bounds[0]) & (cuts <= bounds[-1])]
    velocity = held[np.searchsorted(edges, cuts[:-1], side="right")]
    travel, turn = (velocity * (np.diff(cuts) / 1e9)[:, None]).T
    return np.searchsorted(bounds[1:], cuts[1:]), travel, turn


def held_velocities(log):
    """Stamps [O + 1] at which the velocity changes, and the velocities [O + 2, 2] before, between
    and after them: the robot stands before the first row, and holds the last for a median period.
    """
    time = log.odometry_time
    period = int(np.median(np.diff(time))) if len(time) > 1 else 0
    edges = np.append(time, time[-1] + period)
    return edges, np.vstack([[0.0, 0.0], log.odometry, [0.0, 0.0]])


def _commands(log):
    """Frame at or after the end, distance [m] and turn [rad] of every command."""
    frame = np.searchsorted(log.frame_time, log.odometry_time)
    used = frame < len(log.frame_time)
    travel, turn = log.odometry[used].T
    return frame[used], travel, turn


def dead_reckoning(odometry, start_pose):
    """Integrate the poses [T, 3] at the frames from odometry alone, without gains; heading in
    [-pi, pi)."""
    before = start_pose[2] + np.cumsum(odometry.dtheta) - odometry.dtheta
    c, s = np.cos(before), np.sin(before)
    x = start_pose[0] + np.cumsum(c * odometry.dx - s * odometry.dy)
    y = start_pose[1] + np.cumsum(s * odometry.dx + c * odometry.dy)
    heading = before + odometry.dtheta
    return np.column_stack([x, y, (heading + np.pi) % (2 * np.pi) - np.pi])


def moments(odometry, params):
    """Mean [T, 3] and covariance [T, 3, 3] of the motion (x, y, heading) in each interval.

    In the robot's frame at its start; `models/motion.py:model` in closed form and NumPy. Without
    `gain_tran`, a factor of the result that may be learned later; turns have their gain, for which
    no factor of the result can stand.
    """
    o = odometry
    length = np.hypot(o.dx, o.dy)
    bend = o.lever * (params.gain_rot - 1) * o.dtheta + params.bias_drift * o.distance / 2
    chord = np.arctan2(o.dy, o.dx) + bend
    c, s = np.cos(chord), np.sin(chord)
    turn = params.gain_rot * o.dtheta + params.bias_drift * o.distance
    mean = np.column_stack([length * c, length * s, turn])
    floor = params.floor_tran**2 * o.duration
    drift = params.err_drift**2 * o.distance + params.floor_rot**2 * o.duration
    spin = params.err_rot**2 * o.turn
    along = params.err_tran**2 * o.distance + floor
    side = length**2 * (drift / 3 + (o.lever**2 + o.lever_var) * spin) + floor
    both = length * (drift / 2 + o.lever * spin)
    cov = np.empty((len(length), 3, 3))
    cov[:, 0, 0] = c * c * along + s * s * side
    cov[:, 1, 1] = s * s * along + c * c * side
    cov[:, 0, 1] = cov[:, 1, 0] = c * s * (along - side)
    cov[:, 0, 2] = cov[:, 2, 0] = -s * both
    cov[:, 1, 2] = cov[:, 2, 1] = c * both
    cov[:, 2, 2] = drift + spin
    return mean, cov
