"""Images from files, folders and videos, checked before and after they are decoded.

OpenCV may allocate gigabytes because a small header says so, and may return half an image of a
truncated file. Pillow therefore reads the header first and checks that the file is complete.
OpenCV decodes, since other JPEG decoders round differently.
"""

import glob
import io
import os
import re
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import TiffImageFile

MAX_PIXELS = 100_000_000
MAX_BYTES = 1 << 29  # of a file; 100 Mpixel of three bytes, uncompressed, fit
if "cv2" not in sys.modules:  # it reads its limit once, when imported; a user's own limit stays
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))

import cv2  # noqa: E402

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv")
REMEDY_16 = "only 8 are read; convert it first, e.g. with `convert IMAGE -depth 8 OUT`"
# By the first bytes of a file. `PIL.Image.open` would refuse large images in its own words.
PARSERS = {
    b"\x89PNG": PngImageFile,
    b"\xff\xd8\xff": JpegImageFile,
    b"BM": BmpImageFile,
    b"II*\0": TiffImageFile,
    b"MM\0*": TiffImageFile,
    **{b"P%d" % kind: PpmImageFile for kind in range(1, 7)},
}


class Header(NamedTuple):
    """Size of an image in pixels, and its bits per channel."""

    width: int
    height: int
    bits: int


def read_image(path):
    """The image of a file: uint8 [H, W, 3], BGR; grey comes as three equal channels.

    A rotation told by the file is not applied: a calibration belongs to the pixels as recorded.
    Raises `ValueError` naming the file and what is wrong with it.
    """
    data = _read_bytes(path)
    parsed, header = _parse_header(path, data)
    if header.bits > 8:
        raise ValueError(f"{path}: {header.bits} bits per channel; {REMEDY_16}")
    if not _is_complete(parsed):
        raise ValueError(f"{path}: truncated: the file ends before its image does")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ValueError(f"{path}: can't be decoded: {error.err}") from None
    if image is None:
        raise ValueError(f"{path}: can't be decoded: truncated or damaged")
    if image.shape[:2] != (header.height, header.width):
        found = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(f"{path}: says {header.width} x {header.height} pixels but holds {found}")
    return image


def image_header(path):
    """`Header` of an image file, without decoding it. Raises `ValueError`."""
    return _parse_header(path, _read_bytes(path))[1]


def _parse_header(path, data):
    """Pillow's image, not decoded yet, and the `Header` of a file's bytes."""
    parse = next((parse for start, parse in PARSERS.items() if data.startswith(start)), None)
    if parse is None:
        raise ValueError(f"{path}: not a PNG, JPEG, PGM, PPM, BMP or TIFF image")
    try:
        with warnings.catch_warnings(action="ignore"):  # of damaged metadata, which is not used
            image = parse(io.BytesIO(data))
    except (SyntaxError, OSError, ValueError):
        fault = "truncated, damaged or of an unsupported kind: its header can't be read"
        raise ValueError(f"{path}: {fault}") from None
    check_pixels(path, *image.size)
    return image, Header(*image.size, _bits_per_channel(image))


def _bits_per_channel(image):
    """Bits per channel, from the raw mode that Pillow decodes: 16 of "RGB;16B", else mostly 8."""
    mode = image.tile[0][3]
    mode, *more = [mode] if isinstance(mode, str) else mode
    if isinstance(image, PpmImageFile) and more:
        return int(more[0]).bit_length()  # of the largest value
    if isinstance(image, BmpImageFile):
        return 8  # the 16 of "BGR;16" are those of a pixel
    number = re.search(r";(\d+)", mode)
    return int(number[1]) if number else 8


def check_pixels(path, width, height):
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        limit = MAX_PIXELS // 1_000_000
        raise ValueError(f"{path}: {width} x {height} pixels; 1 to {limit} million are allowed")


def _is_complete(image):
    """Whether the file of a Pillow image goes on to its end, where OpenCV may not miss it."""
    try:
        if isinstance(image, PngImageFile):
            image.verify()  # checksums, without decoding
        elif isinstance(image, JpegImageFile):
            image.draft("L", (1, 1))  # decode an eighth of the size: enough to reach the end
            image.load()
    except (SyntaxError, OSError):
        return False
    return True


def check_size(image, camera, name):
    """Raise `ValueError` unless the image [H, W, ...] has the size the camera is calibrated for."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise ValueError(
            f"{name}: {width} x {height} pixels; the camera is calibrated for "
            f"{camera.width} x {camera.height}"
        )


class Images:
    """The images of a folder, files, a pattern or a video, in natural order, one at a time.

    `source`: a folder, one image file, a pattern with *, a list of files, or one video file.
    Iterating gives (name, image) or, where one can't be read, (name, `ValueError`): the stream goes
    on. `len` is what a video's header says, not what it holds. Raises `ValueError` when there is
    nothing to read.
    """

    def __init__(self, source):
        self.video = None
        if isinstance(source, (list, tuple)):
            self.files = [Path(file) for file in source]
        else:
            self.files = self._find(Path(source))
        if not self.files:
            allowed = " ".join(IMAGE_SUFFIXES)
            raise ValueError(f"{source}: no images; files ending in {allowed} are taken")
        if self.video:
            self.names = [f"{self.video.name}#{i:06d}" for i in range(_video_length(self.video))]
        else:
            self.names = [file.name for file in self.files]

    def _find(self, path):
        if path.is_dir():
            inside = [file for file in path.iterdir() if not file.name.startswith(".")]
            return _sort_naturally(file for file in inside if file.suffix.lower() in IMAGE_SUFFIXES)
        if path.is_file():
            self.video = path if path.suffix.lower() in VIDEO_SUFFIXES else None
            return [path]
        if glob.has_magic(str(path)):
            return _sort_naturally(Path(file) for file in glob.glob(str(path)))
        raise ValueError(f"{path}: no such file or folder")

    def __len__(self):
        return len(self.names)

    def __iter__(self):
        return self.stream()

    def stream(self, first=0):
        """(name, image or `ValueError`) from the image of index `first` on: to resume a run."""
        if self.video:
            yield from _video_frames(self.video, self.names, first)
            return
        for name, file in zip(self.names[first:], self.files[first:], strict=True):
            try:
                yield name, read_image(file)
            except ValueError as error:
                yield name, error


def _sort_naturally(files):
    """Paths sorted as people count: 2 before 10."""

    def key(file):
        parts = re.split(r"(\d+)", str(file))
        return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]

    return sorted(files, key=key)


def _video_length(path):
    video = cv2.VideoCapture(str(path))
    try:
        width, height = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        if not video.isOpened() or count < 1:
            raise ValueError(f"{path}: can't be opened as a video")
        check_pixels(path, int(width), int(height))
        return count
    finally:
        video.release()


def _video_frames(path, names, first):
    """Frames are counted by decoding: seeking lands elsewhere in many files."""
    video = cv2.VideoCapture(str(path))
    try:
        for i, name in enumerate(names):
            if i < first:
                video.grab()
                continue
            found, image = video.read()
            if not found:
                yield name, ValueError(f"{path}: ends at frame {i} of {len(names)}")
                return
            yield name, image
    finally:
        video.release()


def _read_bytes(path):
    path = Path(path)
    if not path.is_file():
        fault = "is a folder, not an image" if path.is_dir() else "no such file"
        raise ValueError(f"{path}: {fault}")
    size = path.stat().st_size
    if not 0 < size <= MAX_BYTES:
        found = f"{size} bytes; at most {MAX_BYTES} are read" if size else "is an empty file"
        raise ValueError(f"{path}: {found}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: can't be read: {error.strerror}") from None
