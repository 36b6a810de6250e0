"""Check the fields of a log: arrays, rows, stamps, numbers.

Every error is one line that names the field, the row, the value and what is allowed.
"""

import math

import numpy as np

LAST_STAMP = 1 << 62  # ns; differences of two stamps still fit


def assign(owner, name, value):
    """Set a field of a frozen dataclass under construction."""
    object.__setattr__(owner, name, value)


def check_array(where, value, dtype, shape, gaps=False):
    """Convert `value` to a read-only array, or None; `shape` lists lengths, None for any.

    `gaps`: whole rows may be NaN. Raises `ValueError`.
    """
    if value is None:
        return None
    try:
        source = np.asarray(value)
        with np.errstate(over="ignore"):
            array = np.array(source, dtype, order="C")
    except (TypeError, ValueError, OverflowError) as err:
        raise ValueError(f"{where}: is not an array of numbers ({err})") from None
    kinds = "iu" if array.dtype.kind in "iu" else "iuf"
    if source.dtype.kind not in kinds and source.size:
        raise ValueError(f"{where}: {source.dtype} is not {array.dtype}")
    pairs = zip(shape, array.shape, strict=False)
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in pairs):
        wanted = " x ".join("any" if w is None else str(w) for w in shape)
        raise ValueError(f"{where}: shape {array.shape}; must be {wanted}")
    if array.dtype.kind == "f":
        good = np.isfinite(array)
        if gaps:
            good |= np.isnan(array).all(axis=tuple(range(1, array.ndim)), keepdims=True)
        check_rows(where, array, good, "must be finite" + ", or nothing but NaN" * gaps)
    elif not np.array_equal(array, source):
        raise ValueError(f"{where}: values do not fit {array.dtype}")
    array.setflags(write=False)
    return array


def check_rows(where, array, good, rule):
    """Raise for the first row that is not good."""
    if not good.all():
        row = int(np.argmin(good.reshape(len(good), -1).all(axis=1)))
        raise ValueError(f"{where}, row {row}: {array[row].tolist()} {rule}")


def check_stamps(where, time):
    """Raise for the first stamp that does not follow the one before it."""
    check_rows(where, time, np.abs(time) < LAST_STAMP, "ns is no stamp")
    step = np.diff(time, prepend=time[:1] - 1)
    check_rows(where, time, step > 0, "repeats or precedes the stamp before it")


def check_number(where, value, least=-math.inf):
    """Convert `value` to a float; raise if it is no number, not finite or below `least`."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < least:
        raise ValueError(f"{where}: {value!r} is not a finite number of at least {least}")
    return float(value)
