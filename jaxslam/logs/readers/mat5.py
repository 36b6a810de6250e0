"""Read plain numeric variables of a MATLAB file of version 5 (save -v7 or -v6).

Written here because SciPy's reader was seen to crash the whole process on damaged files.
Layout: MathWorks, "MAT-File Format", level 5.
"""

import struct
import zlib
from itertools import islice

import numpy as np

MAX_BYTES = 1 << 29  # of the file, and of all its variables unpacked
MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
NUMBERS |= {12: "i8", 13: "u8"}
NUMERIC_CLASSES = range(6, 16)
COMPLEX = 0x0800
HEADER = 128


def read_variables(path, wanted):
    """Read the variables named in `wanted`: float64 arrays by name, None if not plain numbers.

    Raises `ValueError` saying what is wrong with the file, without its name.
    """
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path.stat().st_size} bytes; at most {MAX_BYTES} are read")
    data = memoryview(path.read_bytes())
    order = {b"IM": "<", b"MI": ">"}.get(bytes(data[HEADER - 2 : HEADER]))
    if order is None:
        raise ValueError("it has no header of version 5")
    if struct.unpack_from(order + "H", data, HEADER - 4) != (0x0100,):
        raise ValueError("another version than 5; save it with -v7")
    budget, variables = MAX_BYTES, {}
    for kind, body in _elements(data[HEADER:], order):
        if kind == COMPRESSED:
            kind, body = _unpack(body, order, budget)
            budget -= len(body)
        if kind == MATRIX:
            name, array = _variable(body, order)
            if name in wanted:
                variables[name] = array
    return variables


def _elements(data, order):
    """Yield type and bytes of successive elements."""
    offset = 0
    while offset < len(data):
        if len(data) - offset < 8:
            raise ValueError("it is cut")
        kind, size = struct.unpack_from(order + "II", data, offset)
        start, offset = offset + 8, offset + 8
        if kind >> 16:  # up to four bytes of data are in the tag itself
            start, size, kind = start - 4, kind >> 16, kind & 0xFFFF
            if size > 4:
                raise ValueError("a damaged element")
        else:
            offset += size if kind == COMPRESSED else size + -size % 8
        if start + size > len(data):
            raise ValueError("it is cut")
        yield kind, data[start : start + size]


def _unpack(body, order, budget):
    stream = zlib.decompressobj()
    try:
        data = stream.decompress(body, max(budget, 1))
    except zlib.error as err:
        raise ValueError(f"a damaged variable ({err})") from None
    if not stream.eof:
        raise ValueError(f"a variable is cut, or longer than {budget} bytes")
    return next(_elements(memoryview(data), order), (0, b""))


def _variable(body, order):
    """Name and array of a matrix element."""
    parts = list(islice(_elements(body, order), 4))
    if len(parts) < 3 or len(parts[0][1]) != 8 or len(parts[1][1]) % 4:
        return "", None
    name = bytes(parts[2][1]).decode("latin-1")
    flags = struct.unpack_from(order + "I", parts[0][1])[0]
    if flags & 0xFF not in NUMERIC_CLASSES or flags & COMPLEX or len(parts) < 4:
        return name, None
    shape = np.frombuffer(parts[1][1], order + "i4").tolist()
    kind, numbers = parts[3]
    size = np.dtype(NUMBERS.get(kind, "u1")).itemsize
    wanted = np.prod([float(length) for length in shape]) * size
    if kind not in NUMBERS or min(shape, default=-1) < 0 or wanted != len(numbers):
        raise ValueError(
            f"variable {name!r} of shape {shape} does not fit its {len(numbers)} bytes"
        )
    array = np.frombuffer(numbers, order + NUMBERS[kind]).astype(float)
    return name, array.reshape(shape, order="F")
