"""Initial camera and board poses from the corners alone, without an initial guess.

Radial constraint (Tsai; Scaramuzza et al. 2006, their linear method): for any radial function, a
corner lies in the plane of the optical axis and its pixel. This determines the centre, and each
board's pose except for its height along the axis; the function and the heights then follow from
linear equations. Planar boards leave the sense of the axis open: z > 0 at the centre is chosen.
"""

import numpy as np

from calibration.bundle import Solution
from jaxslam.vision.camera import POLYNOMIAL

GRID = 9  # trial centres along each axis, in each round
ROUNDS = (0.4, 0.1, 0.025)  # half widths of the rounds' grids, in half image sides


def first_solution(corners):
    """Solve for the polynomial model with a0 and a2 only, from `Corners`: `Solution`."""
    half = max(corners.size) / 2
    boards = [corners.board == b for b in range(corners.boards)]
    points = [corners.point[b] for b in boards]
    centre = _find_centre([corners.pixel[b] / half for b in boards], points, np.array(corners.size))
    pixels = [corners.pixel[b] / half - centre for b in boards]
    poses = [_board_pose(*pair) for pair in zip(pixels, points, strict=True)]
    shape, poses = _fit_radial(pixels, points, poses)
    params = np.zeros(len(POLYNOMIAL))
    params[[0, 1, 2, 7, 8]] = *(half * centre), 1, *shape
    axes, translation = poses[..., :2], poses[..., 2]
    third = np.cross(axes[..., 0], axes[..., 1])
    left, _, right = np.linalg.svd(np.concatenate([axes, third[..., None]], -1))
    return Solution(params, left @ right, translation)


def _find_centre(pixels, points, size):
    """Find the centre [2], in half image sides, that fits the radial constraint best, on grids.

    The boards' misfits are summed, not their squares, since one board may be wrong.
    """
    best = (size - 1) / max(size)
    for width in ROUNDS:
        offset = np.linspace(-width, width, GRID)
        trial = best + np.stack(np.meshgrid(offset, offset), -1).reshape(-1, 2)
        misfit = np.zeros(len(trial))
        for pixel, point in zip(pixels, points, strict=True):
            radial = pixel - trial[:, None]
            lateral = _homography(radial, point) @ _homogeneous(point).T
            across = radial[..., 0] * lateral[:, 1] - radial[..., 1] * lateral[:, 0]
            misfit += np.sqrt(np.mean(across**2 / (lateral**2).sum(1), -1))
        best = trial[np.argmin(misfit)]
    return best


def _homography(pixel, point):
    """Matrix [..., 2, 3] from board points (X, Y, 1) to the directions of pixels [..., n, 2] about
    the centre, up to scale and sign: least squares solution of u P_y - v P_x = 0."""
    scale = np.abs(point).max()
    scaled = _homogeneous(point / scale)
    u, v = pixel[..., :1], pixel[..., 1:]
    design = np.concatenate([-v * scaled, u * scaled], -1)
    solution = np.linalg.eigh(design.mT @ design)[1][..., 0]
    return solution.reshape(*solution.shape[:-1], 2, 3) / [scale, scale, 1]


def _homogeneous(point):
    return np.concatenate([point, np.ones_like(point[:, :1])], 1)


def _board_pose(pixel, point):
    """Columns r1, r2, t [3, 3] of a board's pose, with t3 = 0 and an arbitrary sign of row 3."""
    lateral = _homography(pixel, point)
    side = (lateral @ _homogeneous(point).T * pixel.T).sum(0)
    lateral = lateral * (1 if np.median(side) > 0 else -1)  # corners lie towards their pixels
    (a, b), c = (lateral[:, :2] ** 2).sum(0), lateral[:, 0] @ lateral[:, 1]
    root = np.hypot(b - a, 2 * c)  # r1 and r2 must be orthogonal and of equal length
    up = np.sqrt(np.maximum([(root + b - a) / 2, (root - b + a) / 2], 0))
    up[1] *= -1 if c > 0 else 1
    return np.vstack([lateral, [*up, 0]]) / np.sqrt(a + up[0] ** 2)


def _fit_radial(pixels, points, poses):
    """Fit (a0, a2) of all boards together, and the third rows of their poses [B, 3, 3]."""
    poses = np.stack(poses)
    equations = [_equations(*each) for each in zip(pixels, points, poses, strict=True)]
    for pose, (shape, height, right) in zip(poses, equations, strict=True):
        a0 = np.linalg.lstsq(np.column_stack([shape, height]), right)[0][0]
        pose[2] *= np.sign(a0)
    for _ in range(10):  # a board's sign may be wrong by itself: all share one function
        signs = np.sign(poses[:, 2, :2].sum(1))
        fixed = [_equations(*each) for each in zip(pixels, points, poses, strict=True)]
        design = np.zeros((sum(len(f[2]) for f in fixed), 2 + len(poses)))
        design[:, :2] = np.concatenate([f[0] for f in fixed])
        end = np.cumsum([len(f[2]) for f in fixed])
        for b, (_, height, right) in enumerate(fixed):
            design[end[b] - len(right) : end[b], 2 + b] = height
        a = np.linalg.lstsq(design, np.concatenate([f[2] for f in fixed]))[0]
        shape = a[:2] * (np.sign(a[0]) or 1)
        for pose, (terms, height, right) in zip(poses, fixed, strict=True):
            pose[2] = _choose_sign(pose[2], terms @ shape, height, right)
        if (np.sign(poses[:, 2, :2].sum(1)) == signs).all():
            break
    return shape, poses


def _equations(pixel, point, pose):
    """Factors of (a0, a2) [n, 2] and t3 [n] in f(rho) m = rho (z + t3), and the rest [n]."""
    rho = np.hypot(*pixel.T)
    lateral = pose[:2] @ _homogeneous(point).T
    m = (lateral * pixel.T).sum(0) / np.maximum(rho, 1e-12)
    return np.stack([m, m * rho**2], 1), -rho, rho * (point @ pose[2, :2])


def _choose_sign(row, radial, height, right):
    """Third row of a board's pose, with the sign and t3 that fit the radial function best."""
    fits = []
    for sign in (1, -1):
        t3 = height @ (sign * right - radial) / (height @ height)
        fits.append((np.sum((radial + height * t3 - sign * right) ** 2), sign, t3))
    _, sign, t3 = min(fits)
    return np.array([sign * row[0], sign * row[1], t3])
