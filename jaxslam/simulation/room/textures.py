"""Textures of the rendered room's surfaces: paint and grain, with light baked in.

While it is painted, a texture is float32 [columns, rows, 3], blue, green, red in 0..1 as a video
signal: columns along the surface, rows upwards, `TEXEL` m each. Edges lie on texel borders, so that
a nearest-neighbour look-up is sharp exactly at the edge.
"""

import cv2
import numpy as np

TEXEL = 0.005  # m, vertical surfaces
FLAT_TEXEL = 0.01  # m, floor and ceiling
TILE = 0.30  # m, the floor's tiles as in the paper's room
PANEL = 0.60  # m, the ceiling's panels
AMBIENT, LAMP = 0.76, 2.0  # ambient light, and that of one lamp at 1 m head-on
EMISSIVE = 1.0  # added to emissive texels: paint is below it, and is lit by the room's light
FRAME = 0.06  # m, the width of door and window frames

WALL = ((0.80, 0.85, 0.86), (0.74, 0.82, 0.84), (0.84, 0.84, 0.80), (0.72, 0.80, 0.76))
WOOD = ((0.16, 0.32, 0.50), (0.28, 0.46, 0.62), (0.10, 0.19, 0.31), (0.38, 0.56, 0.70))
METAL = ((0.52, 0.50, 0.48), (0.34, 0.36, 0.38), (0.52, 0.40, 0.26), (0.30, 0.42, 0.34))
BRIGHT = ((0.20, 0.25, 0.70), (0.55, 0.35, 0.15), (0.25, 0.50, 0.25), (0.25, 0.60, 0.75))


def texels(length, size=TEXEL):
    return round(length / size)


def blank_texture(length, height, colour, size=TEXEL):
    texture = np.empty((texels(length, size), texels(height, size), 3), np.float32)
    texture[:] = colour
    return texture


def smooth_noise(rng, shape, columns, rows):
    """Draw smooth noise of unit variance [shape], with `columns` x `rows` bumps."""
    coarse = rng.standard_normal((max(2, round(columns)), max(2, round(rows)))).astype(np.float32)
    return cv2.resize(coarse, shape[1::-1], interpolation=cv2.INTER_CUBIC)


def plaster(rng, texture):
    """Make the paint uneven, on scales above a decimetre."""
    wide, high = np.array(texture.shape[:2]) * TEXEL
    texture *= 1 + 0.012 * smooth_noise(rng, texture.shape, wide / 0.15, high / 0.15)[..., None]
    texture *= 1 + 0.015 * smooth_noise(rng, texture.shape, wide / 0.8, high / 0.8)[..., None]


def grain(rng, texture, strength=0.05):
    """Add the grain of wood: slightly bent streaks along the height."""
    wide, high = np.array(texture.shape[:2]) * TEXEL
    fine = smooth_noise(rng, texture.shape, wide / 0.012, high / 0.7)
    broad = smooth_noise(rng, texture.shape, wide / 0.06, high / 1.2)
    texture *= 1 + strength * (0.4 * fine + 0.6 * broad)[..., None]


def paint(texture, left, right, bottom, top, colour, size=TEXEL):
    """Fill a rectangle (m, from the surface's lower start corner) and return it as a view."""
    part = texture[
        texels(left, size) : texels(right, size), texels(bottom, size) : texels(top, size)
    ]
    part[:] = colour
    return part


def door(rng, texture, left, width, height, colours):
    """Paint a leaf in a frame; returns its vertical edges (along, bottom, top)."""
    frame, leaf = colours
    right = left + width
    paint(texture, left, right, 0, height, frame)
    wing = paint(texture, left + FRAME, right - FRAME, 0, height - FRAME, leaf)
    grain(rng, wing)
    knob = right - FRAME - 0.1
    paint(texture, knob, knob + 0.05, 1.0, 1.16, (0.6, 0.62, 0.62))
    handle = [(s, 1.0, 1.16) for s in (knob, knob + 0.05)]
    return [(s, 0.0, height) for s in (left, left + FRAME, right - FRAME, right)] + handle


def window(rng, texture, left, width, bottom, top, frame):
    """Paint two bright panes in a frame; returns their vertical edges."""
    right, middle = left + width, round(left + width / 2, 2)
    paint(texture, left, right, bottom, top, frame)
    panes = [(left + FRAME, middle - FRAME / 2), (middle + FRAME / 2, right - FRAME)]
    for a, b in panes:
        pane = paint(texture, a, b, bottom + FRAME, top - FRAME, (1.0, 0.98, 0.95))
        height = np.linspace(0, 1, pane.shape[1], dtype=np.float32)
        trees = np.clip(3 * (0.35 + 0.04 * smooth_noise(rng, pane.shape, 5, 2) - height), 0, 1)
        pane *= 1 - 0.45 * trees[..., None] * np.array([0.9, 0.5, 0.8], np.float32)
        pane += EMISSIVE
    inner = [(s, bottom + FRAME, top - FRAME) for pair in panes for s in pair]
    return [(left, bottom, top), (right, bottom, top), *inner]


def picture(rng, texture, left, width, bottom, top, colour):
    """Paint a print of soft shapes; returns its vertical edges."""
    part = paint(texture, left, left + width, bottom, top, colour)
    for channel in range(3):
        part[..., channel] *= 1 + 0.18 * smooth_noise(rng, part.shape, 5, 6)
    horizon = round(part.shape[1] * rng.uniform(0.3, 0.6))
    part[:, horizon:] *= 1.25
    np.clip(part, 0, 1, out=part)
    return [(s, bottom, top) for s in (left, left + width)]


def board(rng, texture, left, width, bottom, top):
    """Paint a whiteboard with lines of writing; returns its vertical edges."""
    part = paint(texture, left, left + width, bottom, top, (0.97, 0.97, 0.96))
    for row in range(20, part.shape[1] - 20, 24):
        begin, end = np.sort(rng.integers(20, part.shape[0] - 20, 2))
        shape = part[begin:end, row : row + 3].shape
        part[begin:end, row : row + 3] *= 1 - 0.4 * (rng.random(shape[:2]) < 0.5)[..., None]
    paint(texture, left, left + width, bottom - 0.03, bottom, (0.55, 0.55, 0.55))
    return [(s, bottom, top) for s in (left, left + width)]


def cupboard(rng, texture, colour):
    """Paint two doors side by side, one darker; returns their vertical edges."""
    wide, high = np.array(texture.shape[:2]) * TEXEL
    texture[:] = colour
    grain(rng, texture, 0.04)
    paint(texture, 0, wide, 0, 0.08, np.multiply(colour, 0.5))
    half = round(wide / 2, 2)
    texture[texels(half) :] *= 0.86
    edges, low = [(half, 0.08, high)], round(high / 2, 2)
    for knob in (half - 0.08, half + 0.06):
        paint(texture, knob, knob + 0.02, low, low + 0.12, (0.3, 0.3, 0.3))
        edges += [(s, low, low + 0.12) for s in (knob, knob + 0.02)]
    return edges


def drawers(rng, texture, colour):
    """Paint drawers, one above the other; they have no vertical edges."""
    wide, high = np.array(texture.shape[:2]) * TEXEL
    texture[:] = colour
    grain(rng, texture, 0.03)
    for top in np.arange(0.3, high - 0.1, 0.3):
        paint(texture, 0, wide, top, top + 0.01, np.multiply(colour, 0.45))
        paint(texture, wide / 2 - 0.08, wide / 2 + 0.08, top - 0.1, top - 0.08, (0.25, 0.25, 0.25))
    return []


def shelf(rng, texture, colour):
    """Paint boards with files and books; returns their vertical edges."""
    wide, high = np.array(texture.shape[:2]) * TEXEL
    edges = []
    texture[:] = np.multiply(colour, 0.35)
    for bottom in np.arange(0.08, high - 0.3, 0.36):
        left = round(rng.uniform(0, 0.05), 2)
        while (width := round(rng.uniform(0.10, 0.26), 2)) < wide - left:
            top = bottom + round(rng.uniform(0.24, 0.32), 2)
            back = BRIGHT[rng.integers(4)] if rng.random() < 0.5 else METAL[rng.integers(4)]
            paint(texture, left, left + width, bottom, top, np.multiply(back, rng.uniform(0.8, 1)))
            edges += [(round(s, 2), bottom, top) for s in (left, left + width)]
            left += width + (0.08 if rng.random() < 0.15 else 0.0)
        paint(texture, 0, wide, bottom - 0.03, bottom, colour)
    return edges


def floor(rng, width, depth):
    """Make a floor of plastic tiles in varying shades."""
    colour = rng.choice([(0.46, 0.53, 0.58), (0.55, 0.55, 0.52)])
    texture = blank_texture(width, depth, colour, FLAT_TEXEL)
    x, y = (np.arange(n) * FLAT_TEXEL // TILE for n in texture.shape[:2])
    shade = 1 + 0.06 * (((x[:, None] + y) % 2) - 0.5) * rng.uniform(0, 2)
    shade += (
        0.02
        * rng.standard_normal((int(x[-1]) + 1, int(y[-1]) + 1))[
            np.ix_(x.astype(int), y.astype(int))
        ]
    )
    joint = (np.arange(texture.shape[0]) % texels(TILE, FLAT_TEXEL) == 0)[:, None]
    joint = joint | (np.arange(texture.shape[1]) % texels(TILE, FLAT_TEXEL) == 0)
    texture *= (shade * np.where(joint, 0.7, 1)).astype(np.float32)[..., None]
    return texture


def ceiling(width, depth, lamps, size):
    """Make a ceiling of panels and lamps."""
    texture = blank_texture(width, depth, (0.66, 0.68, 0.68), FLAT_TEXEL)
    for axis in (0, 1):
        joint = np.arange(texture.shape[axis]) % texels(PANEL, FLAT_TEXEL) == 0
        texture[joint if axis == 0 else (slice(None), joint)] *= 0.85
    for x, y in lamps:
        a, b = size[0] / 2, size[1] / 2
        paint(texture, x - a, x + a, y - b, y + b, EMISSIVE + 1, FLAT_TEXEL)
    return texture


def light_on(point, normal, lamps, height):
    """Light [...] of lamps on the ceiling at points [..., 3] of a surface with this normal."""
    light = np.full(point.shape[:-1], AMBIENT)
    for x, y in lamps:
        to = np.array([x, y, height]) - point
        squared = np.sum(to**2, axis=-1) + 0.1
        facing = np.maximum(to @ np.asarray(normal, float), 0) * np.maximum(to[..., 2], 0) / squared
        light += LAMP * facing / squared
    return light


def bake(texture, point, normal, lamps, height, near, shadows):
    """Bake the room's light into a texture; returns uint8.

    `point` [n, m, 3] is a coarse grid over the surface, `near` [n, m] the distance to the nearest
    other surface, which keeps light away; light is interpolated, so that it makes no edges.
    """
    light = light_on(point, normal, lamps, height)
    light *= 1 - 0.30 * shadows * np.exp(-near / 0.20)
    light = cv2.resize(light.astype(np.float32), texture.shape[1::-1])[..., None]
    seen = np.where(texture > EMISSIVE, texture - EMISSIVE, np.minimum(texture, 1) * light)
    return np.rint(255 * np.clip(seen, 0, 1)).astype(np.uint8)


FRONTS = {"cupboard": cupboard, "drawers": drawers, "shelf": shelf}
