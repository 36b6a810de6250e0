"""Draw vertical lines into the panorama and into the image."""

import cv2
import numpy as np

BRIGHT_LEFT, BRIGHT_RIGHT = (60, 60, 255), (255, 180, 0)  # BGR: polarity 1 and -1
SUBPIXEL = 4  # bits of OpenCV's fixed-point coordinates


def draw_lines(panorama_image, lines, view):
    """Draw lines, coloured by polarity, into a copy of the panorama [H, W, 3]."""
    out = panorama_image.copy()
    column, top, bottom = view.column(lines.bearing), view.row(lines.high), view.row(lines.low)
    for i, polarity in enumerate(lines.polarity):
        ends = [(column[i], top[i]), (column[i], bottom[i])]
        _draw(out, np.array(ends), BRIGHT_LEFT if polarity > 0 else BRIGHT_RIGHT)
    return out


def draw_on_image(image, lines, camera, points=24):
    """Draw lines as the camera projects them into a copy of the image [H, W, 3]."""
    out = image.copy()
    for i, polarity in enumerate(lines.polarity):
        up = np.linspace(lines.low[i], lines.high[i], points)
        level = np.cos(up)
        direction = [level * np.cos(lines.bearing[i]), level * np.sin(lines.bearing[i]), np.sin(up)]
        pixel = camera.project(np.stack(direction, -1))
        visible = pixel[np.isfinite(pixel[:, 0])]
        if len(visible) > 1:
            _draw(out, visible, BRIGHT_LEFT if polarity > 0 else BRIGHT_RIGHT)
    return out


def _draw(image, points, colour):
    fixed = np.rint(points * (1 << SUBPIXEL)).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(image, [fixed], False, colour, 1, cv2.LINE_AA, SUBPIXEL)
