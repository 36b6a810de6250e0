"""Many runs of one log in one program: seeds, and sets of parameters.

Small runs are worked off one after the other inside one compiled loop (batched arithmetic would
take both sides of every branch, and look at every landmark of every run); several devices share
them. Each is bit for bit the run that it would be alone.
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
from jaxslam.results.events import association_entropy
from jaxslam.runs import compiled, memory
from jaxslam.runs import run as runner
from jaxslam.runs.assemble import RunProgress, assemble_result
from jaxslam.smoother.genealogy import Tree

STATE_BYTES = 2**29  # what the states of the runs in one program may take
TABLE = "runs.csv"
COLUMNS = (
    *("log_likelihood", "min_ess", "n_landmarks", "overflow", "dead_reckoning_ate_m"),
    *("ate_filtered_rmse_m", "ate_refined_rmse_m"),
    *("landmark_filtered_rmse_m", "landmark_refined_rmse_m"),
    *("landmarks_matched", "landmarks_spurious"),
)


SHOWN = {  # heading and format of the columns that people see
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
    """One of the runs: its seed, its `Params`, and what of these was `swept` (name: value)."""

    seed: int
    params: Params
    swept: dict[str, float]


def plan_tasks(seeds, params, sweeps=()):
    """A `Task` for every seed and every combination of the sweeps' values, in that order.

    `seeds`: text like `0-9` or `1,4,7-9`. `sweeps`: texts like `err_rot=0.05,0.1`. Raises
    `ValueError` for what is neither, a name that is no parameter, or a value that is not allowed.
    """
    axes = dict(map(_axis, sweeps))
    if len(axes) < len(sweeps):
        raise ValueError(f"--sweep: a parameter is named twice in {' '.join(sweeps)}")
    found = []
    for values in itertools.product(*axes.values()):
        told = dict(zip(axes, values, strict=True))
        given = validate(params._replace(**told), "--sweep")
        found += [Task(seed, given, told) for seed in parse_seeds(seeds)]
    return found


def parse_seeds(text):
    """Seeds of text like `0-9` or `1,4,7-9`, each once."""
    found = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        last = last if dash else first
        if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last) < 2**32):
            raise ValueError(f"--seeds is {text!r}; must be whole numbers, like 0-9 or 1,4,7-9")
        found += range(int(first), int(last) + 1)
    return list(dict.fromkeys(found))


def _axis(text):
    """Name and values of text like `err_rot=0.05,0.1`."""
    name, equals, values = text.partition("=")
    if not equals or name not in Params._fields:
        raise ValueError(f"--sweep is {text!r}; must be a parameter's name and values, like a=1,2")
    try:
        return name, list(dict.fromkeys(float(value) for value in values.split(",")))
    except ValueError:
        raise ValueError(f"--sweep {name}: {values!r} are not numbers, like 0.05,0.1") from None


def run_tasks(log, config, todo, progress=None, refine=True, devices=1):
    """The `Result` of every `Task`, as `runner.run` gives it.

    `progress`: called with (steps done, steps in all, a line) of all runs together. `devices`: how
    many share the runs; those that are rejuvenated are worked off one by one on one. Raises
    `ValueError` as `runner.run` does.
    """
    if config.devices > 1:
        raise ValueError("Config.devices: several runs are shared, not their particles; must be 1")
    if config.rejuvenate:
        return _run_in_turn(log, config, todo, progress, refine)
    size = memory.bytes_of(compiled.state_shapes(config))
    most = min(len(todo), max(devices, STATE_BYTES // size))
    memory.check_memory(compiled.estimate_memory(config, len(log.frame_time)), config)
    results, steps, total = [], None, len(todo) * len(log.frame_time)
    for first in range(0, len(todo), most):
        group = todo[first : first + most]
        done = first * len(log.frame_time)
        if progress:
            progress(done, total, f"runs {first + 1}-{first + len(group)} of {len(todo)}")
        count = len(group)
        # Of one size, so that one compilation serves all; what fills up is left out again.
        group += [group[-1]] * (most - count)
        steps, found = _run_together(log, config, group, count, devices, steps, refine)
        results += found
    return results


def _run_in_turn(log, config, todo, progress, refine):
    """Results of runs that stop now and then to be refined, so that no loop can hold several."""
    results, frames = [], len(log.frame_time)
    for i, task in enumerate(todo):
        if progress:
            progress(i * frames, len(todo) * frames, f"run {i + 1} of {len(todo)}")
        results.append(runner.run(log, config, task.params, task.seed, refine=refine))
    return results


def _run_together(log, config, group, count, shared_by, steps, refine):
    """The compiled steps (None: compile them), and results of the first `count` tasks."""
    data = [frames_from_log(log, config, task.params) for task in group]
    params = [jax.tree.map(jnp.asarray, task.params) for task in group]
    keys = [jax.random.key(task.seed) for task in group]
    states = [runner.initial_state(log, config, key) for key in keys]
    keys, states, params = map(_stack, (keys, states, params))
    # A chunk hands over what all runs leave behind.
    wide = dataclasses.replace(config, particles=config.particles * len(group))
    kept = [RunProgress(None, [], Tree(), 0, 0.0, None, []) for _ in range(count)]
    begin, compile_seconds = time.perf_counter(), 0.0
    for chunks in zip(*(compiled.split_into_chunks(part, wide) for part in data), strict=True):
        length, (odometry, _) = chunks[0]
        measurements = _stack([chunk[1] for _, chunk in chunks])
        given = keys, states, jnp.int32(length), odometry, measurements, params
        if steps is None:
            steps = _scan.lower(*given, config, shared_by).compile()
            compile_seconds = time.perf_counter() - begin
        states, found = steps(*given)
        found = jax.tree.map(lambda leaf, length=length: np.asarray(leaf)[:, :length], found)
        for i, at in enumerate(kept):
            summary, past = jax.tree.map(lambda leaf, i=i: leaf[i], found)
            at.summaries.append(summary)
            at.entropy.append(association_entropy(past.landmark_id, past.ancestors))
            at.tree.extend(*past)
    spent = (time.perf_counter() - begin - compile_seconds) / len(group)
    results = []
    for i, at in enumerate(kept):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        at = at._replace(state=state, seconds=spent)
        result = assemble_result(
            at, log, config, group[i].params, group[i].seed, data[i], compile_seconds
        )
        results.append(runner.refine_result(result) if refine else result)
    return steps, results


def _stack(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@partial(jax.jit, static_argnames=("config", "shared_by"))
def _scan(keys, states, count, odometry, measurements, params, config, shared_by):
    """A chunk of frames of all runs: their states and what is kept of each step."""

    def one(run):
        key, state, measurements, params = run
        return compiled.filter_frames(key, state, count, odometry, measurements, params, config)

    return map_over_devices(one, (keys, states, measurements, params), shared_by)


def summary_rows(todo, results):
    """A dict for every run: seed, what was told, and those of `COLUMNS` that any has (or None)."""
    told = [run_folder.summarise(result) for result in results]
    there = [name for name in COLUMNS if any(name in summary for summary in told)]
    return [
        {"seed": task.seed} | task.swept | {name: summary.get(name) for name in there}
        for task, summary in zip(todo, told, strict=True)
    ]


def format_runs(found):
    """The runs as text; below each set of parameters mean and standard deviation over the seeds."""
    swept = [name for name in found[0] if name != "seed" and name not in COLUMNS]
    shown = [name for name in SHOWN if name in found[0]]
    lines = [["seed", *swept, *(SHOWN[name][0] for name in shown)]]
    for _, part in itertools.groupby(found, lambda row: [row[name] for name in swept]):
        part = list(part)
        told = [f"{part[0][name]:g}" for name in swept]
        lines += [[str(row["seed"]), *told, *_cells(row, shown)] for row in part]
        if len(part) > 1:
            columns = {name: [_value(row[name]) for row in part] for name in shown}
            for label, of in (("mean", np.mean), ("sd", partial(np.std, ddof=1))):
                summary = {name: of(values) for name, values in columns.items()}
                lines.append([label, *told, *_cells(summary, shown)])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    )


def _value(value):
    return np.nan if value is None else value


def _cells(row, names):
    return [format(_value(row[name]), SHOWN[name][1]) for name in names]


def _short(value):
    """A number as text, short if that is still the number."""
    return f"{value:g}" if float(f"{value:g}") == value else repr(float(value))


def check_target(folder, overwrite):
    """Raise `ValueError` if the folder of many runs can't be written here."""
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


def save(todo, results, folder, overwrite=False, log_source=None):
    """Write the table, and each run's folder without figures; all appears at once."""
    check_target(folder, overwrite)
    target = Path(folder).resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    partly = temporary_sibling(target)
    partly.mkdir()
    try:
        for task, result in zip(todo, results, strict=True):
            name = "-".join(
                [f"seed-{task.seed}", *(f"{k}-{_short(v)}" for k, v in task.swept.items())]
            )
            run_folder.save(result, partly / name, log_source=log_source, figures=False)
        found = summary_rows(todo, results)
        with open(partly / TABLE, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, found[0])
            writer.writeheader()
            writer.writerows(found)
        fsync_all(partly / TABLE, partly)
        move_folder(partly, target, overwrite)
    finally:
        shutil.rmtree(partly, ignore_errors=True)
