"""Read text tables: exact stamps, bad rows counted, units checked.

A bad row is skipped and counted. More than 5 % of bad rows, or two rows beyond a unit's limit,
raise: the file has another format or unit.
"""

from decimal import Decimal, InvalidOperation
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

MAX_BYTES = 1 << 29
BAD_SHARE = 0.05
LAST_STAMP_S = 9_000_000_000  # int64 ns end at 9.2e9 s, the year 2262
TEN_YEARS_S = 10 * 365.25 * 86400
NANOSECONDS = "that is no time in seconds (nanoseconds? divide them by 1e9)"


class Table(NamedTuple):
    """Rows of a file: line numbers [n], stamps int64 [n] ns (0 without), other columns [n, c].

    `bad`: the rows left out, as (line, reason).
    """

    path: Path
    line: np.ndarray
    time: np.ndarray
    value: np.ndarray
    bad: list[tuple[int, str]]


def read_lines(path, separator=None):
    """Read (number from 1, cells) of every line that is not blank or a comment; and whether the
    last line is complete."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path}: {size} bytes; at most {MAX_BYTES} are read")
    text = path.read_text("utf-8-sig", errors="replace")
    lines = []
    for number, line in enumerate(text.split("\n"), 1):
        content = line.partition("#")[0].strip()
        if content:
            lines.append((number, [cell.strip() for cell in content.split(separator)]))
    if not lines:
        raise ValueError(f"{path}: is empty; a table with rows of numbers is needed")
    return lines, text.endswith("\n")


def parse(path, lines, width, complete=True, stamped=True, blanks=False):
    """Parse lines of `width` columns into a `Table`; the first is a stamp [s] if `stamped`.

    `blanks`: empty cells are NaN, and a stamp may stand alone. `complete` False: the last line has
    no newline, so the file may have been cut.
    """
    good, bad = [], []
    for number, cells in lines:
        try:
            if blanks and len(cells) == 1:
                cells = cells + [""] * (width - 1)
            if len(cells) != width:
                raise ValueError(f"{len(cells)} columns instead of {width}")
            time = stamp(cells[0]) if stamped else 0
            good.append((number, time, [_number(c, blanks) for c in cells[stamped:]]))
        except ValueError as err:
            bad.append((number, str(err)))
    if bad and not complete and bad[-1][0] == lines[-1][0]:
        line, reason = bad[-1]
        raise ValueError(f"{path}, line {line}: the file ends here ({reason}): cut? Copy it again")
    columns = list(zip(*good, strict=True)) or [(), (), ()]
    line, time = (np.array(column, np.int64) for column in columns[:2])
    value = np.array(columns[2], float).reshape(len(good), width - stamped)
    return Table(Path(path), line, time, value, bad)


def stamp(text):
    """Convert decimal seconds to int64 ns, exactly: a Unix time in float64 is 0.2 us off."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"stamp {text[:40]!r} is not a number") from None
    if not seconds.is_finite():
        raise ValueError(f"stamp {text[:40]} is not finite")
    if seconds.copy_abs() >= LAST_STAMP_S:
        raise ValueError(f"stamp {text[:40]}: {NANOSECONDS}")
    return round(seconds * 10**9)


def _number(text, blanks):
    if blanks and not text:
        return np.nan
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{text[:40]!r} is not a number") from None
    if not isfinite(value):
        raise ValueError(f"{text[:40]} is not finite")
    return value


def drop_rows(table, wrong, reason, unit=False):
    """Drop the rows that are `wrong`; raise for two of them if that means a wrong `unit`."""
    lines = table.line[wrong]
    if unit and len(lines) > 1:
        raise ValueError(f"{table.path}, line {lines[0]}: {reason} ({len(lines)} rows)")
    bad = table.bad + [(int(line), reason) for line in lines]
    return Table(table.path, table.line[~wrong], table.time[~wrong], table.value[~wrong], bad)


def to_integers(values):
    """Mask of the values that are integers, and small enough to be exact."""
    return (values == np.round(values)) & (np.abs(values) < 2**53)


def drop_bad_rows(table, skipped):
    """Count bad rows in `skipped`; raise if they are too many or all."""
    bad = sorted(table.bad)
    rows = len(table.line) + len(bad)
    if len(bad) > max(1, BAD_SHARE * rows) or len(bad) == rows:
        where = f"{table.path}, line {bad[0][0]}: {bad[0][1]}" if bad else f"{table.path}: no rows"
        raise ValueError(f"{where} ({len(bad)} of {rows} rows are bad)")
    if bad:
        listed = ", ".join(str(line) for line, _ in bad[:5]) + (", ..." if len(bad) > 5 else "")
        skipped[f"bad row in {table.path.name} (line {listed}: {bad[0][1]})"] = len(bad)
    first, last = int(np.argmin(table.time)), int(np.argmax(table.time))
    if (int(table.time[last]) - int(table.time[first])) / 1e9 > TEN_YEARS_S:
        lines = f"lines {table.line[first]} and {table.line[last]}"
        raise ValueError(f"{table.path}, {lines}: more than ten years apart, {NANOSECONDS}")
    return table


def in_order(time, what, skipped, unique=True):
    """Indices that sort `time`; if `unique`, only the last row of each stamp.

    Counts rows out of order and rows left out in `skipped`.
    """
    order = np.argsort(time, kind="stable")
    backwards = int((np.diff(time) < 0).sum())
    if backwards:
        skipped[f"{what} out of order (sorted, none lost)"] = backwards
    if not unique:
        return order
    last = np.ones(len(order), bool)
    last[:-1] = np.diff(time[order]) > 0
    if not last.all():
        skipped[f"{what} with the stamp of another (last kept)"] = int((~last).sum())
    return order[last]


def wrap_bearings(angle):
    """Wrap angles to [-pi, pi]; those already there, pi included, keep their bits."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


def pose_at(stamp, time, pose):
    """Interpolate the pose [3] at a stamp, the heading along the shorter turn; None outside."""
    if len(time) == 0 or not time[0] <= stamp <= time[-1]:
        return None
    unwrapped = np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])])
    since = (time - stamp) / 1e9
    return np.array([np.interp(0.0, since, column) for column in unwrapped.T])
