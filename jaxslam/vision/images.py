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
if "cv2" not in sys.modules:  # OpenCV reads its limit when imported; a user's own limit stays
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
    """Read an image file: uint8 [H, W, 3], BGR; a grey image has three equal channels.

    An orientation tag is ignored, since a calibration belongs to the pixels as recorded. Raises
    `ValueError` naming the file and what is wrong with it.
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
        announced, (height, width) = f"{header.width} x {header.height}", image.shape[:2]
        raise ValueError(f"{path}: announces {announced} pixels but holds {width} x {height}")
    return image


def _parse_header(path, data):
    """Pillow's image, not decoded, and the `Header`, from the bytes of a file."""
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
    """Raise `ValueError` unless an image of this size is small enough to decode."""
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        limit = MAX_PIXELS // 1_000_000
        raise ValueError(f"{path}: {width} x {height} pixels; 1 to {limit} million are allowed")


def _is_complete(image):
    """Whether the file of a Pillow image is complete, for formats where OpenCV may not notice."""
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
    """Raise `ValueError` unless the camera is calibrated for an image [H, W, ...] of this size."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        calibrated = f"the camera is calibrated for {camera.width} x {camera.height}"
        raise ValueError(f"{name}: {width} x {height} pixels; {calibrated}")


class Images:
    """Images of a folder, a pattern, a list or a video, read one at a time, in natural order.

    `source`: a folder, one image file, a pattern with *, a list of files, or one video file.
    Iterating yields (name, image), or (name, `ValueError`) for an image that can't be read. The
    length of a video is what its header announces. Raises `ValueError` if there is nothing to read.
    """

    def __init__(self, source):
        self.video: Path | None = None
        if isinstance(source, (list, tuple)):
            self.files = [Path(file) for file in source]
        else:
            self.files = self._find(Path(source))
        if not self.files:
            allowed = " ".join(IMAGE_SUFFIXES)
            raise ValueError(f"{source}: no images; files ending in {allowed} are read")
        if self.video:  # ty: ignore[redundant-condition]  # set by _find
            self.names = [f"{self.video.name}#{i:06d}" for i in range(_video_length(self.video))]
        else:
            self.names = [file.name for file in self.files]

    def _find(self, path):
        if path.is_dir():
            files = [file for file in path.iterdir() if not file.name.startswith(".")]
            return _sort_naturally(file for file in files if file.suffix.lower() in IMAGE_SUFFIXES)
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
        """Yield (name, image or `ValueError`) from index `first` on, to resume a run."""
        if self.video:
            yield from _video_frames(self.video, self.names, first)
            return
        for name, file in zip(self.names[first:], self.files[first:], strict=True):
            try:
                yield name, read_image(file)
            except ValueError as error:
                yield name, error


def _sort_naturally(files):
    """Sort paths by the numbers in them: 2 before 10."""

    def key(file):
        parts = re.split(r"(\d+)", str(file))
        return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]

    return sorted(files, key=key)


def _video_length(path):
    video = cv2.VideoCapture(str(path))
    try:
        width, height = map(video.get, (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        if not video.isOpened() or count < 1:
            raise ValueError(f"{path}: can't be opened as a video")
        check_pixels(path, int(width), int(height))
        return count
    finally:
        video.release()


def _video_frames(path, names, first):
    """Yield frames from index `first` on, by decoding all: seeking is inexact in many files."""
    video = cv2.VideoCapture(str(path))
    try:
        for i, name in enumerate(names):
            if i < first:
                video.grab()
                continue
            decoded, image = video.read()
            if not decoded:
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
        fault = f"{size} bytes; at most {MAX_BYTES} are read" if size else "is an empty file"
        raise ValueError(f"{path}: {fault}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: can't be read: {error.strerror}") from None
