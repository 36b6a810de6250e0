"""Run one log many times in one program: with several seeds and sets of parameters.

The runs are filtered one after the other within one compiled loop (batched arithmetic would take
both sides of every branch, and update the landmarks of every run); several devices share the runs.
Each gives the same bits as alone.
"""

import csv
import dataclasses
import itertools
import shutil
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.files import fsync_all, move_folder, temporary_sibling
from jaxslam.filter.frames import frames_from_log
from jaxslam.filter.sharding import map_over_devices
from jaxslam.parameter_file import validate
from jaxslam.parameters import Params
from jaxslam.results import run_folder
from jaxslam.results.tables import format_table
from jaxslam.runs import compiled, memory
from jaxslam.runs import run as runner
from jaxslam.runs.assemble import RunProgress, assemble_result
from jaxslam.smoother.genealogy import Tree

STATE_BYTES = 2**29  # of the states of all runs in one program, at most
TABLE = "runs.csv"
COLUMNS = (
    *("log_likelihood", "min_ess", "n_landmarks", "overflow", "dead_reckoning_ate_m"),
    *("ate_filtered_rmse_m", "ate_refined_rmse_m"),
    *("landmark_filtered_rmse_m", "landmark_refined_rmse_m"),
    *("landmarks_matched", "landmarks_spurious"),
)
SHOWN = {  # heading and format of the columns of the printed table
    "log_likelihood": ("log evidence", ".1f"),
    "min_ess": ("least ESS", ".0f"),
    "ate_filtered_rmse_m": ("path [m]", ".4f"),
    "ate_refined_rmse_m": ("refined", ".4f"),
    "landmark_filtered_rmse_m": ("landmarks [m]", ".4f"),
    "landmark_refined_rmse_m": ("refined", ".4f"),
    "n_landmarks": ("landmarks", ".4g"),
    "landmarks_matched": ("true ones", ".4g"),
    "landmarks_spurious": ("spurious", ".4g"),
}


class Task(NamedTuple):
    """A run: its seed, its `Params`, and the values that were `swept`, by name."""

    seed: int
    params: Params
    swept: dict[str, float]


def plan_tasks(seeds, params, sweeps=()):
    """List a `Task` for every combination of the sweeps' values and, within it, every seed.

    `seeds`: text like `0-9` or `1,4,7-9`. `sweeps`: texts like `err_rot=0.05,0.1`. Raises
    `ValueError` for other text, unknown parameters, and values that are not allowed.
    """
    axes = dict(map(_parse_sweep, sweeps))
    if len(axes) < len(sweeps):
        raise ValueError(f"--sweep: a parameter is named twice in {' '.join(sweeps)}")
    tasks = []
    for values in itertools.product(*axes.values()):
        swept = dict(zip(axes, values, strict=True))
        changed = validate(params._replace(**swept), "--sweep")
        tasks += [Task(seed, changed, swept) for seed in parse_seeds(seeds)]
    return tasks


def parse_seeds(text):
    """Parse text like `0-9` or `1,4,7-9` as seeds, each once."""
    seeds = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        last = last if dash else first
        if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last) < 2**32):
            raise ValueError(f"--seeds is {text!r}; must be whole numbers, like 0-9 or 1,4,7-9")
        seeds += range(int(first), int(last) + 1)
    return list(dict.fromkeys(seeds))


def _parse_sweep(text):
    """Parse text like `err_rot=0.05,0.1` as a name and values."""
    name, equals, values = text.partition("=")
    if not equals or name not in Params._fields:
        raise ValueError(f"--sweep is {text!r}; must be a parameter's name and values, like a=1,2")
    try:
        return name, list(dict.fromkeys(float(value) for value in values.split(",")))
    except ValueError:
        raise ValueError(f"--sweep {name}: {values!r} are not numbers, like 0.05,0.1") from None


def run_tasks(log, config, tasks, progress=None, refine=True, devices=1):
    """Return the `Result` of every `Task`, the same as that of `run.run`.

    `progress`: called with (frames done, number of frames, a line of text) of all runs together.
    `devices`: number of devices that share the runs; with rejuvenation, the runs are filtered one
    by one on one device. Raises `ValueError` as `run.run` does.
    """
    if config.devices > 1:
        raise ValueError("Config.devices: devices share runs here, not particles; must be 1")
    if config.rejuvenate:
        return _run_in_turn(log, config, tasks, progress, refine)
    size = memory.bytes_of(compiled.state_shapes(config))
    most = min(len(tasks), max(devices, STATE_BYTES // size))
    memory.check_memory(compiled.estimate_memory(config, len(log.frame_time)), config)
    results, filter_chunk, total = [], None, len(tasks) * len(log.frame_time)
    for first in range(0, len(tasks), most):
        group = tasks[first : first + most]
        done = first * len(log.frame_time)
        if progress:
            progress(done, total, f"runs {first + 1}-{first + len(group)} of {len(tasks)}")
        count = len(group)
        # Groups of one size, so that one compilation serves all; the padding is left out again.
        group += [group[-1]] * (most - count)
        filter_chunk, more = _run_together(log, config, group, count, devices, filter_chunk, refine)
        results += more
    return results


def _run_in_turn(log, config, tasks, progress, refine):
    """Run the tasks one by one: rejuvenation refines on the host, so one loop can't hold all."""
    results, frames = [], len(log.frame_time)
    for i, task in enumerate(tasks):
        if progress:
            progress(i * frames, len(tasks) * frames, f"run {i + 1} of {len(tasks)}")
        results.append(runner.run(log, config, task.params, task.seed, refine=refine))
    return results


def _run_together(log, config, group, count, devices, filter_chunk, refine):
    """Run a group of tasks in one loop, compiled if `filter_chunk` is None.

    Returns the compiled loop and the results of the first `count` tasks.
    """
    data = [frames_from_log(log, config, task.params) for task in group]
    params = [jax.tree.map(jnp.asarray, task.params) for task in group]
    keys = [jax.random.key(task.seed) for task in group]
    states = [runner.initial_state(log, config, key) for key in keys]
    keys, states, params = map(_stack, (keys, states, params))
    # A chunk hands over the records of all runs.
    wide = dataclasses.replace(config, particles=config.particles * len(group))
    runs = [RunProgress(None, [], Tree(), 0, 0.0, None, []) for _ in range(count)]
    begin, compile_seconds = time.perf_counter(), 0.0
    for chunks in zip(*(compiled.split_into_chunks(part, wide) for part in data), strict=True):
        length, (odometry, _) = chunks[0]
        measurements = _stack([chunk[1] for _, chunk in chunks])
        arguments = keys, states, jnp.int32(length), odometry, measurements, params
        if filter_chunk is None:
            filter_chunk = _filter_frames.lower(*arguments, config, devices).compile()
            compile_seconds = time.perf_counter() - begin
        states, kept = filter_chunk(*arguments)
        kept = jax.tree.map(lambda leaf, length=length: np.asarray(leaf)[:, :length], kept)
        for i, so_far in enumerate(runs):
            so_far.add_chunk(*jax.tree.map(lambda leaf, i=i: leaf[i], kept))
    seconds = (time.perf_counter() - begin - compile_seconds) / len(group)
    results = []
    for i, so_far in enumerate(runs):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        so_far, task = so_far._replace(state=state, seconds=seconds), group[i]
        result = assemble_result(
            so_far, log, config, task.params, task.seed, data[i], compile_seconds
        )
        results.append(runner.refine_result(result) if refine else result)
    return filter_chunk, results


def _stack(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@partial(jax.jit, static_argnames=("config", "devices"))
def _filter_frames(keys, states, count, odometry, measurements, params, config, devices):
    """Filter a chunk of frames in all runs (`compiled.filter_frames`)."""

    def filter_run(run):
        key, state, measurements, params = run
        return compiled.filter_frames(key, state, count, odometry, measurements, params, config)

    return map_over_devices(filter_run, (keys, states, measurements, params), devices)


def summary_rows(tasks, results):
    """List a dict per run: seed, swept values, and the `COLUMNS` that any run has (or None)."""
    summaries = [run_folder.summarise(result) for result in results]
    names = [name for name in COLUMNS if any(name in summary for summary in summaries)]
    return [
        {"seed": task.seed} | task.swept | {name: summary.get(name) for name in names}
        for task, summary in zip(tasks, summaries, strict=True)
    ]


def format_runs(rows):
    """Format the runs as a table; below each set of parameters, mean and standard deviation."""
    swept = [name for name in rows[0] if name != "seed" and name not in COLUMNS]
    shown = [name for name in SHOWN if name in rows[0]]
    lines = [["seed", *swept, *(SHOWN[name][0] for name in shown)]]
    for _, part in itertools.groupby(rows, lambda row: [row[name] for name in swept]):
        group = list(part)
        values = [f"{group[0][name]:g}" for name in swept]
        lines += [[str(row["seed"]), *values, *_cells(row, shown)] for row in group]
        if len(group) > 1:
            columns = {name: [_value(row[name]) for row in group] for name in shown}
            for label, statistic in (("mean", np.mean), ("sd", partial(np.std, ddof=1))):
                summary = {name: statistic(column) for name, column in columns.items()}
                lines.append([label, *values, *_cells(summary, shown)])
    return format_table(lines, ">" * len(lines[0]))


def _value(value):
    return np.nan if value is None else value


def _cells(row, names):
    return [format(_value(row[name]), SHOWN[name][1]) for name in names]


def _short(value):
    """Format a number with six digits, or with all if it needs them."""
    return f"{value:g}" if float(f"{value:g}") == value else repr(float(value))


def check_target(folder, overwrite):
    """Raise `ValueError` if the runs must not be written to this folder."""
    folder = Path(folder)
    if not folder.exists():
        run_folder.check_target(folder)
        return
    if not overwrite:
        raise ValueError(f"{folder}: exists; choose another folder or add --overwrite")
    names = {path.name for path in folder.iterdir()}
    if names and TABLE not in names:
        raise ValueError(f"{folder}: holds no {TABLE}, so it is not overwritten")
    for name in sorted(names - {TABLE}):
        if not name.startswith("seed-"):
            raise ValueError(f"{folder}: holds {name}, which is no run's; it is not overwritten")
        run_folder.check_target(folder / name, overwrite=True)


def save(tasks, results, folder, overwrite=False, log_source=None):
    """Write the table and each run's folder, without figures; all appears at once."""
    check_target(folder, overwrite)
    target = Path(folder).resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    partial_folder = temporary_sibling(target)
    partial_folder.mkdir()
    try:
        for task, result in zip(tasks, results, strict=True):
            values = [f"{name}-{_short(value)}" for name, value in task.swept.items()]
            run = partial_folder / "-".join([f"seed-{task.seed}", *values])
            run_folder.save(result, run, log_source=log_source, figures=False)
        rows = summary_rows(tasks, results)
        with open(partial_folder / TABLE, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        fsync_all(partial_folder / TABLE, partial_folder)
        move_folder(partial_folder, target, overwrite)
    finally:
        shutil.rmtree(partial_folder, ignore_errors=True)
