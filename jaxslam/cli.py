"""The command line: one small function per command.

Results go to stdout, progress and warnings to stderr. Exit codes: 0 ok; 1 finished with warnings
(data lost, map full, numbers not finite); 2 bad input or usage; 130 interrupted. Everything heavy
is imported where it is needed, so that `--help` comes at once.
"""

import os
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter
from cyclopts.validators import Number

DEMO = "lost-in-the-woods"
HELP = f"""FastSLAM: from a logged run to map, trajectory and figures.

Begin with:  jaxslam demo  (a real robot's run becomes a map in runs/demo)
Then:        jaxslam run {DEMO} --sensor bearing
Each command has its own --help with an example. LOG is a .npz file or the name of a bundled
log, {DEMO}. Lengths are metres, angles radians, times seconds.

Exit codes: 0 ok, 1 finished with warnings, 2 bad input or usage, 130 interrupted."""

app = App(
    name="jaxslam",
    help=HELP,
    help_format="plaintext",
    default_parameter=Parameter(negative=(), show_default=lambda value: value is not False),
    suppress_keyboard_interrupt=False,
)
simulate = App(name="simulate", help="Make a log of a simulated world, with its truth.")
app.command(simulate)

LogName = Annotated[str, Parameter(help=f"a .npz file, or the bundled log {DEMO}")]
MovedLog = Annotated[str | None, Parameter(help="where the run's log is now, if it was moved")]
Folder = Annotated[Path, Parameter(help="a run's folder")]
Sensor = Annotated[
    Literal["range_bearing", "position", "bearing"] | None,
    Parameter(help="what the filter is given of each measurement (the first that the log has)"),
]
Association = Annotated[
    Literal["maximum_likelihood", "known"],
    Parameter(help="find out which landmark was measured, or believe the log's identities"),
]
Count = Annotated[int, Parameter(validator=Number(gte=1, lte=10**9))]
Seed = Annotated[
    int, Parameter(help="of the random draws; it makes a run repeatable", validator=Number(gte=0, lt=2**32))
]  # fmt: skip
ParamFile = Annotated[
    Path | None, Parameter(help="TOML file of parameters; those it leaves out keep their default")
]
Paper = Annotated[
    bool,
    Parameter(
        help="the paper's own rules: 2-D positions, best match for every measurement, nothing is "
        "exclusive, clutter or forgotten"
    ),
]
Overwrite = Annotated[bool, Parameter(help="replace what is there")]
Probability = Annotated[float, Parameter(validator=Number(gte=0, lte=1))]


@app.command
def demo(*, seed: Seed = 0):
    """Map a real room: the bundled log, ranges and bearings, identities hidden.

    1,000 particles; takes about a minute; writes runs/demo, replacing an earlier demo.

    Example: jaxslam demo
    """
    from jaxslam import report
    from jaxslam.log import load_log

    out = Path("runs") / "demo"
    report.check_target(out, overwrite=True)
    log = load_log(DEMO)
    settings = _settings(log, "range_bearing", "maximum_likelihood", 1000, None, None, False)
    code = _run(log, *settings, seed, out, True, DEMO)
    print(f"The map is in {out / 'map.png'}")
    return code


@app.command
def run(
    log: LogName,
    /,
    *,
    sensor: Sensor = None,
    association: Association = "maximum_likelihood",
    particles: Annotated[Count, Parameter(help="how many hypotheses of the path")] = 1000,
    landmarks: Annotated[
        Count | None, Parameter(help="slots of the map (64; known: as many as identities)")
    ] = None,
    params: ParamFile = None,
    paper: Paper = False,
    seed: Seed = 0,
    out: Annotated[Path | None, Parameter(help="folder to write (runs/LOG-SENSOR-SEED)")] = None,
    overwrite: Overwrite = False,
):
    """Filter a log: trajectory, map, figures and errors in a folder.

    The folder holds map.png, error.png, particles.png, trajectory.tum, landmarks.csv,
    summary.json, run.toml (every setting), events.jsonl and steps.npz.

    Example: jaxslam run lost-in-the-woods --sensor bearing --association known --out runs/woods
    """
    from jaxslam import report
    from jaxslam.log import load_log

    loaded = load_log(log)
    config, numbers = _settings(loaded, sensor, association, particles, landmarks, params, paper)
    out = out or Path("runs") / f"{Path(log).stem}-{config.sensor}-{seed}"
    report.check_target(out, overwrite)
    return _run(loaded, config, numbers, seed, out, overwrite, log)


@app.command
def compare(
    log: LogName,
    /,
    *,
    sensor: Sensor = None,
    association: Association = "maximum_likelihood",
    params: ParamFile = None,
    paper: Paper = False,
    particles: Annotated[str, Parameter(help="particle counts, by commas")] = "20,100",
    steps: Annotated[Count, Parameter(help="frames to filter")] = 200,
    every: Annotated[
        Count | None, Parameter(help="use each n-th frame only (a tenth of the log is covered)")
    ] = None,
    seed: Seed = 0,
):
    """Show the filter beside the plain NumPy baseline: agreement, accuracy, time.

    Both get the same random draws. The baseline takes a second for some thousand particle steps.

    Example: jaxslam compare lost-in-the-woods --particles 20,100 --steps 200
    """
    from jaxslam import compare as side_by_side
    from jaxslam.log import load_log

    counts = _counts(particles)
    loaded, rows = load_log(log), []
    for count in counts:
        settings = _settings(loaded, sensor, association, count, None, params, paper)
        with _bar(f"{count} particles") as progress:
            rows.append(side_by_side.compare(loaded, *settings, seed, steps, every, progress))
    print(side_by_side.table(rows))
    for row in rows:
        if row.double.same < row.double.steps:
            _warn(f"the two part at step {row.double.same}, {row.double.particles} particles")
    return int(any(row.double.same < row.double.steps for row in rows))


@app.command(usage="Usage: jaxslam convert [OPTIONS] SRC... OUT.npz")
def convert(
    *paths: Annotated[Path, Parameter(help="files or folder to read, then the log to write")],
    robot: Annotated[int | None, Parameter(help="which robot of an MRCLAM folder")] = None,
    overwrite: Overwrite = False,
):
    """Make a log of other people's files; their format is guessed.

    The course's dataset2.mat, an MRCLAM folder (with --robot), or two to four .csv files:
    odometry, measurements, and the truth if there is any (columns: docs/log.md).

    Example: jaxslam convert odometry.csv measurements.csv OUT.npz
    """
    from jaxslam.log import NOT_USED, save_log
    from jaxslam.readers import read

    if len(paths) < 2:
        raise ValueError("convert: what to read, and the .npz file to write, are needed")
    *sources, out = paths
    _check_new(out, overwrite)
    with _bar("reading"):
        log = read(sources, robot)
    save_log(out, log)
    print(f"{out}: {log}; look at it with: jaxslam check {out}")
    lost = {why: n for why, n in log.skipped.items() if not why.startswith(NOT_USED)}
    for why, count in lost.items():
        _warn(f"{count} rows skipped: {why}")
    return int(bool(lost))


@app.command
def check(log: LogName, /):
    """Say what is in a log and what looks wrong: counts, rates, gaps, lost rows, units.

    Exit code 0: all is well, 1: warnings, 2: errors.

    Example: jaxslam check OUT.npz
    """
    from jaxslam import check as examine
    from jaxslam.log import load_log

    findings = examine.check(load_log(log))
    for severity, text in findings:
        print(f"{severity:8} {text}")
    return examine.status(findings)


@app.command
def evaluate(
    folder: Folder,
    /,
    *,
    json: Annotated[bool, Parameter(help="print the errors as JSON")] = False,
    log: MovedLog = None,
):
    """Print the errors of a run against its log's truth.

    Example: jaxslam evaluate runs/demo --json
    """
    from json import dumps

    with _bar("reading"):
        from jaxslam import report

        errors = report.evaluate_folder(folder, log)
    print(dumps(errors, indent=2) if json else report.error_table(errors))
    return 0


@app.command
def plot(folder: Folder, /, *, log: MovedLog = None):
    """Draw the figures of a run anew.

    Example: jaxslam plot runs/demo
    """
    with _bar("drawing"):
        from jaxslam.plot import plot_folder

        paths = plot_folder(folder, log)
    for path in paths:
        print(path)
    return 0


@simulate.command
def planar(
    out: Annotated[Path, Parameter(help="the log to write, a .npz file")],
    /,
    *,
    world: Annotated[
        Literal["room", "grid", "field"],
        Parameter(help="landmarks on the walls of 10 x 4 m, on a grid, or scattered"),
    ] = "room",
    seed: Seed = 0,
    landmarks: Annotated[Count, Parameter(help="point landmarks")] = 40,
    length: Annotated[float, Parameter(help="path [m]")] = 60.0,
    speed: Annotated[float, Parameter(help="[m/s]")] = 0.5,
    rate: Annotated[float, Parameter(help="frames per second [Hz]")] = 5.0,
    odometry_rate: Annotated[float, Parameter(help="odometry per second [Hz]")] = 50.0,
    commands: Annotated[bool, Parameter(help="stop and go, no odometry but commands")] = False,
    stop: Annotated[float, Parameter(help="between stops [m]")] = 0.3,
    err_tran: Annotated[float, Parameter(help="noise along the path [m/sqrt(m)]")] = 0.02,
    err_rot: Annotated[float, Parameter(help="heading, by turning [rad/sqrt(rad)]")] = 0.02,
    err_drift: Annotated[float, Parameter(help="heading, by driving [rad/sqrt(m)]")] = 0.02,
    sigma_range: Annotated[float, Parameter(help="noise of ranges [m]")] = 0.05,
    sigma_bearing: Annotated[float, Parameter(help="noise of bearings [rad]")] = 0.02,
    view_range: Annotated[float, Parameter(help="the sensor sees so far [m]")] = 5.0,
    detection: Annotated[Probability, Parameter(help="of being seen, at range 0")] = 0.9,
    outlier: Annotated[Probability, Parameter(help="of being clutter")] = 0.02,
    truth_resolution: Annotated[float, Parameter(help="truth read off tiles of so many m")] = 0.0,
    overwrite: Overwrite = False,
):
    """Simulate a drive through a planar world, drawn from the filter's own model.

    Example: jaxslam simulate planar OUT.npz --world room --seed 1
    """
    from jaxslam import simulate as worlds
    from jaxslam.log import save_log

    _check_new(out, overwrite)
    with _bar("simulating"):
        log = worlds.planar(
            world, seed, landmarks=landmarks, length_m=length, speed=speed, rate_hz=rate,
            odometry_hz=odometry_rate, commands=commands, stop_m=stop, err_tran=err_tran,
            err_rot=err_rot, err_drift=err_drift, sigma_range=sigma_range,
            sigma_bearing=sigma_bearing, view=(-worlds.pi, worlds.pi, view_range),
            detection=detection, outlier=outlier, truth_resolution=truth_resolution,
        )  # fmt: skip
    save_log(out, log)
    print(f"{out}: {log}")
    return 0


def main(argv=None):
    """Run one command (None: the process's arguments); returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        code = app(argv, exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()
        return code or 0
    except CycloptsError as error:
        problem = f"{error} See: jaxslam --help"
    except KeyboardInterrupt:
        print("jaxslam: interrupted; nothing was written", file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read the output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        problem = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except ValueError as error:
        problem = str(error)
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        problem = "not enough memory; ask for fewer --particles or --landmarks"
    print(f"jaxslam: {problem.splitlines()[0]}", file=sys.stderr)
    return 2


def _settings(log, sensor, association, particles, landmarks, params, paper):
    """`Config` and `Params` as the options say."""
    from jaxslam.config import Config, default_params
    from jaxslam.paramfile import load_params
    from jaxslam.runner import config_for

    sizes = {"particles": particles} | ({"landmarks": landmarks} if landmarks else {})
    sensor = sensor or ("position" if paper else None)
    config = config_for(log, sensor, association, **sizes)
    if paper:
        config = Config.paper(
            particles, config.landmarks, config.measurements,
            sensor=config.sensor, association=association,
        )  # fmt: skip
    base = default_params(config.sensor, log)
    return config, load_params(params, base) if params else base


def _run(log, config, params, seed, out, overwrite, source):
    """Filter, save and report; returns the exit code."""
    import json

    from jaxslam import report, runner

    with _bar("filtering") as progress:
        result = runner.run(log, config, params, seed, progress)
    with _bar("writing"):
        report.save(result, out, overwrite, log_source=source)
    print(report.error_table(json.loads((out / "summary.json").read_text(encoding="utf-8"))))
    steps = f"{len(result.time)} steps in {result.seconds:.1f} s"
    print(f"{steps} and {result.compile_seconds:.1f} s to compile; written to {out}")
    for line in result.flags:
        _warn(line)
    return int(bool(result.flags))


@contextmanager
def _bar(what):
    """A progress bar on stderr; gives a function of (done, total), or None without a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)

        def show(done, total):
            text = what if done else f"{what}: compiling… (once)"
            bar.update(task, description=text, completed=done, total=total if done else None)

        yield show


def _counts(text):
    try:
        counts = [int(count) for count in text.split(",")]
    except ValueError:
        counts = [0]
    if min(counts) < 1:
        raise ValueError(
            f"--particles is {text!r}; must be whole numbers from 1, by commas: 20,100"
        )
    return counts


def _check_new(out, overwrite):
    """Refuse a log's path that is no .npz file or is taken, before the work is done."""
    if out.suffix != ".npz":
        raise ValueError(f"{out}: a log is a .npz file; give its name last, as OUT.npz")
    if out.exists() and not overwrite:
        raise ValueError(f"{out}: exists; choose another name or add --overwrite")


def _warn(text):
    print(f"warning: {text}", file=sys.stderr)
