"""Other people's logs: one module per format, each with one function that makes a `Log`."""

from pathlib import Path

from jaxslam.logs.log_file import BUNDLED, load_log
from jaxslam.logs.readers.aer1513 import read_mat
from jaxslam.logs.readers.csv_files import read_csv
from jaxslam.logs.readers.mrclam import read_mrclam


def read(paths, robot=None):
    """`Log` of a foreign file, folder or list of files, whose format is guessed.

    A `.mat` is the course's, a folder with `Barcodes.dat` MRCLAM's (`robot`: its number), and two
    to four `.csv` files are odometry, measurements, truth and landmarks, in any order; a `.npz`, or
    the name of a bundled log, is a log already. Raises `ValueError` naming the file and what is
    wrong.
    """
    paths = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    if not paths:
        raise ValueError("nothing to read: give a .mat file, an MRCLAM folder or two .csv files")
    for path in paths:
        if not path.exists() and str(path) not in BUNDLED:
            raise ValueError(f"{path}: no such file or folder")
    try:
        return _read(paths, robot)
    except OSError as err:
        raise ValueError(f"{err.filename or paths[0]}: cannot read ({err.strerror})") from err
    except ValueError as err:
        if any(str(path) in str(err) for path in paths):
            raise
        raise ValueError(f"{paths[0]}: {err}") from err  # what `Log` refuses names no file


def _read(paths, robot):
    if len(paths) == 1 and (paths[0] / "Barcodes.dat").exists():
        return read_mrclam(paths[0], robot)
    if robot is not None:
        raise ValueError(f"{paths[0]}: only an MRCLAM folder has robots to choose from")
    if len(paths) == 1 and paths[0].suffix.lower() == ".mat":
        return read_mat(paths[0])
    if all(path.suffix.lower() == ".csv" for path in paths):
        return read_csv(paths)
    if len(paths) == 1 and (paths[0].suffix.lower() == ".npz" or str(paths[0]) in BUNDLED):
        return load_log(paths[0])
    allowed = "a .mat file, a .npz log, an MRCLAM folder (with Barcodes.dat), or two to four .csv"
    listed = ", ".join(str(path) for path in paths)
    raise ValueError(f"{listed}: format not known; give {allowed}")
