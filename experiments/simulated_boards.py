"""Simulate chessboards in front of a known camera, to test a calibration."""

import numpy as np

from calibration.bundle import rotation
from calibration.corners import board_points
from calibration.coverage import angle_change, bearing_uncertainty


def simulate_boards(
    camera, boards=25, noise=0.1, seed=0, board=(6, 7), square=0.03, distance=(0.1, 0.3), tilt=0.6
):
    """Simulate boards fully within the usable part of the image: pixels (a list of [n, 2]) with
    normal noise [px], and points [n, 2] m on the board.

    The boards' centres are at all azimuths and usable elevations, at `distance` (low, high) m. They
    face the camera up to turns about random axes of standard deviation `tilt` / 2 rad. Raises
    `ValueError` if too few boards fit into the view.
    """
    rng, points = np.random.default_rng(seed), board_points(board, square)
    middle = np.column_stack([points - points.mean(0), np.zeros(len(points))])
    low, high = np.sin(camera.elevation)
    pixels = []
    for _ in range(400 * boards):
        azimuth = 2 * np.pi * (len(pixels) + rng.uniform()) / boards  # all round
        rise = np.arcsin(rng.uniform(low, high))
        towards = [np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)]
        towards = np.array(towards) @ camera.matrix  # in the model frame
        facing = _facing(towards) @ rotation(np.array([0, 0, rng.uniform(-np.pi, np.pi)]))
        facing = rotation(rng.normal(0, tilt / 2, 3)) @ facing
        corner = middle @ facing.T + rng.uniform(*distance) * towards
        up = np.arcsin((corner @ camera.matrix.T)[:, 2] / np.linalg.norm(corner, axis=1))
        pixel = camera.pixel(corner)
        usable = (up > camera.elevation[0]) & (up < camera.elevation[1])
        if np.isfinite(pixel).all() and usable.all():
            pixels.append(pixel + rng.normal(0, noise, pixel.shape))
        if len(pixels) == boards:
            return pixels, points
    raise ValueError(
        f"only {len(pixels)} of {boards} boards fit into the view: change their distance"
    )


def _facing(towards):
    """Rotation [3, 3] whose third column is the unit vector `towards`."""
    first = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(towards, first), towards], 1)


def azimuth_error(camera, true, radius):
    """Azimuth error [n] rad of a camera against the true one, without the common rotation, and its
    standard deviation [n] by `bearing_uncertainty`, at the same pixels."""
    stated = bearing_uncertainty(camera, radius)
    usable = np.isfinite(stated.sigma)
    pixel = stated.pixel[usable]
    ray, real = camera.ray(pixel), true.ray(pixel)
    inside = np.isfinite(real).all(1)
    error = angle_change(real[inside], (ray - real)[inside, :, None])[0][:, 0]
    return error, stated.sigma[usable][inside]
