"""The command line: one small function per command.

Results go to stdout, progress and warnings to stderr. Exit codes: 0 ok; 1 finished with warnings
(data lost, map full, numbers not finite); 2 bad input or usage; 130 interrupted. Everything heavy
is imported where it is needed, so that `--help` comes at once.
"""

import os
import sys
from pathlib import Path
from typing import Literal

from cyclopts import App, CycloptsError, Parameter

from jaxslam import cli_images, cli_learn
from jaxslam.config import ASSOCIATIONS, PROPOSALS
from jaxslam.console import (
    DEMO,
    End,
    LogName,
    Overwrite,
    Seed,
    Sensor,
    Start,
    bar,
    check_new,
    note,
    option,
    warn,
    whole,
)

HELP = f"""FastSLAM: from a logged run to map, trajectory and figures.

Begin with:  jaxslam demo     (a real robot's run becomes a map, in runs/demo)
Then:        jaxslam run {DEMO} --sensor bearing --association known
LOG is a .npz file, or {DEMO}, a log that comes with the program.
Each command has a --help of its own, with an example.
Exit codes: 0 ok, 1 ended with warnings, 2 bad input or usage, 130 interrupted."""

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
Proposal = option(Literal[PROPOSALS], PROPOSED) | None


@app.command
def demo(*, seed: Seed = 0):
    """Map a real room: the bundled log, ranges and bearings, identities hidden.

    1,000 particles, about a minute; writes runs/demo, replacing an earlier demo.

    Example: jaxslam demo
    """
    return run(DEMO, sensor="range_bearing", seed=seed, out=Path("runs/demo"), overwrite=True)


@app.command
def run(
    log: LogName,
    /,
    *,
    sensor: Sensor = None,
    association: Association = "maximum_likelihood",
    proposal: Proposal = None,
    particles: whole("how many hypotheses of the path") = 1000,
    landmarks: whole("slots of the map (64; known: one each)") | None = None,
    params: ParamFile = None,
    paper: Paper = False,
    start: Start = 0.0,
    end: End = None,
    no_refine: option(bool, "only filter: path and map are not refined afterwards") = False,
    seed: Seed = 0,
    out: option(Path, "folder to write (runs/LOG-SENSOR-SEED)") | None = None,
    overwrite: Overwrite = False,
):
    """Filter a log, then refine: trajectory, map, figures and errors in a folder.

    trajectory.tum and landmarks.csv are the filter's, as it knew them at the time.
    trajectory_refined.tum and landmarks_refined.csv are the best particle's past
    and map improved by least squares. The folder also holds map.png, error.png,
    particles.png, summary.json, run.toml (every setting), events.jsonl, steps.npz.

    Example: jaxslam run lost-in-the-woods --particles 2000 --out runs/woods
    """
    with bar("reading"):
        from jaxslam import report, runner
        from jaxslam.log import load_log
        from jaxslam.parts import cut

        loaded, part = load_log(log), bool(start) or end is not None
        loaded = cut(loaded, start, end) if part else loaded
    model = _model(loaded, sensor, association, particles, landmarks, params, paper, proposal)
    out = out or Path("runs") / f"{Path(log).stem}-{model[0].sensor}-{seed}"
    report.check_target(out, overwrite)
    with bar("filtering", compiles=True) as progress:
        result = runner.run(loaded, *model, seed, progress, refine=False)
    if not no_refine:
        with bar("refining") as progress:
            result = runner.refined(result, progress)
    with bar("writing"):
        report.save(result, out, overwrite, log_source=None if part else log)
    _told(result, out)
    return int(bool(result.flags))


def _told(result, out):
    """Print what a run found, its advice and its warnings."""
    from jaxslam import report
    from jaxslam.error_table import error_table

    print(error_table(report.summarise(result)))
    spent = f"{result.seconds:.1f} s, and {result.compile_seconds:.1f} s to compile"
    if result.refined is not None:
        spent += f"; refined in {result.refine_seconds:.1f} s"
    print(f"{len(result.time)} steps in {spent}\n{out}: the map is {out / 'map.png'}")
    for line in result.advice:
        note(line)
    for line in result.flags:
        warn(line)


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
    variants: whole("particles of the second table's filters (0: no table)", 0) = 1000,
    steps: whole("frames to filter") = 200,
    every: whole("use each n-th frame (the steps cover a tenth)") | None = None,
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
        from jaxslam import compare as sides
        from jaxslam.log import load_log

        loaded = load_log(log)
    rows = []
    for count in counts:
        model = _model(loaded, sensor, association, count, None, params, paper)
        with bar(f"{count} particles", compiles=True) as progress:
            rows.append(sides.compare(loaded, *model, seed, steps, every, progress))
    print(sides.table(rows))
    if variants:
        from jaxslam import variants as rules

        with bar("variants", compiles=True) as progress:
            model = _model(loaded, sensor, association, variants, None, params, paper)
            found = rules.variants(loaded, *model, seed, steps, every, rows, progress)
        print(f"\n{rules.table(found)}")
    parted = [row.double for row in rows if row.double.same < row.double.steps]
    for row in parted:
        warn(f"{row.particles} particles: the two part at step {row.same}")
    return int(bool(parted))


@app.command(usage="Usage: jaxslam convert [OPTIONS] SRC... OUT.npz")
def convert(
    *paths: option(Path, "files or folder to read, then the log to write"),
    robot: whole("which robot of an MRCLAM folder") | None = None,
    overwrite: Overwrite = False,
):
    """Make a log of other people's files; their format is guessed.

    The course's dataset2.mat, an MRCLAM folder (with --robot), or two to four
    .csv files: odometry, measurements, and true poses and landmarks if known.

    Example: jaxslam convert odometry.csv measurements.csv OUT.npz
    """
    from jaxslam.log import NOT_USED, save_log
    from jaxslam.readers import read

    if len(paths) < 2:
        raise ValueError("convert: what to read, and the .npz file to write, are needed")
    *sources, out = paths
    check_new(out, overwrite)
    with bar("reading"):
        log = read(sources, robot)
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
    from jaxslam import check as examine
    from jaxslam.log import load_log

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
        from jaxslam import report
        from jaxslam.error_table import error_table

        errors = report.evaluate_folder(folder, log)
    print(dumps(errors, indent=2) if json else error_table(errors))


@app.command
def plot(folder: Folder, /, *, log: MovedLog = None):
    """Draw the figures of a run anew.

    Example: jaxslam plot runs/demo
    """
    with bar("drawing"):
        from jaxslam.plot import plot_folder

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
    landmarks: whole("point landmarks") = 40,
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
    from jaxslam import simulate as worlds
    from jaxslam.log import save_log

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
    try:
        tokens = sys.argv[1:] if argv is None else argv
        code = app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()
        return code or 0
    except CycloptsError as error:
        problem = f"{error} See: jaxslam --help"
    except KeyboardInterrupt:
        print("jaxslam: interrupted", file=sys.stderr, flush=True)
        if argv is None:  # at once: stopped while compiling, JAX would crash as Python winds down
            os._exit(130)
        return 130
    except BrokenPipeError:  # whoever read the output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        problem = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except ValueError as error:
        problem = str(error)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise  # a fault of ours: show where
        problem = "not enough memory; ask for fewer --particles or --landmarks"
    print("jaxslam:", problem.split("\n")[0], file=sys.stderr)
    return 2


def _model(log, sensor, association, particles, landmarks, params, paper, proposal=None):
    """`Config` and `Params` as the options say."""
    from jaxslam.config import Config, default_params
    from jaxslam.paramfile import load_params
    from jaxslam.runner import config_for

    told = {"particles": particles, "landmarks": landmarks, "proposal": proposal}
    told = {name: value for name, value in told.items() if value}
    config = config_for(log, sensor or ("position" if paper else None), association, **told)
    if paper:
        sizes = config.particles, config.landmarks, config.measurements
        rules = {"sensor": config.sensor, "association": association}
        config = Config.paper(*sizes, **rules | ({"proposal": proposal} if proposal else {}))
    base = default_params(config.sensor, log)
    return config, load_params(params, base) if params else base


def _counts(text):
    counts = [int(count) if count.isdecimal() else 0 for count in text.split(",")]
    if min(counts) < 1:
        raise ValueError(f"--particles is {text!r}; must be whole numbers from 1, like 20,100")
    return counts
