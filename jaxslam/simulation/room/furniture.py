"""Furnish the rendered room: furniture, paint and light, drawn from a seed."""

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
    distance_outside,
    left_normal,
)

LAMPS = ((2.0, 2.0), (5.0, 2.0), (8.0, 2.0))  # m, centres on the ceiling
LAMP = (1.2, 0.3)  # m, size
GAP = 0.15  # m, least distance between neighbours along a wall
SAME_EDGE = 0.004  # m: closer edges are merged
SKIRTING = 0.1  # m, height

SIZES = {  # m: least and largest width
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
STANDING = {  # m: range of depth and of height; all other kinds are flat on the walls
    "cupboard": ((0.40, 0.50), (1.70, 2.00)),
    "drawers": ((0.40, 0.50), (0.85, 1.20)),
    "shelf": ((0.28, 0.35), (1.80, 2.00)),
    "pilaster": ((0.15, 0.25), (HEIGHT, HEIGHT)),
    "pillar": ((0.25, 0.40), (HEIGHT, HEIGHT)),
}


def furnish(seed=0, *, shadows=1.0, plain=0.2):
    """Draw a furnished `World` from a seed.

    `shadows` 0..1: darkness where surfaces meet; `plain` 0..1: share of the furniture painted like
    the wall behind it, so that its edges have little contrast. Raises `ValueError`.
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
    room = _Room(_walls(rng, colours), [-1] * 4, [], [])
    room.edges.extend((*wall.start, 0.0, HEIGHT, "corner") for wall in room.faces)
    for wall, things in zip(room.faces[:4], _layout(rng), strict=True):
        for kind, begin, width in things:
            if kind in STANDING:
                axis = _direction(wall)
                _add_box(rng, colours, room, kind, wall.start + begin * axis, axis, width)
            else:
                edges = _paint_on_wall(rng, colours, wall.texture, kind, begin, width)
                room.edges.extend(_edges_on(wall, edges, kind))
    for kind, corner, axis, width in _free_standing(rng):
        _add_box(rng, colours, room, kind, corner, axis, width, free=True)
    return _bake(rng, room, shadows)


class _Room(NamedTuple):
    """The room under construction: `owner` is the index of each face's box, -1 for a wall."""

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
        """Draw the colour of a piece of furniture: wood, metal, or the wall's."""
        if rng.random() < self.plain:
            return self.wall * rng.uniform(0.97, 1.0)
        return (self.wood if rng.random() < 0.6 else self.metal)[rng.integers(4)]


def _walls(rng, colours):
    corners = np.array([(0, 0), (WIDTH, 0), (WIDTH, DEPTH), (0, DEPTH)], float)
    walls = []
    for start, end in pairwise([*corners, corners[0]]):
        length = np.linalg.norm(end - start)
        paint = texture.blank_texture(length, HEIGHT, colours.wall)
        texture.plaster(rng, paint)
        texture.paint(paint, 0, length, 0, SKIRTING, colours.wall * 0.45)
        walls.append(Face(start, end, 0.0, HEIGHT, paint))
    return walls


def _layout(rng):
    """Draw the layout of each wall, counter-clockwise from the south: (kind, begin, width)s."""
    south = ["door", "cupboard", "drawers", "pilaster", "picture", "shelf", "picture"]
    north = ["window", "window", "pilaster", "drawers", "board", "cupboard"]
    short = [["window", "cupboard"], ["door", str(rng.choice(["cupboard", "shelf"]))]]
    east, west = (short[i] for i in rng.permutation(2))
    # Keep the corners of the short walls free: the furniture of the long walls stands there.
    walls = ((south, WIDTH, 0.2), (east, DEPTH, 0.7), (north, WIDTH, 0.2), (west, DEPTH, 0.7))
    return [_distribute(rng, kinds, length, margin) for kinds, length, margin in walls]


def _distribute(rng, kinds, length, margin):
    """Place kinds along a wall in random order, with random gaps of at least `GAP`."""
    kinds = rng.permutation(kinds)
    widths = np.round([rng.uniform(*SIZES[kind]) for kind in kinds], 2)
    spare = length - 2 * margin - widths.sum() - GAP * (len(kinds) - 1)
    gaps = np.cumsum(rng.dirichlet(np.full(len(kinds) + 1, 2.0))[:-1] * spare)
    begin = margin + gaps + np.append(0, np.cumsum(widths + GAP)[:-1])
    return list(zip(kinds.tolist(), np.round(begin, 2).tolist(), widths.tolist(), strict=True))


def _free_standing(rng):
    """Yield (kind, corner, axis, width) of two pillars and drawers along the room's middle."""
    for x, kind, most in ((3.0, "pillar", 0.0), (5.0, "drawers", 0.2), (7.0, "pillar", 0.0)):
        width = round(rng.uniform(*SIZES[kind]), 2)
        middle = np.array([x, DEPTH / 2]) + rng.uniform(-0.25, 0.25, 2) * (1, 0.4)
        turn = rng.uniform(-most, most)
        axis = np.array([cos(turn), sin(turn)])
        yield kind, np.round(middle, 2) - axis * width / 2 - left_normal(axis) * 0.2, axis, width


def _add_box(rng, colours, room, kind, corner, axis, width, free=False):
    """Add a box with painted faces and edges; unless `free`, its back is at a wall."""
    deep, tall = (round(rng.uniform(*span), 2) for span in STANDING[kind])
    colour = colours.any(rng) if kind not in ("pilaster", "pillar") else colours.wall * 0.9
    across = deep * left_normal(axis)
    ring = [corner, corner + across, corner + across + width * axis, corner + width * axis, corner]
    for side, (start, end) in enumerate(list(pairwise(ring))[: 4 if free else 3]):
        length = width if side % 2 else deep
        face = Face(start, end, 0.0, tall, texture.blank_texture(length, tall, colour))
        texture.plaster(rng, face.texture)
        if side % 2 and kind in texture.FRONTS:
            edges = texture.FRONTS[kind](rng, face.texture, colour)
            room.edges.extend(_edges_on(face, edges, kind))
        room.faces.append(face)
        room.owner.append(len(room.boxes))
    room.boxes.append(Box(corner, axis, width, deep, tall, colour))
    room.edges.extend((*point, 0.0, tall, kind) for point in ring[:4])


def _paint_on_wall(rng, colours, paint, kind, begin, width):
    """Paint something flat on a wall; returns its vertical edges (along, bottom, top)."""
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


def _edges_on(face, edges, kind):
    """Convert edges (along, bottom, top) on a face to (x, y, bottom, top, kind); low ones (books,
    handles) are of kind "detail"."""
    at = face.start + np.array([s for s, _, _ in edges])[:, None] * _direction(face)
    kinds = [kind if high - low >= LANDMARK else "detail" for _, low, high in edges]
    return [(*p, *mark[1:], name) for p, mark, name in zip(at, edges, kinds, strict=True)]


def _merge(edges):
    """Make `Edges` of rows (x, y, bottom, top, kind); merge touching ones at one point."""
    rows = []
    for x, y, low, high, kind in sorted(edges, key=lambda row: (row[4] == "detail", row[2])):
        for row in rows:
            if np.hypot(row[0] - x, row[1] - y) < SAME_EDGE and low <= row[3] and high >= row[2]:
                row[2:4] = min(row[2], low), max(row[3], high)
                break
        else:
            rows.append([x, y, low, high, kind])
    x, y, low, high, kind = (np.array(column) for column in zip(*rows, strict=True))
    return Edges(np.column_stack([x, y]), low, high, kind)


def _bake(rng, room, shadows):
    """Bake the light into every surface and assemble the `World`."""
    boxes, faces = room.boxes, []
    for face, owner in zip(room.faces, room.owner, strict=True):
        length, normal = np.linalg.norm(face.end - face.start), left_normal(_direction(face))
        along, up = _cells(length)[:, None, None], _cells(face.top)[:, None]
        flat = face.start + along * _direction(face)
        point = np.concatenate(np.broadcast_arrays(flat[..., :1], flat[..., 1:], up), -1)
        near = _clearance(point, boxes, owner)
        baked = texture.bake(face.texture, point, (*normal, 0), LAMPS, HEIGHT, near, shadows)
        faces.append(face._replace(texture=baked))
    flat = []
    for paint, height, up in (
        (texture.floor(rng, WIDTH, DEPTH), 0.0, 1.0),
        (texture.ceiling(WIDTH, DEPTH, LAMPS, LAMP), HEIGHT, -1.0),
    ):
        x, y = np.meshgrid(_cells(WIDTH), _cells(DEPTH), indexing="ij")
        point = np.stack([x, y, np.full_like(x, height)], -1)
        near = _clearance(point, boxes, -1)
        flat.append(texture.bake(paint, point, (0, 0, up), LAMPS, HEIGHT, near, shadows))
    boxes = [box._replace(colour=np.rint(200 * box.colour).astype(np.uint8)) for box in boxes]
    columns = [
        np.array([getattr(face, name) for face in faces]) for name in ("start", "end", "top")
    ]
    return World(faces, boxes, _merge(room.edges), *flat, *columns, np.array(room.owner))


def _cells(length, spacing=0.1):
    """Centres of cells of about this size along a length."""
    count = max(2, round(length / spacing))
    return (np.arange(count) + 0.5) * length / count


def _clearance(point, boxes, owner):
    """Distance [...] of points [..., 3] to the nearest wall, floor, ceiling or other box."""
    x, y, z = np.moveaxis(point, -1, 0)
    gaps = [x, WIDTH - x, y, DEPTH - y, z, HEIGHT - z]
    gaps = [np.where(np.abs(gap) < 1e-6, np.inf, gap) for gap in gaps]  # not its own surface
    for i, box in enumerate(boxes):
        if i != owner:
            side = np.linalg.norm(np.maximum(distance_outside(box, point[..., :2]), 0), axis=-1)
            gaps.append(np.hypot(side, np.maximum(z - box.top, 0)))
    return np.min(gaps, axis=0)


def _direction(face):
    return (face.end - face.start) / np.linalg.norm(face.end - face.start)
