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
            columns = {
                f.name: steps[f.name]
                for f in fields(Result)
                if f.metadata and (f.name in steps or f.default is MISSING)
            }
            landmarks = MapEstimate(**_columns_of("map", steps))
            columns |= _smoother_columns(steps)
        seed, source = settings["seed"], settings["log"]
        spent = {name: summary[name] for name in ("seconds", "compile_seconds", "dropped")}
        spent["refine_seconds"] = summary.get("refine_seconds")
    except FileNotFoundError as error:
        problem = f"no {Path(error.filename).name}; not a run's folder"
        raise ValueError(f"{directory}: {problem}") from None
    except (OSError, KeyError, TypeError, ValueError, EOFError, BadZipFile, zlib.error) as error:
        raise ValueError(f"{directory}: a broken run's folder ({error}); run it again") from error
    used = _find_log(directory, source) if log is None else load_log(log)
    if not np.isin(columns["time"], used.frame_time).all():
        problem = f"{used.name} is not the log of this run (frame times differ)"
        raise ValueError(f"{directory}: {problem}")
    return Result(
        log=used, config=config, params=params, seed=seed, landmarks=landmarks, **columns, **spent
    )


def _columns_of(name, steps):
    """Return the columns of one table in `steps.npz`; those of no dimension as numbers."""
    start = f"{name}_"
    columns = {key.removeprefix(start): steps[key] for key in steps if key.startswith(start)}
    return {key: value if value.ndim else value.item() for key, value in columns.items()}


def _smoother_columns(steps):
    """Return the tables of `SMOOTHED` that are there; older folders have none."""
    found = {name: _columns_of(name, steps) for name in SMOOTHED}
    kinds = {"ancestral": Ancestral, "lineage": Lineage}
    if found["refined"]:
        from jaxslam.smoother.refine import Refined  # brings JAX, which nothing else here needs

        kinds["refined"] = Refined
    return {name: kind(**found[name]) for name, kind in kinds.items() if found[name]}


def evaluate_folder(directory, log=None):
    """Compute the errors of a saved run again, from its columns and its log's truth."""
    return compute_errors(load_result(directory, log))


def _find_log(directory, source):
    try:
        return load_log(source if source in BUNDLED else directory / source)
    except ValueError as error:
        raise ValueError(f"{error}; it is the log of {directory}: add --log PATH") from error


def plot_folder(directory, log=None):
    """Draw the figures of a saved run again. `log`: path of its log, if that was moved."""
    return draw_figures(load_result(directory, log), directory)
