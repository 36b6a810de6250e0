"""Ray cast a furnished room, exactly and fast: every pixel is the mean of rays spread over it.

The rays of a camera are sorted by azimuth once. The azimuths of all faces' ends cut the view into
sectors; within a sector the faces are in the same order for all rays, so it is painted from back to
front. The result is an index into one table of colours for each ray.
"""

from math import pi
from typing import NamedTuple

import numpy as np

from jaxslam.simulation.room.geometry import DEPTH, HEIGHT, WIDTH, World, distance_outside
from jaxslam.simulation.room.textures import FLAT_TEXEL, TEXEL

RIM = np.radians(1.3)  # imaged beyond the usable elevations, so that a tilted camera has them all
SOFT = np.radians(0.3)  # over which the image darkens there
DARK = 0.025  # brightness outside, and on the mirror's holder in the middle


class Rays(NamedTuple):
    """A camera's rays, sorted by azimuth [n] (robot frame).

    `cosine`, `sine` [n] over ground, `slope` [n], and `flat_index` [n] of each ray in [pixels,
    samples]; `pixel` [P] flat indices into the image, with the azimuth `side` [P] and the `share`
    [P] of the scene in them; `dark` float32 [H, W, 3], the image around the scene.
    """

    azimuth: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray
    slope: np.ndarray
    flat_index: np.ndarray
    pixel: np.ndarray
    side: np.ndarray
    share: np.ndarray
    dark: np.ndarray


def camera_rays(camera, samples=5):
    """Make the `Rays` of a camera, `samples` per pixel."""
    v, u = np.mgrid[: camera.height, : camera.width]
    pixel = np.stack([u, v], -1).reshape(-1, 2).astype(float)
    up = 1 if (camera.lens == "up") != camera.mirror else -1
    elevation = np.arcsin(up * camera.ray(pixel)[:, 2])  # relative to the lens, as its rim is
    low, high = camera.elevation[0] - RIM, camera.elevation[1] + RIM
    share = np.clip(0.5 + np.minimum(elevation - low, high - elevation) / SOFT, 0, 1)
    ring = 0.05 * np.exp(-(((elevation - high) / np.radians(4) - 1.2) ** 2) * 4)
    dark = np.repeat(DARK + ring[:, None], 3, 1)
    kept = np.flatnonzero(share > 0)
    # A low-discrepancy sequence, shifted from pixel to pixel: no row or column is preferred.
    plastic = np.array([0.7548776662, 0.5698402910])
    shift = np.random.default_rng(0).random((len(kept), 1, 2))
    spread = (shift + np.arange(samples)[:, None] * plastic) % 1 - 0.5
    direction = camera.direction((pixel[kept, None] + spread).reshape(-1, 2))
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    flat_index = np.argsort(azimuth, kind="stable")
    ground = np.hypot(direction[:, 0], direction[:, 1])
    parts = (direction[:, 0] / ground, direction[:, 1] / ground, direction[:, 2] / ground)
    cosine, sine, slope = (part[flat_index].astype(np.float32) for part in parts)
    middle = camera.direction(pixel[kept])
    side = np.arctan2(middle[:, 1], middle[:, 0])
    dark = dark.reshape(camera.height, camera.width, 3).astype(np.float32)
    share = share[kept, None].astype(np.float32)
    return Rays(azimuth[flat_index], cosine, sine, slope, flat_index, kept, side, share, dark)


class Scene(NamedTuple):
    """A world with all its colours in one table [n] of 4 bytes each.

    `face`, `floor`, `ceiling`, `tops`: where the colours of each face, the floor, the ceiling and
    the tops of boxes begin; `rows` of each face's texture.
    """

    world: World
    colours: np.ndarray
    face: np.ndarray
    rows: np.ndarray
    floor: int
    ceiling: int
    tops: int


def build_scene(world):
    """Build the `Scene` of a `World`."""
    tops = np.array([box.colour for box in world.boxes])[:, None]
    paints = [*(face.texture for face in world.faces), world.floor, world.ceiling, tops]
    begin = np.cumsum([0] + [paint.shape[0] * paint.shape[1] for paint in paints]).tolist()
    colours = np.zeros((begin[-1], 4), np.uint8)
    colours[:, :3] = np.concatenate([paint.reshape(-1, 3) for paint in paints])
    rows = np.array([paint.shape[1] for paint in paints])
    return Scene(world, colours.view(np.uint32)[:, 0], np.array(begin[:-4]), rows, *begin[-4:-1])


def cast(scene, rays, eye, heading):
    """Find the colours uint8 [n, 4] (the last byte unused) that the rays from `eye` [3] meet."""
    index = np.zeros(len(rays.azimuth), np.int32)
    c, s = np.float32(np.cos(heading)), np.float32(np.sin(heading))
    dx, dy = c * rays.cosine - s * rays.sine, s * rays.cosine + c * rays.sine
    for begin, end, faces in _sectors(scene.world, rays.azimuth, eye, heading):
        part = slice(begin, end)
        for i, face in enumerate(faces):
            paint = _paint_wall if i == 0 else _paint_box
            paint(scene, face, eye, dx[part], dy[part], rays.slope[part], index[part])
    return scene.colours[index].view(np.uint8).reshape(-1, 4)


def _sectors(world, azimuth, eye, heading):
    """Yield (begin, end, faces from back to front) of each sector of the sorted azimuths [n]."""
    to_start, to_end = world.start - eye[:2], world.end - eye[:2]
    facing = to_start[:, 0] * to_end[:, 1] - to_start[:, 1] * to_end[:, 0] > 0
    face = np.flatnonzero(facing)
    first, last = (
        (np.arctan2(to[face, 1], to[face, 0]) - heading + pi) % (2 * pi) - pi
        for to in (to_start, to_end)
    )
    border = np.unique(np.concatenate([first, last, [-pi, pi]]))
    middle = (border[1:] + border[:-1])[:, None] / 2
    covers = (middle - first) % (2 * pi) < (last - first) % (2 * pi)
    span = world.end[face] - world.start[face]
    normal = np.stack([-span[:, 1], span[:, 0]], -1)
    depth = np.sum(to_start[face] * normal, -1)
    turned = middle + heading
    with np.errstate(divide="ignore"):
        reach = depth / (np.cos(turned) * normal[:, 0] + np.sin(turned) * normal[:, 1])
    order = np.argsort(np.where(covers, -reach, np.inf), axis=1)
    bounds = np.searchsorted(azimuth, border)
    bounds[-1] = len(azimuth)
    for k, count in enumerate(covers.sum(1)):
        if bounds[k + 1] > bounds[k]:
            yield bounds[k], bounds[k + 1], face[order[k, :count]]


def _intersect(scene, face, eye, dx, dy, slope):
    """Intersect rays with a face's plane: height, and index into the face's colours."""
    start = scene.world.start[face] - eye[:2]
    span = scene.world.end[face] - scene.world.start[face]
    ex, ey = (span / np.hypot(*span)).tolist()
    sx, sy = start.tolist()
    reach = np.float32(sx * ey - sy * ex) / (dx * np.float32(ey) - dy * np.float32(ex))
    column = reach * (dx * np.float32(ex / TEXEL) + dy * np.float32(ey / TEXEL))
    column -= np.float32((sx * ex + sy * ey) / TEXEL)
    rows, columns = scene.rows[face], round(np.hypot(*span) / TEXEL)
    height = reach * slope + np.float32(eye[2])
    index = np.clip(column.astype(np.int32), 0, columns - 1) * np.int32(rows)
    return height, index + (height * np.float32(1 / TEXEL)).astype(np.int32)


def _paint_wall(scene, face, eye, dx, dy, slope, index):
    """Paint a wall, the floor below it and the ceiling above."""
    height, texel = _intersect(scene, face, eye, dx, dy, slope)
    index[:] = texel + np.int32(scene.face[face])
    for level, begin, at in (
        (0.0, scene.floor, np.flatnonzero(height < 0)),
        (HEIGHT, scene.ceiling, np.flatnonzero(height >= HEIGHT)),
    ):
        if len(at):
            reach = np.float32((level - eye[2]) / FLAT_TEXEL) / slope[at]
            x = (reach * dx[at] + np.float32(eye[0] / FLAT_TEXEL)).astype(np.int32)
            y = (reach * dy[at] + np.float32(eye[1] / FLAT_TEXEL)).astype(np.int32)
            columns, rows = round(WIDTH / FLAT_TEXEL), round(DEPTH / FLAT_TEXEL)
            x, y = np.clip(x, 0, columns - 1), np.clip(y, 0, rows - 1)
            index[at] = begin + x * rows + y


def _paint_box(scene, face, eye, dx, dy, slope, index):
    """Paint a box's face, and its top where it is visible from above."""
    world = scene.world
    top, owner = world.top[face], world.owner[face]
    if top < eye[2]:
        at = np.flatnonzero(slope < 0)
        reach = np.float32(top - eye[2]) / slope[at]
        point = np.stack([eye[0] + reach * dx[at], eye[1] + reach * dy[at]], -1)
        index[at[distance_outside(world.boxes[owner], point).max(-1) < 0]] = scene.tops + owner
    height, texel = _intersect(scene, face, eye, dx, dy, slope)
    np.copyto(index, texel + np.int32(scene.face[face]), where=(height >= 0) & (height < top))


def expose(scene, rays, eye, heading, light=1.0):
    """Make the image float32 [H, W, 3] of 0..1, with `light` [P, 3] (or 1) on the scene."""
    colours = np.empty((len(rays.flat_index), 4), np.uint8)
    colours[rays.flat_index] = cast(scene, rays, eye, heading)
    colours = colours.reshape(len(rays.pixel), -1, 4)
    mean = colours.sum(axis=1, dtype=np.uint16)[:, :3] * np.float32(1 / 255 / colours.shape[1])
    image = rays.dark.copy()
    flat = image.reshape(-1, 3)
    flat[rays.pixel] += rays.share * (mean * light - flat[rays.pixel])
    return image
