"""Match the lines of two frames by angle and colour (paper, section III-B).

As the robot drives, a line's bearing moves from front to back, and closer lines move farther:
between the change of a line at infinity (the turn alone) and that of a line at the nearest depth. A
pair is allowed if its change of bearing lies in that interval; differences of colours, polarity and
elevations add to its cost. The cheapest one-to-one assignment is chosen, over all pairs at once.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

FORBIDDEN = 1e6
DARK_SIGMA = 0.015  # standard deviation of black, of 0..1


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the matching. `nearest` m: least depth of a line. `typical_depth` m: changes of
    bearing larger than at this depth cost more. `gate`: standard deviations by which a change of
    bearing may exceed its interval. `heading_sigma` rad and `travel_sigma` (share of the distance):
    error of the motion if no covariance is given. `colour_sigma` (share of the brightness) and
    `elevation_sigma` rad: standard deviations between two frames. `unmatched`: cost of leaving a
    line unmatched, in half squared standard deviations. `use_colour`: compare colours, not only
    bearings."""

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
    """Appearance of n lines of a log or an image: elevations `low`, `high` [n] rad, `polarity` [n],
    `colour` [n, 2, 3] of the left and the right side, 0..1."""

    low: np.ndarray
    high: np.ndarray
    polarity: np.ndarray
    colour: np.ndarray


def match(before, after, motion, settings=None, heading_sigma=None, inverse_depth=None):
    """Match the `Lines` of two frames one-to-one: pairs of indices, int [m, 2].

    `motion`: pose (x, y, heading) [3] of the sensor at `after` in its frame at `before`, or one per
    line [n, 3]. `heading_sigma` rad: standard deviation of its heading, a number or [n].
    `inverse_depth` [n, 2] 1/m: least and largest of the lines of `before`, as far as known.
    """
    settings = MatchSettings() if settings is None else settings
    appearances = None
    if settings.use_colour:
        appearances = (appearance_of(before), appearance_of(after))
    return match_bearings(
        (before.bearing, after.bearing),
        (before.sigma, after.sigma),
        motion,
        appearances,
        settings,
        heading_sigma,
        inverse_depth,
    )


def appearance_of(lines):
    """`Appearance` of `Lines`."""
    return Appearance(lines.low, lines.high, lines.polarity, lines.colour)


def match_bearings(
    bearings,
    sigmas,
    motion,
    appearances=None,
    settings=None,
    heading_sigma=None,
    inverse_depth=None,
):
    """`match` of arrays: pairs (before, after) of bearings [n] rad, standard deviations [n] and
    `Appearance` (None: only bearings count)."""
    settings = MatchSettings() if settings is None else settings
    heading_sigma = settings.heading_sigma if heading_sigma is None else heading_sigma
    first, second = (np.asarray(b, float) for b in bearings)
    if len(first) == 0 or len(second) == 0:
        return np.empty((0, 2), int)
    motion = np.broadcast_to(np.asarray(motion, float), (len(first), 3))
    cost = _angle_cost(first, second, sigmas, motion, heading_sigma, inverse_depth, settings)
    if appearances is not None:
        cost = cost + _elevation_cost(*appearances, settings) + _polarity_cost(*appearances)
        cost = cost + _colour_cost(*appearances, cost, settings)
    return assign_pairs(cost, settings.unmatched)


def _angle_cost(first, second, sigmas, motion, heading_sigma, inverse_depth, settings):
    """Cost [n, m] of the change of bearing; `FORBIDDEN` beyond the gate."""
    if inverse_depth is None:
        inverse_depth = np.tile([0.0, 1 / settings.nearest], (len(first), 1))
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
    uncertain = settings.travel_sigma * travel * np.minimum(inverse_depth[:, 1], 1.0)
    variance = np.square(sigmas[0])[:, None] + np.square(sigmas[1])[None, :]
    sigma = np.sqrt(variance + (np.square(heading_sigma) + np.square(uncertain))[:, None])
    outside = np.maximum(np.maximum(low - change, change - high), 0) / sigma
    # A line at the typical depth turns by `usual`; larger changes are less likely.
    usual = np.hypot(np.abs(side)[:, None] / settings.typical_depth, sigma)
    cost = outside**2 / 2 + np.minimum((change / usual) ** 2 / 4, 3.0)
    return np.where(outside <= settings.gate, cost, FORBIDDEN)


def _elevation_cost(before, after, settings):
    """Cost [n, m] of the ends' elevations, each capped: one end may have been covered."""
    total = 0.0
    for first, second in ((before.low, after.low), (before.high, after.high)):
        change = np.asarray(second, float)[None, :] - np.asarray(first, float)[:, None]
        total = total + np.minimum((change / settings.elevation_sigma) ** 2 / 4, 2.0)
    return total


def _polarity_cost(before, after):
    """Cost [n, m] of unequal polarity, which may occur as the background of an edge changes."""
    differs = np.asarray(before.polarity)[:, None] != np.asarray(after.polarity)[None, :]
    return 4.0 * differs


def _colour_cost(before, after, cost, settings):
    """Cost [n, m] of colours, after the gain of the light. Each side is capped separately, since
    one side of an edge may be a distant background."""
    first = np.asarray(before.colour, float)
    second = np.asarray(after.colour, float)
    gain = light_gain(first, second, cost)
    dark = np.minimum(gain, 1.0)  # compare in the light of the darker frame: noise is not amplified
    difference = second[None, :] * (dark / gain) - first[:, None] * dark
    level = np.maximum(second[None, :] * (dark / gain), first[:, None] * dark)
    sigma = DARK_SIGMA + settings.colour_sigma * level.mean(axis=-1, keepdims=True)
    per_side = np.mean((difference / sigma) ** 2, axis=-1)
    return np.minimum(per_side, 5.0).sum(axis=-1)


def light_gain(before, after, cost):
    """Gain [3] of the light between two frames, per channel: the median ratio of likely pairs.

    `before` [n, 2, 3], `after` [m, 2, 3]; `cost` [n, m] of everything but the colour. The cheapest
    partners of every line count; the median tolerates wrong ones.
    """
    likely = cost <= np.minimum(cost.min(axis=1, keepdims=True) + 1.0, 8.0)
    i, j = np.nonzero(likely)
    if len(i) == 0:
        return np.ones(before.shape[-1])
    # Dark and saturated sides tell little about the light; 0.02 limits the darkest ratios.
    first, second = before[i].reshape(-1, 3), after[j].reshape(-1, 3)
    ratio = np.log((second + 0.02) / (first + 0.02))
    clear = (np.minimum(first, second) > 0.05) & (np.maximum(first, second) < 0.98)
    gains = [
        np.median(r[use]) if use.any() else 0.0 for r, use in zip(ratio.T, clear.T, strict=True)
    ]
    return np.exp(np.clip(gains, -1.5, 1.5))


def assign_pairs(cost, unmatched):
    """Cheapest one-to-one assignment [m, 2], without pairs dearer than two unmatched lines."""
    gain = np.minimum(cost - 2 * unmatched, 0.0)
    rows, columns = linear_sum_assignment(gain)
    good = gain[rows, columns] < 0
    return np.column_stack([rows[good], columns[good]])
