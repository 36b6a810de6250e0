"""Normal equations of a chain of poses bordered by points: solved, and inverted where needed.

Poses touch their neighbours only, so that their part of the matrix is banded (3 x 3 blocks, five
diagonals below the main one); points touch any pose. The points are solved for first, with the
poses eliminated (Schur's complement), as in bundle adjustment (Triggs et al. 2000, section 6).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array

BAND = 5  # diagonals below the main one


class Normal(NamedTuple):
    """H step = gradient for T poses and L points, in blocks.

    `diagonal` [T, 3, 3]; `off` [T - 1, 3, 3]: pose t with pose t + 1; `border` [2 L, 3 T], sparse:
    points with poses; `corner` [L, 2, 2]; `pose_gradient` [T, 3]; `point_gradient` [L, 2].
    """

    diagonal: np.ndarray
    off: np.ndarray
    border: csr_array
    corner: np.ndarray
    pose_gradient: np.ndarray
    point_gradient: np.ndarray


class Factor(NamedTuple):
    """The matrix taken apart: banded Cholesky factor `chain` [6, 3 T] of the poses' part A, `reach`
    [3 T, 2 L] = A^-1 border^T, and `points` [2 L, 2 L]: the points' part of the whole's inverse."""

    chain: np.ndarray
    reach: np.ndarray
    points: np.ndarray


def solve(normal):
    """Step of the poses [T, 3] and of the points [L, 2], and the `Factor`.

    Raises `numpy.linalg.LinAlgError` when the matrix is not positive definite.
    """
    chain = cholesky_banded(_band(normal.diagonal, normal.off), lower=True, check_finite=False)
    right = np.vstack([normal.border.toarray(), normal.pose_gradient.ravel()]).T
    solved = cho_solve_banded((chain, True), right, check_finite=False)
    reach, alone = solved[:, :-1], solved[:, -1]
    size = len(normal.corner)
    schur = -(normal.border @ reach)
    block = np.arange(2 * size).reshape(size, 2)
    schur[block[:, :, None], block[:, None, :]] += normal.corner
    root = np.linalg.inv(np.linalg.cholesky((schur + schur.T) / 2))
    points = root.T @ root
    point_step = points @ (normal.point_gradient.ravel() - normal.border @ alone)
    pose_step = alone - reach @ point_step
    return pose_step.reshape(-1, 3), point_step.reshape(-1, 2), Factor(chain, reach, points)


def pose_covariances(factor):
    """Marginal covariances [T, 3, 3] of the poses: the diagonal blocks of the whole's inverse.

    Those of the chain alone follow backwards, S_t = D_t^-1 + G_t S_(t+1) G_t^T with the Cholesky
    factor's blocks D = L_tt L_tt^T and G = L_tt^-T L_(t+1)t^T, as in a Rauch-Tung-Striebel smoother
    (a selected inverse, Takahashi 1973): sums only, so nothing cancels. The border adds
    reach points reach^T.
    """
    below, beside = _blocks(factor.chain)
    root = np.linalg.inv(below)
    cov = root.transpose(0, 2, 1) @ root
    gain = root.transpose(0, 2, 1)[:-1] @ beside.transpose(0, 2, 1)
    for t in range(len(gain) - 1, -1, -1):
        cov[t] += gain[t] @ cov[t + 1] @ gain[t].T
    reach = factor.reach.reshape(len(cov), 3, -1)
    return cov + (reach @ factor.points) @ reach.transpose(0, 2, 1)


def _places():
    """Where the entries (row, column) of a diagonal block, or of the one below it, are stored."""
    row, column = np.indices((3, 3))
    return row, column, row >= column


def _band(diagonal, off):
    """Lower banded storage [6, 3 T]: row i - j, column j."""
    size = len(diagonal)
    row, column, lower = _places()
    band = np.zeros((BAND + 1, size, 3))
    band[(row - column)[lower], :, column[lower]] = diagonal[:, row[lower], column[lower]].T
    band[3 + row - column, :-1, column] = off.transpose(2, 1, 0)
    return band.reshape(BAND + 1, 3 * size)


def _blocks(chain):
    """Diagonal blocks [T, 3, 3] of a lower banded factor, and those below them [T - 1, 3, 3]."""
    band = chain.reshape(BAND + 1, -1, 3)
    row, column, lower = _places()
    diagonal = np.zeros((band.shape[1], 3, 3))
    diagonal[:, row[lower], column[lower]] = band[(row - column)[lower], :, column[lower]].T
    beside = band[3 + row - column, :-1, column].transpose(2, 0, 1)
    return diagonal, beside
