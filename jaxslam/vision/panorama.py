"""Views of an omnidirectional image: panorama, perspective, bird's eye.

Each is a cached table of image coordinates computed from the calibrated camera, so that views are
free of misalignments of mirror, lens and mount.
"""

from functools import lru_cache
from math import pi
from typing import NamedTuple

import cv2
import numpy as np

LEAST_ROWS, MOST_ROWS = 16, 2048
CACHED = 8  # views kept; a panorama of 1,440 columns takes 3 MB


class Panorama(NamedTuple):
    """Azimuth over elevation, evenly spaced in both, left on the left.

    `azimuth` [W] rad, descending from pi to -pi: ahead is in the middle; `elevation` [H] rad,
    descending; both at the pixels' centres. `map_x`, `map_y`, `valid` as in `View`.
    """

    azimuth: np.ndarray
    elevation: np.ndarray
    map_x: np.ndarray
    map_y: np.ndarray
    valid: np.ndarray

    @property
    def step(self):
        """Spacing [rad] of the columns."""
        return 2 * pi / len(self.azimuth)

    @property
    def row_height(self):
        """Spacing [rad] of the rows."""
        return (self.elevation[0] - self.elevation[-1]) / (len(self.elevation) - 1)

    def bearing(self, column):
        """Azimuth [rad] in (-pi, pi] of fractional columns, also beyond the seam."""
        return _wrap(pi - (np.asarray(column) + 0.5) * self.step)

    def column(self, bearing):
        """Fractional column in [-0.5, W - 0.5) of an azimuth [rad]."""
        return (pi - np.asarray(bearing)) % (2 * pi) / self.step - 0.5

    def row(self, elevation):
        """Fractional row of an elevation [rad]."""
        up = self.elevation
        return (up[0] - np.asarray(elevation)) / (up[0] - up[-1]) * (len(up) - 1)


class View(NamedTuple):
    """`map_x`, `map_y` float32 [H, W]: image coordinates; `valid` bool [H, W]: inside the image."""

    map_x: np.ndarray
    map_y: np.ndarray
    valid: np.ndarray


@lru_cache(maxsize=CACHED)
def panorama(camera, columns=1440, elevation=None):
    """`Panorama` of a camera; cached, read-only.

    `elevation` (low, high) [rad], None: the camera's. The number of rows is that of the image's
    pixels between the two. Raises `ValueError` if the camera sees none of these elevations.
    """
    low, high = camera.elevation if elevation is None else elevation
    if not (isinstance(columns, int) and 16 <= columns <= 1 << 14):
        raise ValueError(f"panorama: {columns} columns; 16 to 16384 are allowed")
    if not -pi / 2 <= low < high <= pi / 2:
        raise ValueError(f"panorama: elevation {low:g}..{high:g} rad; must rise within +-pi/2")
    low, high, rows = _extent(camera, low, high)
    azimuth = pi - (np.arange(columns) + 0.5) * (2 * pi / columns)
    edges = np.linspace(high, low, rows + 1)
    up = (edges[1:] + edges[:-1]) / 2
    view = _view(camera, directions(azimuth[None, :], up[:, None]))
    return Panorama(_freeze(azimuth), _freeze(up), *view)


@lru_cache(maxsize=CACHED)
def perspective(camera, azimuth=0.0, elevation=0.0, field=pi / 2, width=640, height=480):
    """`View` of a pinhole camera pointing to (azimuth, elevation) [rad]; cached.

    `field` [rad]: horizontal angle of view. Black where the camera sees nothing. Raises
    `ValueError` for a field of 0, or pi and more.
    """
    if not 0 < field < pi:
        raise ValueError(f"perspective: field {field:g} rad; must be within 0 to pi")
    focal = width / 2 / np.tan(field / 2)
    right = (np.arange(width) - (width - 1) / 2)[None, :]
    down = (np.arange(height) - (height - 1) / 2)[:, None]
    ahead, left = directions(azimuth, elevation), directions(azimuth + pi / 2, 0.0)
    up = np.cross(ahead, left)
    return _view(camera, focal * ahead - right[..., None] * left - down[..., None] * up)


@lru_cache(maxsize=CACHED)
def birds_eye(camera, extent=4.0, size=512):
    """`View` of the floor from above with the robot's heading upwards; cached.

    `extent` [m]: half the side of a square around the robot's origin; `size` px. Black where the
    camera does not see the floor. Raises `ValueError` unless its height (`position`) is above 0.
    """
    if (height := camera.position[2]) <= 0:
        raise ValueError(f"birds_eye: the camera is {height:g} m above the floor; set its height")
    metres = extent * (1 - (2 * np.arange(size) + 1) / size)
    floor = np.stack([*np.meshgrid(metres, metres, indexing="ij"), np.zeros((size, size))], -1)
    return _view(camera, floor - np.array(camera.position))


def unwrap(image, view):
    """Resample the image [H, W] or [H, W, 3] as a `Panorama` or `View`; black outside the image."""
    return cv2.remap(image, view.map_x, view.map_y, cv2.INTER_LINEAR)


def _extent(camera, low, high):
    """Elevations (low, high) [rad] visible at any azimuth, and the number of pixels between."""
    up = np.linspace(low, high, 721)
    azimuth = np.linspace(-pi, pi, 72, endpoint=False)
    pixel = camera.project(directions(azimuth[:, None], up[None, :]))
    seen = np.flatnonzero(np.isfinite(pixel[..., 0]).any(0))
    if len(seen) < 2:
        raise ValueError(
            f"panorama: the camera sees nothing at elevations of {np.degrees(low):.1f} to "
            f"{np.degrees(high):.1f} deg; check its elevation, mirror and lens"
        )
    length = np.nansum(np.hypot(*np.moveaxis(np.diff(pixel, axis=1), -1, 0)), 1).max()
    return up[seen[0]], up[seen[-1]], int(np.clip(round(length), LEAST_ROWS, MOST_ROWS))


def directions(azimuth, elevation):
    """Unit directions [..., 3] of azimuths and elevations [rad]."""
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1)


def _view(camera, direction):
    """`View` of directions [H, W, 3] of any length in the robot's frame."""
    pixel = camera.project(direction)
    up = np.arcsin(direction[..., 2] / np.linalg.norm(direction, axis=-1))
    low, high = camera.elevation
    with np.errstate(invalid="ignore"):
        # Within the outermost pixels' centres, beyond which interpolation is impossible.
        valid = ((pixel >= 0) & (pixel <= np.array([camera.width, camera.height]) - 1)).all(-1)
    valid &= (up >= low - 1e-9) & (up <= high + 1e-9)
    pixel = np.where(valid[..., None], pixel, -2.0).astype(np.float32)
    return View(_freeze(pixel[..., 0].copy()), _freeze(pixel[..., 1].copy()), _freeze(valid))


def _freeze(array):
    array.setflags(write=False)
    return array


def _wrap(angle):
    """Wrap an angle [rad] to (-pi, pi]."""
    return pi - (pi - angle) % (2 * pi)
