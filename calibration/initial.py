"""A first camera and first board poses from the corners alone, without a guess set by hand.

Radial constraint (Tsai; Scaramuzza et al. 2006, their linear method): whatever the radial
function is, a corner lies in the plane of the optical axis and its pixel. That gives the centre
and each board's pose but for its height along the axis; then the function and the heights are
linear. Turning the axis' sense round changes nothing in planar boards: z > 0 at the centre is
taken.
"""

import numpy as np

from calibration.bundle import Solution
from jaxslam.vision.camera import POLYNOMIAL

GRID = 9  # centres tried along an axis, in each of the rounds
ROUNDS = (0.4, 0.1, 0.025)  # half widths of the rounds' grids, in half image sides


def first_solution(corners):
    """`Solution` of the polynomial model with a0 and a2 alone, from `Corners`."""
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
    """Centre [2], in half image sides, that fits the radial constraint best; a search by grids.

    The misfits of the boards are added, not their squares: one board may be wrong.
    """
    best = (size - 1) / max(size)
    for width in ROUNDS:
        offset = np.linspace(-width, width, GRID)
        tried = best + np.stack(np.meshgrid(offset, offset), -1).reshape(-1, 2)
        misfit = np.zeros(len(tried))
        for pixel, point in zip(pixels, points, strict=True):
            apart = pixel - tried[:, None]
            lateral = _homography(apart, point) @ _homogeneous(point).T
            across = apart[..., 0] * lateral[:, 1] - apart[..., 1] * lateral[:, 0]
            misfit += np.sqrt(np.mean(across**2 / (lateral**2).sum(1), -1))
        best = tried[np.argmin(misfit)]
    return best


def _homography(pixel, point):
    """[..., 2, 3] from board points (X, Y, 1) to the direction of pixels [..., n, 2] about the
    centre: u P_y - v P_x = 0 solved in least squares; its scale and sign are open."""
    scale = np.abs(point).max()
    known = _homogeneous(point / scale)
    u, v = pixel[..., :1], pixel[..., 1:]
    rows = np.concatenate([-v * known, u * known], -1)
    solution = np.linalg.eigh(rows.mT @ rows)[1][..., 0]
    return solution.reshape(*solution.shape[:-1], 2, 3) / [scale, scale, 1]


def _homogeneous(point):
    return np.concatenate([point, np.ones_like(point[:, :1])], 1)


def _board_pose(pixel, point):
    """[3, 3] with columns r1, r2, t of a board; t's third is open (0), the third row's sign too."""
    lateral = _homography(pixel, point)
    side = (lateral @ _homogeneous(point).T * pixel.T).sum(0)
    lateral = lateral * (1 if np.median(side) > 0 else -1)  # a corner lies on its pixel's side
    (a, b), c = (lateral[:, :2] ** 2).sum(0), lateral[:, 0] @ lateral[:, 1]
    root = np.hypot(b - a, 2 * c)  # r1 and r2 are to be of one length and square to each other
    up = np.sqrt(np.maximum([(root + b - a) / 2, (root - b + a) / 2], 0))
    up[1] *= -1 if c > 0 else 1
    return np.vstack([lateral, [*up, 0]]) / np.sqrt(a + up[0] ** 2)


def _fit_radial(pixels, points, poses):
    """a0, a2 of all boards together and their poses [B, 3, 3], the third rows now known."""
    poses = np.stack(poses)
    rows = [_equations(*each) for each in zip(pixels, points, poses, strict=True)]
    for pose, (shape, height, right) in zip(poses, rows, strict=True):
        a0 = np.linalg.lstsq(np.column_stack([shape, height]), right)[0][0]
        pose[2] *= np.sign(a0)
    for _ in range(10):  # a board's own sign may be wrong: each follows the others' function
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
    """Of f(rho) m = rho (z + t3): factors of a0 and a2 [n, 2], of t3 [n], and the rest [n]."""
    rho = np.hypot(*pixel.T)
    lateral = pose[:2] @ _homogeneous(point).T
    m = (lateral * pixel.T).sum(0) / np.maximum(rho, 1e-12)
    return np.stack([m, m * rho**2], 1), -rho, rho * (point @ pose[2, :2])


def _choose_sign(row, seen, height, right):
    """The board's third row with the sign, and the t3, that fit a given radial function."""
    fits = []
    for sign in (1, -1):
        t3 = height @ (sign * right - seen) / (height @ height)
        fits.append((np.sum((seen + height * t3 - sign * right) ** 2), sign, t3))
    _, sign, t3 = min(fits)
    return np.array([sign * row[0], sign * row[1], t3])
