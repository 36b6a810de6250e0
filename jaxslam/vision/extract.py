"""From images and odometry to a log: lines of every image, matched and triangulated.

Images are read one at a time; only their lines are kept. What is done is on the disk as well, so
that a run that was interrupted goes on where it stopped and ends with the same log.
"""

from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from jaxslam.logs.log import NOT_USED, FloorPlan, Log
from jaxslam.logs.log_file import save_log
from jaxslam.logs.odometry import increments
from jaxslam.logs.readers.csv_files import read_odometry, read_truth
from jaxslam.logs.readers.text_table import drop_bad_rows, parse, pose_at, read_lines
from jaxslam.vision.extraction_journal import ExtractionJournal
from jaxslam.vision.image_times import NO_TIME, image_times
from jaxslam.vision.images import Images, cv2
from jaxslam.vision.lines import Lines, LineSettings, extract_lines, is_dark
from jaxslam.vision.log_triangulation import triangulate_log
from jaxslam.vision.overlay import draw_on_image

DETECTION = 0.5  # declared: what stands in a room hides what is behind it, half of the time
REACH = 10.0  # m, declared as what the camera can see
PLAN = ["x1_m", "y1_m", "x2_m", "y2_m"]
MOTION = ("err_tran", "err_rot", "err_drift", "floor_tran", "floor_rot", "gain_tran", "gain_rot")
MOTION += ("bias_drift",)
VIDEO_RATE = 10.0  # frames per second of an overlay video
CODECS = {".mp4": "mp4v", ".avi": "MJPG"}


def extract(
    source,  # folder, file, pattern, list of files or video: see `Images`
    camera,  # `Camera`
    odometry,  # .csv of velocities or commands: see `readers.csvpair`
    out=None,  # .npz to write; None: only the `Log` is returned, and nothing can be resumed
    *,
    times=None,  # .csv image,time_s; None: see `image_times`
    truth=None,  # folder of poses.csv, landmarks.csv and plan.csv, those that are known
    lines=None,  # `LineSettings`
    points=None,  # `PointSettings`
    params=None,  # `Params` of the robot's motion, for the points and declared; None: the defaults
    reach=REACH,  # m
    overlay=None,  # folder for pictures, or an .mp4 or .avi, with the lines drawn in
    overwrite=False,  # replace `out`
    progress=None,  # called with (images done, images in all)
):
    """`Log` of a drive's images. Rows are lines: bearing, its sigma, a descriptor of 9 columns
    (elevations of the ends, polarity, colours left and right as blue, green, red), and a point
    where the line was seen from far enough apart.

    Every image that could be looked at is a frame, also when it showed no line. The lines' own
    standard deviations go to `bearing_sigma`; the parameter `sigma_bearing`, which the filter
    believes, is left alone: what a filter can bear is wider than what a line's fit says, since
    errors of edges with a size repeat. Images and rows left out are counted by reason in `skipped`.
    Raises `ValueError` when there is nothing to work on, or settings changed since a run that was
    interrupted.
    """
    _check_out(out, overwrite)
    partial = None if out is None else Path(out).with_name(f".{Path(out).name}.partial")
    skipped = {}
    lines = LineSettings() if lines is None else lines
    images = Images(source)
    _check_overlay(overlay, images, overwrite or (partial is not None and partial.exists()))
    kind, table = read_odometry(odometry, skipped)
    time, origin = image_times(images, (kind, table.time), times)
    kept = _select_images(images, time, kind, table.time, skipped)
    if len(kept) == 0:
        spans = f"{_format_span(time[time != NO_TIME])}; {odometry} has {_format_span(table.time)}"
        raise ValueError(
            f"{images.names[0]}: no image has odometry; times are from {origin}, {spans}"
        )
    known = _read_truth_folder(truth, skipped)
    settings = _fingerprint(images, time, kept, camera, lines)
    with ExtractionJournal(partial, settings) as done:
        _extract_images(images, kept, camera, lines, done, overlay, progress)
    if all(isinstance(found, str) for _, found in done.rows):
        done.remove()  # nothing in it is worth going on from
    log = _make_log(
        done.rows, time[kept], kind, table, camera, reach, skipped, _log_name(source, out)
    )
    log = _add_truth(log, *known)
    if params is not None:  # the filter must believe of the motion what the points were made with
        noise = {name: float(getattr(params, name)) for name in MOTION}
        log = replace(log, noise=log.noise | noise)
        params = params._replace(mount_x=log.mounting[0], mount_y=log.mounting[1], mount_yaw=0.0)
    log = triangulate_log(log, params, points)
    if out is not None:
        save_log(out, log)
        done.remove()
    return log


def _check_out(out, overwrite):
    if out is None:
        return
    out = Path(out)
    if out.suffix != ".npz":
        raise ValueError(f"{out}: a log is a .npz file; name it {out.name}.npz")
    if out.exists() and not overwrite:
        raise ValueError(f"{out}: exists; choose another name, or overwrite it")


def _check_overlay(target, images, replace):
    """Refuse what would replace the images themselves, or drawings of another run."""
    if target is None:
        return
    target = Path(target)
    theirs = [images.video] if images.video else {Path(file).parent for file in images.files}
    if any(target.resolve() == place.resolve() for place in theirs):
        raise ValueError(f"{target}: the images themselves are there; choose another for drawings")
    taken = any(target.iterdir()) if target.is_dir() else target.exists()
    if taken and not replace:
        raise ValueError(f"{target}: exists; choose another name or add --overwrite")


def _format_span(stamps):
    return f"{stamps.min() / 1e9:.1f} to {stamps.max() / 1e9:.1f} s"


def _log_name(source, out):
    if out is not None:
        return Path(out).stem
    first = source[0] if isinstance(source, list | tuple) else source
    return Path(first).stem or "images"


def _select_images(images, time, kind, odometry_time, skipped):
    """Indices of the images to look at, in order of time."""
    timed = np.flatnonzero(time != NO_TIME)
    _count(skipped, "image without a time", len(time) - len(timed))
    backwards = int((np.diff(time[timed]) < 0).sum())
    if backwards and images.video:
        raise ValueError(f"{images.video}: times run backwards; a video can't be sorted")
    _count(skipped, "image out of order (sorted, none lost)", backwards)
    order = timed[np.argsort(time[timed], kind="stable")]
    again = np.diff(time[order], prepend=time[order][:1] - 1) == 0
    _count(skipped, "image with the stamp of another (first kept)", int(again.sum()))
    order = order[~again]
    if kind == "velocity":
        # Beyond its ends the robot is taken to stand, which a moving one does not.
        period = np.median(np.diff(odometry_time)) if len(odometry_time) > 1 else 0
        margin = max(2 * period, 10**8)
        inside = time[order] >= odometry_time[0] - margin
        inside &= time[order] <= odometry_time[-1] + margin
    else:
        # A command acts at its stamp: what comes before the first or after the last stands still,
        # but an image a long way off belongs to another drive.
        margin = max(60e9, float(odometry_time[-1] - odometry_time[0]))
        inside = np.abs(time[order] - np.clip(time[order], *odometry_time[[0, -1]])) <= margin
    _count(skipped, "image without odometry at its time", int((~inside).sum()))
    return order[inside]


def _count(skipped, reason, count):
    if count:
        skipped[reason] = skipped.get(reason, 0) + int(count)


def _fingerprint(images, time, kept, camera, lines):
    """What the lines depend on, for a run that goes on later."""
    names = [images.names[i] for i in kept]
    files = [images.video] if images.video else [images.files[i] for i in kept]
    sizes = [Path(file).stat().st_size if Path(file).exists() else -1 for file in files]
    seen = {name: np.asarray(value).tolist() for name, value in asdict(camera).items()
            if value is not None and name != "covariance"}  # fmt: skip
    return {
        "images": list(zip(names, time[kept].tolist(), strict=True)),
        "sizes of the images": sizes,
        "camera": seen,
        "lines": asdict(lines),
    }


def _extract_images(images, kept, camera, settings, done, overlay, progress):
    """Lines of all images that are not done yet, appended to `done`, and drawn if wanted."""
    total, ready = len(kept), len(done.rows)
    with _Overlay(overlay) as canvas:
        # What is done is looked at again only if it is to be drawn again.
        first = 0 if overlay is not None else ready
        for k, (name, image) in enumerate(_stream(images, kept, first), first):
            if k >= ready:
                done.add(name, _extract_image(image, camera, settings))
            if overlay is not None and not isinstance(done.rows[k][1], str):
                canvas.add(name, draw_on_image(image, done.rows[k][1], camera))
            if progress:
                progress(k + 1, total)


def _stream(images, kept, first):
    """(name, image or `ValueError`) of the images `kept`, in that order, from the first on."""
    if not images.video:
        yield from Images([images.files[i] for i in kept]).stream(first)
        return
    wanted, given = set(kept[first:].tolist()), set()
    for i, found in enumerate(images.stream()):
        if i in wanted:
            given.add(i)
            yield found
    for i in sorted(wanted - given):  # the header promised more than there is
        yield images.names[i], ValueError(f"{images.names[i]}: the video ends before")


def _extract_image(image, camera, settings):
    """`Lines`, or the reason why there are none."""
    if isinstance(image, ValueError):
        return f"image unreadable: {str(image).split(': ', 1)[-1]}"
    if image.shape[:2] != (camera.height, camera.width):
        found = f"{image.shape[1]} x {image.shape[0]}"
        return f"image of {found} pixels, camera of {camera.width} x {camera.height}"
    if is_dark(image):
        return "dark image"
    return extract_lines(image, camera, settings)


def _make_log(rows, time, kind, odometry, camera, reach, skipped, name):
    """The `Log` of bearings alone."""
    reasons = Counter(found for _, found in rows if isinstance(found, str))
    first = {}
    for image, found in rows:
        if isinstance(found, str):
            first.setdefault(found, image)
    skipped |= {f"{why} (first: {first[why]})": count for why, count in reasons.items()}
    looked = [k for k, (_, found) in enumerate(rows) if not isinstance(found, str)]
    if not looked:
        why, count = reasons.most_common(1)[0]
        raise ValueError(f"{first[why]}: no image can be used; {count} of {len(rows)}: {why}")
    found = [rows[k][1] for k in looked]
    counts = [len(lines.bearing) for lines in found]
    _count(skipped, f"{NOT_USED}image without a line (a frame all the same)", counts.count(0))
    lines = Lines(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    colour = lines.colour.reshape(-1, 6)
    log = Log(
        name=name,
        odometry_time=odometry.time,
        odometry=odometry.value,
        odometry_kind=kind,
        frame_time=time[looked],
        frame=np.repeat(np.arange(len(looked)), counts),
        bearing=lines.bearing,
        bearing_sigma=lines.sigma,
        descriptor=np.column_stack([lines.low, lines.high, lines.polarity, colour]),
        view=(-np.pi, np.pi, reach),
        mounting=(*camera.position[:2], 0.0),  # bearings are in the robot's heading already
        noise={"detection": DETECTION},
        skipped=skipped,
    )
    return log


def _read_truth_folder(folder, skipped):
    """`Truth` and `FloorPlan` in a folder, None where it has none; counts bad rows in `skipped`."""
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
    """The log with what is known of the truth, and the start pose of it."""
    motion = increments(log)
    still = (motion.distance[1:] == 0) & (motion.turn[1:] == 0)
    skipped = dict(log.skipped)
    _count(skipped, f"{NOT_USED}image without motion since the one before (a frame all the same)",
           still.sum())  # fmt: skip
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
    """Pictures into a folder, or frames into a video, by the name's ending."""

    def __init__(self, target):
        self.target = None if target is None else Path(target)
        self.video = None

    def __enter__(self):
        if self.target is not None and self.target.suffix.lower() not in CODECS:
            try:
                self.target.mkdir(parents=True, exist_ok=True)
            except OSError as err:
                raise ValueError(
                    f"{self.target}: cannot be made ({err.strerror}); give a folder, .mp4 or .avi"
                ) from None
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
