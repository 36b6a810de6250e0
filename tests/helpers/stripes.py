"""For tests: a mirror camera, and a world of stripes whose borders are vertical lines."""

from functools import lru_cache

import cv2
import numpy as np

from jaxslam.vision.camera import Camera


def mirror_camera(**changes):
    """A double mirror's view, -5 to 65 degrees, 640 x 480, somewhat misaligned."""
    theta = np.radians(np.linspace(1, 97, 60))
    rho = 232 / 320 * theta / np.radians(95)
    powers = np.stack([rho**k for k in (0, 2, 3, 4, 5, 6)], 1)
    shape = np.linalg.lstsq(powers, rho / np.tan(theta), rcond=None)[0]
    params = np.array([322.3, 238.1, 1.0003, 1e-4, 1e-4, 1e-3, -5e-4, *shape])
    usual = {"elevation": (np.radians(-5), np.radians(65)), "position": (0.0, 0.0, 0.6)}
    return Camera(640, 480, "polynomial", params, **{**usual, **changes})


@lru_cache(maxsize=2)
def rays(camera, samples):
    """Pixels [P] (flat) that see something, and directions [P, samples, 3] spread over each."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    pixel = np.stack([u, v], -1).reshape(-1, 2)
    up = np.arcsin(camera.direction(pixel)[:, 2])
    low, high = camera.elevation
    seen = np.flatnonzero((up > low - 0.05) & (up < high + 0.05))
    k = np.arange(samples)[:, None]
    spread = (k + 0.5) * np.array([1 / samples, 0.6180339887]) % 1 - 0.5
    return seen, camera.direction(pixel[seen, None] + (spread if samples > 1 else 0.0))


def painted(camera, colour, samples=1):
    """The image [H, W, 3] of a world whose colour is a function of direction [..., 3]."""
    seen, direction = rays(camera, samples)
    image = np.zeros((camera.height * camera.width, 3))
    image[seen] = np.nan_to_num(colour(direction)).mean(1)
    return image.reshape(camera.height, camera.width, 3)


def photograph(picture, noise=0.0, blur=0.0, seed=0):
    """uint8 of a picture in grey levels, after blur [px] and noise [grey levels]."""
    if blur:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    noisy = picture + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def stripes(camera, azimuth, colour, low=-0.14, high=1.17, back=None, samples=10):
    """Picture of stripes: `colour[i]` from `azimuth[i]` (sorted, rad) to the next, wrapping round.

    Between elevations `low` and `high` [rad], scalars or one per stripe; elsewhere `back`.
    """
    colour = np.asarray(colour, float)
    low, high = (np.broadcast_to(np.asarray(end, float), len(azimuth)) for end in (low, high))
    back = np.zeros(3) if back is None else np.asarray(back, float)

    def seen(direction):
        with np.errstate(invalid="ignore"):
            i = np.searchsorted(azimuth, np.arctan2(direction[..., 1], direction[..., 0])) - 1
            up = np.arcsin(direction[..., 2])
            inside = (up > low[i]) & (up < high[i])
        return np.where(inside[..., None], colour[i], back)

    return painted(camera, seen, samples)


def room_of_stripes(camera, seed, count=30, noise=3.0, blur=0.5):
    """(azimuths [count], image): stripes of random widths, at least 2 degrees, and colours."""
    rng = np.random.default_rng(seed)
    gap = np.radians(2) + rng.dirichlet(np.full(count, 1.0)) * (2 * np.pi - count * np.radians(2))
    azimuth = np.sort((rng.uniform(0, 2 * np.pi) + np.cumsum(gap)) % (2 * np.pi) - np.pi)
    colour = rng.uniform(60, 200, (count, 3))
    colour[::2] *= 0.7  # neighbours differ
    return azimuth, photograph(stripes(camera, azimuth, colour), noise, blur, seed)
