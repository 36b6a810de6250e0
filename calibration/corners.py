"""Find the corners of a chessboard in images; unusable images are rejected with a reason.

`board`: number of inner corners (per row, per column), as in OpenCV. Pixels as in `Camera`.
"""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from jaxslam.vision.images import Images, read_image

# Without the exhaustive search, three in ten boards in images of a mirror camera are missed.
PLAIN, ACCURATE = cv2.CALIB_CB_EXHAUSTIVE, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
# The most accurate depends on lens and light (cornerSubPix halves the residual of a fisheye and
# raises a parabolic mirror's by half), so the calibration's residual selects one.
VARIANTS = ("search", "upsampled search", "cornerSubPix")
UPSAMPLED = 8_000_000  # px, largest image in which to search for a board at twice the size
SUBPIX_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)


class Views(NamedTuple):
    """Images with a board; `corners[variant]`: a list of [n, 2] px. `rejected`: (name, reason)."""

    names: list
    files: list
    corners: dict
    size: tuple  # (width, height) of all
    rejected: list


def board_points(board, square):
    """Corners [n, 2] m of a board in its plane, in the order in which OpenCV finds them."""
    columns, rows = board
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return square * np.stack([x.ravel(), y.ravel()], 1).astype(float)


def check_board(board, square):
    """Raise `ValueError` unless `board` and `square` [m] describe a chessboard."""
    if len(board) != 2 or any(int(n) != n or not 3 <= n <= 100 for n in board):
        raise ValueError(f"board {tuple(board)}: must be two numbers of inner corners, 3 to 100")
    if not (np.isfinite(square) and square > 0):
        raise ValueError(f"square {square!r}: must be above 0 m")


def find_views(source, board, progress=None):
    """Find boards in a folder, pattern or list of images (also a list of one of these): `Views`.

    Images that differ from the most frequent size are rejected. `progress(done, total)` in images.
    Raises `ValueError` if no board is found.
    """
    if isinstance(source, (list, tuple)) and len(source) == 1:
        source = source[0]
    origin = f"{source[0]} and so on" if isinstance(source, (list, tuple)) else source
    images, seen, rejected = Images(source), [], []
    if images.video:
        raise ValueError(f"{origin}: a video; give single images of the board")
    for done, (file, (name, image)) in enumerate(zip(images.files, images, strict=True)):
        if isinstance(image, ValueError):
            rejected.append((name, str(image)))
        else:
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            seen.append((name, file, grey.shape[::-1], find_corners(grey, board)))
        if progress:
            progress(done + 1, len(images))
    if not seen:
        raise ValueError(f"{origin}: no image can be read; the first: {rejected[0][1]}")
    size = Counter(view[2] for view in seen).most_common(1)[0][0]
    no_board = f"no board of {board[0]} x {board[1]} inner corners found"
    for name, _, (width, height), corners in seen:
        if (width, height) != size:
            most = f"most images have {size[0]} x {size[1]}"
            rejected.append((name, f"{width} x {height} pixels; {most}"))
        elif corners is None:
            rejected.append((name, no_board))
    good = [view for view in seen if view[2] == size and view[3] is not None]
    if not good:
        count = "count where four squares meet, not the squares"
        raise ValueError(f"{origin}: {no_board} in any of {len(seen)} images; {count}")
    names, files, _, found = map(list, zip(*good, strict=True))
    return Views(names, files, {v: [f[v] for f in found] for v in VARIANTS}, size, rejected)


def find_corners(grey, board):
    """Find the board in a grey image [H, W]: corners [n, 2] px by variant, or None."""
    found, accurate = (find_grid(grey, board, flags) for flags in (PLAIN, ACCURATE))
    found = accurate if found is None else found
    if found is None:
        return None
    if accurate is None or np.abs(accurate - found).max() > 0.5 * _spacing(found, board):
        accurate = found  # not found, or in the other order of corners: poses would differ
    return dict(zip(VARIANTS, (found, accurate, refine(grey, found, board)), strict=True))


def find_grid(grey, board, flags):
    """Find the board's corners [n, 2] px in the first of `_attempts` that shows it, or None."""
    for image, scale in _attempts(grey):
        good, corners = cv2.findChessboardCornersSB(image, tuple(board), flags=flags)
        if good:
            # (n, 1, 2) before OpenCV 5, (n, 2) since. Pixel u is at 2 u + 0.5 at twice the size.
            return (corners.reshape(-1, 2).astype(float) + 0.5) / scale - 0.5
    return None


def _attempts(grey):
    """Yield (image, scale): as it is, with more local contrast, and at twice the size."""
    yield grey, 1
    yield cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 8)).apply(grey), 1
    if 4 * grey.size <= UPSAMPLED:  # the search's filters remove squares of a few pixels
        yield cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 2


def refine(grey, corners, board):
    """Refine corners [n, 2] px by cornerSubPix, in windows that contain one corner each."""
    half = int(np.clip(_spacing(corners, board) / 3, 2, 5))
    start = corners.astype(np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), SUBPIX_STOP)
    return moved.reshape(-1, 2).astype(float)


def find_again(file: Path, predicted, board):
    """Localise the corners [n, 2] px of a board again, from the positions predicted by a camera."""
    return refine(cv2.cvtColor(read_image(file), cv2.COLOR_BGR2GRAY), predicted, board)


def _spacing(corners, board):
    """Distance [px] of the closest neighbours of the grid."""
    grid = corners.reshape(board[1], board[0], 2)
    return min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
