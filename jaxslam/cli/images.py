"""The commands that begin at images: calibrate, extract, triangulate, and the rendered room."""

from pathlib import Path
from typing import Literal

from cyclopts import App

from jaxslam.cli.common import (
    LogName,
    OutLog,
    Overwrite,
    Seed,
    check_new,
    option,
    progress_bar,
    warn,
)

calibrate = App(name="calibrate", help="Fit a camera, its tilt, or a sensor's errors.")

Source = option(Path, "a folder of images, one image, or a video")
Boards = option(Path, "a folder of images of the board, or the images themselves")
CameraFile = option(Path, "the camera: .toml, OCamCalib's .txt, or .yaml of Kalibr or OpenCV")
Camera = option(Path, "where the camera is written, a .toml file")
Motion = option(Path, "parameters of the robot's motion, from calibrate sensor") | None
Overlay = option(Path, "folder, .mp4 or .avi for the images with their lines drawn in") | None
Truth = option(Path, "folder of poses.csv, landmarks.csv and plan.csv, where known") | None
Models = Literal["polynomial", "unified"]
Sides = Literal["up", "down"]
LensSide = option(Sides, "where the lens points on the robot")
LensOfFile = option(Sides, "where the lens points; not for a .toml, which says it")
Mirror = option(bool, "the lens looks into one mirror (not for two, which turn the view back)")
MirrorOfFile = option(bool, "it looks into one mirror; not for a .toml, which says it")
Drives = Literal["loop", "straight", "turn"]
Presets = Literal["clean", "normal", "hard"]


@calibrate.command(usage="Usage: jaxslam calibrate camera [OPTIONS] IMAGES...")
def camera(
    *images: Boards,
    board: option(str, "inner corners (where four squares meet), as 6x7"),
    square: option(float, "side of one square [m]"),
    model: option(Models, "polynomial (Scaramuzza) or unified (Mei) model") = "polynomial",
    mirror: Mirror = False,
    lens: LensSide = "up",
    out: Camera = Path("camera.toml"),
    report: option(Path, "picture of the fit, a .png") = Path("camera.png"),
    overwrite: Overwrite = False,
):
    """Calibrate a mirror or fisheye camera from images of a chessboard.

    Take ten or more: all round the camera, near and far, the board tilted. Prints the
    residuals of every image, what was rejected and why, how the corners cover the
    view, and the uncertainty of bearings in degrees.

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
        found = calibrate_camera(
            list(images) if len(images) > 1 else images[0],
            _parse_board(board),
            square,
            model=model,
            mirror=mirror,
            lens=lens,
            progress=progress,
        )
    save_camera(out, found.camera)
    draw(found, report)
    print(text(found))
    print(f"{out}: the camera; {report}: the fit")
    return int(bool(found.rejected))  # a warning about the set is advice


@calibrate.command
def tilt(
    images: Source,
    /,
    *,
    camera: CameraFile,
    mirror: MirrorOfFile = False,
    lens: LensOfFile = "up",
    out: Camera | None = None,
    overwrite: Overwrite = False,
):
    """Find which way is up from the vertical lines of ordinary images of rooms.

    Prints the roll and pitch to correct on the mount; --out writes the camera with
    the tilt, which then compensates it.

    Example: jaxslam calibrate tilt images/ --camera camera.toml --out level.toml
    """
    from calibration.tilt import camera_with_tilt, describe, find_tilt
    from jaxslam.vision.camera_files import load_camera, save_camera
    from jaxslam.vision.images import Images

    if out:
        check_new(out, overwrite, "a camera", ".toml")
    known = load_camera(camera, mirror, lens)
    with progress_bar("looking for lines") as progress:
        found = find_tilt(Images(images), known, progress=progress)
    print(describe(found))
    if out:
        save_camera(out, camera_with_tilt(known, found))
        print(f"{out}: the camera with this tilt")
    for why, count in found.skipped.items():
        warn(f"images skipped, {count}: {why}")
    return int(bool(found.skipped))


@calibrate.command
def sensor(
    log: LogName,
    /,
    *,
    out: option(Path, "file to write, a .toml, for --params of extract and run") = Path(
        "params.toml"
    ),
    figure: option(Path, "picture of points and ellipses (the paper's fig. 6)") | None = None,
    overwrite: Overwrite = False,
):
    """Find a sensor's error model from a drive whose truth is known.

    The paper's procedure: drive straight past surveyed lines, 30 stops or more, and
    extract with --truth. Prints the noise of bearings and motion, and which model of
    a point's error predicts best, each on the half of the drive it was not fitted on.

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
            raise ValueError(f"{log}: has no points to draw; leave --figure out, or triangulate")
    with progress_bar("fitting"):
        report = sensor_report.calibrate_sensor(drive)
    print(sensor_report.text(report))
    base = default_params("position" if report.models else "bearing", drive)
    params = sensor_report.filter_params(report, base)
    errors = sensor_report.values(report)[1]
    save_params(
        out, params, {k: v for k, v in errors.items() if getattr(base, k) != getattr(params, k)}
    )
    print(f"{out}: the motion, and the points' scale, for --params of extract and run")
    if figure:
        print(f"{sensor_report.draw(report, drive, figure)}: points, ellipses, surveyed lines")


def extract(
    images: Source,
    /,
    *,
    camera: CameraFile,
    mirror: MirrorOfFile = False,
    lens: LensOfFile = "up",
    odometry: option(
        Path, ".csv of time_s,distance_m,turn_rad or time_s,forward_m_s,yaw_rate_rad_s"
    ),
    out: OutLog,
    truth: Truth = None,
    params: Motion = None,
    overlay: Overlay = None,
    overwrite: Overwrite = False,
):
    """Make a log of images: vertical lines, matched and triangulated, with the odometry.

    When the images were taken is read from frames.csv (image,time_s), in their folder
    or the one above. Without it: one image before the first command and one after
    each, a video's own rate, or names that are seconds, whichever fits first.
    The same command again goes on where an interrupted one stopped.

    Example: jaxslam extract images/ --camera c.toml --odometry o.csv --out OUT.npz
    """
    from jaxslam.parameter_file import load_params
    from jaxslam.parameters import default_params
    from jaxslam.vision.camera_files import load_camera
    from jaxslam.vision.extract import extract as run_extract

    check_new(out, overwrite)
    known = load_camera(camera, mirror, lens)
    robot = load_params(params, default_params("position")) if params else None
    try:
        with progress_bar("extracting lines") as progress:
            log = run_extract(
                images, known, odometry, out, truth=truth, params=robot, overlay=overlay,
                overwrite=overwrite, progress=progress,
            )  # fmt: skip
    except KeyboardInterrupt:
        warn("stopped; the same command again goes on from here")
        raise
    return _summarize(log, out)


def triangulate(
    log: LogName, out: OutLog, /, *, params: Motion = None, overwrite: Overwrite = False
):
    """Add points to a log of bearings: matched between frames, triangulated by odometry.

    The paper's way on any log; jaxslam run --sensor position then uses the points.
    What extract wrote has points already.

    Example: jaxslam triangulate lost-in-the-woods OUT.npz
    """
    from jaxslam.logs.log_file import load_log, save_log
    from jaxslam.parameter_file import load_params
    from jaxslam.parameters import default_params
    from jaxslam.vision.log_triangulation import triangulate_log

    check_new(out, overwrite)
    with progress_bar("triangulating") as progress:
        given = load_log(log)
        robot = load_params(params, default_params("position", given)) if params else None
        found = triangulate_log(given, robot, progress=progress)
    save_log(out, found)
    return _summarize(found, out, " --sensor position", given.skipped)


def room(
    out: option(Path, "folder to write"),
    /,
    *,
    seed: Seed = 0,
    drive: option(
        Drives, "round and round the room, straight along a wall, or turning on the spot"
    ) = "loop",
    step: option(float, "between two images [m]") = 0.2,
    length: option(float, "of the path [m] (loop 60, straight 6); of a turn [rad] (a whole one)")
    | None = None,
    preset: option(Presets, "light, blur and noise of the images") = "normal",
    overwrite: Overwrite = False,
):
    """Render the drive of a robot through a furnished room, seen by a mirror camera.

    Writes images, the commands (how wheels slipped is in the truth only), the camera,
    and the truth: poses, landmarks, floor plan. A loop has some 300 images.

    Example: jaxslam simulate room rooms/1 --seed 1
    """
    from jaxslam.simulation.room.render import render_room

    with progress_bar("rendering") as progress:
        frames = render_room(
            out,
            seed=seed,
            drive=drive,
            step=step,
            length=length,
            preset=preset,
            overwrite=overwrite,
            progress=progress,
        )
    given = f"--camera {out / 'camera.toml'} --odometry {out / 'odometry.csv'} --truth {out}"
    print(f"{out}: {frames} images; next: jaxslam extract {out / 'images'} {given} --out OUT.npz")


def _parse_board(text):
    """Corners along both sides, of text like 6x7."""
    sides = [int(side) if side.isdecimal() else 0 for side in text.lower().split("x")]
    if len(sides) != 2 or min(sides) < 2:
        raise ValueError(f"--board is {text!r}; must be two counts of inner corners, like 6x7")
    return tuple(sides)


def _summarize(log, out, how="", told=()):
    """Print what a log of lines holds and what was left out, but for what was `told` when the log
    was made; the exit code."""
    import numpy as np

    from jaxslam.logs.log import NOT_USED

    points = int(np.isfinite(log.point[:, 0]).sum())
    print(f"{out}: {log}, {points} points")
    lost = False
    for why, count in log.skipped.items():
        if why.startswith(NOT_USED):
            print(f"{count} {why}")
        elif why not in told:
            lost = True
            warn(f"{why}: {count}")
    if not len(log.frame):
        warn("no line in any image: blurred, or is the camera's file another's?")
    elif not points:
        warn("no points: only jaxslam run --sensor bearing can map this")
    else:
        print(f"map it with: jaxslam run {out}{how}")
    return int(lost or not points)
