"""What the first bytes of an image file say of its size, and whether its last bytes are there."""

import re
import struct
from typing import NamedTuple

MAX_PIXELS = 100_000_000
JPEG_SIZES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # the start-of-frame markers
JPEG_BARE = {0x01, *range(0xD0, 0xD8)}  # markers without a length


class Header(NamedTuple):
    """What a file says of its image: size in pixels and bits per channel."""

    width: int
    height: int
    bits: int


def read_header(path, data):
    kinds = {
        b"\x89PNG": _png,
        b"\xff\xd8\xff": _jpeg,
        b"BM": _bmp,
        b"II*\0": _tiff,
        b"MM\0*": _tiff,
        **{b"P%d" % kind: _netpbm for kind in range(1, 7)},
    }
    parse = next((kinds[start] for start in kinds if data.startswith(start)), None)
    if parse is None:
        raise ValueError(f"{path}: not a PNG, JPEG, PGM, PPM, BMP or TIFF image")
    try:
        header = Header(*parse(data))
    except (struct.error, IndexError, ValueError):
        raise ValueError(f"{path}: truncated or damaged: no image size in its header") from None
    check_pixels(path, header.width, header.height)
    return header


def check_pixels(path, width, height):
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        limit = MAX_PIXELS // 1_000_000
        raise ValueError(f"{path}: {width} x {height} pixels; 1 to {limit} million are allowed")


def _png(data):
    return struct.unpack_from(">IIB", data, 16)


def _jpeg(data):
    for marker, at in _jpeg_segments(data):
        if marker in JPEG_SIZES:
            bits, height, width = struct.unpack_from(">BHH", data, at + 2)
            return width, height, bits
    raise ValueError


def _jpeg_segments(data):
    """(marker, where its length stands) up to the first scan's."""
    at = 2
    while True:
        while data[at] == 0xFF and data[at + 1] == 0xFF:  # fill bytes
            at += 1
        if data[at] != 0xFF:
            raise ValueError
        marker, at = data[at + 1], at + 2
        yield marker, at
        if marker == 0xDA:
            return
        if marker not in JPEG_BARE:
            at += struct.unpack_from(">H", data, at)[0]


def _bmp(data):
    if struct.unpack_from("<I", data, 14)[0] == 12:
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height), 8


def _netpbm(data):
    words = re.sub(rb"#[^\n]*", b" ", data[:4096]).split(maxsplit=4)
    if data[1:2] in b"14":
        return int(words[1]), int(words[2]), 1
    return int(words[1]), int(words[2]), int(words[3]).bit_length()


def _tiff(data):
    order = "<" if data[:2] == b"II" else ">"
    at = struct.unpack_from(order + "I", data, 4)[0]
    value = {258: 1}
    for i in range(struct.unpack_from(order + "H", data, at)[0]):
        entry = at + 2 + 12 * i
        tag, kind, count = struct.unpack_from(order + "HHI", data, entry)
        if tag in (256, 257, 258):
            form = order + ("H" if kind == 3 else "I")
            where = entry + 8
            if count * struct.calcsize(form) > 4:  # too long for the entry: stands elsewhere
                where = struct.unpack_from(order + "I", data, where)[0]
            value[tag] = struct.unpack_from(form, data, where)[0]
    return value.get(256, 0), value.get(257, 0), value[258]


def complete(data):
    """Whether the end mark is there, in the formats whose decoders may not miss it."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data
    if data.startswith(b"\xff\xd8"):
        try:  # from the first scan on: a thumbnail before it has an end mark of its own
            scan = max(at for marker, at in _jpeg_segments(data) if marker == 0xDA)
        except (struct.error, IndexError, ValueError):
            return False
        return data.rfind(b"\xff\xd9", scan) > 0
    return True
