"""Which line of one frame is which of the next (paper, section III-B): by angle and colour.

As the robot drives, a line's bearing moves from front to back, the farther the nearer it is: from
the turn alone (a line at infinity) to what a line at the nearest depth would show. A pair is
allowed if its change of bearing lies in that interval, and costs what its colours, polarity and
elevations differ by. The cheapest one-to-one assignment is taken, all pairs at once.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

FORBIDDEN = 1e6
DARK_SIGMA = 0.015  # of 0..1: how much black differs, by noise


@dataclass(frozen=True)
class MatchSettings:
    """`nearest` m: no line is nearer. `typical_depth` m: what lines usually have; the change of
    bearing is the more expected the smaller it is. `gate`: standard deviations beyond the interval
    that are let in. `heading_sigma` rad and `travel_sigma` (share of the distance): the motion's
    error, where no covariance is given. `colour_sigma` (share of the brightness) and
    `elevation_sigma` rad: usual differences of one line in two frames. `unmatched`: cost of leaving
    a line alone, in units of half a squared standard deviation. `use_colour`: off, only bearings
    decide.
    """

    nearest: float = 0.3
    typical_depth: float = 3.0
    gate: float = 3.5
    heading_sigma: float = 0.012
    travel_sigma: float = 0.1
    colour_sigma: float = 0.1
    elevation_sigma: float = 0.03
    unmatched: float = 5.0
    use_colour: bool = True


class Appearance(NamedTuple):
    """How n lines look, for logs and lines alike: `low`, `high` [n] rad, `polarity` [n], `colour`
    [n, 2, 3] of the left and the right side, 0..1."""

    low: np.ndarray
    high: np.ndarray
    polarity: np.ndarray
    colour: np.ndarray


def match(before, after, motion, settings=None, heading_sigma=None, inverse_depth=None):
    """Pairs of indices, int [m, 2], of `Lines` of two frames; one-to-one.

    `motion`: pose [3] of the sensor at `after` in its frame at `before`, or one per line [n, 3].
    `heading_sigma` rad: its heading's, one number or one per line [n]. `inverse_depth` [n, 2] 1/m:
    what is known of the depth of the lines of `before`, least and largest.
    """
    settings = MatchSettings() if settings is None else settings
    looks = None
    if settings.use_colour:
        looks = (appearance_of(before), appearance_of(after))
    return match_bearings(
        (before.bearing, after.bearing),
        (before.sigma, after.sigma),
        motion,
        looks,
        settings,
        heading_sigma,
        inverse_depth,
    )


def appearance_of(lines):
    """`Appearance` of `Lines`."""
    return Appearance(lines.low, lines.high, lines.polarity, lines.colour)


def match_bearings(
    bearings, sigmas, motion, looks=None, settings=None, heading_sigma=None, inverse_depth=None
):
    """`match` on plain arrays: pairs (before, after) of bearings and standard deviations, and of
    `Appearance` (None: bearings alone decide)."""
    settings = MatchSettings() if settings is None else settings
    heading_sigma = settings.heading_sigma if heading_sigma is None else heading_sigma
    first, second = (np.asarray(b, float) for b in bearings)
    if len(first) == 0 or len(second) == 0:
        return np.empty((0, 2), int)
    motion = np.broadcast_to(np.asarray(motion, float), (len(first), 3))
    cost = _angle_cost(first, second, sigmas, motion, heading_sigma, inverse_depth, settings)
    if looks is not None:
        cost = cost + _elevation_cost(*looks, settings) + _polarity_cost(*looks)
        cost = cost + _colour_cost(*looks, cost, settings)
    return assign_pairs(cost, settings.unmatched)


def _angle_cost(first, second, sigmas, motion, heading_sigma, inverse_depth, settings):
    """Cost [n, m] of the change of bearing; `FORBIDDEN` beyond the gate."""
    if inverse_depth is None:
        inverse_depth = np.tile([0.0, 1 / settings.nearest], (len(first), 1))
    travel = np.hypot(motion[:, 0], motion[:, 1])
    # Sideways and forward parts of the motion as the ray sees it: at depth 1/q the bearing, less
    # the turn, changes by atan2(-q side, 1 - q ahead).
    c, s = np.cos(first), np.sin(first)
    ahead, side = c * motion[:, 0] + s * motion[:, 1], c * motion[:, 1] - s * motion[:, 0]
    ends = np.arctan2(-inverse_depth * side[:, None], 1 - inverse_depth * ahead[:, None])
    low, high = ends.min(axis=1)[:, None], ends.max(axis=1)[:, None]
    change = second[None, :] - (first - motion[:, 2])[:, None]
    change = (change + np.pi) % (2 * np.pi) - np.pi
    # An error in the travelled distance, and sideways, turns near lines more.
    uncertain = settings.travel_sigma * travel * np.minimum(inverse_depth[:, 1], 1.0)
    variance = np.square(sigmas[0])[:, None] + np.square(sigmas[1])[None, :]
    sigma = np.sqrt(variance + (np.square(heading_sigma) + np.square(uncertain))[:, None])
    outside = np.maximum(np.maximum(low - change, change - high), 0) / sigma
    # A line at the typical depth moves by `usual`: larger changes are the less expected.
    usual = np.hypot(np.abs(side)[:, None] / settings.typical_depth, sigma)
    cost = outside**2 / 2 + np.minimum((change / usual) ** 2 / 4, 3.0)
    return np.where(outside <= settings.gate, cost, FORBIDDEN)


def _elevation_cost(before, after, settings):
    """Cost of ends that moved, each capped: something may have come in front of one."""
    total = 0.0
    for one, other in ((before.low, after.low), (before.high, after.high)):
        off = (np.asarray(other, float)[None, :] - np.asarray(one, float)[:, None]) / (
            settings.elevation_sigma
        )
        total = total + np.minimum(off**2 / 4, 2.0)
    return total


def _polarity_cost(before, after):
    """Dear, not forbidden: behind an edge in front of a wall the background changes."""
    differs = np.asarray(before.polarity)[:, None] != np.asarray(after.polarity)[None, :]
    return 4.0 * differs


def _colour_cost(before, after, cost, settings):
    """Cost of colours that differ by more than the light does; each side capped for itself, since
    one side of an edge may be far behind it and slide by."""
    one = np.asarray(before.colour, float)
    other = np.asarray(after.colour, float)
    gain = light_gain(one, other, cost)
    dark = np.minimum(gain, 1.0)  # compare in the light of the darker frame: nothing is amplified
    off = other[None, :] * (dark / gain) - one[:, None] * dark
    level = np.maximum(other[None, :] * (dark / gain), one[:, None] * dark)
    sigma = DARK_SIGMA + settings.colour_sigma * level.mean(axis=-1, keepdims=True)
    per_side = np.mean((off / sigma) ** 2, axis=-1)
    return np.minimum(per_side, 5.0).sum(axis=-1)


def light_gain(before, after, cost):
    """Gain [3] of the light between frames, per channel: the median ratio of likely pairs.

    `before` [n, 2, 3], `after` [m, 2, 3], `cost` [n, m] of everything but the colour. Of every line
    the cheapest partners count; the median doesn't mind that some are wrong.
    """
    likely = cost <= np.minimum(cost.min(axis=1, keepdims=True) + 1.0, 8.0)
    i, j = np.nonzero(likely)
    if len(i) == 0:
        return np.ones(before.shape[-1])
    # Dark sides say little of the light and saturated ones too little; 0.02 tames the darkest.
    one, other = before[i].reshape(-1, 3), after[j].reshape(-1, 3)
    ratio = np.log((other + 0.02) / (one + 0.02))
    clear = (np.minimum(one, other) > 0.05) & (np.maximum(one, other) < 0.98)
    gains = [
        np.median(r[use]) if use.any() else 0.0 for r, use in zip(ratio.T, clear.T, strict=True)
    ]
    return np.exp(np.clip(gains, -1.5, 1.5))


def assign_pairs(cost, unmatched):
    """Cheapest one-to-one assignment [m, 2]; a pair dearer than leaving both alone is none."""
    gain = np.minimum(cost - 2 * unmatched, 0.0)
    rows, columns = linear_sum_assignment(gain)
    good = gain[rows, columns] < 0
    return np.column_stack([rows[good], columns[good]])
