"""Merge the pieces of one line, and correct the bearings of close pairs of lines.

Two edges closer than the optics resolve, such as the sides of a window frame, appear too far apart,
since each distorts the other's flank. Both are about as wide as all other edges of the image, so
the shift follows from the apparent separation.
"""

from math import pi

import numpy as np

SEPARATION = np.linspace(1.1, 7, 119)  # true, in widths; closer edges cancel each other
WIDER = 1.15  # width of a sharp edge's gradient over its width at the peak


def merge_pieces(lines, bearing, gap):
    """Merge pieces of one line, at most `bearing` and, in elevation, `gap` [rad] apart; `Lines`.

    Brightness changes across all pieces in the same sense.
    """
    n = len(lines.bearing)
    if n < 2:
        return lines
    between = np.maximum(lines.low[:, None] - lines.high, lines.low - lines.high[:, None])
    linked = (np.abs(_bearing_difference(lines)) <= bearing) & (between <= gap)
    # Polarity does not serve: it is random where two colours are equally bright.
    step = (lines.colour[:, 0] - lines.colour[:, 1]).astype(float)
    linked &= (step @ step.T > 0) | np.eye(n, dtype=bool)
    group = np.arange(n)
    for _ in range(n):  # the least index spreads through a group
        least = np.where(linked, group, n).min(axis=1)
        if (least == group).all():
            break
        group = least
    return _combine(lines, np.unique(group, return_inverse=True)[1])


def separate_close_pairs(lines, width):
    """Correct close pairs of opposite polarity, which appear too far apart; `Lines`.

    Their `sigma` grows with the correction. `width` [rad] of a sharp edge's gradient in this image.
    """
    if len(lines.bearing) < 2:
        return lines
    apart = _bearing_difference(lines)
    low, high = lines.low, lines.high
    overlap = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    part = np.clip(overlap / (high - low)[:, None], 0, 1)
    pair = (part > 0.3) & (lines.polarity[:, None] != lines.polarity)
    square = lines.strength**2
    share = square / (square[:, None] + square)  # the weaker line is shifted more
    width = WIDER * width
    apparent = np.abs(apart) / width
    true = np.interp(apparent, APPARENT, SEPARATION, left=SEPARATION[0])
    too_far = np.where(pair & (apparent < SEPARATION[-1]), (apparent - true) * width, 0.0)
    push = too_far * share * part * np.sign(apart)
    bearing = lines.bearing - push.sum(axis=1)
    sigma = np.sqrt(lines.sigma**2 + (too_far**2 * share * part).sum(axis=1) / 4)
    return lines._replace(bearing=pi - (pi - bearing) % (2 * pi), sigma=sigma)


def _apparent_separation():
    """Apparent separations of opposite edges: the gradient is the difference of two Gaussians."""
    x, d = np.linspace(0, 8, 801), SEPARATION[:, None]
    both = np.exp(-0.5 * (x - d / 2) ** 2) - np.exp(-0.5 * (x + d / 2) ** 2)
    return 2 * x[np.argmax(both, axis=1)]


APPARENT = _apparent_separation()


def _bearing_difference(lines):
    """Bearing of each line less that of each other [n, n] rad in [-pi, pi)."""
    return (lines.bearing[:, None] - lines.bearing + pi) % (2 * pi) - pi


def _combine(lines, group):
    """`Lines` of the groups [n] of pieces: bearings weighted by variance, colours by length."""
    n = group.max() + 1
    first = np.unique(group, return_index=True)[1]
    weight = 1 / lines.sigma**2
    share = weight / np.bincount(group, weight)[group]
    offset = (lines.bearing - lines.bearing[first][group] + pi) % (2 * pi) - pi
    bearing = lines.bearing[first] + np.bincount(group, share * offset)
    length = lines.high - lines.low
    part = length / np.bincount(group, length)[group]
    colour = np.zeros((n, 2, 3), np.float32)
    np.add.at(colour, group, (part[:, None, None] * lines.colour).astype(np.float32))
    polarity = np.bincount(group, lines.polarity * lines.strength)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, group, lines.low)
    np.maximum.at(high, group, lines.high)
    return type(lines)(
        bearing=pi - (pi - bearing) % (2 * pi),
        sigma=1 / np.sqrt(np.bincount(group, weight)),
        low=low,
        high=high,
        polarity=np.where(polarity >= 0, 1, -1),
        colour=colour,
        strength=np.sqrt(np.bincount(group, lines.strength**2)),
    )
