"""Lines that belong together: pieces of one are merged, close pairs moved to where they are.

Two edges nearer than the optics resolve, such as the sides of a window's frame, are seen too far
apart: each bends the other's flank. Both are known to be about as wide as all other edges of the
image, so how far they were pushed follows from how far apart they look.
"""

from math import pi

import numpy as np

SEPARATION = np.linspace(1.1, 7, 119)  # true distances, in widths: nearer edges cancel each other
WIDER = 1.15  # the gradient of a sharp edge over its width at the peak


def merge_pieces(lines, bearing, gap):
    """`Lines` with pieces of one line put together: close in `bearing`, at most `gap` apart [rad].

    Pieces of one line lie above each other, and colour changes across them in the same sense.
    """
    n = len(lines.bearing)
    if n < 2:
        return lines
    between = np.maximum(lines.low[:, None] - lines.high, lines.low - lines.high[:, None])
    same = (np.abs(_bearing_difference(lines)) <= bearing) & (between <= gap)
    # not by polarity, which is a toss-up where two colours are equally bright
    step = (lines.colour[:, 0] - lines.colour[:, 1]).astype(float)
    same &= (step @ step.T > 0) | np.eye(n, dtype=bool)
    group = np.arange(n)
    for _ in range(n):  # the least index spreads through a group
        least = np.where(same, group, n).min(axis=1)
        if (least == group).all():
            break
        group = least
    return _combine(lines, np.unique(group, return_inverse=True)[1])


def separate_close_pairs(lines, width):
    """`Lines` with close pairs of opposite polarity moved together, and less sure of themselves.

    `width` [rad]: standard deviation of a sharp edge's gradient in this image.
    """
    if len(lines.bearing) < 2:
        return lines
    apart = _bearing_difference(lines)
    overlap = np.minimum(lines.high[:, None], lines.high) - np.maximum(
        lines.low[:, None], lines.low
    )
    part = np.clip(overlap / (lines.high - lines.low)[:, None], 0, 1)
    pair = (part > 0.3) & (lines.polarity[:, None] != lines.polarity)
    square = lines.strength**2
    share = square / (square[:, None] + square)  # the weaker one is pushed farther
    width = WIDER * width
    seen = np.abs(apart) / width
    true = np.interp(seen, APPARENT, SEPARATION, left=SEPARATION[0])
    too_far = np.where(pair & (seen < SEPARATION[-1]), (seen - true) * width, 0.0)
    push = too_far * share * part * np.sign(apart)
    bearing = lines.bearing - push.sum(axis=1)
    return lines._replace(
        bearing=pi - (pi - bearing) % (2 * pi),
        sigma=np.sqrt(lines.sigma**2 + (too_far**2 * share * part).sum(axis=1) / 4),
    )


def _apparent_separation():
    """How far apart two opposite edges look: their gradients are a Gaussian less another beside."""
    x, d = np.linspace(0, 8, 801), SEPARATION[:, None]
    both = np.exp(-0.5 * (x - d / 2) ** 2) - np.exp(-0.5 * (x + d / 2) ** 2)
    return 2 * x[np.argmax(both, axis=1)]


APPARENT = _apparent_separation()


def _bearing_difference(lines):
    """Bearing of each line from each [n, n] rad in [-pi, pi): positive where it is to the left."""
    return (lines.bearing[:, None] - lines.bearing + pi) % (2 * pi) - pi


def _combine(lines, group):
    n = group.max() + 1
    first = np.unique(group, return_index=True)[1]
    weight = 1 / lines.sigma**2
    share = weight / np.bincount(group, weight)[group]
    away = (lines.bearing - lines.bearing[first][group] + pi) % (2 * pi) - pi
    bearing = lines.bearing[first] + np.bincount(group, share * away)
    length = lines.high - lines.low
    part = length / np.bincount(group, length)[group]
    colour = np.zeros((n, 2, 3), np.float32)
    np.add.at(colour, group, (part[:, None, None] * lines.colour).astype(np.float32))
    turn = np.bincount(group, lines.polarity * lines.strength)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, group, lines.low)
    np.maximum.at(high, group, lines.high)
    return type(lines)(
        bearing=pi - (pi - bearing) % (2 * pi),
        sigma=1 / np.sqrt(np.bincount(group, weight)),
        low=low,
        high=high,
        polarity=np.where(turn >= 0, 1, -1),
        colour=colour,
        strength=np.sqrt(np.bincount(group, lines.strength**2)),
    )
