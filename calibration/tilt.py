"""How far the camera's axis leans from gravity, from the vertical lines of ordinary images.

Lines that are vertical in the world all lie in planes through the camera that contain "up". So up
is what is perpendicular to the normals of the planes of many lines: a robust least squares problem
in two unknowns. Lines are looked for with a generous slope first, then again in views that are
nearly upright. Images should come from several places: what leans in a room leans in every image
of it taken from one place.
"""

from dataclasses import dataclass, replace
from math import degrees
from typing import NamedTuple

import numpy as np

from jaxslam.vision.camera import tilt_matrix
from jaxslam.vision.edges import PAD, find_edges
from jaxslam.vision.images import check_size
from jaxslam.vision.panorama import directions, panorama, unwrap

PASSES = (
    (0.12, 0.25),
    (0.03, 0.12),
    (0.02, 0.08),
    (0.01, 0.08),
)  # tilt [rad] and slope [columns per row] allowed
LARGEST = 0.17  # rad, of the tilt that is found
LENGTH, GAP = 0.18, 0.03  # rad, of the lines used
CONTRAST, SIGNIFICANCE = 1.2, 5.0  # grey levels per column; times the noise
LEAST_LINES = 12
LEAST_PER_IMAGE = 5  # lines, for an estimate from one image alone
BLOCK, FLOOR = 7, 0.1  # rows whose peaks go together; columns, error of their mean at best
GRID = 41  # trial tilts each way
SPREAD = 0.004  # rad: how far from its plane up may be for a line that is vertical, at the start
ONE_SIDED = 0.05  # spread of the lines' azimuths [rad] that is too little
BIWEIGHT = 4.685  # robust standard deviations


@dataclass(frozen=True, eq=False)
class Tilt:
    """`roll` and `pitch` [rad] of the camera as a `Camera` takes them, `covariance` [2, 2] of them.

    `lines` used of `candidates` in `images` images; `per_image` (name, roll, pitch, lines) of those
    with enough of their own; `scatter` [rad] of a line about it; `skipped` images by reason.
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
    """`Tilt` of a camera from images: an `Images` or a list of (name, image or `ValueError`).

    Raises `ValueError` when there are too few vertical lines, all on one side, or far off.
    """
    total, given = len(PASSES) * len(images), camera
    for step, (most, slope) in enumerate(PASSES):
        before = step * len(images)

        def report(done, before=before):
            if progress:
                progress(before + done, total)

        found, names, skipped = _find_lines(images, camera, slope, report)
        lines = _join(found, skipped)
        up, weight = _fit_up(lines, most)
        looked, camera = camera, camera_with_up(camera, up)
    _check_change(given, camera)
    kept = weight > 0
    residual = lines.normal[kept] @ up
    return Tilt(
        roll=camera.roll,
        pitch=camera.pitch,
        covariance=_covariance(lines, up, weight),
        lines=int(kept.sum()),
        candidates=len(weight),
        images=len(found),
        scatter=float(1.4826 * np.median(np.abs(residual))),
        per_image=_per_image(lines, weight, looked, names),
        skipped=skipped,
    )


def camera_with_tilt(camera, found):
    """The camera with the roll and pitch of a `Tilt`."""
    return replace(camera, roll=found.roll, pitch=found.pitch)


def describe(found):
    """Two lines for whoever turns the screws of the mount."""
    roll_error, pitch_error = np.degrees(np.sqrt(np.diag(found.covariance)))
    front = "raise the front" if found.pitch > 0 else "lower the front"
    left = "lower the left" if found.roll > 0 else "raise the left"
    return "\n".join(
        f"{name} {angle:+.2f} +- {error:.2f} deg: {what} by {abs(angle):.2f} deg"
        for name, angle, error, what in (
            ("pitch", degrees(found.pitch), pitch_error, front),
            ("roll", degrees(found.roll), roll_error, left),
        )
    )


def camera_with_up(camera, up):
    """The camera turned so that what it takes for the direction `up` [3] points up; yaw is kept."""
    x, y, z = tilt_matrix(camera.roll, camera.pitch).T @ (up / np.linalg.norm(up))
    return replace(camera, roll=float(np.arctan2(y, z)), pitch=float(-np.arcsin(x)))


def _check_change(given, found):
    # the last row of a matrix is up, in the model's frame
    change = np.arccos(np.clip(given.matrix[2] @ found.matrix[2], -1, 1))
    if change > LARGEST:
        raise ValueError(
            f"tilt: {degrees(change):.0f} deg from the camera file's own; at most "
            f"{degrees(LARGEST):.0f} can be found: check its calibration, mirror and lens"
        )


def _find_lines(images, camera, slope, report):
    """`Normals` of each usable image, all names, and the skipped images' reasons with counts."""
    found, names, skipped, first = [], [], {}, {}
    for index, (name, image) in enumerate(images):
        names.append(name)
        try:
            if isinstance(image, ValueError):
                raise image
            check_size(image, camera, name)
        except ValueError as error:
            reason = str(error).split(": ", 1)[-1]  # without the path: alike ones are counted
            first.setdefault(reason, name)
            skipped[reason] = skipped.get(reason, 0) + 1
        else:
            found.append(_normals(image, camera, slope, index))
        report(index + 1)
    return found, names, {f"{why} (first: {first[why]})": n for why, n in skipped.items()}


def _normals(image, camera, slope, index):
    """`Normals` of one image's nearly vertical lines."""
    view = panorama(camera)
    spacing = (view.elevation[0] - view.elevation[-1]) / (len(view.elevation) - 1)
    length, gap = (max(2, round(angle / spacing)) for angle in (LENGTH, GAP))
    edges = find_edges(unwrap(image, view), view.valid, CONTRAST, SIGNIFICANCE, length, gap, slope)
    n = int(edges.segment.max(initial=-1)) + 1
    ray = directions(view.bearing(edges.column - PAD), view.elevation[edges.row])
    moment = np.stack(
        [np.bincount(edges.segment, a * b, n) for a in ray.T for b in ray.T], -1
    ).reshape(n, 3, 3)
    value, vector = np.linalg.eigh(moment)
    count = np.bincount(edges.segment, minlength=n)
    # A normal turns about the line's middle by its points' scatter, of rows in blocks, over their
    # lever.
    variance = BLOCK * value[:, 0] / np.maximum(count, 1) + (FLOOR * view.step) ** 2
    sigma = np.sqrt(variance / np.maximum(value[:, 1], 1e-12))
    middle = np.bincount(edges.segment, edges.column, n) / count
    once = (middle >= PAD - 0.5) & (middle < PAD + len(view.azimuth) - 0.5)
    return Normals(vector[once, :, 0], sigma[once], np.full(int(once.sum()), index))


def _join(found, skipped):
    lines = sum(len(normals.sigma) for normals in found)
    if lines < LEAST_LINES:
        reasons = "".join(f"; {count} skipped: {reason}" for reason, count in skipped.items())
        raise ValueError(
            f"tilt: {lines} nearly vertical lines in {len(found)} images; at least {LEAST_LINES} "
            f"are needed, of images that are bright and sharp{reasons}"
        )
    return Normals(*(np.concatenate(part) for part in zip(*found, strict=True)))


def _fit_up(lines, most):
    """Up [3] (z = 1) within `most` [rad] of z, and the lines' weights [n]: 0 for what leans."""
    trial = np.linspace(-most, most, GRID)
    x, y = (part.ravel() for part in np.meshgrid(trial, trial))
    spread = np.hypot(lines.sigma, SPREAD)
    away = np.abs(lines.normal @ np.stack([x, y, np.ones_like(x)])) / spread[:, None]
    best = np.argmin(np.minimum(away**2, 9.0).sum(axis=0))
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
    """Covariance [2, 2] of (roll, pitch), from how the lines scatter (sandwich)."""
    # d roll = -d(up_y), d pitch = d(up_x) near level, so (roll, pitch) has rows (n_y, n_x).
    design = lines.normal[:, [1, 0]] * [1.0, -1.0]
    bread = np.linalg.inv((design * weight[:, None]).T @ design)
    score = design * (weight * (lines.normal @ up))[:, None]
    return bread @ (score.T @ score) @ bread


def _per_image(lines, weight, camera, names):
    """(name, roll, pitch, lines) of the images with enough lines of their own."""
    rows = []
    for index, name in enumerate(names):
        mine = (lines.image == index) & (weight > 0)
        if mine.sum() < LEAST_PER_IMAGE:
            continue
        normal = lines.normal[mine] * np.sqrt(weight[mine])[:, None]
        xy = np.linalg.lstsq(normal[:, :2], -normal[:, 2], rcond=None)[0]
        one = camera_with_up(camera, np.array([*xy, 1.0]))
        rows.append((name, one.roll, one.pitch, int(mine.sum())))
    return rows
