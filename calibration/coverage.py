"""Coverage of the image by the boards, and the uncertainty of bearings."""

from typing import NamedTuple

import numpy as np

from calibration.bundle import derivatives

RINGS, SECTORS = 5, 12
FROM_AXIS = np.radians(30.0)  # least angle from the axis, where azimuth is undefined
GRID = 24  # radii and azimuths of the map of uncertainty


class Coverage(NamedTuple):
    """Number of corners in equal rings of radius and sectors of azimuth [RINGS, SECTORS]."""

    count: np.ndarray
    radius: tuple  # px from the centre: nearest and farthest corner
    angle: tuple  # rad from the optical axis: least and largest
    gap: float  # rad: the largest range of azimuth without a corner
    distance: np.ndarray  # [B] m of the boards


class Bearings(NamedTuple):
    """Standard deviations [GRID, GRID] rad at the pixels [GRID, GRID, 2] of a polar grid (radius,
    azimuth): `sigma` of azimuth, NaN outside the image and near the axis, and `polar`, of the angle
    from the axis. RMS and maximum of `sigma` in degrees."""

    sigma: np.ndarray
    polar: np.ndarray
    pixel: np.ndarray
    rms_deg: float
    max_deg: float


def coverage(camera, corners, distance):
    """`Coverage` of `Corners` on boards at `distance` [B] m."""
    offset = corners.pixel - camera.params[:2]
    radius, azimuth = np.hypot(*offset.T), np.arctan2(*offset.T[::-1])
    limits = (0, radius.max()), (-np.pi, np.pi)
    count, _, _ = np.histogram2d(radius, azimuth, (RINGS, SECTORS), limits)
    around = np.sort(azimuth)
    gap = np.diff(around, append=around[0] + 2 * np.pi).max()
    angle = np.arccos(np.clip(camera.ray(corners.pixel)[:, 2], -1, 1))
    radii, angles = ((float(x.min()), float(x.max())) for x in (radius, angle))
    return Coverage(count.astype(int), radii, angles, float(gap), distance)


def polar_pixels(camera, radius):
    """Pixels [GRID, GRID, 2] of a polar grid over radii (low, high) px."""
    rho = np.linspace(*radius, GRID)[:, None]
    around = np.arange(GRID) * 2 * np.pi / GRID
    return np.stack([rho * np.cos(around), rho * np.sin(around)], -1) + camera.params[:2]


def angle_change(ray, change):
    """Changes of azimuth (about the model's z) and of the angle from z, [n, k] rad each, of unit
    rays [n, 3] that change by `change` [n, 3, k].

    The common rotation, which the boards' poses and the mounting absorb, is removed.
    """
    turn = np.cross(np.eye(3)[None], ray[:, None]).transpose(0, 2, 1)  # w x ray = turn @ w
    design, flat = turn.reshape(-1, 3), change.reshape(3 * len(ray), -1)
    rest = (flat - design @ np.linalg.lstsq(design, flat)[0]).reshape(change.shape)
    x, y, z = (ray[:, i : i + 1] for i in range(3))
    square = x**2 + y**2
    outwards = (x * rest[:, 0] + y * rest[:, 1]) / np.sqrt(square)
    return (x * rest[:, 1] - y * rest[:, 0]) / square, z * outwards - np.sqrt(square) * rest[:, 2]


def ray_change(camera, pixel, ray):
    """d ray / d params [n, 3, P] at fixed pixels, by the implicit function theorem."""
    _, by_params, by_ray = derivatives(camera.model, camera.size, camera.params, ray)
    across = np.linalg.svd(ray[:, None])[2][:, 1:].mT  # [n, 3, 2]: plane normal to the ray
    return -across @ np.linalg.solve(by_ray @ across, by_params)


def bearing_uncertainty(camera, radius):
    """`Bearings` of a camera that has a covariance, within radii (low, high) px."""
    pixel = polar_pixels(camera, radius)
    ray = camera.ray(pixel)
    usable = np.isfinite(ray).all(-1) & (ray[..., 2] < np.cos(FROM_AXIS))
    if not usable.any():  # a narrow lens
        usable = np.isfinite(ray).all(-1)
    by_params = angle_change(ray[usable], ray_change(camera, pixel[usable], ray[usable]))
    sigma = np.full((2, *usable.shape), np.nan)
    for target, by in zip(sigma, by_params, strict=True):
        target[usable] = np.sqrt(np.einsum("np,pq,nq->n", by, camera.covariance, by).clip(0))
    degrees = np.degrees(sigma[0][usable])
    return Bearings(*sigma, pixel, float(np.sqrt(np.mean(degrees**2))), float(degrees.max()))


def list_warnings(corners, names, cover, uncertain):
    """List the weaknesses of a set of boards, in sentences for the user."""
    found = []
    if corners.boards < 6:
        found.append(f"only {corners.boards} boards: 10 or more all round are advised")
    if cover.gap > np.radians(120):
        gap = f"{np.degrees(cover.gap):.0f}° of azimuth"
        found.append(f"no corner in {gap}: move the board all round")
    if cover.distance.max() < 1.15 * cover.distance.min():
        found.append("all boards are at one distance: bring some nearer and some farther away")
    if cover.radius[0] > 0.7 * cover.radius[1]:
        found.append("the corners lie in one narrow ring: move the board inwards and outwards")
    if uncertain.rms_deg > 0.1:
        found.append(f"bearings are known to {uncertain.rms_deg:.2f}° only: take more boards")
    views = [corners.pixel[corners.board == b] for b in range(corners.boards)]
    duplicates = []
    for i, view in enumerate(views):
        equal = (view.shape == v.shape and np.abs(view - v).max() < 0.01 for v in views[:i])
        duplicates += [(j, i) for j, same in enumerate(equal) if same][:1]
    if duplicates:
        more = f" ({len(duplicates) - 1} more like this)" if len(duplicates) > 1 else ""
        j, i = duplicates[0]
        found.append(f"{names[j]} and {names[i]} are the same picture, which counts twice{more}")
    return found
