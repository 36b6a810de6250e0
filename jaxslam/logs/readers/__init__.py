"""Read logs in other formats: one module per format, each with a function that returns a `Log`.

`FORMATS` has a row for each; a new format is a module and a row. `text_table` serves the text
formats, `mat5` MATLAB files. Nothing heavy is imported before a file is read: `jaxslam convert
--help` lists the formats.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jaxslam.logs.log import Log


class Format(NamedTuple):
    """A format that can be read.

    `name` for messages; `detects(paths)`: whether a list of existing paths is in this format;
    `read(paths, robot)`: the `Log`; `help`: what the files hold, and their option; `robots`:
    whether `robot` chooses one of several.
    """

    name: str
    detects: Callable
    read: Callable
    help: str
    robots: bool = False


def read(paths: str | Path | Sequence[str | Path], robot: int | None = None) -> "Log":
    """Read the `Log` of a file, a folder or a list of files, in the first of `FORMATS` that fits.

    `robot`: number of the robot, where there are several. Raises `ValueError` naming the file and
    what is wrong.
    """
    paths = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    *names, last = (row.name for row in FORMATS)
    allowed = f"{', '.join(names)}, or {last}"
    if not paths:
        raise ValueError(f"nothing to read: give {allowed}")
    for path in paths:
        if not path.exists() and not _is_log([path]):
            raise ValueError(f"{path}: no such file or folder")
    found = next((row for row in FORMATS if row.detects(paths)), None)
    if robot is not None and not (found and found.robots):
        raise ValueError(f"{paths[0]}: only an MRCLAM folder has robots to choose from")
    if found is None:
        raise ValueError(f"{', '.join(map(str, paths))}: format not known; give {allowed}")
    try:
        return found.read(paths, robot)
    except OSError as err:
        raise ValueError(f"{err.filename or paths[0]}: cannot read ({err.strerror})") from err
    except ValueError as err:
        if any(str(path) in str(err) for path in paths):
            raise
        raise ValueError(f"{paths[0]}: {err}") from err  # what `Log` refuses names no file


def _is_mrclam(paths):
    return len(paths) == 1 and (paths[0] / "Barcodes.dat").exists()


def _read_mrclam(paths, robot):
    from jaxslam.logs.readers.mrclam import read_mrclam

    return read_mrclam(paths[0], robot)


def _is_mat(paths):
    return len(paths) == 1 and paths[0].suffix.lower() == ".mat"


def _read_mat(paths, robot):
    from jaxslam.logs.readers.aer1513 import read_mat

    return read_mat(paths[0])


def _is_csv(paths):
    return all(path.suffix.lower() == ".csv" for path in paths)


def _read_csv(paths, robot):
    from jaxslam.logs.readers.csv_files import read_csv

    return read_csv(paths)


def _is_log(paths):
    from jaxslam.logs.log_file import BUNDLED

    npz = paths[0].suffix.lower() == ".npz" and paths[0].exists()
    return len(paths) == 1 and (npz or str(paths[0]) in BUNDLED)


def _read_log(paths, robot):
    from jaxslam.logs.log_file import load_log

    return load_log(paths[0])


FORMATS = (
    Format(
        "an MRCLAM folder (with Barcodes.dat)",
        _is_mrclam,
        _read_mrclam,
        "one robot's log (--robot)",
        robots=True,
    ),
    Format("a .mat file", _is_mat, _read_mat, "the course's dataset2.mat"),
    Format(
        "two to four .csv files",
        _is_csv,
        _read_csv,
        "odometry, measurements, and the truth if known",
    ),
    Format("a .npz log", _is_log, _read_log, "to move its frames (--time-offset)"),
)
