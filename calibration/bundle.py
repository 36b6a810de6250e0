"""Joint bundle adjustment of a camera and the poses of its boards, dense and in double precision.

A residual depends on the camera's parameters and on its own board's pose alone, so the normal
equations are a dense corner for the camera and 6 x 6 blocks for the boards, which Schur's
complement removes. JAX differentiates the camera model; the chain through a pose is written out.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.vision.camera import parameter_names, ray_to_pixel

PAD = 1024  # corners: sets are filled up to multiples of it, so that one compilation serves many
UNSEEN = 100.0  # px, residual of a corner that the camera does not image
HUBER = 5.0  # robust standard deviations; beyond, a residual pulls with constant force
OUTLIER = 10.0  # of the same: such corners are taken out and reported


@dataclass(frozen=True)
class Corners:
    """What is observed: pixels [n, 2], points [n, 2] m on the board, board [n] rising indices."""

    pixel: np.ndarray
    point: np.ndarray
    board: np.ndarray
    size: tuple

    @property
    def boards(self):
        return int(self.board[-1]) + 1

    def of_boards(self, keep):
        """Those of the boards `keep` (indices), numbered anew."""
        part = [self.board == b for b in keep]
        number = np.concatenate([np.full(p.sum(), i) for i, p in enumerate(part)])
        return Corners(
            np.concatenate([self.pixel[p] for p in part]),
            np.concatenate([self.point[p] for p in part]),
            number,
            self.size,
        )


@dataclass(frozen=True)
class Solution:
    """Camera params [P] and poses of the boards: rotations [B, 3, 3], translations [B, 3] m.

    `free` [P, F]: the directions in which params were free. `residual` [n, 2] px, of every corner;
    `weight` [n]: 0 where a corner is an outlier. `information` [F, F]: of the free directions, the
    poses eliminated, per px^2.
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
        """Residuals' lengths [n] px."""
        return np.hypot(*self.residual.T)

    @property
    def rms(self):
        return float(np.sqrt(np.mean(self.distance**2)))


def free_directions(model, names):
    """[P, F]: unit directions of the named parameters; the affine's d and e are one, "e"."""
    every = parameter_names(model)
    free = np.zeros((len(every), len(names)))
    for column, name in enumerate(names):
        free[every.index(name), column] = 1
        if name == "e":  # d - e is a rotation about the axis, which the poses have already
            free[every.index("d"), column] = 1
    return free


@partial(jax.jit, static_argnames=("model", "size"))
def _derivatives(model, size, params, point):
    """Pixels [n, 2] of points [n, 3] in the model frame, d pixel/d params, d pixel/d point."""

    def one(params, point):
        pixel = ray_to_pixel(model, params, size, point)
        return pixel, pixel

    jacobian, pixel = jax.vmap(jax.jacfwd(one, (0, 1), has_aux=True), (None, 0))(params, point)
    return pixel, *jacobian


def derivatives(model, size, params, point):
    """`_derivatives` in double precision, padded; NumPy in and out."""
    filled = np.zeros((-(-len(point) // PAD) * PAD, 3)) + [0.0, 0.0, 1.0]
    filled[: len(point)] = point
    with jax.enable_x64(True):
        given = jnp.asarray(params, jnp.float64), jnp.asarray(filled, jnp.float64)
        return [np.asarray(part)[: len(point)] for part in _derivatives(model, size, *given)]


def adjust(model, corners, start, free, steps=60):
    """Levenberg-Marquardt from a `Solution` over params + `free` and all poses: a `Solution`.

    Huber's weights times those of `start`; `free` of [P, 0] estimates the poses alone.
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
    """A solution with its residuals [n, 2] px and their derivatives."""

    def __init__(self, model, corners, solution):
        self.solution, board = solution, corners.board
        arm = np.einsum("nij,nj->ni", solution.rotation[board][..., :2], corners.point)
        point = arm + solution.translation[board]
        pixel, camera, place = derivatives(model, corners.size, solution.params, point)
        seen = np.isfinite(pixel).all(1)[:, None]
        self.residual = np.where(seen, pixel - corners.pixel, UNSEEN)
        self.camera = np.where(seen[..., None], camera, 0) @ solution.free
        place = np.where(seen[..., None], place, 0)
        # d place . (turn x arm) = turn . (arm x d place)
        self.pose = np.concatenate([np.cross(arm[:, None], place), place], -1)
        self.starts = np.flatnonzero(np.diff(board, prepend=-1))
        self.length = np.hypot(*self.residual.T)
        self.scale = robust_scale(self.length[solution.weight > 0])

    def cost(self, scale):
        near, k = self.length, HUBER * scale
        return np.sum(self.solution.weight * np.where(near < k, near**2, 2 * k * near - k * k))

    def normal(self):
        """Blocks of the weighted normal equations: camera, camera to poses, poses; gradients."""
        huber = np.minimum(1, HUBER * self.scale / np.maximum(self.length, 1e-300))
        root = np.sqrt(self.solution.weight * huber)[:, None]
        r, c, p = root * self.residual, root[..., None] * self.camera, root[..., None] * self.pose
        flat = c.reshape(r.size, c.shape[-1])
        cross, own, pull = (
            np.add.reduceat(product, self.starts)
            for product in (c.mT @ p, p.mT @ p, (p.mT @ r[..., None])[..., 0])
        )
        return flat.T @ flat, cross, own, flat.T @ r.ravel(), pull

    def step(self, damping):
        """The solution moved by one damped step."""
        camera, cross, own, pull_camera, pull = self.normal()
        camera, own = _damp(camera, damping), _damp(own, damping)
        solved = np.linalg.solve(own, np.concatenate([cross.mT, pull[..., None]], -1))
        schur = camera - np.einsum("bfj,bjg->fg", cross, solved[..., :-1])
        right = pull_camera - np.einsum("bfj,bj->f", cross, solved[..., -1])
        change = -np.linalg.lstsq(schur, right)[0]
        poses = -solved[..., -1] - solved[..., :-1] @ change
        old = self.solution
        return replace(
            old,
            params=old.params + old.free @ change,
            rotation=rotation(poses[:, :3]) @ old.rotation,
            translation=old.translation + poses[:, 3:],
        )

    def information(self):
        """[F, F] per px^2: of the camera's free directions, whatever the poses are."""
        camera, cross, own, _, _ = self.normal()
        return camera - np.einsum("bfj,bjg->fg", cross, np.linalg.solve(_damp(own, 0.0), cross.mT))


def robust_scale(length):
    """Standard deviation per axis [px] of 2-D normal residuals with these lengths: the median's."""
    return max(float(np.median(length)) / 1.1774, 1e-6)


def rotation(vector):
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] rad (Rodrigues)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    o = np.zeros_like(x)
    k = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * k @ k


def _damp(matrix, damping):
    """The matrix with its diagonal grown (Marquardt), and never zero."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    least = 1e-12 * np.max(diagonal, initial=1.0)
    return matrix + (damping * diagonal + least)[..., None] * np.eye(matrix.shape[-1])
