"""Tilt of the camera's axis against gravity, from the vertical lines of ordinary images.

A vertical line of the world and the camera span a plane that contains "up". So up is perpendicular
to the normals of these planes: a robust least squares problem with two unknowns. Lines are searched
with a large slope first, and then again in views that are nearly upright. Images should come from
several places, since an object that leans does so in every image from one place.
"""

from dataclasses import dataclass, replace
from math import degrees
from typing import NamedTuple

import numpy as np

from jaxslam.vision.camera import tilt_matrix
from jaxslam.vision.edges import PAD, find_edges
from jaxslam.vision.images import check_size
from jaxslam.vision.panorama import directions, panorama, unwrap

# Largest tilt [rad] and slope [columns per row] of each pass.
PASSES = ((0.12, 0.25), (0.03, 0.12), (0.02, 0.08), (0.01, 0.08))
LARGEST = 0.17  # rad, the largest tilt that can be found
LENGTH, GAP = 0.18, 0.03  # rad, least length and largest gap of a line
CONTRAST, SIGNIFICANCE = 1.2, 5.0  # grey levels per column; times the noise
LEAST_LINES = 12
LEAST_PER_IMAGE = 5  # lines, for an estimate from one image alone
BLOCK, FLOOR = 7, 0.1  # rows with correlated errors; columns, least error of a line's mean
GRID = 41  # trial tilts along each axis
SPREAD = 0.004  # rad, initial standard deviation of a line's lean
ONE_SIDED = 0.05  # spread of the lines' azimuths [rad] below which the tilt is undetermined
BIWEIGHT = 4.685  # robust standard deviations


@dataclass(frozen=True, eq=False)
class Tilt:
    """`roll` and `pitch` [rad] of the camera, as in `Camera`, and their `covariance` [2, 2].

    `lines` used of `candidates` in `images` images, `skipped` by reason; `per_image` (name, roll,
    pitch, lines) of those with enough; `scatter` [rad]: robust deviation from the vertical.
    """

    roll: float
    pitch: float
    covariance: np.ndarray
    lines: int
    candidates: int
    images: int
    scatter: float
    per_image: list[tuple[str, float, float, int]]
    skipped: dict[str, int]


class Normals(NamedTuple):
    """`normal` [n, 3] of the lines' planes in the robot's frame, `sigma` [n] rad, `image` [n]."""

    normal: np.ndarray
    sigma: np.ndarray
    image: np.ndarray


def find_tilt(images, camera, progress=None):
    """Find the `Tilt` of a camera from `Images` or a list of (name, image or `ValueError`).

    `progress(done, total)` in images, over all passes. Raises `ValueError` if there are too few
    vertical lines, all are in one direction, or the tilt is too large.
    """
    total, nominal = len(PASSES) * len(images), camera
    for step, (most, slope) in enumerate(PASSES):
        before = step * len(images)

        def report(done, before=before):
            if progress:
                progress(before + done, total)

        normals, names, skipped = _find_lines(images, camera, slope, report)
        lines = _join(normals, skipped)
        up, weight = _fit_up(lines, most)
        previous, camera = camera, camera_with_up(camera, up)
    _check_change(nominal, camera)
    kept = weight > 0
    counts = int(kept.sum()), len(weight), len(normals)
    scatter = float(1.4826 * np.median(np.abs(lines.normal[kept] @ up)))
    covariance, per_image = (
        _covariance(lines, up, weight),
        _per_image(lines, weight, previous, names),
    )
    return Tilt(camera.roll, camera.pitch, covariance, *counts, scatter, per_image, skipped)


def camera_with_tilt(camera, tilt):
    """The camera with the roll and pitch of a `Tilt`."""
    return replace(camera, roll=tilt.roll, pitch=tilt.pitch)


def describe(tilt):
    """Instructions to level the mount, in two lines."""
    roll_error, pitch_error = np.degrees(np.sqrt(np.diag(tilt.covariance)))
    pitch, roll = degrees(tilt.pitch), degrees(tilt.roll)
    front = f"{'raise' if pitch > 0 else 'lower'} the front by {abs(pitch):.2f} deg"
    left = f"{'lower' if roll > 0 else 'raise'} the left by {abs(roll):.2f} deg"
    return (
        f"pitch {pitch:+.2f} +- {pitch_error:.2f} deg: {front}\n"
        f"roll {roll:+.2f} +- {roll_error:.2f} deg: {left}"
    )


def camera_with_up(camera, up):
    """The camera turned so that the direction `up` [3] becomes vertical; yaw is kept."""
    x, y, z = tilt_matrix(camera.roll, camera.pitch).T @ (up / np.linalg.norm(up))
    return replace(camera, roll=float(np.arctan2(y, z)), pitch=float(-np.arcsin(x)))


def _check_change(nominal, camera):
    """Raise `ValueError` if the tilt between two cameras is too large to be found reliably."""
    # The last row of `Camera.matrix` is "up" in the model's frame.
    change = np.arccos(np.clip(nominal.matrix[2] @ camera.matrix[2], -1, 1))
    if change > LARGEST:
        raise ValueError(
            f"tilt: {degrees(change):.0f} deg from that of the camera file; at most "
            f"{degrees(LARGEST):.0f} can be found: check its calibration, mirror and lens"
        )


def _find_lines(images, camera, slope, report):
    """`Normals` of each usable image, names of all, and counts of skipped images by reason."""
    normals, names, skipped, first = [], [], {}, {}
    for index, (name, image) in enumerate(images):
        names.append(name)
        try:
            if isinstance(image, ValueError):
                raise image
            check_size(image, camera, name)
        except ValueError as error:
            reason = str(error).split(": ", 1)[-1]  # without the path, to count equal reasons
            first.setdefault(reason, name)
            skipped[reason] = skipped.get(reason, 0) + 1
        else:
            normals.append(_normals(image, camera, slope, index))
        report(index + 1)
    return normals, names, {f"{why} (first: {first[why]})": n for why, n in skipped.items()}


def _normals(image, camera, slope, index):
    """`Normals` of one image's nearly vertical lines."""
    view = panorama(camera)
    length, gap = (max(2, round(angle / view.row_height)) for angle in (LENGTH, GAP))
    edges = find_edges(unwrap(image, view), view.valid, CONTRAST, SIGNIFICANCE, length, gap, slope)
    n = int(edges.segment.max(initial=-1)) + 1
    ray = directions(view.bearing(edges.column - PAD), view.elevation[edges.row])
    products = [np.bincount(edges.segment, a * b, n) for a in ray.T for b in ray.T]
    value, vector = np.linalg.eigh(np.stack(products, -1).reshape(n, 3, 3))
    count = np.bincount(edges.segment, minlength=n)
    # A normal turns about the line's middle by the scatter of its points, in blocks of rows, over
    # their lever.
    variance = BLOCK * value[:, 0] / np.maximum(count, 1) + (FLOOR * view.step) ** 2
    sigma = np.sqrt(variance / np.maximum(value[:, 1], 1e-12))
    middle = np.bincount(edges.segment, edges.column, n) / count
    inside = (middle >= PAD - 0.5) & (middle < PAD + len(view.azimuth) - 0.5)
    return Normals(vector[inside, :, 0], sigma[inside], np.full(int(inside.sum()), index))


def _join(images, skipped):
    """Concatenate the `Normals` of images. Raises `ValueError` for too few lines."""
    lines = sum(len(normals.sigma) for normals in images)
    if lines < LEAST_LINES:
        reasons = "".join(f"; {count} skipped: {reason}" for reason, count in skipped.items())
        raise ValueError(
            f"tilt: {lines} nearly vertical lines in {len(images)} images; at least {LEAST_LINES} "
            f"are needed, of images that are bright and sharp{reasons}"
        )
    return Normals(*(np.concatenate(part) for part in zip(*images, strict=True)))


def _fit_up(lines, most):
    """Fit up [3] (z = 1) within `most` [rad] of z; returns it, and weights [n], 0 for outliers."""
    trial = np.linspace(-most, most, GRID)
    x, y = (part.ravel() for part in np.meshgrid(trial, trial))
    spread = np.hypot(lines.sigma, SPREAD)
    misfit = np.abs(lines.normal @ np.stack([x, y, np.ones_like(x)])) / spread[:, None]
    best = np.argmin(np.minimum(misfit**2, 9.0).sum(axis=0))
    up = np.array([x[best], y[best], 1.0])
    for _ in range(20):
        residual = lines.normal @ up
        robust = np.maximum(1.4826 * np.median(np.abs(residual)), 1e-4)
        scale = BIWEIGHT * np.hypot(lines.sigma, min(robust, SPREAD))
        weight = np.clip(1 - (residual / scale) ** 2, 0, None) ** 2 / scale**2
        normal = lines.normal * np.sqrt(weight)[:, None]
        if np.linalg.matrix_rank(normal[:, :2], tol=ONE_SIDED * np.linalg.norm(normal)) < 2:
            raise ValueError("tilt: the vertical lines are all in one direction; turn the robot")
        up[:2] = np.linalg.lstsq(normal[:, :2], -normal[:, 2], rcond=None)[0]
    return up, weight


def _covariance(lines, up, weight):
    """Covariance [2, 2] of (roll, pitch), from the scatter of the lines (sandwich estimator)."""
    # d roll = -d(up_y), d pitch = d(up_x) near level, so (roll, pitch) has rows (n_y, n_x).
    design = lines.normal[:, [1, 0]] * [1.0, -1.0]
    bread = np.linalg.inv((design * weight[:, None]).T @ design)
    score = design * (weight * (lines.normal @ up))[:, None]
    return bread @ (score.T @ score) @ bread


def _per_image(lines, weight, camera, names):
    """(name, roll, pitch, number of lines) of the images with enough lines."""
    rows = []
    for index, name in enumerate(names):
        used = (lines.image == index) & (weight > 0)
        if used.sum() < LEAST_PER_IMAGE:
            continue
        normal = lines.normal[used] * np.sqrt(weight[used])[:, None]
        xy = np.linalg.lstsq(normal[:, :2], -normal[:, 2], rcond=None)[0]
        level = camera_with_up(camera, np.array([*xy, 1.0]))
        rows.append((name, level.roll, level.pitch, int(used.sum())))
    return rows
