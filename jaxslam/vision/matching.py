"""Match the lines of two frames by angle and colour (paper, section III-B).

As the robot drives, a line's bearing moves from front to back, and closer lines move farther:
between the change of a line at infinity (the turn alone) and that of a line at the nearest depth. A
pair is allowed if its change of bearing lies in that interval; differences of colours, polarity and
elevations add to its cost. The cheapest one-to-one assignment is chosen, over all pairs at once.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

FORBIDDEN = 1e6
NEAREST = 0.3  # m, least depth of a line
TYPICAL_DEPTH = 3.0  # m; changes of bearing larger than at this depth cost more
GATE = 3.5  # standard deviations by which a change of bearing may exceed its interval
HEADING_SIGMA = 0.012  # rad, of the motion if no covariance is given
TRAVEL_SIGMA = 0.1  # share of the distance
COLOUR_SIGMA = 0.1  # share of the brightness, between two frames
DARK_SIGMA = 0.015  # standard deviation of black, of 0..1
ELEVATION_SIGMA = 0.03  # rad, between two frames
UNMATCHED = 5.0  # cost of leaving a line unmatched, in half squared standard deviations


class Appearance(NamedTuple):
    """Appearance of n lines of a log or an image: elevations `low`, `high` [n] rad, `polarity` [n],
    `colour` [n, 2, 3] of the left and the right side, 0..1."""

    low: np.ndarray
    high: np.ndarray
    polarity: np.ndarray
    colour: np.ndarray


def match(before, after, motion, use_colour=True, heading_sigma=HEADING_SIGMA, inverse_depth=None):
    """Match the `Lines` of two frames one-to-one: pairs of indices, int [m, 2].

    `motion`: pose (x, y, heading) [3] of the sensor at `after` in its frame at `before`, or one per
    line [n, 3]. `heading_sigma` rad: standard deviation of its heading, a number or [n].
    `inverse_depth` [n, 2] 1/m: least and largest of the lines of `before`, as far as known.
    `use_colour`: compare appearances, not only bearings.
    """
    lines = before, after
    appearances = tuple(map(appearance_of, lines)) if use_colour else None
    bearings, sigmas = ([getattr(part, name) for part in lines] for name in ("bearing", "sigma"))
    return match_bearings(bearings, sigmas, motion, appearances, heading_sigma, inverse_depth)


def appearance_of(lines):
    """`Appearance` of `Lines`."""
    return Appearance(lines.low, lines.high, lines.polarity, lines.colour)


def match_bearings(
    bearings, sigmas, motion, appearances=None, heading_sigma=HEADING_SIGMA, inverse_depth=None
):
    """`match` of arrays: pairs (before, after) of bearings [n] rad, standard deviations [n] and
    `Appearance` (None: only bearings count)."""
    first, second = (np.asarray(b, float) for b in bearings)
    if len(first) == 0 or len(second) == 0:
        return np.empty((0, 2), int)
    motion = np.broadcast_to(np.asarray(motion, float), (len(first), 3))
    cost = _angle_cost(first, second, sigmas, motion, heading_sigma, inverse_depth)
    if appearances is not None:
        cost = cost + _elevation_cost(*appearances) + _polarity_cost(*appearances)
        cost = cost + _colour_cost(*appearances, cost)
    return assign_pairs(cost, UNMATCHED)


def _angle_cost(first, second, sigmas, motion, heading_sigma, inverse_depth):
    """Cost [n, m] of the change of bearing; `FORBIDDEN` beyond the gate."""
    if inverse_depth is None:
        inverse_depth = np.tile([0.0, 1 / NEAREST], (len(first), 1))
    travel = np.hypot(motion[:, 0], motion[:, 1])
    # Of the motion, the parts along the ray and across it: at depth 1/q the bearing, less the
    # turn, changes by atan2(-q side, 1 - q ahead).
    c, s = np.cos(first), np.sin(first)
    ahead, side = c * motion[:, 0] + s * motion[:, 1], c * motion[:, 1] - s * motion[:, 0]
    ends = np.arctan2(-inverse_depth * side[:, None], 1 - inverse_depth * ahead[:, None])
    low, high = ends.min(axis=1)[:, None], ends.max(axis=1)[:, None]
    change = second[None, :] - (first - motion[:, 2])[:, None]
    change = (change + np.pi) % (2 * np.pi) - np.pi
    # An error of the distance, along or across, turns near lines more.
    uncertain = TRAVEL_SIGMA * travel * np.minimum(inverse_depth[:, 1], 1.0)
    variance = np.square(sigmas[0])[:, None] + np.square(sigmas[1])[None, :]
    sigma = np.sqrt(variance + (np.square(heading_sigma) + np.square(uncertain))[:, None])
    outside = np.maximum(np.maximum(low - change, change - high), 0) / sigma
    # A line at the typical depth turns by `usual`; larger changes are less likely.
    usual = np.hypot(np.abs(side)[:, None] / TYPICAL_DEPTH, sigma)
    cost = outside**2 / 2 + np.minimum((change / usual) ** 2 / 4, 3.0)
    return np.where(outside <= GATE, cost, FORBIDDEN)


def _elevation_cost(before, after):
    """Cost [n, m] of the ends' elevations, each capped: one end may have been covered."""
    total = 0.0
    for first, second in ((before.low, after.low), (before.high, after.high)):
        change = np.asarray(second, float)[None, :] - np.asarray(first, float)[:, None]
        total = total + np.minimum((change / ELEVATION_SIGMA) ** 2 / 4, 2.0)
    return total


def _polarity_cost(before, after):
    """Cost [n, m] of unequal polarity, which may occur as the background of an edge changes."""
    return 4.0 * (np.asarray(before.polarity)[:, None] != np.asarray(after.polarity)[None, :])


def _colour_cost(before, after, cost):
    """Cost [n, m] of colours, after the gain of the light. Each side is capped separately, since
    one side of an edge may be a distant background."""
    first, second = (np.asarray(part.colour, float) for part in (before, after))
    gain = light_gain(first, second, cost)
    dark = np.minimum(gain, 1.0)  # compare in the light of the darker frame: noise is not amplified
    difference = second[None, :] * (dark / gain) - first[:, None] * dark
    level = np.maximum(second[None, :] * (dark / gain), first[:, None] * dark)
    sigma = DARK_SIGMA + COLOUR_SIGMA * level.mean(axis=-1, keepdims=True)
    per_side = np.mean((difference / sigma) ** 2, axis=-1)
    return np.minimum(per_side, 5.0).sum(axis=-1)


def light_gain(before, after, cost):
    """Gain [3] of the light between two frames, per channel: the median ratio of likely pairs.

    `before` [n, 2, 3], `after` [m, 2, 3]; `cost` [n, m] of everything but the colour. The cheapest
    partners of every line count; the median tolerates wrong ones.
    """
    i, j = np.nonzero(cost <= np.minimum(cost.min(axis=1, keepdims=True) + 1.0, 8.0))
    if len(i) == 0:
        return np.ones(before.shape[-1])
    # Dark and saturated sides tell little about the light; 0.02 limits the darkest ratios.
    first, second = before[i].reshape(-1, 3), after[j].reshape(-1, 3)
    ratio = np.log((second + 0.02) / (first + 0.02))
    clear = (np.minimum(first, second) > 0.05) & (np.maximum(first, second) < 0.98)
    channels = zip(ratio.T, clear.T, strict=True)
    gains = [np.median(r[use]) if use.any() else 0.0 for r, use in channels]
    return np.exp(np.clip(gains, -1.5, 1.5))


def assign_pairs(cost, unmatched):
    """Cheapest one-to-one assignment [m, 2], without pairs dearer than two unmatched lines."""
    gain = np.minimum(cost - 2 * unmatched, 0.0)
    rows, columns = linear_sum_assignment(gain)
    return np.column_stack([rows, columns])[gain[rows, columns] < 0]
