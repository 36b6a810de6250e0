"""The command `run`: filter a log and smooth the result, in one process or in several."""

import time
import traceback
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from cyclopts import Group, Parameter

from jaxslam.cli import common
from jaxslam.cli.common import LogName, Overwrite, ParamFile, Seed, Sensor, at_least, option
from jaxslam.config import ASSOCIATIONS, PROPOSALS
from jaxslam.runs import cluster, supervisor

FAULT = 70  # exit code of a process that fails by a bug, reported to the other processes
HEADINGS = "Filter", "Long runs", "Several runs", "Parallel"
FILTER, LONG, SEVERAL, PARALLEL = map(Group.create_ordered, HEADINGS)
ASSOCIATION = "Data association: maximum likelihood, the log's identities, or sampled per particle."
NO_SMOOTHING = "Write the filter's estimates only; do not smooth trajectory and map."
PROPOSAL = (
    "Draw poses from odometry (prior), or from odometry and measurements (informed, the default "
    "for bearings with maximum likelihood)."
)
LANDMARKS = "Slots of the map (default: 64; with known association, one per landmark)."
REJUVENATE = (
    "Metres travelled after which the particles are redrawn from the smoothed posterior (default: "
    "3 for bearings with maximum likelihood, otherwise never)."
)
DESCRIPTORS = (
    "Appearance coordinates used in data association (default: all that distinguish landmarks, "
    "for bearings with unknown association; otherwise 0)."
)
CHECKPOINT = "Save a checkpoint at this interval, e.g. 60s, 5m or 1h."
RESUME = "Resume from the last checkpoint, if any; implies --checkpoint-every 60s."
SEEDS = "Repeat the run for each seed, e.g. 0-9 or 1,4,7-9, and print a table."
SWEEP = "Repeat the run for each value of a parameter, e.g. err_rot=0.05,0.1; may be repeated."
DEVICES = "Devices of this process that share the particles, or the runs of --seeds and --sweep."
COORDINATOR = "HOST:PORT where process 0 waits for the others; 127.0.0.1:PORT on one machine."
PROCESSES = "Processes that share the run (default: as Slurm or Open MPI started)."
PROCESS = "Index of this process, from 0. Only process 0 writes files and prints."


class CheckpointOptions(NamedTuple):
    """Checkpoints of a run: the interval, as text, and whether to resume from one."""

    every: str
    resume: bool


class RunOptions(NamedTuple):
    """What to run and where to write it.

    `name`: the log's name or path; `part`: only part of it is used; `shared`: by several processes.
    """

    log: object
    config: object
    params: object
    seed: int
    out: Path
    name: str
    part: bool
    overwrite: bool
    no_smoothing: bool
    checkpoints: CheckpointOptions | None
    shared: bool

    @property
    def inputs(self):
        """What determines the result: log, config, params and seed."""
        return self.log, self.config, self.params, self.seed

    @property
    def source(self):
        return None if self.part else self.name


def run(
    log: LogName,
    /,
    *,
    sensor: Sensor = None,
    association: option(Literal[ASSOCIATIONS], ASSOCIATION) = "maximum_likelihood",
    particles: at_least("Number of particles.") = 1000,
    params: ParamFile = None,
    seed: Seed = 0,
    out: option(Path, "Folder to write (default: runs/LOG-SENSOR-SEED).") | None = None,
    overwrite: Overwrite = False,
    no_smoothing: option(bool, NO_SMOOTHING) = False,
    no_refine: Annotated[bool, Parameter(show=False)] = False,  # its name in version 0.1
    proposal: option(Literal[PROPOSALS], PROPOSAL, FILTER) | None = None,
    landmarks: at_least(LANDMARKS, group=FILTER) | None = None,
    paper: option(bool, common.PAPER, FILTER) = False,
    rejuvenate: option(float, REJUVENATE, FILTER) | None = None,
    descriptors: at_least(DESCRIPTORS, 0, group=FILTER) | None = None,
    start: option(float, common.START, FILTER) = 0.0,
    end: option(float, common.END, FILTER) | None = None,
    checkpoint_every: option(str, CHECKPOINT, LONG) | None = None,
    resume: option(bool, RESUME, LONG) = False,
    seeds: option(str, SEEDS, SEVERAL) | None = None,
    sweep: option(tuple[str, ...], SWEEP, SEVERAL) = (),
    devices: at_least(DEVICES, group=PARALLEL) = 1,
    coordinator: option(str, COORDINATOR, PARALLEL) | None = None,
    num_processes: at_least(PROCESSES, group=PARALLEL) | None = None,
    process_id: at_least(PROCESS, 0, group=PARALLEL) | None = None,
):
    """Filter a log and smooth the result; write trajectory, map, figures and errors.

    Use trajectory_refined.tum and landmarks_refined.csv, smoothed over all frames;
    trajectory.tum and landmarks.csv are the filter's estimates at each frame.
    The folder also holds map.png, summary.json and run.toml with every setting.

    Example: jaxslam run lost-in-the-woods --particles 2000 --out runs/woods
    """
    address = cluster.find_address(coordinator, num_processes, process_id)
    if address and address.process:
        supervisor.run_supervised()
    with common.progress_bar("reading", shown=address is None or address.process == 0):
        from jaxslam.logs.log_file import load_log
        from jaxslam.logs.slicing import cut

        loaded, part = load_log(log), bool(start) or end is not None
        loaded = cut(loaded, start, end) if part else loaded
    several = seeds is not None or sweep
    if several and (checkpoint_every or resume or address):
        raise ValueError("--seeds and --sweep are for small runs: without checkpoints, one process")
    total = 1 if several else devices * (address.processes if address else 1)
    model = config_from_options(
        loaded, sensor, association, particles, landmarks, params, paper, proposal, total,
        rejuvenate, descriptors,
    )  # fmt: skip
    name = seed if seeds is None else f"seeds-{seeds}"
    out = out or Path("runs") / f"{Path(log).stem}-{model[0].sensor}-{name}"
    use_devices(devices)
    checkpoints = None
    if checkpoint_every or resume:
        checkpoints = CheckpointOptions(checkpoint_every or "60s", resume)
    options = RunOptions(
        loaded, *model, seed, out, log, part, overwrite, no_smoothing or no_refine, checkpoints,
        shared=address is not None,
    )  # fmt: skip
    if several:
        return run_batch(options, str(seed) if seeds is None else seeds, sweep, devices)
    if address is None:
        return run_alone(options)
    return run_shared(options, address)


def config_from_options(
    log, sensor, association, particles, landmarks, params, paper, proposal=None, devices=1,
    rejuvenate=None, descriptors=None,
):  # fmt: skip
    """`Config` and `Params` from the command's options; None for an option that is not given."""
    from jaxslam.config import Config
    from jaxslam.parameter_file import load_params
    from jaxslam.parameters import default_params
    from jaxslam.runs.run import config_for

    if particles % devices:
        below = particles // devices * devices
        fit = f"{below} or {below + devices}" if below else devices
        raise ValueError(
            f"--particles is {particles}, which {devices} devices can't share evenly; take {fit}"
        )
    settings = {"particles": particles, "landmarks": landmarks, "proposal": proposal}
    settings = {name: value for name, value in settings.items() if value}
    if descriptors is not None:
        if paper:
            raise ValueError("--descriptors: with --paper, association uses positions alone")
        settings["descriptors"] = descriptors
    config = config_for(log, sensor or ("position" if paper else None), association, **settings)
    if paper:
        sizes = config.particles, config.landmarks, config.measurements
        rules = {"sensor": config.sensor, "association": association}
        config = Config.paper(*sizes, **rules | ({"proposal": proposal} if proposal else {}))
    every = config.rejuvenate if rejuvenate is None else rejuvenate
    config = replace(config, devices=devices, rejuvenate=every)
    base = default_params(config.sensor, log)
    return config, load_params(params, base) if params else base


def run_filter(options, checkpoints=None):
    """Filter and, unless --no-smoothing, refine with progress bars; return the `Result`."""
    from jaxslam.runs import run

    with (
        common.progress_bar("filtering", compiles=True) as progress,
        cluster.silence_stdout() if options.shared else nullcontext(),
    ):
        result = run.run(*options.inputs, progress, refine=False, checkpoints=checkpoints)
    if options.no_smoothing:
        return result
    with common.progress_bar("refining") as progress:
        return run.refine_result(result, progress)


def use_devices(count):
    """Let JAX split the CPU into `count` devices; has no effect on GPUs."""
    if count == 1:
        return
    import jax

    with suppress(RuntimeError):  # after the first computation the devices are fixed
        jax.config.update("jax_num_cpu_devices", count)


def run_alone(options):
    """Filter, smooth and write, in a single process or in process 0; return the exit code."""
    result = _run_with_checkpoints(options) if options.checkpoints else _run_at_once(options)
    return int(bool(result and result.flags))


def _run_at_once(options):
    from jaxslam.results import run_folder

    run_folder.check_target(options.out, options.overwrite)
    result = run_filter(options)
    with common.progress_bar("writing"):
        run_folder.save(result, options.out, options.overwrite, log_source=options.source)
    print_summary(result, options.out)
    return result


def _run_with_checkpoints(options):
    """Run with checkpoints; return the `Result`, or None if the run had finished before."""
    from jaxslam.results import run_folder
    from jaxslam.runs import checkpoints as checkpointing

    out, overwrite, (every, resume) = options.out, options.overwrite, options.checkpoints
    every = checkpointing.parse_interval(every)
    if overwrite and resume:
        raise ValueError("--resume continues a run, --overwrite replaces it; choose one")
    _check_log_outside(options)
    with checkpointing.Checkpoints(out, every, resume, overwrite) as checkpoints:
        if checkpoints.finished:
            checkpointing.check_finished(out, *options.inputs)
            print(f"{out}: is finished already; nothing to do")
            return None
        result = run_filter(options, checkpoints)
        with common.progress_bar("writing"):
            run_folder.save_into(result, out, log_source=options.source)
        checkpoints.clear()
    print_summary(result, out)
    return result


def _check_log_outside(options):
    """Raise `ValueError` if the log lies in the folder whose files are replaced."""
    if Path(options.name).resolve().is_relative_to(options.out.resolve()):
        why = f"is in {options.out}, where results are replaced; choose another --out"
        raise ValueError(f"{options.name}: {why}")


def run_shared(options, address):
    """Take part in a run of several processes. Ends this process once all have met."""
    from jaxslam.results import run_folder
    from jaxslam.runs.checkpoint_file import run_fingerprint

    run = {
        **run_fingerprint(*options.inputs),
        "devices": options.config.devices,
        "out": str(options.out),
        "long": str(options.checkpoints),
        "refined": not options.no_smoothing,
        "versions": run_folder.versions(),
    }
    group = cluster.ProcessGroup(address, cluster.rendezvous(address, run))
    code = FAULT
    try:
        code = common.run_command(lambda: _run_as_member(options, address, group))
    except Exception:
        traceback.print_exc()
    finally:
        group.exit(code)


def _run_as_member(options, address, group):
    from jaxslam.runs import run
    from jaxslam.runs.checkpoints import FollowerCheckpoints

    try:
        cluster.connect(address)
        if group.is_leader:
            return run_alone(options)
        wait = group.wait_for_leader
        follow = FollowerCheckpoints(options.out, wait) if options.checkpoints else None
        with cluster.silence_stdout():
            run.run(*options.inputs, refine=False, checkpoints=follow)
        wait()
    except RuntimeError as error:
        if "Gloo" not in str(error):  # XLA's transport between CPUs: a broken connection
            raise
        time.sleep(cluster.EXIT_TIMEOUT)  # `group` learns which process died, and reports it
        raise ConnectionError("the connection to another process broke") from None


def print_summary(result, out):
    """Print errors, times and the run folder; advice and warnings on stderr."""
    from jaxslam.results import run_folder
    from jaxslam.results.tables import error_table

    print(error_table(run_folder.summarise(result)))
    spent = f"{result.seconds:.1f} s, and {result.compile_seconds:.1f} s to compile"
    if result.refined is not None:
        spent += f"; refined in {result.refine_seconds:.1f} s"
    print(f"{len(result.time)} steps in {spent}\n{out}: the map is {out / 'map.png'}")
    for line in result.advice:
        common.note(line)
    for line in result.flags:
        common.warn(line)


def run_batch(options, seeds, sweep, devices):
    """Run all seeds and parameter values, print their table, and return the exit code."""
    from jaxslam.runs import batch

    tasks = batch.plan_tasks(seeds, options.params, sweep)
    _check_log_outside(options)
    batch.check_target(options.out, options.overwrite)
    with common.progress_bar("running", compiles=True) as progress:
        smooth = not options.no_smoothing
        results = batch.run_tasks(options.log, options.config, tasks, progress, smooth, devices)
    with common.progress_bar("writing"):
        batch.save(tasks, results, options.out, options.overwrite, options.source)
    print(batch.format_runs(batch.summary_rows(tasks, results)))
    print(f"{options.out}: the table is {options.out / batch.TABLE}, with a folder for each run")
    for line in dict.fromkeys(line for result in results for line in result.flags):
        common.warn(line)
    return int(any(result.flags for result in results))
