"""A furnished room: its surfaces, its vertical edges, and which of them a place sees.

The room is 10 x 4 m, x along its length, its lower-left corner at the origin. Everything in it is
made of vertical rectangles (`Face`), seen from the side that lies to the left of start -> end, and
of the tops and undersides of boxes. Edges and their visibility come from this geometry alone, never
from the camera or the renderer. Metres, radians (CCW), colours blue, green, red.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from jaxslam import render_texture as texture
from jaxslam.render_texture import FLAT_TEXEL, TEXEL

WIDTH, DEPTH, HEIGHT = 10.0, 4.0, 2.6  # m: along x, along y, floor to ceiling
LAMPS = ((2.0, 2.0), (5.0, 2.0), (8.0, 2.0))  # m, their middles on the ceiling
LAMP = (1.2, 0.3)  # m
GAP = 0.15  # m between neighbours along a wall, at least
LANDMARK = 0.4  # m: a vertical edge at least as tall is a landmark
SAME = 0.004  # m: edges closer than that are one
ASIDE = np.radians(0.25)  # how far beside an edge its contrast is taken

VIEW = (np.radians(-5), np.radians(65))  # elevations the double mirror shows

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


class Face(NamedTuple):
    """A vertical rectangle over `start` -> `end` [2] from `bottom` to `top`, with its paint."""

    start: np.ndarray
    end: np.ndarray
    bottom: float
    top: float
    texture: np.ndarray  # [columns, rows, 3], columns from the start, rows from the bottom


class Box(NamedTuple):
    """What stands in the room: `corner` [2], unit `axis` [2] along its width, depth to the left."""

    corner: np.ndarray
    axis: np.ndarray
    width: float
    depth: float
    top: float
    colour: np.ndarray  # [3], of its top


class Edges(NamedTuple):
    """All vertical boundaries: `point` [E, 2], `bottom`, `top` [E], `kind` [E] of text.

    An edge's row is its id.
    """

    point: np.ndarray
    bottom: np.ndarray
    top: np.ndarray
    kind: np.ndarray

    @property
    def landmark(self):
        """[E]: tall enough to be one."""
        return self.top - self.bottom >= LANDMARK - 1e-9


class Visible(NamedTuple):
    """Edges seen from a place, by bearing: `id`, `bearing` in the robot's frame, `distance`,
    elevations `low`, `high` of the longest visible piece's ends, `contrast` 0..1 between both
    sides of it (RMS over the colours, in the room's mean light), `point` [n, 2]."""

    id: np.ndarray
    bearing: np.ndarray
    distance: np.ndarray
    low: np.ndarray
    high: np.ndarray
    contrast: np.ndarray
    point: np.ndarray


@dataclass(frozen=True, eq=False)
class World:
    """A room as `room` furnishes it.

    `faces`, the first four of them the walls, with their `start`, `end` [F, 2] and `top` [F] as
    arrays, and `owner` [F], each face's box, -1 for a wall's; `floor`, `ceiling` uint8 [x, y, 3].
    """

    faces: list[Face]
    boxes: list[Box]
    edges: Edges
    floor: np.ndarray
    ceiling: np.ndarray
    start: np.ndarray
    end: np.ndarray
    top: np.ndarray
    owner: np.ndarray

    @property
    def plan(self):
        """The floor plan's segments [n, 4]: x1, y1, x2, y2."""
        return np.hstack([self.start, self.end])

    def clearance(self, point):
        """Distance [n] of points [n, 2] to the nearest face, negative inside a box or outside."""
        point = np.atleast_2d(np.asarray(point, float))
        along, to = self.end - self.start, point[:, None] - self.start
        part = np.clip(np.sum(to * along, -1) / np.sum(along**2, -1), 0, 1)
        near = np.linalg.norm(to - part[..., None] * along, axis=-1).min(1)
        inside = np.any([outside(box, point).max(-1) < 0 for box in self.boxes], axis=0)
        beyond = np.any((point < 0) | (point > (WIDTH, DEPTH)), axis=-1)
        return np.where(inside | beyond, -near, near)


def room(seed=0, *, shadows=1.0, plain=0.2):
    """A `World` drawn from a seed.

    `shadows` 0..1: how dark it is where things meet; `plain` 0..1: the share of the furniture that
    is painted like the wall behind it, so that its edges hardly show. Raises `ValueError`.
    """
    for name, value in (("shadows", shadows), ("plain", plain)):
        if not 0 <= value <= 1:
            raise ValueError(f"room: {name} is {value!r}, allowed: 0 to 1")
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
        paint = texture.blank(np.linalg.norm(end - start), HEIGHT, colours.wall)
        texture.plaster(rng, paint)
        texture.paint(
            paint, 0, np.linalg.norm(end - start), 0, 0.1, colours.wall * 0.45
        )  # skirting
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
        yield kind, np.round(middle, 2) - axis * width / 2 - _left(axis) * 0.2, axis, width


def _stand(rng, colours, built, kind, corner, axis, width, free=False):
    """Add a box: its faces with their paint, its edges. One that is not `free` has a wall behind."""
    deep, tall = (round(rng.uniform(*span), 2) for span in STANDING[kind])
    colour = colours.any(rng) if kind not in ("pilaster", "pillar") else colours.wall * 0.9
    across = deep * _left(axis)
    ring = [corner, corner + across, corner + across + width * axis, corner + width * axis, corner]
    for side, (start, end) in enumerate(list(pairwise(ring))[: 4 if free else 3]):
        length = width if side % 2 else deep
        face = Face(start, end, 0.0, tall, texture.blank(length, tall, colour))
        texture.plaster(rng, face.texture)
        if side % 2 and kind in texture.FRONTS:
            marks = texture.FRONTS[kind](rng, face.texture, colour)
            built.edges.extend(_marked(face, marks, "book" if kind == "shelf" else kind))
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
    """Edges (x, y, bottom, top, kind) of marks (along, bottom, top) on a face."""
    return [(*(face.start + s * _direction(face)), low, high, kind) for s, low, high in marks]


def _merge(edges):
    """`Edges` of rows (x, y, bottom, top, kind); those of one place that touch become one."""
    rows = []
    for x, y, low, high, kind in sorted(edges, key=lambda row: (row[4] == "book", row[2])):
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
        length, normal = np.linalg.norm(face.end - face.start), _left(_direction(face))
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


def outside(box, point):
    """How far points [..., 2] are beyond a box's sides, along its width and depth [..., 2]."""
    to = point - box.corner
    local = np.stack([to @ box.axis, to @ _left(box.axis)], -1)
    half = np.array([box.width, box.depth]) / 2
    return np.abs(local - half) - half


def _direction(face):
    return (face.end - face.start) / np.linalg.norm(face.end - face.start)


def _left(axis):
    return np.array([-axis[1], axis[0]])


def visible_edges(world, pose, position=(0.0, 0.0, 0.6), elevation=VIEW):
    """The `Visible` edges from a pose (x, y, heading), of a camera at `position` on the robot.

    `elevation` (low, high): what the camera sees. What stands before an edge hides its lower part.
    """
    x, y, heading = pose
    c, s = cos(heading), sin(heading)
    eye = np.array([x + c * position[0] - s * position[1], y + s * position[0] + c * position[1]])
    eye, edges = np.append(eye, position[2]), world.edges
    to = edges.point - eye[:2]
    distance, azimuth = np.hypot(*to.T), np.arctan2(to[:, 1], to[:, 0])
    reach, _ = _crossings(world, eye, to / distance[:, None])
    before = np.where(reach < distance[:, None] - 1e-6, reach, np.inf)
    hidden = np.where(np.isfinite(before), (world.top - eye[2]) / before, -np.inf).max(1)
    low = np.maximum((edges.bottom - eye[2]) / distance, hidden)
    low = np.maximum(low, np.tan(elevation[0]))
    high = np.minimum((edges.top - eye[2]) / distance, np.tan(elevation[1]))
    seen = np.flatnonzero(high > low)
    low, high = np.arctan(low[seen]), np.arctan(high[seen])
    contrast = _contrast(world, eye, azimuth[seen], low, high)
    bearing = (azimuth[seen] - heading + pi) % (2 * pi) - pi
    order = np.argsort(bearing)
    columns = (seen, bearing, distance[seen], low, high, contrast, edges.point[seen])
    return Visible(*(column[order] for column in columns))


def _contrast(world, eye, azimuth, low, high, rows=9):
    """RMS over the colours of the mean difference [n] between the left and the right of edges."""
    part = (np.arange(rows) + 0.5) / rows
    elevation = low[:, None] + part * (high - low)[:, None]
    sides = []
    for side in (ASIDE, -ASIDE):
        turned = np.repeat(azimuth + side, rows)
        sides.append(look(world, eye, turned, elevation.ravel())[1].reshape(-1, rows, 3).mean(1))
    return np.sqrt(np.mean((sides[0] - sides[1]) ** 2, axis=-1))


def look(world, eye, azimuth, elevation):
    """What rays [n] from `eye` [3] meet: distance over ground [n] and colour 0..1 [n, 3].

    Every ray against every surface: slow and plain, what the renderer is held against. `azimuth`
    and `elevation` are the world's.
    """
    eye, direction = np.asarray(eye, float), np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    slope = np.tan(elevation)
    reach, along = _crossings(world, eye, direction)
    with np.errstate(invalid="ignore"):
        height = eye[2] + reach * slope[:, None]
    reach[(height < 0) | (height > world.top)] = np.inf
    face = reach.argmin(1)
    ray = np.arange(len(face))
    distance = reach[ray, face]
    colour = np.zeros((len(face), 3))
    for i in np.unique(face[np.isfinite(distance)]):
        at = (face == i) & np.isfinite(distance)
        paint = world.faces[i].texture
        colour[at] = _texel(paint, along[at, i] / TEXEL, height[at, i] / TEXEL)
    with np.errstate(divide="ignore"):
        for level, paint in ((0.0, world.floor), (HEIGHT, world.ceiling)):
            to = np.where((level - eye[2]) * slope > 0, (level - eye[2]) / slope, np.inf)
            at = to < distance
            x, y = (eye[:2] + to[at, None] * direction[at]).T / FLAT_TEXEL
            colour[at], distance[at] = _texel(paint, x, y), to[at]
        for box in world.boxes:
            to = np.where((box.top - eye[2]) * slope > 0, (box.top - eye[2]) / slope, np.inf)
            to[slope >= 0] = np.inf  # tops are seen from above
            at = np.flatnonzero(to < distance)
            at = at[outside(box, eye[:2] + to[at, None] * direction[at]).max(-1) < 0]
            colour[at], distance[at] = box.colour, to[at]
    return distance, colour / 255


def _crossings(world, eye, direction):
    """Distance [n, F] at which rays meet the front of each face (inf: not) and where along it."""
    span = world.end - world.start
    length = np.linalg.norm(span, axis=-1)
    unit = span / length[:, None]
    to = world.start - eye[:2]
    across = to[:, 0] * unit[:, 1] - to[:, 1] * unit[:, 0]  # > 0: the eye is on the left
    facing = direction[:, :1] * unit[:, 1] - direction[:, 1:] * unit[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where((across > 0) & (facing > 0), across / facing, np.inf)
        along = reach * (direction @ unit.T) - np.sum(to * unit, -1)
    return np.where((along >= 0) & (along <= length), reach, np.inf), along


def _texel(paint, column, row):
    index = (np.clip(axis.astype(int), 0, n - 1) for axis, n in zip((column, row), paint.shape))
    return paint[tuple(index)]
