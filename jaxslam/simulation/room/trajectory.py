"""Drive through the rendered room: stop, capture, translate, turn.

A driver who sees the robot steers it round the room. The log has only the commands, of which the
truth falls short, since wheels slip. Metres, radians (CCW).
"""

from math import atan2, ceil, cos, hypot, pi, sin
from typing import NamedTuple

import numpy as np

from jaxslam.simulation.room.geometry import DEPTH, WIDTH

RADIUS = 0.25  # m, of the robot (Pioneer-DX3)
ASIDE = 0.90  # m between the loop and the long walls
CORNER = 0.5  # m, radius of the loop's corners
LAP = 20.0  # m round the loop: 60 m are three rounds and end near the start
SWAY = 0.04  # m, amplitude of the deviation from the loop, different in each round
TURN = pi / 18  # rad from stop to stop when turning on the spot
LANE = 8.0  # m, length of the straight path
LENGTH = {"loop": 60.0, "straight": 6.0, "turn": 2 * pi}  # m, m, rad


class Drive(NamedTuple):
    """True poses [n + 1, 3] at the stops and commands [n, 2] between: distance, then turn."""

    pose: np.ndarray
    command: np.ndarray


def stop_and_go(
    kind="loop",  # loop: round the room; straight: along a wall; turn: on the spot
    seed=0,
    *,
    step=0.2,  # m commanded from stop to stop
    length=None,  # m truly driven, at least (turn: rad commanded); None: 60, 6, 2 pi
    slip=0.025,  # mean fraction of distance lost by slip, drawn for every step
    turn_error=0.02,  # standard deviation of a turn's relative error
    drift=0.01,  # rad/sqrt m, drift of the heading when driving
):
    """Draw a `Drive`; furniture never stands on its path. Raises `ValueError`."""
    _check(kind, step, length, slip, turn_error, drift)
    length = LENGTH[kind] if length is None else length
    rng = np.random.default_rng([seed, 1])
    path = _lane(length) if kind == "straight" else _loop(rng, length)
    ahead = path[1] - path[0]
    pose = [(*path[0], atan2(ahead[1], ahead[0]))]
    commands, done, at = [], 0.0, 0
    while done < length - 1e-9:
        if kind == "turn":
            distance, turn = 0.0, min(TURN, length - done)
        else:
            at = _nearest(path, at, pose[-1])
            distance, turn = step, _steer(path, at, pose[-1], step)
        commands.append((distance, turn))
        lost = rng.uniform(0, 2 * slip)
        drifted = drift * distance**0.5 * rng.standard_normal()
        turned = turn * (1 + turn_error * rng.standard_normal())
        pose.append(_move(pose[-1], distance * (1 - lost), drifted, turned))
        done += turn if kind == "turn" else distance * (1 - lost)
    return Drive(np.array(pose), np.array(commands))


def _move(pose, distance, drifted, turned):
    """True pose after a step whose heading drifts evenly over the distance, before it turns."""
    x, y, heading = pose
    along = heading + drifted / 2
    heading = (heading + drifted + turned + pi) % (2 * pi) - pi
    return x + distance * cos(along), y + distance * sin(along), heading


def _steer(path, at, pose, step):
    """Turn after the next translation, towards the path one step further on."""
    x, y, heading = pose
    x, y = x + step * cos(heading), y + step * sin(heading)
    goal = path[min(at + round(2 * step / SPACING), len(path) - 1)]
    if hypot(goal[0] - x, goal[1] - y) < step / 2:
        return 0.0
    return (atan2(goal[1] - y, goal[0] - x) - heading + pi) % (2 * pi) - pi


SPACING = 0.01  # m between the points of a path


def _nearest(path, at, pose):
    """Index of the path's nearest point to the robot, searching forwards from the last."""
    window = path[at : at + 150]
    return at + int(np.argmin(np.hypot(*(window - pose[:2]).T)))


def _lane(length):
    """Straight path [n, 2] along the south wall, a little longer than driven, to steer by."""
    x = np.arange(ceil((length + 0.5) / SPACING)) * SPACING + (WIDTH - LANE) / 2
    return np.column_stack([x, np.full(len(x), ASIDE + 0.1)])


def _loop(rng, length):
    """Path [n, 2] round a rounded rectangle, from anywhere on its south side, with `SWAY`."""
    deep = DEPTH - 2 * ASIDE - 2 * CORNER
    wide = (LAP - 2 * pi * CORNER) / 2 - deep
    at = (rng.uniform(0.1, 0.5) * wide + np.arange(ceil((length + 1) / SPACING)) * SPACING) % LAP
    bend = pi / 2 * CORNER
    lengths = np.array([wide, bend, deep, bend] * 2)
    begins = np.append(0, np.cumsum(lengths))
    piece = np.searchsorted(begins, at, side="right") - 1
    into, quarter = at - begins[piece], piece // 2
    curved = piece % 2 == 1
    # Each quarter: straight ahead, then a bend to the left about its centre.
    turned = np.where(curved, into / CORNER, 0.0)
    side = np.where(quarter % 2 == 0, wide, deep)
    ahead = np.where(curved, side + CORNER * np.sin(turned), into) - side / 2
    aside = np.where(curved, CORNER * (1 - np.cos(turned)), 0.0)
    aside = aside + SWAY * np.sin(np.arange(len(at)) * SPACING * 0.9 + rng.uniform(0, 2 * pi))
    out = np.where(quarter % 2 == 0, deep, wide) / 2 + CORNER - aside
    c, s = np.cos(quarter * pi / 2), np.sin(quarter * pi / 2)
    return np.column_stack([c * ahead + s * out, s * ahead - c * out]) + (WIDTH / 2, DEPTH / 2)


def _check(kind, step, length, slip, turn_error, drift):
    if kind not in LENGTH:
        raise ValueError(f"drive: {kind!r} is none of {', '.join(LENGTH)}")
    longest = LANE - 0.5 if kind == "straight" else 10_000
    good = length is None or 0 < length <= longest
    rules = {
        "step": (step, 0.02 <= step <= 0.5, "0.02 to 0.5 m"),
        "length": (length, good, f"above 0, to {longest:g}"),
        "slip": (slip, 0 <= slip <= 0.2, "0 to 0.2"),
        "turn_error": (turn_error, 0 <= turn_error <= 0.2, "0 to 0.2"),
        "drift": (drift, 0 <= drift <= 0.1, "0 to 0.1 rad/sqrt m"),
    }
    for name, (value, good, allowed) in rules.items():
        if not good:
            raise ValueError(f"drive: {name} is {value!r}, allowed: {allowed}")
