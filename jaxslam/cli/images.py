"""Commands for images: `calibrate`, `extract`, `triangulate` and `simulate room`."""

from pathlib import Path
from typing import Literal

from cyclopts import App, Group

from jaxslam.cli import common
from jaxslam.cli.common import LogName, OutLog, Overwrite, Seed, check_new, option, progress_bar

calibrate = App(name="calibrate", help="Calibrate a camera, its tilt, or a sensor's errors.")

CAMERA, FOREIGN = map(Group.create_ordered, ("Camera", "Camera files of other tools"))
Source = option(Path, "Folder of images, one image, or a video.")
Boards = option(Path, "Folder of images of the board, or the image files.")
CameraFile = option(Path, "Camera file: .toml, OCamCalib's .txt, or .yaml of Kalibr or OpenCV.")
Camera = option(Path, "Camera file to write, a .toml file.")
Motion = option(Path, "TOML file with parameters of the motion, from calibrate sensor.") | None
Overlay = option(Path, "Folder, .mp4 or .avi to write: the images with their lines.") | None
Figure = option(Path, "Picture of points and ellipses (paper, fig. 6), a .png file.") | None
Truth = option(Path, "Folder with any of poses.csv, landmarks.csv and plan.csv.") | None
Models = Literal["polynomial", "unified"]
Sides = Literal["up", "down"]
LensSide = option(Sides, "Direction of the lens on the robot.", CAMERA)
LensOfFile = option(Sides, "Direction of the lens; a .toml file holds its own.", FOREIGN)
Mirror = option(bool, "The camera looks into one mirror (two restore the view).", CAMERA)
MirrorOfFile = option(bool, "The camera looks into one mirror; a .toml file holds this.", FOREIGN)
Drives = Literal["loop", "straight", "turn"]
Presets = Literal["clean", "normal", "hard"]
DRIVE = "Round the room, straight along a wall, or a turn on the spot."
LENGTH = "Length of the path in metres (default: loop 60, straight 6), or of a turn in rad (2 pi)."
MODEL = "Camera model: polynomial (Scaramuzza) or unified (Mei)."
ODOMETRY = "Odometry .csv: time_s,distance_m,turn_rad or time_s,forward_m_s,yaw_rate_rad_s."


@calibrate.command(usage="Usage: jaxslam calibrate camera [OPTIONS] IMAGES...")
def camera(
    *images: Boards,
    board: option(str, "Number of inner corners (where four squares meet), e.g. 6x7."),
    square: option(float, "Side of a square in metres."),
    out: Camera = Path("camera.toml"),
    report: option(Path, "Picture of the fit to write, a .png file.") = Path("camera.png"),
    overwrite: Overwrite = False,
    model: option(Models, MODEL, CAMERA) = "polynomial",
    mirror: Mirror = False,
    lens: LensSide = "up",
):
    """Calibrate a mirror or fisheye camera from images of a chessboard.

    Take ten or more images: all round the camera, near and far, with the board tilted.
    Prints the residuals of every image, rejected images with reasons, the coverage of
    the view by corners, and the uncertainty of bearings in degrees.

    Example: jaxslam calibrate camera boards/ --board 6x7 --square 0.03 --mirror
    """
    from calibration.camera import calibrate_camera
    from calibration.camera_report import draw, text
    from jaxslam.vision.camera_files import save_camera

    if not images:
        raise ValueError("calibrate camera: a folder, or files, of images are needed")
    check_new(out, overwrite, "a camera", ".toml")
    check_new(report, overwrite, "a picture", ".png")
    with progress_bar("finding corners") as progress:
        calibration = calibrate_camera(
            list(images) if len(images) > 1 else images[0], _parse_board(board), square,
            model=model, mirror=mirror, lens=lens, progress=progress,
        )  # fmt: skip
    save_camera(out, calibration.camera)
    draw(calibration, report)
    print(text(calibration))
    print(f"{out}: the camera; {report}: the fit")
    return int(bool(calibration.rejected))  # warnings about the set are only advice


@calibrate.command
def tilt(
    images: Source,
    /,
    *,
    camera: CameraFile,
    out: Camera | None = None,
    overwrite: Overwrite = False,
    mirror: MirrorOfFile = False,
    lens: LensOfFile = "up",
):
    """Find the tilt of a camera from the vertical lines in ordinary images of rooms.

    Prints the roll and pitch to correct on the mount. Alternatively, --out writes a
    camera file that compensates the tilt.

    Example: jaxslam calibrate tilt images/ --camera camera.toml --out level.toml
    """
    from calibration.tilt import camera_with_tilt, describe, find_tilt
    from jaxslam.vision.camera_files import load_camera, save_camera
    from jaxslam.vision.images import Images

    if out:
        check_new(out, overwrite, "a camera", ".toml")
    nominal = load_camera(camera, mirror, lens)
    with progress_bar("searching for lines") as progress:
        found = find_tilt(Images(images), nominal, progress=progress)
    print(describe(found))
    if out:
        save_camera(out, camera_with_tilt(nominal, found))
        print(f"{out}: the camera with this tilt")
    for why, count in found.skipped.items():
        common.warn(f"images skipped, {count}: {why}")
    return int(bool(found.skipped))


@calibrate.command
def sensor(
    log: LogName,
    /,
    *,
    out: option(Path, "TOML file to write, for --params of extract and run.") = Path("params.toml"),
    figure: Figure = None,
    overwrite: Overwrite = False,
):
    """Fit a sensor's error model to a drive whose truth is known.

    The paper's procedure: drive straight past surveyed lines, with 30 stops or more,
    and extract with --truth. Prints the noise of bearings and motion, and compares
    models of a point's error, by two-fold cross-validation on halves of the drive.

    Example: jaxslam calibrate sensor straight.npz --out params.toml --figure points.png
    """
    from calibration import sensor_report
    from jaxslam.logs.log_file import load_log
    from jaxslam.parameter_file import save_params
    from jaxslam.parameters import default_params

    check_new(out, overwrite, "a file of parameters", ".toml")
    drive = load_log(log)
    if figure:
        check_new(figure, overwrite, "a picture", ".png")
        if not drive.has("position") or drive.point is None:
            remedy = "omit --figure, or run jaxslam triangulate first"
            raise ValueError(f"{log}: has no points to draw; {remedy}")
    with progress_bar("fitting"):
        report = sensor_report.calibrate_sensor(drive)
    print(sensor_report.text(report))
    base = default_params("position" if report.models else "bearing", drive)
    params = sensor_report.filter_params(report, base)
    errors = sensor_report.values(report)[1]
    fitted = {k: v for k, v in errors.items() if getattr(base, k) != getattr(params, k)}
    save_params(out, params, fitted)
    print(f"{out}: motion and position_scale, for --params of extract and run")
    if figure:
        print(f"{sensor_report.draw(report, drive, figure)}: points, ellipses, surveyed lines")


def extract(
    images: Source,
    /,
    *,
    camera: CameraFile,
    odometry: option(Path, ODOMETRY),
    out: OutLog,
    truth: Truth = None,
    params: Motion = None,
    overlay: Overlay = None,
    overwrite: Overwrite = False,
    mirror: MirrorOfFile = False,
    lens: LensOfFile = "up",
):
    """Make a log from images and odometry: vertical lines, matched and triangulated.

    The images' times are read from frames.csv (image,time_s), in their folder or the
    one above. Without it, the first that fits: one image before the first command and
    one after each, the frame rate of a video, or names that are times in seconds.
    To resume an interrupted extraction, repeat the command.

    Example: jaxslam extract images/ --camera c.toml --odometry o.csv --out OUT.npz
    """
    from jaxslam.parameter_file import load_params
    from jaxslam.parameters import default_params
    from jaxslam.vision.camera_files import load_camera
    from jaxslam.vision.extract import extract as run_extract

    check_new(out, overwrite)
    calibrated = load_camera(camera, mirror, lens)
    robot = load_params(params, default_params("position")) if params else None
    try:
        with progress_bar("extracting lines") as progress:
            log = run_extract(
                images, calibrated, odometry, out, truth=truth, params=robot, overlay=overlay,
                overwrite=overwrite, progress=progress,
            )  # fmt: skip
    except KeyboardInterrupt:
        common.warn("stopped; repeat the command to resume")
        raise
    return _summarize(log, out)


def triangulate(
    log: LogName, out: OutLog, /, *, params: Motion = None, overwrite: Overwrite = False
):
    """Add points to a log: bearings, matched between frames and triangulated by odometry.

    This is the paper's procedure, for any log of bearings. Logs from extract have
    points already. Use them with jaxslam run --sensor position.

    Example: jaxslam triangulate lost-in-the-woods OUT.npz
    """
    from jaxslam.logs.log_file import load_log, save_log
    from jaxslam.parameter_file import load_params
    from jaxslam.parameters import default_params
    from jaxslam.vision.log_triangulation import triangulate_log

    check_new(out, overwrite)
    with progress_bar("triangulating") as progress:
        bearings = load_log(log)
        robot = load_params(params, default_params("position", bearings)) if params else None
        points = triangulate_log(bearings, robot, progress=progress)
    save_log(out, points)
    return _summarize(points, out, " --sensor position", bearings.skipped)


def room(
    out: option(Path, "Folder to write."),
    /,
    *,
    seed: Seed = 0,
    drive: option(Drives, DRIVE) = "loop",
    step: option(float, "Distance between two images in metres.") = 0.2,
    length: option(float, LENGTH) | None = None,
    preset: option(Presets, "Light, blur and noise of the images.") = "normal",
    overwrite: Overwrite = False,
):
    """Render a robot's drive through a furnished room, seen by a mirror camera.

    Writes images, commands (without the slip of the wheels), the camera file, and the
    truth: poses, landmarks and floor plan. A loop has about 300 images.

    Example: jaxslam simulate room rooms/1 --seed 1
    """
    from jaxslam.simulation.room.render import render_room

    with progress_bar("rendering") as progress:
        frames = render_room(
            out, seed=seed, drive=drive, step=step, length=length, preset=preset,
            overwrite=overwrite, progress=progress,
        )  # fmt: skip
    inputs = f"--camera {out / 'camera.toml'} --odometry {out / 'odometry.csv'} --truth {out}"
    print(f"{out}: {frames} images; next: jaxslam extract {out / 'images'} {inputs} --out OUT.npz")


def _parse_board(text):
    """Parse the number of corners along both sides, like 6x7."""
    sides = [int(side) if side.isdecimal() else 0 for side in text.lower().split("x")]
    if len(sides) != 2 or min(sides) < 2:
        raise ValueError(f"--board is {text!r}; must be two counts of inner corners, like 6x7")
    return tuple(sides)


def _summarize(log, out, options="", reported=()):
    """Print the contents of a log of lines, and what was skipped; return the exit code.

    `options` of `jaxslam run` for this log; `reported`: skipped reasons of the log it is made from.
    """
    import numpy as np

    from jaxslam.logs.log import NOT_USED

    points = int(np.isfinite(log.point[:, 0]).sum())
    print(f"{out}: {log}, {points} points")
    incomplete = False
    for why, count in log.skipped.items():
        if why.startswith(NOT_USED):
            print(f"{count} {why}")
        elif why not in reported:
            incomplete = True
            common.warn(f"{why}: {count}")
    if not len(log.frame):
        common.warn("no line in any image: are they blurred, or taken by another camera?")
    elif not points:
        common.warn("no points: only jaxslam run --sensor bearing can map this log")
    else:
        print(f"map it with: jaxslam run {out}{options}")
    return int(incomplete or not points)
