"""The command line: one small function per command.

Results go to stdout, progress and warnings to stderr. Exit codes: 0 ok; 1 finished with warnings
(data lost, map full, numbers not finite); 2 bad input or usage; 69 a process of the run is missing
or died; 74 no space left; 75 the run's folder is being written by another process; 130 interrupted.
Everything heavy is imported where it is needed, so that `--help` comes at once.
"""

import os
import sys
from pathlib import Path
from typing import Literal

from cyclopts import App, CycloptsError, Parameter

from jaxslam.cli import images as cli_images
from jaxslam.cli import learn as cli_learn
from jaxslam.cli import run as cli_run
from jaxslam.cli.common import (
    DEMO,
    End,
    LogName,
    Overwrite,
    Seed,
    Sensor,
    Start,
    at_least,
    bar,
    check_new,
    option,
    warn,
)
from jaxslam.config import ASSOCIATIONS, PROPOSALS
from jaxslam.files import NO_SPACE
from jaxslam.runs import cluster, supervisor

HELP = f"""FastSLAM: from a logged run to map, trajectory and figures.

Begin with:  jaxslam demo     (a real robot's run becomes a map, in runs/demo)
Then:        jaxslam run {DEMO} --sensor bearing --association known
LOG is a .npz file, or {DEMO}, a log that comes with the program.
Each command has a --help of its own, with an example.
Exit codes: 0 ok, 1 ended with warnings, 2 bad input or usage, 69 a process of the run is
missing or died, 74 no space left, 75 folder in use, 130 interrupted."""

FULL, BUSY = 74, 75  # no space left; the folder is in use
HOST_PORT = "HOST:PORT where process 0 waits for the others (127.0.0.1: of this machine)"

app = App(
    name="jaxslam",
    help=HELP,
    help_format="plaintext",
    default_parameter=Parameter(negative=()),  # no --no-overwrite
    suppress_keyboard_interrupt=False,
)
simulate = App(name="simulate", help="Make a simulated world: a log, or images, with the truth.")
app.command(simulate)
app.command(cli_images.calibrate)
app.command(cli_images.extract)
app.command(cli_images.triangulate)
app.command(cli_learn.learn, usage="Usage: jaxslam learn [OPTIONS] LOG...")
simulate.command(cli_images.room)


MovedLog = option(str, "where the run's log is, if it was moved") | None
Folder = option(Path, "a run's folder")
ParamFile = option(Path, "TOML file of parameters, for those it names") | None
Paper = option(bool, "the paper's rules: positions, each its best match, no clutter")
Worlds = Literal["room", "grid", "field"]
ASSOCIATED = "find out which landmark was measured, believe the log, or draw by particle"
Association = option(Literal[ASSOCIATIONS], ASSOCIATED)
Plain = Literal["maximum_likelihood", "known"]
PROPOSED = "poses drawn from odometry, or informed by the measurements"
LOOKS = "coordinates of looks that help to associate (bearings, hidden: all that tell; else 0)"
REJUVENATED = "metres after which particles are redrawn (bearings, hidden: 3; else 0: never)"
Proposal = option(Literal[PROPOSALS], PROPOSED) | None


@app.command
def demo(*, seed: Seed = 0):
    """Map a real room: the bundled log, bearings alone, identities hidden.

    1,000 particles, two or three minutes; writes runs/demo, replacing an earlier demo.

    Example: jaxslam demo
    """
    return run(DEMO, sensor="bearing", seed=seed, out=Path("runs/demo"), overwrite=True)


@app.command
def run(
    log: LogName,
    /,
    *,
    sensor: Sensor = None,
    association: Association = "maximum_likelihood",
    proposal: Proposal = None,
    particles: at_least("how many hypotheses of the path") = 1000,
    landmarks: at_least("slots of the map (64; known: one each)") | None = None,
    params: ParamFile = None,
    paper: Paper = False,
    rejuvenate: option(float, REJUVENATED) | None = None,
    descriptors: at_least(LOOKS, 0) | None = None,
    start: Start = 0.0,
    end: End = None,
    no_refine: option(bool, "only filter: path and map are not refined afterwards") = False,
    seed: Seed = 0,
    out: option(Path, "folder to write (runs/LOG-SENSOR-SEED)") | None = None,
    overwrite: Overwrite = False,
    checkpoint_every: option(str, "put the run aside so often, like 60s, 5m, 1h") | None = None,
    resume: option(bool, "go on with a run that was interrupted or killed (every 60s)") = False,
    seeds: option(str, "several runs in one program, like 0-9 or 1,4,7-9: a table") | None = None,
    sweep: option(tuple[str, ...], "and for these values, like err_rot=0.05,0.1 (repeat)") = (),
    devices: at_least("of this process, that share the particles (or the runs of --seeds)") = 1,
    coordinator: option(str, HOST_PORT) | None = None,
    num_processes: at_least("processes that share the run (Slurm, Open MPI say)") | None = None,
    process_id: at_least("which of them this is; 0 alone writes and speaks", 0) | None = None,
):
    """Filter a log, then refine: trajectory, map, figures and errors in a folder.

    trajectory.tum and landmarks.csv are the filter's, as it knew them at the time.
    trajectory_refined.tum and landmarks_refined.csv are the best particle's past
    and map improved by least squares. The folder also holds map.png, error.png,
    particles.png, summary.json, run.toml (every setting), events.jsonl, steps.npz.
    With --seeds or --sweep: runs.csv, and a folder for each run, without figures.

    Example: jaxslam run lost-in-the-woods --particles 2000 --out runs/woods
    """
    place = cluster.find_address(coordinator, num_processes, process_id)
    if place and place.process:
        supervisor.run_supervised()
    with bar("reading", shown=place is None or place.process == 0):
        from jaxslam.logs.log_file import load_log
        from jaxslam.logs.slicing import cut

        loaded, part = load_log(log), bool(start) or end is not None
        loaded = cut(loaded, start, end) if part else loaded
    many = seeds is not None or sweep
    if many and (checkpoint_every or resume or place):
        raise ValueError("--seeds and --sweep are for small runs: without checkpoints, one process")
    total = 1 if many else devices * (place.processes if place else 1)
    model = cli_run.build_model(
        loaded, sensor, association, particles, landmarks, params, paper, proposal, total,
        rejuvenate, descriptors,
    )  # fmt: skip
    name = seed if seeds is None else f"seeds-{seeds}"
    out = out or Path("runs") / f"{Path(log).stem}-{model[0].sensor}-{name}"
    cli_run.use_devices(devices)
    long = (
        cli_run.CheckpointOptions(checkpoint_every or "60s", resume)
        if checkpoint_every or resume
        else None
    )
    task = cli_run.Task(
        loaded, *model, seed, out, log, part, overwrite, no_refine, long, shared=place is not None
    )
    if many:
        return cli_run.run_many(task, str(seed) if seeds is None else seeds, sweep, devices)
    if place is None:
        return cli_run.run(task)
    return cli_run.run_shared(task, place, guarded)


@app.command
def compare(
    log: LogName,
    /,
    *,
    sensor: Sensor = None,
    association: option(
        Plain, "find out which landmark was measured, or believe the log"
    ) = "maximum_likelihood",
    params: ParamFile = None,
    paper: Paper = False,
    particles: option(str, "particle counts of the baseline, by commas") = "20,100",
    variants: at_least("particles of the second table's filters (0: no table)", 0) = 1000,
    steps: at_least("frames to filter") = 200,
    every: at_least("use each n-th frame (the steps cover a tenth)") | None = None,
    seed: Seed = 0,
):
    """Show the filter beside the plain NumPy baseline: agreement, accuracy, time.

    Both get the same random draws. The baseline is slow: 20 particles over 200
    steps take it some 10 seconds. A second table adds the paper's rules, FastSLAM
    1.0, the informed proposal and refinement, with more particles.

    Example: jaxslam compare lost-in-the-woods --particles 20,100 --steps 200
    """
    counts = _counts(particles)
    with bar("reading"):
        from jaxslam.logs.log_file import load_log
        from jaxslam.reference import compare as sides

        loaded = load_log(log)
    rows = []
    for count in counts:
        model = cli_run.build_model(loaded, sensor, association, count, None, params, paper)
        with bar(f"{count} particles", compiles=True) as progress:
            rows.append(sides.compare(loaded, *model, seed, steps, every, progress))
    print(sides.table(rows))
    if variants:
        from jaxslam.reference import variants as rules

        with bar("variants", compiles=True) as progress:
            model = cli_run.build_model(loaded, sensor, association, variants, None, params, paper)
            found = rules.variants(loaded, *model, seed, steps, every, rows, progress)
        print(f"\n{rules.table(found)}")
    parted = [row.double for row in rows if row.double.same < row.double.steps]
    for row in parted:
        warn(f"{row.particles} particles: the two part at step {row.same}")
    return int(bool(parted))


@app.command(usage="Usage: jaxslam convert [OPTIONS] SRC... OUT.npz")
def convert(
    *paths: option(Path, "files or folder to read, then the log to write"),
    robot: at_least("which robot of an MRCLAM folder") | None = None,
    time_offset: option(float, "seconds to move the frames by, as check says") = 0.0,
    overwrite: Overwrite = False,
):
    """Make a log of other people's files; their format is guessed.

    The course's dataset2.mat, an MRCLAM folder (with --robot), or two to four
    .csv files: odometry, measurements, and true poses and landmarks if known;
    or a log, to move its frames (--time-offset).

    Example: jaxslam convert odometry.csv measurements.csv OUT.npz
    """
    from jaxslam.logs.clock_offset import shift_frames
    from jaxslam.logs.log import NOT_USED
    from jaxslam.logs.log_file import save_log
    from jaxslam.logs.readers import read

    if len(paths) < 2:
        raise ValueError("convert: what to read, and the .npz file to write, are needed")
    *sources, out = paths
    check_new(out, overwrite)
    with bar("reading"):
        log = shift_frames(read(sources, robot), time_offset)
    save_log(out, log)
    print(f"{out}: {log}; look at it with: jaxslam check {out}")
    lost = {why: n for why, n in log.skipped.items() if not why.startswith(NOT_USED)}
    for why, count in lost.items():
        warn(f"{count} rows skipped: {why}")
    return int(bool(lost))


@app.command
def check(log: LogName, /):
    """Say what is in a log and what looks wrong: counts, rates, gaps, lost rows, units.

    Example: jaxslam check OUT.npz
    """
    from jaxslam.logs import diagnostics as examine
    from jaxslam.logs.log_file import load_log

    findings = examine.check(load_log(log))
    for severity, text in findings:
        print(f"{severity:8} {text}")
    return examine.status(findings)


@app.command
def evaluate(folder: Folder, /, *, json: option(bool, "as JSON") = False, log: MovedLog = None):
    """Print the errors of a run against its log's truth.

    Example: jaxslam evaluate runs/demo --json
    """
    from json import dumps

    with bar("reading"):
        from jaxslam.results import load
        from jaxslam.results.tables import error_table

        errors = load.evaluate_folder(folder, log)
    print(dumps(errors, indent=2) if json else error_table(errors))


@app.command
def plot(folder: Folder, /, *, log: MovedLog = None):
    """Draw the figures of a run anew.

    Example: jaxslam plot runs/demo
    """
    with bar("drawing"):
        from jaxslam.results.load import plot_folder

        paths = plot_folder(folder, log)
    for path in paths:
        print(path)


@simulate.command
def planar(
    out: option(Path, "the log to write, a .npz file"),
    /,
    *,
    world: option(Worlds, "landmarks on the walls of 10 x 4 m, on a grid, or scattered") = "room",
    seed: Seed = 0,
    landmarks: at_least("point landmarks") = 40,
    length: option(float, "of the path [m]") = 60.0,
    speed: option(float, "[m/s]") = 0.5,
    rate: option(float, "frames per second [Hz]") = 5.0,
    odometry_rate: option(float, "odometry per second [Hz]") = 50.0,
    commands: option(bool, "stop and go: commands instead of odometry") = False,
    stop: option(float, "between two stops [m]") = 0.3,
    err_tran: option(float, "noise along the path [m/sqrt(m)]") = 0.02,
    err_rot: option(float, "noise of the heading, by turning [rad/sqrt(rad)]") = 0.02,
    err_drift: option(float, "noise of the heading, by driving [rad/sqrt(m)]") = 0.02,
    sigma_range: option(float, "noise of ranges [m]") = 0.05,
    sigma_bearing: option(float, "noise of bearings [rad]") = 0.02,
    view_range: option(float, "the sensor sees so far [m]") = 5.0,
    detection: option(float, "probability of being seen, at range 0") = 0.9,
    outlier: option(float, "probability of being clutter") = 0.02,
    truth_resolution: option(float, "truth is read off tiles of this size [m]") = 0.0,
    overwrite: Overwrite = False,
):
    """Simulate a drive through a planar world, drawn from the filter's own model.

    Example: jaxslam simulate planar OUT.npz --world room --seed 1
    """
    from jaxslam.logs.log_file import save_log
    from jaxslam.simulation import planar as worlds

    check_new(out, overwrite)
    with bar("simulating"):
        log = worlds.planar(
            world, seed, landmarks=landmarks, length_m=length, speed=speed, rate_hz=rate,
            odometry_hz=odometry_rate, commands=commands, stop_m=stop, err_tran=err_tran,
            err_rot=err_rot, err_drift=err_drift, sigma_range=sigma_range,
            sigma_bearing=sigma_bearing, view=(-worlds.pi, worlds.pi, view_range),
            detection=detection, outlier=outlier, truth_resolution=truth_resolution,
        )  # fmt: skip
    save_log(out, log)
    print(f"{out}: {log}")


def main(argv=None):
    """Run one command (None: the process's arguments); returns the exit code."""
    tokens = sys.argv[1:] if argv is None else argv
    told = {"exit_on_error": False, "print_error": False, "result_action": "return_value"}
    return guarded(lambda: app(tokens, **told), at_once=argv is None)


def guarded(work, at_once=False):
    """The exit code of some work, after the one line that says what went wrong."""
    failed = 2
    try:
        code = work()
        sys.stdout.flush()
        return code or 0
    except CycloptsError as error:
        problem = f"{error} See: jaxslam --help"
    except KeyboardInterrupt as error:
        print("jaxslam: interrupted" + "".join(error.args), file=sys.stderr, flush=True)
        if at_once:  # stopped while compiling, JAX would crash as Python winds down
            os._exit(130)
        return 130
    except BrokenPipeError:  # whoever read the output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        failed = BUSY if isinstance(error, BlockingIOError) else failed
        failed = FULL if error.errno in NO_SPACE else failed
        failed = cluster.LOST if isinstance(error, ConnectionError) else failed
        problem = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except ValueError as error:
        problem = str(error)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise  # a fault of ours: show where
        problem = "not enough memory; ask for fewer --particles or --landmarks"
    print("jaxslam:", problem.split("\n")[0], file=sys.stderr)
    return failed


def _counts(text):
    counts = [int(count) if count.isdecimal() else 0 for count in text.split(",")]
    if min(counts) < 1:
        raise ValueError(f"--particles is {text!r}; must be whole numbers from 1, like 20,100")
    return counts
