"""Joint bundle adjustment of a camera and the poses of its boards, dense and in double precision.

A residual depends only on the camera's parameters and its board's pose, so the normal equations
have a dense block for the camera and 6 x 6 blocks for the boards, which the Schur complement
eliminates. JAX differentiates the camera model; derivatives by poses follow by the chain rule.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.vision.camera import parameter_names, ray_to_pixel

PAD = 1024  # corners are padded to multiples of it, so that one compilation serves many sets
UNSEEN = 100.0  # px, residual of a corner outside the camera's view
HUBER = 5.0  # robust standard deviations beyond which the cost of a residual is linear
OUTLIER = 10.0  # robust standard deviations beyond which a corner is excluded and reported


@dataclass(frozen=True)
class Corners:
    """Observed corners: `pixel` [n, 2], `point` [n, 2] m on the board, `board` [n], sorted."""

    pixel: np.ndarray
    point: np.ndarray
    board: np.ndarray
    size: tuple

    @property
    def boards(self):
        return int(self.board[-1]) + 1

    def of_boards(self, keep):
        """The corners of the boards `keep` (sorted indices), renumbered from 0."""
        index = np.concatenate([np.flatnonzero(self.board == b) for b in keep])
        number = np.searchsorted(keep, self.board[index])
        return Corners(self.pixel[index], self.point[index], number, self.size)


@dataclass(frozen=True)
class Solution:
    """Camera params [P] and poses of the boards: rotations [B, 3, 3], translations [B, 3] m.

    `free` [P, F]: directions in which params were estimated. `residual` [n, 2] px of every corner;
    `weight` [n]: 0 for outliers. `information` [F, F] per px^2 along `free`, poses eliminated.
    """

    params: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    free: np.ndarray = None
    residual: np.ndarray = None
    weight: np.ndarray = None
    information: np.ndarray = None

    @property
    def distance(self):
        """Lengths [n] px of the residuals."""
        return np.hypot(*self.residual.T)

    @property
    def rms(self):
        return float(np.sqrt(np.mean(self.distance**2)))


def free_directions(model, names):
    """Directions [P, F] of the named parameters; "e" means d and e of the affine map together."""
    every = parameter_names(model)
    free = np.zeros((len(every), len(names)))
    for column, name in enumerate(names):
        free[every.index(name), column] = 1
        if name == "e":  # d - e is a rotation about the axis, which the poses include
            free[every.index("d"), column] = 1
    return free


@partial(jax.jit, static_argnames=("model", "size"))
def _derivatives(model, size, params, point):
    """Pixels [n, 2] of points [n, 3] in the model frame, and derivatives by params and by point."""

    def project(params, point):
        pixel = ray_to_pixel(model, params, size, point)
        return pixel, pixel

    jacobian, pixel = jax.vmap(jax.jacfwd(project, (0, 1), has_aux=True), (None, 0))(params, point)
    return pixel, *jacobian


def derivatives(model, size, params, point):
    """`_derivatives` in double precision, padded; NumPy in and out."""
    padded = np.zeros((-(-len(point) // PAD) * PAD, 3)) + [0.0, 0.0, 1.0]
    padded[: len(point)] = point
    with jax.enable_x64(True):
        args = jnp.asarray(params, jnp.float64), jnp.asarray(padded, jnp.float64)
        return [np.asarray(part)[: len(point)] for part in _derivatives(model, size, *args)]


def adjust(model, corners, start, free, steps=60):
    """Adjust all poses, and the params along `free` [P, F], by Levenberg-Marquardt: `Solution`.

    Huber weights multiply those of `start`; F = 0 estimates the poses alone.
    """
    weight = np.ones(len(corners.pixel)) if start.weight is None else start.weight
    best = _Linearization(model, corners, replace(start, free=free, weight=weight))
    damping = 1e-3
    for _ in range(steps):
        moved = _Linearization(model, corners, best.step(damping))
        before, after = best.cost(best.scale), moved.cost(best.scale)
        damping = max(damping / 10, 1e-9) if after < before else damping * 10
        if after < before:
            best = moved
        if abs(before - after) < 1e-10 * before or damping > 1e9:
            break
    return replace(best.solution, residual=best.residual, information=best.information())


class _Linearization:
    """A `Solution` with its residuals [n, 2] px and their derivatives."""

    def __init__(self, model, corners, solution):
        self.solution, board = solution, corners.board
        arm = np.einsum("nij,nj->ni", solution.rotation[board][..., :2], corners.point)
        point = arm + solution.translation[board]
        pixel, by_params, by_point = derivatives(model, corners.size, solution.params, point)
        seen = np.isfinite(pixel).all(1)[:, None]
        self.residual = np.where(seen, pixel - corners.pixel, UNSEEN)
        self.camera = np.where(seen[..., None], by_params, 0) @ solution.free
        by_point = np.where(seen[..., None], by_point, 0)
        # by_point . (turn x arm) = turn . (arm x by_point)
        self.pose = np.concatenate([np.cross(arm[:, None], by_point), by_point], -1)
        self.starts = np.flatnonzero(np.diff(board, prepend=-1))
        self.length = np.hypot(*self.residual.T)
        self.scale = robust_scale(self.length[solution.weight > 0])

    def cost(self, scale):
        """Sum of weighted Huber costs at a robust standard deviation `scale` [px]."""
        near, k = self.length, HUBER * scale
        return np.sum(self.solution.weight * np.where(near < k, near**2, 2 * k * near - k * k))

    def normal(self):
        """Blocks of the normal equations: camera, camera x poses, poses, and both gradients."""
        huber = np.minimum(1, HUBER * self.scale / np.maximum(self.length, 1e-300))
        root = np.sqrt(self.solution.weight * huber)[:, None]
        r, c, p = root * self.residual, root[..., None] * self.camera, root[..., None] * self.pose
        flat = c.reshape(r.size, c.shape[-1])
        products = c.mT @ p, p.mT @ p, (p.mT @ r[..., None])[..., 0]
        cross, own, pull = (np.add.reduceat(product, self.starts) for product in products)
        return flat.T @ flat, cross, own, flat.T @ r.ravel(), pull

    def step(self, damping):
        """The solution after one damped step."""
        camera, cross, own, pull_camera, pull = self.normal()
        camera, own = _damp(camera, damping), _damp(own, damping)
        solved = np.linalg.solve(own, np.concatenate([cross.mT, pull[..., None]], -1))
        schur = camera - np.einsum("bfj,bjg->fg", cross, solved[..., :-1])
        right = pull_camera - np.einsum("bfj,bj->f", cross, solved[..., -1])
        change = -np.linalg.lstsq(schur, right)[0]
        poses = -solved[..., -1] - solved[..., :-1] @ change
        old = self.solution
        params, translation = old.params + old.free @ change, old.translation + poses[:, 3:]
        turned = rotation(poses[:, :3]) @ old.rotation
        return replace(old, params=params, rotation=turned, translation=translation)

    def information(self):
        """Information [F, F] per px^2 of the camera's free directions, with poses eliminated."""
        camera, cross, own, _, _ = self.normal()
        return camera - np.einsum("bfj,bjg->fg", cross, np.linalg.solve(_damp(own, 0.0), cross.mT))


def robust_scale(length):
    """Standard deviation [px] per axis of 2-D normal residuals, from their median length."""
    return max(float(np.median(length)) / 1.1774, 1e-6)


def rotation(vector):
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] rad (Rodrigues)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    o = np.zeros_like(x)
    k = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * k @ k


def _damp(matrix, damping):
    """Increase the diagonal of matrices (Marquardt), and keep it above zero."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    least = 1e-12 * np.max(diagonal, initial=1.0)
    return matrix + (damping * diagonal + least)[..., None] * np.eye(matrix.shape[-1])
