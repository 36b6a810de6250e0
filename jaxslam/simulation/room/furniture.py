"""Furnishing the rendered room: what stands where, its paint and its light, drawn from a seed."""

from itertools import pairwise
from math import cos, sin
from typing import NamedTuple

import numpy as np

from jaxslam.simulation.room import textures as texture
from jaxslam.simulation.room.geometry import (
    DEPTH,
    HEIGHT,
    LANDMARK,
    WIDTH,
    Box,
    Edges,
    Face,
    World,
    left,
    outside,
)

LAMPS = ((2.0, 2.0), (5.0, 2.0), (8.0, 2.0))  # m, their middles on the ceiling
LAMP = (1.2, 0.3)  # m
GAP = 0.15  # m between neighbours along a wall, at least
SAME = 0.004  # m: edges closer than that are one
SKIRTING = 0.1  # m

SIZES = {  # m: how wide things are, at least and at most
    "door": (0.94, 1.04),
    "window": (1.20, 1.60),
    "cupboard": (0.80, 1.10),
    "drawers": (0.70, 1.20),
    "shelf": (0.80, 1.00),
    "pilaster": (0.30, 0.45),
    "pillar": (0.25, 0.40),
    "picture": (0.50, 0.80),
    "board": (1.20, 1.60),
}
STANDING = {  # m: how deep and how tall; the rest hangs on the walls
    "cupboard": ((0.40, 0.50), (1.70, 2.00)),
    "drawers": ((0.40, 0.50), (0.85, 1.20)),
    "shelf": ((0.28, 0.35), (1.80, 2.00)),
    "pilaster": ((0.15, 0.25), (HEIGHT, HEIGHT)),
    "pillar": ((0.25, 0.40), (HEIGHT, HEIGHT)),
}


def furnish(seed=0, *, shadows=1.0, plain=0.2):
    """A `World` drawn from a seed.

    `shadows` 0..1: how dark it is where things meet; `plain` 0..1: the share of the furniture that
    is painted like the wall behind it, so that its edges hardly show. Raises `ValueError`.
    """
    for name, value in (("shadows", shadows), ("plain", plain)):
        if not 0 <= value <= 1:
            raise ValueError(f"furnish: {name} is {value!r}, allowed: 0 to 1")
    rng = np.random.default_rng([seed, 0])
    colours = _Colours(
        np.array(texture.WALL[rng.integers(4)]),
        rng.permutation(texture.WOOD),
        rng.permutation(texture.METAL),
        plain,
    )
    built = _Built(_walls(rng, colours), [-1] * 4, [], [])
    built.edges.extend((*wall.start, 0.0, HEIGHT, "corner") for wall in built.faces)
    for wall, things in zip(built.faces[:4], _layout(rng), strict=True):
        for kind, begin, width in things:
            if kind in STANDING:
                axis = _direction(wall)
                _stand(rng, colours, built, kind, wall.start + begin * axis, axis, width)
            else:
                marks = _hang(rng, colours, wall.texture, kind, begin, width)
                built.edges.extend(_marked(wall, marks, kind))
    for kind, corner, axis, width in _islands(rng):
        _stand(rng, colours, built, kind, corner, axis, width, free=True)
    return _finish(rng, built, shadows)


class _Built(NamedTuple):
    """The room while it is furnished: `owner` is each face's box, or -1 for a wall."""

    faces: list
    owner: list
    boxes: list
    edges: list


class _Colours(NamedTuple):
    wall: np.ndarray
    wood: np.ndarray
    metal: np.ndarray
    plain: float

    def any(self, rng):
        """A piece of furniture's colour: wood, metal, or the wall's."""
        if rng.random() < self.plain:
            return self.wall * rng.uniform(0.97, 1.0)
        return (self.wood if rng.random() < 0.6 else self.metal)[rng.integers(4)]


def _walls(rng, colours):
    corners = np.array([(0, 0), (WIDTH, 0), (WIDTH, DEPTH), (0, DEPTH)], float)
    walls = []
    for start, end in pairwise([*corners, corners[0]]):
        length = np.linalg.norm(end - start)
        paint = texture.blank(length, HEIGHT, colours.wall)
        texture.plaster(rng, paint)
        texture.paint(paint, 0, length, 0, SKIRTING, colours.wall * 0.45)
        walls.append(Face(start, end, 0.0, HEIGHT, paint))
    return walls


def _layout(rng):
    """What is along each wall, counter-clockwise from the south: lists of (kind, begin, width)."""
    south = ["door", "cupboard", "drawers", "pilaster", "picture", "shelf", "picture"]
    north = ["window", "window", "pilaster", "drawers", "board", "cupboard"]
    short = [["window", "cupboard"], ["door", str(rng.choice(["cupboard", "shelf"]))]]
    east, west = (short[i] for i in rng.permutation(2))
    # on the short walls nothing reaches into the corners, where the long walls' furniture stands
    walls = ((south, WIDTH, 0.2), (east, DEPTH, 0.7), (north, WIDTH, 0.2), (west, DEPTH, 0.7))
    return [_spread(rng, kinds, length, margin) for kinds, length, margin in walls]


def _spread(rng, kinds, length, margin):
    """(kind, begin, width) of things in random order with random gaps of `GAP` or more."""
    kinds = rng.permutation(kinds)
    widths = np.round([rng.uniform(*SIZES[kind]) for kind in kinds], 2)
    spare = length - 2 * margin - widths.sum() - GAP * (len(kinds) - 1)
    gaps = np.cumsum(rng.dirichlet(np.full(len(kinds) + 1, 2.0))[:-1] * spare)
    begin = margin + gaps + np.append(0, np.cumsum(widths + GAP)[:-1])
    return list(zip(kinds.tolist(), np.round(begin, 2).tolist(), widths.tolist(), strict=True))


def _islands(rng):
    """Two pillars and a piece of furniture along the room's middle: (kind, corner, axis, width)."""
    for x, kind, most in ((3.0, "pillar", 0.0), (5.0, "drawers", 0.2), (7.0, "pillar", 0.0)):
        width = round(rng.uniform(*SIZES[kind]), 2)
        middle = np.array([x, DEPTH / 2]) + rng.uniform(-0.25, 0.25, 2) * (1, 0.4)
        turn = rng.uniform(-most, most)
        axis = np.array([cos(turn), sin(turn)])
        yield kind, np.round(middle, 2) - axis * width / 2 - left(axis) * 0.2, axis, width


def _stand(rng, colours, built, kind, corner, axis, width, free=False):
    """Add a box: faces with their paint, edges. If it is not `free`, it has a wall behind."""
    deep, tall = (round(rng.uniform(*span), 2) for span in STANDING[kind])
    colour = colours.any(rng) if kind not in ("pilaster", "pillar") else colours.wall * 0.9
    across = deep * left(axis)
    ring = [corner, corner + across, corner + across + width * axis, corner + width * axis, corner]
    for side, (start, end) in enumerate(list(pairwise(ring))[: 4 if free else 3]):
        length = width if side % 2 else deep
        face = Face(start, end, 0.0, tall, texture.blank(length, tall, colour))
        texture.plaster(rng, face.texture)
        if side % 2 and kind in texture.FRONTS:
            marks = texture.FRONTS[kind](rng, face.texture, colour)
            built.edges.extend(_marked(face, marks, kind))
        built.faces.append(face)
        built.owner.append(len(built.boxes))
    built.boxes.append(Box(corner, axis, width, deep, tall, colour))
    built.edges.extend((*point, 0.0, tall, kind) for point in ring[:4])


def _hang(rng, colours, paint, kind, begin, width):
    """Paint something flat on a wall; where its edges are: (along, bottom, top)."""
    if kind == "door":
        leaf, frame = colours.any(rng), colours.metal[0] * 0.8
        return texture.door(rng, paint, begin, width, 2.06, (frame, leaf))
    if kind == "window":
        frame = colours.wall if rng.random() < colours.plain else colours.metal[1] * 0.7
        return texture.window(rng, paint, begin, width, 0.9, 2.1, frame)
    bottom, top = round(rng.uniform(0.8, 1.1), 2), round(rng.uniform(1.7, 2.0), 2)
    if kind == "board":
        return texture.board(rng, paint, begin, width, bottom, top)
    colour = texture.BRIGHT[rng.integers(4)]
    return texture.picture(rng, paint, begin, width, bottom, top, colour)


def _marked(face, marks, kind):
    """Edges (x, y, bottom, top, kind) of marks (along, bottom, top) on a face; the low ones (books,
    handles) are details."""
    at = face.start + np.array([s for s, _, _ in marks])[:, None] * _direction(face)
    kinds = [kind if high - low >= LANDMARK else "detail" for _, low, high in marks]
    return [(*p, *mark[1:], name) for p, mark, name in zip(at, marks, kinds, strict=True)]


def _merge(edges):
    """`Edges` of rows (x, y, bottom, top, kind); those of one place that touch become one."""
    rows = []
    for x, y, low, high, kind in sorted(edges, key=lambda row: (row[4] == "detail", row[2])):
        for row in rows:
            if np.hypot(row[0] - x, row[1] - y) < SAME and low <= row[3] and high >= row[2]:
                row[2:4] = min(row[2], low), max(row[3], high)
                break
        else:
            rows.append([x, y, low, high, kind])
    x, y, low, high, kind = (np.array(column) for column in zip(*rows, strict=True))
    return Edges(np.column_stack([x, y]), low, high, kind)


def _finish(rng, built, shadows):
    """Bake the light into every surface and put the world together."""
    boxes, faces = built.boxes, []
    for face, owner in zip(built.faces, built.owner, strict=True):
        length, normal = np.linalg.norm(face.end - face.start), left(_direction(face))
        along, up = _cells(length)[:, None, None], _cells(face.top)[:, None]
        flat = face.start + along * _direction(face)
        point = np.concatenate(np.broadcast_arrays(flat[..., :1], flat[..., 1:], up), -1)
        near = _near(point, boxes, owner)
        baked = texture.bake(face.texture, point, (*normal, 0), LAMPS, HEIGHT, near, shadows)
        faces.append(face._replace(texture=baked))
    flat = []
    for paint, height, up in (
        (texture.floor(rng, WIDTH, DEPTH), 0.0, 1.0),
        (texture.ceiling(WIDTH, DEPTH, LAMPS, LAMP), HEIGHT, -1.0),
    ):
        x, y = np.meshgrid(_cells(WIDTH), _cells(DEPTH), indexing="ij")
        point = np.stack([x, y, np.full_like(x, height)], -1)
        near = _near(point, boxes, -1)
        flat.append(texture.bake(paint, point, (0, 0, up), LAMPS, HEIGHT, near, shadows))
    boxes = [box._replace(colour=np.rint(200 * box.colour).astype(np.uint8)) for box in boxes]
    columns = [
        np.array([getattr(face, name) for face in faces]) for name in ("start", "end", "top")
    ]
    return World(faces, boxes, _merge(built.edges), *flat, *columns, np.array(built.owner))


def _cells(length, spacing=0.1):
    """Middles of cells of about this size along a length."""
    count = max(2, round(length / spacing))
    return (np.arange(count) + 0.5) * length / count


def _near(point, boxes, owner):
    """Distance [...] of points [..., 3] to the nearest wall, floor, ceiling or box not its own."""
    x, y, z = np.moveaxis(point, -1, 0)
    gaps = [x, WIDTH - x, y, DEPTH - y, z, HEIGHT - z]
    gaps = [np.where(np.abs(gap) < 1e-6, np.inf, gap) for gap in gaps]  # the one it lies on
    for i, box in enumerate(boxes):
        if i != owner:
            side = np.linalg.norm(np.maximum(outside(box, point[..., :2]), 0), axis=-1)
            gaps.append(np.hypot(side, np.maximum(z - box.top, 0)))
    return np.min(gaps, axis=0)


def _direction(face):
    return (face.end - face.start) / np.linalg.norm(face.end - face.start)
