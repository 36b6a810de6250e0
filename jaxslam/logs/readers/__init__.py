"""Read logs in other formats: one module per format, each with a function that returns a `Log`.

`FORMATS` has a row for each; a new format is a module and a row. `text_table` serves the text
formats, `mat5` MATLAB files. Nothing heavy is imported before a file is read: `jaxslam convert
--help` lists the formats.
"""

from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jaxslam.logs.log import Log


class Format(NamedTuple):
    """A format that can be read.

    `name` for messages; `detects(path)`: whether a path is in this format; `read(path)`: the `Log`;
    `help`: what the files hold. `robots`: `read(path, robot)` chooses one of several robots;
    `several`: `read(paths)` reads a list.
    """

    name: str
    detects: Callable
    read: Callable
    help: str
    robots: bool = False
    several: bool = False


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
        if not path.exists() and not _is_log(path):
            raise ValueError(f"{path}: no such file or folder")
    fits = (row for row in FORMATS if row.several or len(paths) == 1)
    found = next((row for row in fits if all(map(row.detects, paths))), None)
    if robot is not None and not (found and found.robots):
        raise ValueError(f"{paths[0]}: only an MRCLAM folder has robots to choose from")
    if found is None:
        raise ValueError(f"{', '.join(map(str, paths))}: format not known; give {allowed}")
    try:
        source = paths if found.several else paths[0]
        return found.read(source, *([robot] if found.robots else []))
    except OSError as err:
        raise ValueError(f"{err.filename or paths[0]}: cannot read ({err.strerror})") from err
    except ValueError as err:
        if any(str(path) in str(err) for path in paths):
            raise
        raise ValueError(f"{paths[0]}: {err}") from err  # what `Log` refuses names no file


def _import_later(module, name):
    """A function that imports the reader `name` when it is called."""
    return lambda *given: getattr(import_module(f"jaxslam.logs.{module}"), name)(*given)


def _is_log(path):
    from jaxslam.logs.log_file import BUNDLED

    return str(path) in BUNDLED or (path.suffix.lower() == ".npz" and path.exists())


FORMATS = (
    Format(
        "an MRCLAM folder (with Barcodes.dat)", lambda path: (path / "Barcodes.dat").exists(),
        _import_later("readers.mrclam", "read_mrclam"), "one robot's log (--robot)", robots=True,
    ),
    Format(
        "a .mat file", lambda path: path.suffix.lower() == ".mat",
        _import_later("readers.aer1513", "read_mat"), "the course's dataset2.mat",
    ),
    Format(
        "two to four .csv files", lambda path: path.suffix.lower() == ".csv",
        _import_later("readers.csv_files", "read_csv"),
        "odometry, measurements, and the truth if known", several=True,
    ),
    Format(
        "a .npz log", _is_log,
        _import_later("log_file", "load_log"), "to move its frames (--time-offset)",
    ),
)  # fmt: skip
