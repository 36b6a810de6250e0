"""The command line: the application, and its commands on logs and run folders.

Results go to stdout, progress and warnings to stderr. Exit codes: 0 ok; 1 finished with warnings
(data lost, map full, numbers not finite); 2 bad input or usage; 69 a process of the run is missing
or died; 74 no space left; 75 another process is writing the folder; 130 interrupted.
Commands import what they need themselves, so that `--help` is fast.
"""

import sys
from pathlib import Path
from typing import Literal

from cyclopts import App, Parameter

from jaxslam.cli import common
from jaxslam.cli import images as cli_images
from jaxslam.cli import learn as cli_learn
from jaxslam.cli import run as cli_run
from jaxslam.cli.common import LogName, OutLog, Overwrite, ParamFile, Seed, Sensor, at_least, option
from jaxslam.logs.readers import FORMATS

HELP = f"""FastSLAM: from a logged run to map, trajectory and figures.

Start with:  jaxslam demo     (maps a real room, in two or three minutes)
Then:        jaxslam run {common.DEMO} --sensor bearing --association known
LOG is a .npz file, or {common.DEMO}, a log that comes with the program.
Each command has its own --help, with an example.
Exit codes: 0 ok, 1 finished with warnings, 2 bad input or usage, 69 a process
of the run is missing, 74 no space left, 75 folder in use, 130 interrupted."""

app = App(
    name="jaxslam",
    help=HELP,
    help_format="plaintext",
    default_parameter=Parameter(negative=(), show_default=common.show_default),  # no --no-overwrite
    suppress_keyboard_interrupt=False,
)
simulate = App(name="simulate", help="Simulate a drive: a log, or images, with ground truth.")
app.command(simulate)
app.command(cli_run.run)
app.command(cli_images.calibrate)
app.command(cli_images.extract)
app.command(cli_images.triangulate)
app.command(cli_learn.learn, usage="Usage: jaxslam learn [OPTIONS] LOG...")
simulate.command(cli_images.room)
app.register_install_completion_command(
    add_to_startup=False,  # leaves .bashrc and the like alone
    help="Install shell completion of commands and options.",
    group="Options",
)
app["--help"].group = app["--version"].group = "Options"

MovedLog = option(str, "Path of the run's log, if the log was moved.") | None
Folder = option(Path, "Run folder.")
Matching = Literal["maximum_likelihood", "known"]
ASSOCIATION = "Data association: maximum likelihood, or identities from the log."
EVERY = "Use every n-th frame (default: the steps cover a tenth of the log)."
WORLD = "Landmarks on the walls of a room of 10 x 4 m, on a grid, or scattered over a field."


@app.command
def demo(*, seed: Seed = 0):
    """Map a real room from the bundled log: bearings only, unknown data association.

    Takes two or three minutes with 1,000 particles. Writes runs/demo, and replaces
    an earlier demo there.

    Example: jaxslam demo
    """
    return cli_run.run(
        common.DEMO, sensor="bearing", seed=seed, out=Path("runs/demo"), overwrite=True
    )


@app.command
def compare(
    log: LogName,
    /,
    *,
    sensor: Sensor = None,
    association: option(Matching, ASSOCIATION) = "maximum_likelihood",
    params: ParamFile = None,
    paper: option(bool, common.PAPER) = False,
    particles: option(str, "Numbers of particles to compare with, separated by commas.") = "20,100",
    steps: at_least("Frames to filter.") = 200,
    every: at_least(EVERY) | None = None,
    seed: Seed = 0,
):
    """Compare the filter with the plain NumPy reference: agreement, accuracy, time.

    Both use the same random numbers. The reference is slow: about 10 seconds for
    20 particles over 200 steps.

    Example: jaxslam compare lost-in-the-woods --particles 20,100 --steps 200
    """
    counts = _parse_counts(particles)
    with common.progress_bar("reading"):
        from jaxslam.logs.log_file import load_log
        from jaxslam.reference import compare as sides

        loaded = load_log(log)
    rows = []
    for count in counts:
        model = cli_run.config_from_options(loaded, sensor, association, count, None, params, paper)
        with common.progress_bar(f"{count} particles", compiles=True) as progress:
            rows.append(sides.compare(loaded, *model, seed, steps, every, progress))
    print(sides.table(rows))
    parted = [row.double for row in rows if row.double.same < row.double.steps]
    for row in parted:
        common.warn(f"{row.particles} particles: the two part at step {row.same}")
    return int(bool(parted))


CONVERT = f"""Convert files in another format to a log; the format is detected.

SRC may be:
{chr(10).join(f"- {row.name}: {row.help}" for row in FORMATS)}

Example: jaxslam convert odometry.csv measurements.csv OUT.npz"""


@app.command(help=CONVERT, usage="Usage: jaxslam convert [OPTIONS] SRC... OUT.npz")
def convert(
    *paths: option(Path, "Files or folder to read, then the log to write."),
    robot: at_least("Number of the robot, for an MRCLAM folder.") | None = None,
    time_offset: option(float, "Seconds to add to the times of frames, as check suggests.") = 0.0,
    overwrite: Overwrite = False,
):
    """Convert files in one of `readers.FORMATS` to a log."""
    from jaxslam.logs.clock_offset import shift_frames
    from jaxslam.logs.log import NOT_USED
    from jaxslam.logs.log_file import save_log
    from jaxslam.logs.readers import read

    if len(paths) < 2:
        raise ValueError("convert: files to read, and the .npz file to write, are needed")
    *sources, out = paths
    common.check_new(out, overwrite)
    with common.progress_bar("reading"):
        log = shift_frames(read(sources, robot), time_offset)
    save_log(out, log)
    print(f"{out}: {log}; look at it with: jaxslam check {out}")
    lost = {why: n for why, n in log.skipped.items() if not why.startswith(NOT_USED)}
    for why, count in lost.items():
        common.warn(f"{count} rows skipped: {why}")
    return int(bool(lost))


@app.command
def check(log: LogName, /):
    """Check a log: counts, rates, gaps, lost rows, units, and what looks wrong.

    Example: jaxslam check OUT.npz
    """
    from jaxslam.logs import diagnostics as examine
    from jaxslam.logs.log_file import load_log

    findings = examine.check(load_log(log))
    for severity, text in findings:
        print(f"{severity:8} {text}")
    return examine.status(findings)


@app.command
def evaluate(
    folder: Folder,
    /,
    *,
    json: option(bool, "Print the errors as JSON.") = False,
    log: MovedLog = None,
):
    """Print the errors of a run against the ground truth of its log.

    Example: jaxslam evaluate runs/demo --json
    """
    from json import dumps

    with common.progress_bar("reading"):
        from jaxslam.results import load
        from jaxslam.results.tables import error_table

        errors = load.evaluate_folder(folder, log)
    print(dumps(errors, indent=2) if json else error_table(errors))


@app.command
def plot(folder: Folder, /, *, log: MovedLog = None):
    """Draw the figures of a run again.

    Example: jaxslam plot runs/demo
    """
    with common.progress_bar("drawing"):
        from jaxslam.results.load import plot_folder

        paths = plot_folder(folder, log)
    for path in paths:
        print(path)


@simulate.command
def planar(
    out: OutLog,
    /,
    *,
    world: option(Literal["room", "grid", "field"], WORLD) = "room",
    seed: Seed = 0,
    landmarks: at_least("Number of landmarks.") = 40,
    length: option(float, "Length of the path in m.") = 60.0,
    speed: option(float, "Speed of the robot in m/s.") = 0.5,
    rate: option(float, "Frames per second.") = 5.0,
    odometry_rate: option(float, "Odometry readings per second.") = 50.0,
    commands: option(bool, "Stop and go: record motion commands instead of odometry.") = False,
    stop: option(float, "Distance between two stops in m, with --commands.") = 0.3,
    err_tran: option(float, "Noise along the path in m/sqrt(m).") = 0.02,
    err_rot: option(float, "Noise of the heading from turning in rad/sqrt(rad).") = 0.02,
    err_drift: option(float, "Noise of the heading from driving in rad/sqrt(m).") = 0.02,
    sigma_range: option(float, "Noise of ranges in m.") = 0.05,
    sigma_bearing: option(float, "Noise of bearings in rad.") = 0.02,
    view_range: option(float, "Range of the sensor in m.") = 5.0,
    detection: option(float, "Probability that a landmark at range 0 is detected.") = 0.9,
    outlier: option(float, "Probability that a measurement is clutter.") = 0.02,
    truth_resolution: option(float, "Round the true poses to tiles of this size in m.") = 0.0,
    overwrite: Overwrite = False,
):
    """Simulate a drive through a planar world, with the models of the filter.

    Example: jaxslam simulate planar OUT.npz --world room --seed 1
    """
    from jaxslam.logs.log_file import save_log
    from jaxslam.simulation import planar as worlds

    common.check_new(out, overwrite)
    with common.progress_bar("simulating"):
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
    """Run one command (None: of the process's arguments) and return its exit code."""
    tokens = sys.argv[1:] if argv is None else argv
    return common.run_command(
        lambda: app(tokens, exit_on_error=False, print_error=False, result_action="return_value"),
        at_once=argv is None,
    )


def _parse_counts(text):
    counts = [int(count) if count.isdecimal() else 0 for count in text.split(",")]
    if min(counts) < 1:
        raise ValueError(f"--particles is {text!r}; must be whole numbers from 1, like 20,100")
    return counts
