"""What the boards cover of the image, and how sure the bearings are there."""

from typing import NamedTuple

import numpy as np

from calibration.bundle import derivatives

RINGS, SECTORS = 5, 12
FROM_AXIS = np.radians(30.0)  # azimuth is judged from here on: it has no meaning on the axis
GRID = 24  # radii and azimuths of the map of uncertainty


class Coverage(NamedTuple):
    """Corners counted in equal rings of radius and sectors of azimuth [RINGS, SECTORS]."""

    count: np.ndarray
    radius: tuple  # px from the centre: nearest and farthest corner
    angle: tuple  # rad from the optical axis of these
    gap: float  # rad: the largest range of azimuth without a corner
    distance: np.ndarray  # [B] m of the boards


class Bearings(NamedTuple):
    """Standard deviations, rad [radius, azimuth], on the pixels [.., .., 2] of a polar grid: of
    azimuth, NaN outside the image and near the axis, and of the angle from the axis. RMS and
    maximum in degrees, of azimuth."""

    sigma: np.ndarray
    polar: np.ndarray
    pixel: np.ndarray
    rms_deg: float
    max_deg: float


def coverage(camera, corners, distance):
    """`Coverage` of `Corners` whose boards are `distance` [B] m away."""
    apart = corners.pixel - camera.params[:2]
    radius, azimuth = np.hypot(*apart.T), np.arctan2(*apart.T[::-1])
    count, _, _ = np.histogram2d(
        radius, azimuth, (RINGS, SECTORS), ((0, radius.max()), (-np.pi, np.pi))
    )
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
    """Change of azimuth (about the model's z) and of the angle from z, [n, k] rad each, when unit
    rays [n, 3] change by [n, 3, k].

    The rotation common to all, which the boards' poses and the mounting take up, is removed.
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
    across = np.linalg.svd(ray[:, None])[2][:, 1:].mT  # [n, 3, 2]: the plane square to the ray
    return -across @ np.linalg.solve(by_ray @ across, by_params)


def bearing_uncertainty(camera, radius):
    """`Bearings` of a camera with a covariance, within radii (low, high) px."""
    pixel = polar_pixels(camera, radius)
    ray = camera.ray(pixel)
    usable = np.isfinite(ray).all(-1) & (ray[..., 2] < np.cos(FROM_AXIS))
    if not usable.any():  # a narrow lens
        usable = np.isfinite(ray).all(-1)
    by_params = angle_change(ray[usable], ray_change(camera, pixel[usable], ray[usable]))
    sigma = np.full((2, *usable.shape), np.nan)
    for into, by in zip(sigma, by_params, strict=True):
        into[usable] = np.sqrt(np.einsum("np,pq,nq->n", by, camera.covariance, by).clip(0))
    degrees = np.degrees(sigma[0][usable])
    return Bearings(*sigma, pixel, float(np.sqrt(np.mean(degrees**2))), float(degrees.max()))


def azimuth_error(camera, true, radius):
    """Azimuth error [n] rad of a camera against the true one, the common rotation removed, and
    its stated standard deviation [n]: at the pixels of `bearings`."""
    known = bearing_uncertainty(camera, radius)
    usable = np.isfinite(known.sigma)
    pixel = known.pixel[usable]
    ray, real = camera.ray(pixel), true.ray(pixel)
    inside = np.isfinite(real).all(1)
    error = angle_change(real[inside], (ray - real)[inside, :, None])[0][:, 0]
    return error, known.sigma[usable][inside]


def list_warnings(corners, names, cover, uncertain):
    """What is doubtful about a set of boards: sentences for the user."""
    told = []
    if corners.boards < 6:
        told.append(f"only {corners.boards} boards: 10 or more all round are advised")
    if cover.gap > np.radians(120):
        told.append(
            f"no corner in {np.degrees(cover.gap):.0f}° of azimuth: move the board all round"
        )
    if cover.distance.max() < 1.15 * cover.distance.min():
        told.append("all boards are at one distance: bring some nearer and some farther away")
    if cover.radius[0] > 0.7 * cover.radius[1]:
        told.append("the corners lie in one narrow ring: move the board inwards and outwards")
    if uncertain.rms_deg > 0.1:
        told.append(f"bearings are known to {uncertain.rms_deg:.2f}° only: take more boards")
    views = [corners.pixel[corners.board == b] for b in range(corners.boards)]
    twins = []
    for i, view in enumerate(views):
        same = (view.shape == v.shape and np.abs(view - v).max() < 0.01 for v in views[:i])
        twins += [(j, i) for j, found in enumerate(same) if found][:1]
    if twins:
        more = f" ({len(twins) - 1} more are twice there)" if len(twins) > 1 else ""
        j, i = twins[0]
        told.append(f"{names[j]} and {names[i]} are the same picture: one counts twice{more}")
    return told
