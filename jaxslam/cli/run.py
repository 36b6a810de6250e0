"""What `jaxslam run` does, short or long; and what other commands share with it."""

import time
import traceback
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from jaxslam.cli.common import bar, note, warn
from jaxslam.runs import cluster

FAULT = 70  # exit code of a process that fails by a fault of ours, told to the others


class CheckpointOptions(NamedTuple):
    """Options of a run that is put aside: `every` so often, as text; `resume`: go on with it."""

    every: str
    resume: bool


class Task(NamedTuple):
    """What `jaxslam run` is to do. `name`: the log's as given; `part`: only a part of it is used;
    `shared`: by several processes."""

    log: object
    config: object
    params: object
    seed: int
    out: Path
    name: str
    part: bool
    overwrite: bool
    no_refine: bool
    long: CheckpointOptions | None
    shared: bool

    @property
    def source(self):
        return None if self.part else self.name


def build_model(
    log, sensor, association, particles, landmarks, params, paper, proposal=None, devices=1,
    rejuvenate=None, descriptors=None,
):  # fmt: skip
    """`Config` and `Params` as the options say."""
    from jaxslam.config import Config
    from jaxslam.parameter_file import load_params
    from jaxslam.parameters import default_params
    from jaxslam.runs.run import config_for

    if particles % devices:
        least = particles // devices * devices
        fit = f"{least} or {least + devices}" if least else devices
        raise ValueError(
            f"--particles is {particles}, which {devices} devices can't share evenly; take {fit}"
        )
    told = {"particles": particles, "landmarks": landmarks, "proposal": proposal}
    told = {name: value for name, value in told.items() if value}
    if descriptors is not None:
        if paper:
            raise ValueError("--descriptors: the paper's rules (--paper) associate by place alone")
        told["descriptors"] = descriptors
    config = config_for(log, sensor or ("position" if paper else None), association, **told)
    if paper:
        sizes = config.particles, config.landmarks, config.measurements
        rules = {"sensor": config.sensor, "association": association}
        config = Config.paper(*sizes, **rules | ({"proposal": proposal} if proposal else {}))
    every = config.rejuvenate if rejuvenate is None else rejuvenate
    config = replace(config, devices=devices, rejuvenate=every)
    base = default_params(config.sensor, log)
    return config, load_params(params, base) if params else base


def run_filter(task, checkpoints=None):
    """A run's result; with progress bars."""
    from jaxslam.runs import run

    with (
        bar("filtering", compiles=True) as progress,
        cluster.silence_stderr() if task.shared else nullcontext(),
    ):
        result = run.run(
            task.log,
            task.config,
            task.params,
            task.seed,
            progress,
            refine=False,
            checkpoints=checkpoints,
        )
    if task.no_refine:
        return result
    with bar("refining") as progress:
        return run.refine_result(result, progress)


def use_devices(count):
    """Let JAX have so many devices on a CPU, if it has not begun; on GPUs this does nothing."""
    if count == 1:
        return
    import jax

    with suppress(RuntimeError):  # a process that has computed already keeps its devices
        jax.config.update("jax_num_cpu_devices", count)


def run(task):
    """Filter, refine and write: the command in one process, or in the one that leads."""
    result = _run_long(task) if task.long else _run_short(task)
    return int(bool(result and result.flags))


def _run_short(task):
    from jaxslam.results import run_folder

    run_folder.check_target(task.out, task.overwrite)
    result = run_filter(task)
    with bar("writing"):
        run_folder.save(result, task.out, task.overwrite, log_source=task.source)
    print_summary(result, task.out)
    return result


def _run_long(task):
    """A run that is put aside now and then; None if it was finished already."""
    from jaxslam.results import run_folder
    from jaxslam.runs import checkpoints as offline

    out, overwrite, (every, resume) = task.out, task.overwrite, task.long
    every = offline.parse_interval(every)
    if overwrite and resume:
        raise ValueError("--resume goes on with a run, --overwrite replaces it; choose one")
    _check_beside(task)
    with offline.Checkpoints(out, every, resume, overwrite) as checkpoints:
        if checkpoints.finished:
            offline.check_finished(out, task.log, task.config, task.params, task.seed)
            print(f"{out}: is finished already; nothing to do")
            return None
        result = run_filter(task, checkpoints)
        with bar("writing"):
            run_folder.save_into(result, out, log_source=task.source)
        checkpoints.clear()
    print_summary(result, out)
    return result


def _check_beside(task):
    """Raise `ValueError` if the log is where results are replaced."""
    if Path(task.name).resolve().is_relative_to(task.out.resolve()):
        raise ValueError(
            f"{task.name}: is in {task.out}, where results are replaced; choose another --out"
        )


def run_shared(task, place, guarded):
    """The command in one of several processes; does not return once they have met."""
    from jaxslam.results import run_folder
    from jaxslam.runs import checkpoints as offline

    run = {
        **offline.run_fingerprint(task.log, task.config, task.params, task.seed),
        "devices": task.config.devices,
        "out": str(task.out),
        "long": str(task.long),
        "refined": not task.no_refine,
        "versions": run_folder.versions(),
    }
    team = cluster.Team(place, cluster.rendezvous(place, run))
    code = FAULT
    try:
        code = guarded(lambda: _share(task, place, team))
    except Exception:
        traceback.print_exc()
    finally:
        team.leave(code)


def _share(task, place, team):
    from jaxslam.runs import checkpoints as offline
    from jaxslam.runs import run

    try:
        cluster.connect(place)
        if team.leads:
            return run(task)
        follow = offline.FollowerCheckpoints(task.out, team.wait) if task.long else None
        with cluster.silence_stderr():
            run.run(task.log, task.config, task.params, task.seed, refine=False, checkpoints=follow)
        team.wait()
    except RuntimeError as error:
        if "Gloo" not in str(error):
            raise
        time.sleep(cluster.GRACE)  # whoever died is told meanwhile
        raise ConnectionError("the connection to another process broke") from None


def print_summary(result, out):
    """Print what a run found, its advice and its warnings."""
    from jaxslam.results import run_folder
    from jaxslam.results.tables import error_table

    print(error_table(run_folder.summarise(result)))
    spent = f"{result.seconds:.1f} s, and {result.compile_seconds:.1f} s to compile"
    if result.refined is not None:
        spent += f"; refined in {result.refine_seconds:.1f} s"
    print(f"{len(result.time)} steps in {spent}\n{out}: the map is {out / 'map.png'}")
    for line in result.advice:
        note(line)
    for line in result.flags:
        warn(line)


def run_many(task, seeds, sweep, devices):
    """A table of runs, with a folder for each; the exit code."""
    from jaxslam.runs import batch

    todo = batch.plan_tasks(seeds, task.params, sweep)
    _check_beside(task)
    batch.check_target(task.out, task.overwrite)
    with bar("running", compiles=True) as progress:
        results = batch.run_tasks(
            task.log, task.config, todo, progress, not task.no_refine, devices
        )
    with bar("writing"):
        batch.save(todo, results, task.out, task.overwrite, task.source)
    print(batch.table(batch.summary_rows(todo, results)))
    print(f"{task.out}: the table is {task.out / batch.TABLE}, with a folder for each run")
    for line in dict.fromkeys(line for result in results for line in result.flags):
        warn(line)
    return int(any(result.flags for result in results))
