"""Block-tridiagonal normal equations bordered by landmarks, an arrowhead matrix

    H = [ A  B' ]     A [3 T, 3 T]: poses, which couple to their neighbours only: banded
        [ B  C  ]     B [2 L, 3 T], the border: points with poses; C [2 L, 2 L], the corner: points

C is block-diagonal (2 x 2). The poses are eliminated and the points solved for first, by Schur's
complement C - B A^-1 B', as in bundle adjustment (Triggs et al. 2000, section 6).
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array

BAND = 5  # diagonals below the main one


class NormalEquations(NamedTuple):
    """H step = gradient for T poses and L points, in blocks.

    `diagonal` [T, 3, 3] and `off` [T - 1, 3, 3] (pose t with pose t + 1) of A; `border` [2 L, 3 T]:
    B, sparse; `corner` [L, 2, 2] of C; `pose_gradient` [T, 3]; `point_gradient` [L, 2].
    """

    diagonal: np.ndarray
    off: np.ndarray
    border: csr_array
    corner: np.ndarray
    pose_gradient: np.ndarray
    point_gradient: np.ndarray


class Factor(NamedTuple):
    """Factorization of H: `chain` [6, 3 T], the banded Cholesky factor of A; `inverse_border`
    [3 T, 2 L] = A^-1 B'; `points` [2 L, 2 L], the points' part of H^-1 (their covariance)."""

    chain: np.ndarray
    inverse_border: np.ndarray
    points: np.ndarray


def solve(normal):
    """Solve for the step of the poses [T, 3] and of the points [L, 2]; also returns the `Factor`.

    Raises `numpy.linalg.LinAlgError` when the matrix is not positive definite.
    """
    chain = cholesky_banded(_band(normal.diagonal, normal.off), lower=True, check_finite=False)
    right = np.vstack([normal.border.toarray(), normal.pose_gradient.ravel()]).T
    solved = cho_solve_banded((chain, True), right, check_finite=False)
    inverse_border, alone = solved[:, :-1], solved[:, -1]
    size = len(normal.corner)
    schur = -(normal.border @ inverse_border)
    block = np.arange(2 * size).reshape(size, 2)
    schur[block[:, :, None], block[:, None, :]] += normal.corner
    root = np.linalg.inv(np.linalg.cholesky((schur + schur.T) / 2))
    points = root.T @ root
    point_step = points @ (normal.point_gradient.ravel() - normal.border @ alone)
    pose_step = alone - inverse_border @ point_step
    factor = Factor(chain, inverse_border, points)
    return pose_step.reshape(-1, 3), point_step.reshape(-1, 2), factor


def pose_covariances(factor):
    """Compute the poses' marginal covariances [T, 3, 3], the diagonal blocks of H^-1.

    Those of A^-1 follow by backward recursion, S_t = D_t^-1 + G_t S_(t+1) G_t^T with the Cholesky
    factor's blocks D = L_tt L_tt^T and G = L_tt^-T L_(t+1)t^T, as in a Rauch-Tung-Striebel smoother
    (a selected inverse, Takahashi 1973): sums only, so nothing cancels. The border adds
    A^-1 B' points B A^-1.
    """
    below, beside = _blocks(factor.chain)
    root = np.linalg.inv(below)
    cov = root.transpose(0, 2, 1) @ root
    gain = root.transpose(0, 2, 1)[:-1] @ beside.transpose(0, 2, 1)
    for t in range(len(gain) - 1, -1, -1):
        cov[t] += gain[t] @ cov[t + 1] @ gain[t].T
    inverse_border = factor.inverse_border.reshape(len(cov), 3, -1)
    return cov + (inverse_border @ factor.points) @ inverse_border.transpose(0, 2, 1)


def _block_entries():
    """Rows and columns of the entries of a 3 x 3 block, and whether each is in its lower part."""
    row, column = np.indices((3, 3))
    return row, column, row >= column


def _band(diagonal, off):
    """Lower banded storage [6, 3 T]: row i - j, column j."""
    size = len(diagonal)
    row, column, lower = _block_entries()
    band = np.zeros((BAND + 1, size, 3))
    band[(row - column)[lower], :, column[lower]] = diagonal[:, row[lower], column[lower]].T
    band[3 + row - column, :-1, column] = off.transpose(2, 1, 0)
    return band.reshape(BAND + 1, 3 * size)


def _blocks(chain):
    """Diagonal blocks [T, 3, 3] of a lower banded factor, and those below them [T - 1, 3, 3]."""
    band = chain.reshape(BAND + 1, -1, 3)
    row, column, lower = _block_entries()
    diagonal = np.zeros((band.shape[1], 3, 3))
    diagonal[:, row[lower], column[lower]] = band[(row - column)[lower], :, column[lower]].T
    beside = band[3 + row - column, :-1, column].transpose(2, 0, 1)
    return diagonal, beside
