"""From images and odometry to a log: lines of every image, matched and triangulated.

Images are read one at a time; only their lines are kept. A journal on disk holds the lines found so
far, so that an interrupted run resumes where it stopped and ends with the same log.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from jaxslam.logs.log import NOT_USED, FloorPlan, Log
from jaxslam.logs.log_file import save_log
from jaxslam.logs.odometry import increments
from jaxslam.logs.readers.csv_files import read_odometry, read_truth
from jaxslam.logs.readers.text_table import drop_bad_rows, parse, pose_at, read_lines
from jaxslam.parameters import Params
from jaxslam.vision.camera import Camera
from jaxslam.vision.extraction_journal import ExtractionJournal
from jaxslam.vision.image_times import NO_TIME, image_times
from jaxslam.vision.images import Images, cv2
from jaxslam.vision.lines import Lines, LineSettings, extract_lines, is_dark
from jaxslam.vision.log_triangulation import PointSettings, triangulate_log
from jaxslam.vision.overlay import draw_on_image

DETECTION = 0.5  # declared in the log: about half of the time, a line is hidden by furniture
REACH = 10.0  # m, declared in the log as the camera's range
PLAN = ["x1_m", "y1_m", "x2_m", "y2_m"]
MOTION = ("err_tran", "err_rot", "err_drift", "floor_tran", "floor_rot", "gain_tran", "gain_rot")
MOTION += ("bias_drift",)
VIDEO_RATE = 10.0  # frames per second of an overlay video
CODECS = {".mp4": "mp4v", ".avi": "MJPG"}


def extract(
    source: str | Path | Sequence[str | Path],  # as for `Images`
    camera: Camera,
    odometry: str | Path,  # .csv, velocities or commands: see `csv_files.read_odometry`
    out: str | Path | None = None,  # .npz to write; None: cannot be resumed
    *,
    times: str | Path | None = None,  # .csv image,time_s; None: see `image_times`
    truth: str | Path | None = None,  # folder with any of poses.csv, landmarks.csv and plan.csv
    lines: LineSettings | None = None,
    points: PointSettings | None = None,
    params: Params | None = None,  # of the motion, declared in the log
    reach: float = REACH,  # m, range of the camera
    overlay: str | Path | None = None,  # folder or video to write, images with their lines
    overwrite: bool = False,  # replace `out`
    progress: Callable[[int, int], None] | None = None,  # images done, number of images
) -> Log:
    """Make a `Log` from the images of a drive. A measurement is a line: its bearing [rad] in the
    robot's frame, `bearing_sigma`, a descriptor of 9 columns (elevations of the ends, polarity,
    colours left and right as blue, green, red), and a point [m] where its parallax suffices.

    Every readable image is a frame, even without a line. `bearing_sigma` is the standard deviation
    of a line's fit; the filter's `sigma_bearing` has to be larger, since errors of edges that have
    a width repeat from frame to frame. What is left out is counted by reason in `skipped`. Raises
    `ValueError` if no image can be used, or for other settings than those of the run to resume.
    """
    out = None if out is None else Path(out)
    _check_out(out, overwrite)
    journal_path = None if out is None else out.with_name(f".{out.name}.partial")
    skipped, images = {}, Images(source)
    lines = LineSettings() if lines is None else lines
    resumes = journal_path is not None and journal_path.exists()
    _check_overlay(overlay, images, overwrite or resumes)
    kind, table = read_odometry(odometry, skipped)
    time, origin = image_times(images, (kind, table.time), times)
    kept = _select_images(images, time, kind, table.time, skipped)
    if len(kept) == 0:
        spans = f"{_format_span(time[time != NO_TIME])}; {odometry} has {_format_span(table.time)}"
        why = f"no image has odometry; times are from {origin}, {spans}"
        raise ValueError(f"{images.names[0]}: {why}")
    known = _read_truth_folder(truth, skipped)
    settings = _fingerprint(images, time, kept, camera, lines)
    with ExtractionJournal(journal_path, settings) as journal:
        _extract_images(images, kept, camera, lines, journal, overlay, progress)
    if all(isinstance(lines, str) for _, lines in journal.images):
        journal.remove()  # there is nothing in it to resume from
    first = source if isinstance(source, str | Path) else source[0]
    name = (out or Path(first)).stem or "images"
    log = _make_log(journal.images, time[kept], kind, table, camera, reach, skipped, name)
    log = _add_truth(log, *known)
    if params is not None:  # the filter must use the motion model that the points were made with
        noise = {name: float(getattr(params, name)) for name in MOTION}
        log = replace(log, noise=log.noise | noise)
        params = params._replace(mount_x=log.mounting[0], mount_y=log.mounting[1], mount_yaw=0.0)
    log = triangulate_log(log, params, points)
    if out is not None:
        save_log(out, log)
        journal.remove()
    return log


def _check_out(out, overwrite):
    if out is not None and out.suffix != ".npz":
        raise ValueError(f"{out}: a log is a .npz file; name it {out.name}.npz")
    if out is not None and out.exists() and not overwrite:
        raise ValueError(f"{out}: exists; choose another name, or overwrite it")


def _check_overlay(target, images, replace):
    """Raise `ValueError` if drawings would replace the images, or the drawings of another run."""
    if target is None:
        return
    target = Path(target)
    sources = [images.video] if images.video else {Path(file).parent for file in images.files}
    if any(target.resolve() == source.resolve() for source in sources):
        why = "the images themselves are there; choose another place for drawings"
        raise ValueError(f"{target}: {why}")
    exists = any(target.iterdir()) if target.is_dir() else target.exists()
    if exists and not replace:
        raise ValueError(f"{target}: exists; choose another name or add --overwrite")


def _format_span(stamps):
    return f"{stamps.min() / 1e9:.1f} to {stamps.max() / 1e9:.1f} s"


def _select_images(images, time, kind, odometry_time, skipped):
    """Indices of the images to process, in order of time."""
    timed = np.flatnonzero(time != NO_TIME)
    _count(skipped, "image without a time", len(time) - len(timed))
    backwards = int((np.diff(time[timed]) < 0).sum())
    if backwards and images.video:
        raise ValueError(f"{images.video}: times run backwards; a video can't be sorted")
    _count(skipped, "image out of order (sorted, none lost)", backwards)
    order = timed[np.argsort(time[timed], kind="stable")]
    repeated = np.diff(time[order], prepend=time[order][:1] - 1) == 0
    _count(skipped, "image with the stamp of another (first kept)", int(repeated.sum()))
    order = order[~repeated]
    if kind == "velocity":
        # Before and after its odometry the robot is assumed to stand, which may be wrong.
        period = np.median(np.diff(odometry_time)) if len(odometry_time) > 1 else 0
        margin = max(2 * period, 10**8)
        inside = time[order] >= odometry_time[0] - margin
        inside &= time[order] <= odometry_time[-1] + margin
    else:
        # Before the first and after the last command the robot stands, but an image from long
        # before or after belongs to another drive.
        margin = max(60e9, float(odometry_time[-1] - odometry_time[0]))
        inside = np.abs(time[order] - np.clip(time[order], *odometry_time[[0, -1]])) <= margin
    _count(skipped, "image without odometry at its time", int((~inside).sum()))
    return order[inside]


def _count(skipped, reason, count):
    if count:
        skipped[reason] = skipped.get(reason, 0) + int(count)


def _fingerprint(images, time, kept, camera, lines):
    """What the lines depend on, compared before a run is resumed."""
    names = [images.names[i] for i in kept]
    files = [images.video] if images.video else [images.files[i] for i in kept]
    sizes = [Path(file).stat().st_size if Path(file).exists() else -1 for file in files]
    model = {name: np.asarray(value).tolist() for name, value in asdict(camera).items()
             if value is not None and name != "covariance"}  # fmt: skip
    return {
        "images": list(zip(names, time[kept].tolist(), strict=True)),
        "sizes of the images": sizes,
        "camera": model,
        "lines": asdict(lines),
    }


def _extract_images(images, kept, camera, settings, journal, overlay, progress):
    """Append the lines of all images that are not in `journal` yet; draw them if wanted."""
    total, done = len(kept), len(journal.images)
    with _Overlay(overlay) as canvas:
        # Finished images are read again only to be drawn.
        first = 0 if overlay is not None else done
        for k, (name, image) in enumerate(_stream(images, kept, first), first):
            if k >= done:
                journal.add(name, _extract_image(image, camera, settings))
            lines = journal.images[k][1]
            if overlay is not None and not isinstance(lines, str):
                canvas.add(name, draw_on_image(image, lines, camera))
            if progress:
                progress(k + 1, total)


def _stream(images, kept, first):
    """Yield (name, image or `ValueError`) of the images `kept` from index `first` on, in order."""
    if not images.video:
        yield from Images([images.files[i] for i in kept]).stream(first)
        return
    wanted, read = set(kept[first:].tolist()), set()
    for i, frame in enumerate(images.stream()):
        if i in wanted:
            read.add(i)
            yield frame
    for i in sorted(wanted - read):  # the header announced more frames than there are
        yield images.names[i], ValueError(f"{images.names[i]}: the video ends before this frame")


def _extract_image(image, camera, settings):
    """`Lines` of an image, or the reason why there are none."""
    if isinstance(image, ValueError):
        return f"image unreadable: {str(image).split(': ', 1)[-1]}"
    if image.shape[:2] != (camera.height, camera.width):
        size = f"{image.shape[1]} x {image.shape[0]}"
        return f"image of {size} pixels, camera of {camera.width} x {camera.height}"
    if is_dark(image):
        return "dark image"
    return extract_lines(image, camera, settings)


def _make_log(images, time, kind, odometry, camera, reach, skipped, name):
    """The `Log` of bearings alone, without truth or points."""
    unusable = [(image, why) for image, why in images if isinstance(why, str)]
    reasons = Counter(why for _, why in unusable)
    first = {why: image for image, why in reversed(unusable)}
    skipped |= {f"{why} (first: {first[why]})": count for why, count in reasons.items()}
    usable = [k for k, (_, lines) in enumerate(images) if not isinstance(lines, str)]
    if not usable:
        why, count = reasons.most_common(1)[0]
        raise ValueError(f"{first[why]}: no image can be used; {count} of {len(images)}: {why}")
    frames = [images[k][1] for k in usable]
    counts = [len(lines.bearing) for lines in frames]
    _count(skipped, f"{NOT_USED}image without a line (a frame all the same)", counts.count(0))
    lines = Lines(*(np.concatenate(parts) for parts in zip(*frames, strict=True)))
    colour = lines.colour.reshape(-1, 6)
    return Log(
        name=name, skipped=skipped, noise={"detection": DETECTION}, view=(-np.pi, np.pi, reach),
        mounting=(*camera.position[:2], 0.0),  # bearings are relative to the robot's heading
        odometry_time=odometry.time, odometry=odometry.value, odometry_kind=kind,
        frame_time=time[usable], frame=np.repeat(np.arange(len(usable)), counts),
        bearing=lines.bearing, bearing_sigma=lines.sigma,
        descriptor=np.column_stack([lines.low, lines.high, lines.polarity, colour]),
    )  # fmt: skip


def _read_truth_folder(folder, skipped):
    """`Truth` and `FloorPlan` of a folder, or None; bad rows are counted in `skipped`."""
    if folder is None:
        return None, None
    folder = Path(folder)
    files = [folder / name for name in ("poses.csv", "landmarks.csv")]
    truth = read_truth([file for file in files if file.is_file()], skipped)
    plan = read_plan(folder / "plan.csv") if (folder / "plan.csv").is_file() else None
    if truth is None and plan is None:
        raise ValueError(f"{folder}: has none of poses.csv, landmarks.csv and plan.csv")
    return truth, plan


def _add_truth(log, truth, plan):
    """The log with its truth, started at the true pose if that is known."""
    motion, skipped = increments(log), dict(log.skipped)
    still = ((motion.distance[1:] == 0) & (motion.turn[1:] == 0)).sum()
    why = f"{NOT_USED}image without motion since the one before (a frame all the same)"
    _count(skipped, why, still)
    start = None
    if truth is not None and truth.time is not None:
        start = pose_at(max(log.start, int(truth.time[0])), truth.time, truth.pose)
    pose = log.start_pose if start is None else start
    return replace(log, truth=truth, plan=plan, start_pose=pose, skipped=skipped)


def read_plan(path):
    """`FloorPlan` of a .csv of walls: x1_m,y1_m,x2_m,y2_m."""
    lines, complete = read_lines(path, ",")
    if [cell.strip('"').lower() for cell in lines[0][1]] != PLAN:
        found = ",".join(lines[0][1])[:80]
        raise ValueError(f"{path}, line {lines[0][0]}: header {found!r}; must be {','.join(PLAN)}")
    table = drop_bad_rows(parse(path, lines[1:], 4, complete, stamped=False), {})
    return FloorPlan(table.value)


class _Overlay:
    """Writer of drawings: pictures in a folder, or frames of a video, by the suffix of `target`."""

    def __init__(self, target):
        self.target = None if target is None else Path(target)
        self.video = None

    def __enter__(self):
        if self.target is not None and self.target.suffix.lower() not in CODECS:
            try:
                self.target.mkdir(parents=True, exist_ok=True)
            except OSError as err:
                why = f"can't be made ({err.strerror}); give a folder, .mp4 or .avi"
                raise ValueError(f"{self.target}: {why}") from None
        return self

    def __exit__(self, *_):
        if self.video is not None:
            self.video.release()

    def add(self, name, picture):
        suffix = self.target.suffix.lower()
        if suffix in CODECS:
            if self.video is None:
                code = cv2.VideoWriter.fourcc(*CODECS[suffix])
                size = picture.shape[1::-1]
                self.video = cv2.VideoWriter(str(self.target), code, VIDEO_RATE, size)
                if not self.video.isOpened():
                    raise ValueError(f"{self.target}: can't be written as a video; try a folder")
            self.video.write(picture)
            return
        path = self.target / f"{Path(name.replace('#', '-')).stem}.png"
        if not cv2.imwrite(str(path), picture):
            raise ValueError(f"{path}: can't be written; is the disk full?")
