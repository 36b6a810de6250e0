"""Write the run folder, all of it or nothing (docs/reference/file-formats.md lists its files).

The folder of a run with checkpoints (`runs.checkpoints`) exists from its beginning; there
`summary.json` appears last.
"""

import json
import os
import shutil
from contextlib import contextmanager
from dataclasses import fields
from importlib.metadata import PackageNotFoundError, version
from math import cos, isfinite, sin
from numbers import Integral
from pathlib import Path
from platform import python_version

import numpy as np

from jaxslam.files import NO_SPACE, fsync_all, move_folder, temporary_sibling
from jaxslam.logs.log_file import BUNDLED, save_log
from jaxslam.results import run_lock
from jaxslam.results.events import ambiguous_measurements, list_events
from jaxslam.results.figures import FIGURES, draw_figures
from jaxslam.results.metrics import compute_errors

FILE_NAMES = {  # columns of `steps.npz` that keep their name of version 0.1
    "landmark_id": "match",
    "lineage_landmark_id": "lineage_birth",
    "refined_landmark_id": "refined_match",
}
SMOOTHED = "ancestral", "lineage", "refined"  # tables of `steps.npz` that not every run has

FINISHED, CHECKPOINTS, PARTIAL = "summary.json", "checkpoints", ".results"
NEEDED = "run.toml", FINISHED, "steps.npz"  # in every finished run folder
WORKING = run_lock.NAME, CHECKPOINTS, PARTIAL  # only in an unfinished one
OPTIONAL = "log.npz", "trajectory_refined.tum", "landmarks_refined.csv", *FIGURES
FILES = *NEEDED, "trajectory.tum", "landmarks.csv", "events.jsonl", *OPTIONAL


def save(result, directory, overwrite=False, log_source=None, figures=True):
    """Write a run folder; all of it appears at once, or nothing does.

    `log_source`: path or name that the log was loaded from; None: the log is stored in the folder.
    Raises `ValueError` if the folder can't be written, or exists (`overwrite`: and is no run's).
    """
    directory = Path(directory)
    check_target(directory, overwrite)
    target = directory.resolve()
    partial = temporary_sibling(target)
    with _writing(directory, partial):
        target.parent.mkdir(parents=True, exist_ok=True)
        partial.mkdir()
        _write_files(result, partial, _log_reference(log_source, target), figures)
        move_folder(partial, target, overwrite)


def save_into(result, directory, log_source=None):
    """Write the results of a run with checkpoints into its folder; `summary.json` appears last.

    Raises `OSError` if there is no space on the disk.
    """
    directory = Path(directory)
    partial = directory / PARTIAL
    clear_results(directory)
    with _writing(directory, partial):
        partial.mkdir()
        _write_files(result, partial, _log_reference(log_source, directory.resolve()))
        for path in sorted(partial.iterdir(), key=lambda path: path.name == FINISHED):
            if path.name == FINISHED:
                fsync_all(directory)
            os.replace(path, directory / path.name)
        fsync_all(directory)


def clear_results(directory):
    """Remove a run's results, complete or not; first the file that marks them as complete."""
    shutil.rmtree(directory / PARTIAL, ignore_errors=True)
    for name in (FINISHED, *FILES):
        (directory / name).unlink(missing_ok=True)


def check_target(directory, overwrite=False, resume=False):
    """Raise `ValueError` if a run folder can't be written here; call it before a long run.

    `resume`: allow a finished or an unfinished run. Raises `BlockingIOError` if another process is
    writing there.
    """
    directory = Path(directory)
    with _writing(directory):
        if directory.exists() or directory.is_symlink():
            run_lock.check_unlocked(directory)
            _check_existing(directory, overwrite, resume)
        parent = next(path for path in directory.resolve().parents if path.exists())
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            raise ValueError(f"{directory}: can't be made in {parent}; choose another with --out")


def _check_existing(directory, overwrite, resume):
    if not directory.is_dir():
        raise ValueError(f"{directory}: is not a folder; choose another with --out")
    names = {path.name for path in directory.iterdir()}
    unfinished = FINISHED not in names and not names.isdisjoint(WORKING)
    is_run = unfinished or not names or names.issuperset(NEEDED)
    if resume and is_run:
        return
    if resume:
        raise ValueError(f"{directory}: is not a run's folder, so there is nothing to resume")
    if unfinished and not overwrite:
        raise ValueError(f"{directory}: a run is unfinished; add --resume, or --overwrite")
    if not overwrite:
        raise ValueError(f"{directory}: exists; choose another folder or add --overwrite")
    if not is_run:
        raise ValueError(f"{directory}: is not a run's folder, so it is not overwritten")
    if foreign := sorted(names - {*FILES, *WORKING}):
        raise ValueError(f"{directory}: holds {foreign[0]}, not of a run, so it is not overwritten")


def summarise(result):
    """Return `summary.json` as a dict: sizes, times, evidence, warnings, versions, errors."""
    config = result.config
    return {
        "log": result.log.name,
        **{k: getattr(config, k) for k in ("sensor", "association", "proposal", "descriptors")},
        "seed": result.seed,
        "n_particles": config.particles,
        "n_steps": len(result.time),
        "n_measurements": int((np.asarray(result.row) >= 0).sum()),
        "seconds": result.seconds,
        "compile_seconds": result.compile_seconds,
        "log_likelihood": float(result.log_likelihood),
        "n_landmarks": len(result.landmarks.mean),
        "min_ess": float(np.min(result.ess)) if len(result.ess) else None,
        "overflow": float(np.sum(result.overflow)),
        "dropped_measurements": int(sum(result.dropped.values())),
        "dropped": dict(result.dropped),
        "ambiguous_measurements": len(ambiguous_measurements(result)),
        "warnings": list(result.flags),
        "advice": list(result.advice),
        **_smoother_summary(result),
        "versions": versions(),
        **compute_errors(result),
    }


def _smoother_summary(result):
    """Return the part of `summarise` about genealogy and refinement, as far as the run has them."""
    summary = {}
    if result.ancestral is not None:
        summary["least_ancestors"] = int(np.min(result.ancestral.distinct, initial=2**31))
    if result.refine_seconds is not None:
        summary["refine_seconds"] = result.refine_seconds
    if (refined := result.refined) is not None:
        summary["refine_rounds"] = int(refined.rounds)
        summary["refine_converged"] = bool(refined.converged)
        summary["n_landmarks_refined"] = len(refined.mean)
    return summary


def versions():
    """Return the versions of Python and of the packages that compute a run."""
    found = {"python": python_version()}
    for package in ("jaxslam", "jax", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def tum_lines(time, pose):
    """Yield lines `t x y z qx qy qz qw`: seconds exact to the nanosecond, m, unit quaternion.

    `time` int64 ns [T], `pose` [T, 3]. Without exponents, which not every reader accepts.
    """
    for stamp, (x, y, heading) in zip(np.asarray(time).tolist(), pose, strict=True):
        sign, (second, nano) = "-" * (stamp < 0), divmod(abs(stamp), 10**9)
        turn = f"{sin(heading / 2):.9f} {cos(heading / 2):.9f}"
        yield f"{sign}{second}.{nano:09d} {x:.9f} {y:.9f} 0 0 0 {turn}\n"


def landmark_lines(landmarks):
    """Yield the lines of `landmarks.csv`, numbers with all their digits."""
    yield "id,x,y,sxx,sxy,syy,n\n"
    columns = landmarks.id, landmarks.mean, landmarks.cov, landmarks.n
    for landmark_id, mean, cov, n in zip(*columns, strict=True):
        numbers = ",".join(repr(float(value)) for value in (*mean, *cov))
        yield f"{int(landmark_id)},{numbers},{int(n)}\n"


def run_toml(result, log):
    """Return the text of `run.toml`: all settings of the run, with defaults filled in."""
    lines = [f"name = {_toml(result.log.name)}"]
    lines += [f"log = {_toml(log)}  # path (from this folder) or name"]
    lines += [f"seed = {_toml(result.seed)}"]
    lines += ["", "[config]", *_toml_table(vars(result.config))]
    lines += ["", "[params]  # SI units, radians", *_toml_table(result.params._asdict())]
    return "\n".join(lines) + "\n"


def _write_files(result, folder, source, figures=True):
    """Write all files of a run into a folder, and flush them to the disk."""
    if source is None:
        save_log(folder / "log.npz", result.log)
        source = "log.npz"
    columns: dict = {f.name: getattr(result, f.name) for f in fields(result) if f.metadata}
    tables = {"map": result.landmarks} | {name: getattr(result, name) for name in SMOOTHED}
    for name, table in tables.items():
        if table is not None:
            columns |= {f"{name}_{key}": value for key, value in table._asdict().items()}
    columns = {name: np.asarray(value) for name, value in columns.items() if value is not None}
    columns = {FILE_NAMES.get(name, name): column for name, column in columns.items()}
    np.savez_compressed(folder / "steps.npz", **columns)
    files = {
        "run.toml": [run_toml(result, source)],
        "trajectory.tum": tum_lines(result.time, result.pose),
        "landmarks.csv": landmark_lines(result.landmarks),
        "events.jsonl": (_json(event) + "\n" for event in list_events(result)),
        "summary.json": [_json(summarise(result), indent=2) + "\n"],
    }
    if result.refined is not None:
        files["trajectory_refined.tum"] = tum_lines(result.time, result.refined.pose)
        files["landmarks_refined.csv"] = landmark_lines(result.landmarks_refined)
    for name, lines in files.items():
        with open(folder / name, "w", encoding="utf-8", newline="\n") as file:
            file.writelines(lines)
    if figures:
        draw_figures(result, folder)
    fsync_all(*folder.iterdir(), folder)


def _log_reference(log_source, target):
    """Return the log's entry in run.toml, a bundled name or a path; None: store a copy."""
    if log_source is None or (str(log_source) in BUNDLED and not Path(log_source).exists()):
        return log_source
    path = Path(log_source).resolve()
    # A log inside the folder that is being replaced would go with it.
    return None if path.is_relative_to(target) else str(path)


@contextmanager
def _writing(directory, partial=None):
    """Turn an `OSError` into one that names the folder, or a `ValueError` if there is space enough
    and no other process writes; remove `partial` at the end."""
    try:
        yield
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno in NO_SPACE:
            raise OSError(error.errno, error.strerror, str(directory)) from error
        problem = f"can't be written ({error.strerror}); choose another with --out"
        raise ValueError(f"{directory}: {problem}") from error
    finally:
        if partial:
            shutil.rmtree(partial, ignore_errors=True)


def _toml(value):
    """Format a text, bool, whole number or float as TOML."""
    if isinstance(value, (str, bool)):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(int(value) if isinstance(value, Integral) else float(value))


def _toml_table(values):
    return [f"{name} = {_toml(value)}" for name, value in values.items()]


def _json(value, indent=None):
    """Format as JSON; numbers that are not finite, which JSON lacks, become null."""
    return json.dumps(_finite(value), indent=indent, ensure_ascii=False, allow_nan=False)


def _finite(value):
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not isfinite(value) else value
