"""Times of images in the odometry's clock: from a table, commands, a video or the images' names."""

from pathlib import Path

import numpy as np

from jaxslam.logs.readers.text_table import read_lines, stamp
from jaxslam.vision.images import cv2

HEADER = ["image", "time_s"]
NO_TIME = -(1 << 62)


def image_times(images, odometry, table=None):
    """Stamps int64 [n] ns of `Images` (`NO_TIME`: unknown), and their origin in words.

    The first source that applies: `table`, or a `frames.csv` (image,time_s) in the images' folder
    or the one above; commands, if there is one image before the first and one after each; a video's
    frame rate; names in seconds. `odometry`: (kind, stamps [o] ns). Raises `ValueError` if none do.
    """
    table = _find_table(images) if table is None else Path(table)
    if table is not None:
        return _from_table(images, table), str(table)
    kind, stamps = odometry
    if kind == "command" and len(images) == len(stamps) + 1:
        # Only the order matters: the robot stands between commands.
        return np.append(stamps[0] - 10**9, stamps), "one image before and after each command"
    if images.video:
        period = 1e9 / _frame_rate(images.video)
        return np.rint(np.arange(len(images)) * period).astype(np.int64), "the video's rate"
    try:
        return np.array([stamp(Path(name).stem) for name in images.names]), "the images' names"
    except ValueError:
        pass
    counts = f"; there are {len(images)} images and {len(stamps)} commands" * (kind == "command")
    raise ValueError(
        f"{images.names[0]}: no times for the images: give a frames.csv (image,time_s), name them "
        f"by their seconds, or take one before the first command and one after each{counts}"
    )


def _frame_rate(path):
    """Frames per second of a video."""
    video = cv2.VideoCapture(str(path))
    try:
        rate = video.get(cv2.CAP_PROP_FPS)
    finally:
        video.release()
    if not 0 < rate < 1e4:
        raise ValueError(f"{path}: has no frame rate; give a frames.csv (image,time_s)")
    return rate


def _find_table(images):
    """The `frames.csv` of the images' folder or of the folder above it, or None."""
    folder = images.video.parent if images.video else Path(images.files[0]).parent
    tables = [folder / "frames.csv", folder.parent / "frames.csv"]
    return next((table for table in tables if table.is_file()), None)


def _from_table(images, path):
    lines, _ = read_lines(path, ",")
    if [cell.strip('"').lower() for cell in lines[0][1]] != HEADER:
        found = ",".join(lines[0][1])[:80]
        raise ValueError(f"{path}, line {lines[0][0]}: header {found!r}; must be image,time_s")
    times = {}
    for number, cells in lines[1:]:
        name = Path(cells[0].strip('"')).name
        try:
            if len(cells) != 2 or name in times:
                raise ValueError("is listed twice" if name in times else "two columns are needed")
            times[name] = stamp(cells[1])
        except ValueError as err:
            raise ValueError(f"{path}, line {number}: {name!r}: {err}") from None
    if not any(name in times for name in images.names):
        raise ValueError(f"{path}: names none of the images ({images.names[0]}, ...)")
    return np.array([times.get(name, NO_TIME) for name in images.names])
