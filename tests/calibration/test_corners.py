"""Chessboards painted at known places, found again; what can't be used is told."""

import cv2
import numpy as np
import pytest

from calibration.corners import board_points, check_board, find_again, find_corners, find_views

BOARD = (6, 7)
SIZE = (640, 480)


def painted(seed=0, scale=1.0, contrast=1.0, size=SIZE):
    """Grey image [H, W] of a slanted board and its corners [42, 2]."""
    rng = np.random.default_rng(seed)
    squares = np.indices((BOARD[1] + 1, BOARD[0] + 1)).sum(0) % 2 == 0
    cell, over = 40, 4
    texture = np.kron(np.where(squares, 20, 235).astype(np.uint8), np.ones((cell, cell), np.uint8))
    texture = cv2.copyMakeBorder(texture, cell, cell, cell, cell, cv2.BORDER_CONSTANT, value=235)
    corners = (board_points(BOARD, 1.0) + 2) * cell - 0.5  # between the squares' pixels
    height, width = texture.shape
    quad = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    to = scale * (quad - quad.mean(0)) * 0.8 + rng.uniform(-30, 30, (4, 2)) * scale
    to = (to + np.array(size) / 2 + rng.uniform(-20, 20, 2)).astype(np.float32)
    found = cv2.perspectiveTransform(corners[None], cv2.getPerspectiveTransform(quad, to))[0]
    fine = over * to + (over - 1) / 2  # centres of pixels of an image `over` times as large
    warp = cv2.getPerspectiveTransform(quad, fine.astype(np.float32))
    large = (over * size[0], over * size[1])
    image = cv2.warpPerspective(texture, warp, large, flags=cv2.INTER_AREA, borderValue=120)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(float)
    image = 120 + contrast * (image - 120) + rng.normal(0, 1.5 * contrast, image.shape)
    return image.clip(0, 255).astype(np.uint8), found


def nearest(found, true):
    """Distances [n] of found corners to the true ones; the order may begin at either end."""
    return min((np.hypot(*(f - true).T) for f in (found, found[::-1])), key=np.sum)


def write(folder, count=3):
    for i in range(count):
        cv2.imwrite(str(folder / f"board{i}.png"), painted(i)[0])
    return folder


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_painted_corners_are_found_to_a_tenth_of_a_pixel(seed):
    grey, true = painted(seed)
    for variant, corners in find_corners(grey, BOARD).items():
        assert corners.shape == (42, 2) and corners.dtype == float
        assert nearest(corners, true).mean() < 0.1, variant
        offset = corners.mean(0) - true.mean(0)  # half a pixel would be another convention
        assert np.abs(offset).max() < 0.05, variant


@pytest.mark.parametrize(("scale", "contrast"), [(0.25, 1.0), (0.8, 0.06)])
def test_small_and_faint_boards_are_found(scale, contrast):
    grey, true = painted(3, scale, contrast)
    found = find_corners(grey, BOARD)
    assert found is not None and nearest(found["search"], true).mean() < 0.5


def test_no_board_gives_none():
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    assert find_corners(noise, BOARD) is None


def test_corners_are_found_again_where_they_are_expected(tmp_path):
    grey, true = painted(1)
    cv2.imwrite(str(tmp_path / "b.png"), grey)
    expected = true + np.random.default_rng(0).uniform(-1.5, 1.5, true.shape)
    found = find_again(tmp_path / "b.png", expected, BOARD)
    assert np.hypot(*(found - true).T).max() < 0.2


def test_views_have_names_and_progress(tmp_path):
    seen = []
    views = find_views(write(tmp_path), BOARD, lambda *given: seen.append(given))
    assert views.names == ["board0.png", "board1.png", "board2.png"] and not views.rejected
    assert views.size == SIZE and seen == [(1, 3), (2, 3), (3, 3)]
    assert {len(corners) for corners in views.corners.values()} == {3}
    assert find_views([tmp_path], BOARD).names == views.names


def test_images_that_cannot_be_used_are_rejected_with_the_reason(tmp_path):
    write(tmp_path)
    cv2.imwrite(str(tmp_path / "deep.png"), np.zeros((480, 640), np.uint16))
    cv2.imwrite(str(tmp_path / "empty.png"), np.full((480, 640), 90, np.uint8))
    cv2.imwrite(str(tmp_path / "other.png"), painted(5, size=(800, 600))[0])
    (tmp_path / "cut.png").write_bytes((tmp_path / "board0.png").read_bytes()[:9000])
    (tmp_path / "text.png").write_text("no image")
    views = find_views(tmp_path, BOARD)
    reasons = dict(views.rejected)
    assert len(views.names) == 3 and len(reasons) == 5
    assert "16 bits" in reasons["deep.png"]
    assert "no board of 6 x 7 inner corners" in reasons["empty.png"]
    assert "800 x 600 pixels; most images have 640 x 480" in reasons["other.png"]
    assert "cut.png" in reasons["cut.png"] and "text.png" in reasons["text.png"]


def test_a_wrong_board_size_is_told(tmp_path):
    write(tmp_path, 2)
    with pytest.raises(ValueError, match="no board of 9 x 9 inner corners found in any of 2"):
        find_views(tmp_path, (9, 9))


def test_nothing_readable_is_told(tmp_path):
    (tmp_path / "a.png").write_text("no image")
    with pytest.raises(ValueError, match="no image can be read"):
        find_views(tmp_path, BOARD)


@pytest.mark.parametrize(
    ("board", "square"),
    [((6,), 0.03), ((2, 7), 0.03), ((6, 7.5), 0.03), ((6, 7), 0), ((6, 7), np.nan)],
)
def test_boards_that_are_none_are_refused(board, square):
    with pytest.raises(ValueError, match="must be"):
        check_board(board, square)
