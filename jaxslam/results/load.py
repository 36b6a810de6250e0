"""Read a run folder; draw its figures or compute its errors again."""

import json
import tomllib
import zlib
from dataclasses import MISSING, fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from jaxslam.config import Config
from jaxslam.logs.log_file import BUNDLED, load_log
from jaxslam.parameters import Params, current_names
from jaxslam.results.figures import draw_figures
from jaxslam.results.metrics import compute_errors
from jaxslam.results.result import MapEstimate, Result
from jaxslam.results.run_folder import FILE_NAMES, SMOOTHED
from jaxslam.smoother.genealogy import Ancestral, Lineage


def load_result(directory: str | Path, log: str | Path | None = None) -> Result:
    """Load the `Result` in a run folder. `log`: path of its log, if that was moved.

    Raises `ValueError` if a file is missing or broken, or if the log is not the run's.
    """
    directory = Path(directory)
    try:
        settings = tomllib.loads((directory / "run.toml").read_text(encoding="utf-8"))
        config = Config.from_dict(settings["config"])
        params = Params(**current_names(settings["params"]))
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        with open(directory / "steps.npz", "rb") as f, np.load(f, allow_pickle=False) as archive:
            names = {stored: name for name, stored in FILE_NAMES.items()}
            steps = {names.get(stored, stored): archive[stored] for stored in archive.files}
        columns = [f for f in fields(Result) if f.metadata]
        known = {f.name: steps[f.name] for f in columns if f.name in steps or f.default is MISSING}
        known["landmarks"] = MapEstimate(**_columns_of("map", steps))
        known |= _smoother_tables(steps) | {"seed": settings["seed"]}
        known |= {name: summary[name] for name in ("seconds", "compile_seconds", "dropped")}
        known["refine_seconds"], source = summary.get("refine_seconds"), settings["log"]
    except FileNotFoundError as error:
        missing = Path(error.filename).name
        raise ValueError(f"{directory}: no {missing}; not a run's folder") from None
    except (OSError, KeyError, TypeError, ValueError, EOFError, BadZipFile, zlib.error) as error:
        raise ValueError(f"{directory}: a broken run's folder ({error}); run it again") from error
    used = _load_log_of(directory, source) if log is None else load_log(log)
    if not np.isin(known["time"], used.frame_time).all():
        problem = f"{used.name} is not the log of this run (frame times differ)"
        raise ValueError(f"{directory}: {problem}")
    return Result(log=used, config=config, params=params, **known)


def _columns_of(name, steps):
    """Return the columns of one table in `steps.npz`; scalars as numbers."""
    start = f"{name}_"
    columns = {key.removeprefix(start): steps[key] for key in steps if key.startswith(start)}
    return {key: value if value.ndim else value.item() for key, value in columns.items()}


def _smoother_tables(steps):
    """Return the tables of `SMOOTHED` that the folder has; old folders have none."""
    tables = {name: _columns_of(name, steps) for name in SMOOTHED}
    kinds = {"ancestral": Ancestral, "lineage": Lineage}
    if tables["refined"]:
        from jaxslam.smoother.refine import Refined  # imports JAX, which nothing else here needs

        kinds["refined"] = Refined
    return {name: kind(**tables[name]) for name, kind in kinds.items() if tables[name]}


def evaluate_folder(directory, log=None):
    """Compute the errors of a saved run again, from its columns and its log's truth."""
    return compute_errors(load_result(directory, log))


def _load_log_of(directory, source):
    try:
        return load_log(source if source in BUNDLED else directory / source)
    except ValueError as error:
        raise ValueError(f"{error}; it is the log of {directory}: add --log PATH") from error


def plot_folder(directory, log=None):
    """Draw the figures of a saved run again. `log`: path of its log, if that was moved."""
    return draw_figures(load_result(directory, log), directory)
