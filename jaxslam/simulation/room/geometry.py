"""A furnished room: its surfaces, its vertical edges, and which of them are visible from a pose.

The room is 10 x 4 m, x along its length, its lower-left corner at the origin. All of it consists of
vertical rectangles (`Face`), visible from the left of start -> end, and of the tops of boxes. Edges
and their visibility are computed from this geometry alone, without camera or renderer. Metres,
radians (CCW), colours blue, green, red.
"""

from dataclasses import dataclass
from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from jaxslam.simulation.room.textures import FLAT_TEXEL, TEXEL

WIDTH, DEPTH, HEIGHT = 10.0, 4.0, 2.6  # m: along x, along y, floor to ceiling
LANDMARK = 0.4  # m: a vertical edge at least as tall is a landmark
ASIDE = np.radians(0.25)  # azimuth on either side of an edge at which its contrast is taken
VIEW = (np.radians(-5), np.radians(65))  # elevations that the double mirror shows


class Face(NamedTuple):
    """A vertical rectangle over `start` -> `end` [2] from `bottom` to `top`, with its texture."""

    start: np.ndarray
    end: np.ndarray
    bottom: float
    top: float
    texture: np.ndarray  # [columns, rows, 3], columns from the start, rows from the bottom


class Box(NamedTuple):
    """A box on the floor: `corner` [2], unit `axis` [2] along its width, depth to the left."""

    corner: np.ndarray
    axis: np.ndarray
    width: float
    depth: float
    top: float
    colour: np.ndarray  # [3], of the top


class Edges(NamedTuple):
    """All vertical edges: `point` [E, 2], `bottom`, `top` [E], `kind` [E] (text). The index of an
    edge is its id."""

    point: np.ndarray
    bottom: np.ndarray
    top: np.ndarray
    kind: np.ndarray

    @property
    def landmark(self):
        """Mask [E] of edges tall enough to be landmarks."""
        return self.top - self.bottom >= LANDMARK - 1e-9


class Visible(NamedTuple):
    """Edges visible from a pose, sorted by bearing.

    `id`, `bearing` in the robot's frame, `distance`, elevations `low` and `high` of the visible
    part, `contrast` 0..1 between its sides (RMS over colours, in the room's mean light), `point`
    [n, 2].
    """

    id: np.ndarray
    bearing: np.ndarray
    distance: np.ndarray
    low: np.ndarray
    high: np.ndarray
    contrast: np.ndarray
    point: np.ndarray


@dataclass(frozen=True, eq=False)
class World:
    """A furnished room (`furnish`).

    `faces`, the four walls first; their `start`, `end` [F, 2] and `top` [F] as arrays; `owner` [F],
    the index of each face's box, -1 for a wall; `floor`, `ceiling` uint8 [x, y, 3].
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
        """Distance [n] of points [n, 2] to the nearest face; negative in a box or off the room."""
        point = np.atleast_2d(np.asarray(point, float))
        along, to = self.end - self.start, point[:, None] - self.start
        part = np.clip(np.sum(to * along, -1) / np.sum(along**2, -1), 0, 1)
        near = np.linalg.norm(to - part[..., None] * along, axis=-1).min(1)
        inside = np.any([distance_outside(box, point).max(-1) < 0 for box in self.boxes], axis=0)
        beyond = np.any((point < 0) | (point > (WIDTH, DEPTH)), axis=-1)
        return np.where(inside | beyond, -near, near)


def distance_outside(box, point):
    """Distance of points [..., 2] beyond a box's sides, along its width and depth [..., 2]."""
    to = point - box.corner
    local = np.stack([to @ box.axis, to @ left_normal(box.axis)], -1)
    half = np.array([box.width, box.depth]) / 2
    return np.abs(local - half) - half


def left_normal(axis):
    return np.array([-axis[1], axis[0]])


def eye_at(pose, position):
    """Position [3] of a camera at `position` on the robot, for a robot at (x, y, heading)."""
    x, y, heading = pose
    c, s = cos(heading), sin(heading)
    forward, aside, height = position
    return np.array([x + c * forward - s * aside, y + s * forward + c * aside, height])


def visible_edges(world, pose, position=(0.0, 0.0, 0.6), elevation=VIEW):
    """Find the edges `Visible` from a pose (x, y, heading) to a camera at `position` on the robot.

    `elevation` (low, high): the camera's view. Faces in front of an edge hide its lower part.
    """
    eye, edges, heading = eye_at(pose, position), world.edges, pose[2]
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
    """RMS over colours of the mean difference [n] between left and right of edges."""
    part = (np.arange(rows) + 0.5) / rows
    elevation = low[:, None] + part * (high - low)[:, None]
    sides = []
    for side in (ASIDE, -ASIDE):
        turned = np.repeat(azimuth + side, rows)
        colour = trace_rays(world, eye, turned, elevation.ravel())[1]
        sides.append(colour.reshape(-1, rows, 3).mean(1))
    return np.sqrt(np.mean((sides[0] - sides[1]) ** 2, axis=-1))


def trace_rays(world, eye, azimuth, elevation):
    """Trace rays [n] from `eye` [3]: distance over ground [n] and colour 0..1 [n, 3] they meet.

    Tests every ray against every surface: slow and plain, the reference of the renderer. `azimuth`
    and `elevation` are in the world's frame.
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
        texture = world.faces[i].texture
        colour[at] = _texel(texture, along[at, i] / TEXEL, height[at, i] / TEXEL)
    with np.errstate(divide="ignore"):
        for level, texture in ((0.0, world.floor), (HEIGHT, world.ceiling)):
            to = np.where((level - eye[2]) * slope > 0, (level - eye[2]) / slope, np.inf)
            at = to < distance
            x, y = (eye[:2] + to[at, None] * direction[at]).T / FLAT_TEXEL
            colour[at], distance[at] = _texel(texture, x, y), to[at]
        for box in world.boxes:
            to = np.where((box.top - eye[2]) * slope > 0, (box.top - eye[2]) / slope, np.inf)
            to[slope >= 0] = np.inf  # tops are visible from above
            at = np.flatnonzero(to < distance)
            at = at[distance_outside(box, eye[:2] + to[at, None] * direction[at]).max(-1) < 0]
            colour[at], distance[at] = box.colour, to[at]
    return distance, colour / 255


def _crossings(world, eye, direction):
    """Distance [n, F] at which rays meet the front of each face (inf: none), and where along it."""
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


def _texel(texture, column, row):
    index = (
        np.clip(axis.astype(int), 0, n - 1)
        for axis, n in zip((column, row), texture.shape[:2], strict=True)
    )
    return texture[tuple(index)]
