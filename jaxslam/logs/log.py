"""The log: what a robot drove and measured.

The interface between sensors, images and files on one side and the filter on the other. Stamps are
int64 nanoseconds of one clock; lengths metres; angles radians, counter-clockwise, x forward.
`log_file` stores the fields below by name.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from jaxslam.logs.validation import assign, check_array, check_number, check_rows, check_stamps
from jaxslam.parameters import FORMER_NAMES, Params

if TYPE_CHECKING:
    from jaxslam.logs.appearance_space import AppearanceSpace

# Prefix of reasons in `Log.skipped` for rows that the filter has no use for (another robot seen).
NOT_USED = "not used: "
KINDS = ("velocity", "command")


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth, as far as it is known (None: unknown); the filter never gets it.

    `time` int64 [P] ns with `pose` [P, 3] (x, y, heading); `landmarks` [L, 2] with `landmark_id`
    int64 [L]; `identity` int64 [n]: the true landmark's id per measurement, -1 for clutter;
    `resolution` [m] of the poses (0: exact; 0.3 for readings off floor tiles).
    """

    time: np.ndarray | None = None
    pose: np.ndarray | None = None
    landmarks: np.ndarray | None = None
    landmark_id: np.ndarray | None = None
    identity: np.ndarray | None = None
    resolution: float = 0.0

    def __post_init__(self):
        assign(self, "time", check_array("truth.time", self.time, np.int64, (None,)))
        poses = None if self.time is None else len(self.time)
        assign(self, "pose", check_array("truth.pose", self.pose, np.float64, (poses, 3)))
        if (self.time is None) != (self.pose is None):
            raise ValueError("truth: time and pose must be given together")
        if self.time is not None:
            check_stamps("truth.time", self.time)
        assign(
            self, "landmarks", check_array("truth.landmarks", self.landmarks, np.float64, (None, 2))
        )
        count = 0 if self.landmarks is None else len(self.landmarks)
        ids = check_array("truth.landmark_id", self.landmark_id, np.int64, (count,))
        if ids is not None and len(np.unique(ids)) != len(ids):
            raise ValueError("truth.landmark_id: the same id stands for two landmarks")
        assign(self, "landmark_id", ids)
        assign(self, "identity", check_array("truth.identity", self.identity, np.int64, (None,)))
        if self.identity is not None:
            check_rows("truth.identity", self.identity, self.identity >= -1, "must be -1 or more")
        assign(self, "resolution", check_number("truth.resolution", self.resolution, least=0))


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Background of a map: `segments` [S, 4] (x1, y1, x2, y2) in m, or `image` uint8 [H, W] with
    `scale` m per pixel and its lower-left corner at `origin` [m]."""

    segments: np.ndarray | None = None
    image: np.ndarray | None = None
    scale: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        if self.segments is None and self.image is None:
            raise ValueError("plan: has neither segments nor an image")
        assign(self, "segments", check_array("plan.segments", self.segments, np.float64, (None, 4)))
        assign(self, "image", check_array("plan.image", self.image, np.uint8, (None, None)))
        assign(self, "scale", check_number("plan.scale", self.scale))
        if self.scale <= 0:
            raise ValueError(f"plan.scale: {self.scale} m per pixel; must be above 0")
        assign(
            self,
            "origin",
            tuple(check_array("plan.origin", self.origin, np.float64, (2,)).tolist()),
        )


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Log:
    """One recorded drive, validated on construction; arrays are read-only copies.

    - `odometry` [O, 2] of kind "velocity" (forward m/s, yaw rate rad/s, held from its stamp until
      the next) or "command" (distance m, then turn rad, executed in the interval that ends at its
      stamp).
    - `frame_time` [F]: stamps of all frames, also empty ones; `frame` [n]: the frame of each
      measurement, not decreasing.
    - `bearing`, `range` [n], `point` [n, 2], `point_cov` [n, 3] (xx, xy, yy) in the sensor's frame,
      NaN where a bearing has no point. `bearing_sigma` [n] rad, as the detector states it.
      `point_baseline` [n]: distance by odometry from which a point was triangulated, NaN where it
      was not; a gain of the odometry rescales such a point.
    - `identity` [n] as measured, -1 where none was; `descriptor` [n, D] describes appearance.
    - `view` (least bearing, largest bearing, largest range) of the sensor; `mounting` (x, y, yaw),
      its pose on the robot; `time_offset` [s], added to the frames' stamps before.
    - `noise` declares values of `Params`. `start_pose`, `start_cov`: the robot's pose at `start`.
    - `skipped`: how many rows the reader dropped, by reason.

    Raises `ValueError` naming field, row and what is allowed.
    """

    name: str
    odometry_time: np.ndarray
    odometry: np.ndarray
    odometry_kind: str = "velocity"
    frame_time: np.ndarray
    frame: np.ndarray
    bearing: np.ndarray | None = None
    bearing_sigma: np.ndarray | None = None
    range: np.ndarray | None = None
    point: np.ndarray | None = None
    point_cov: np.ndarray | None = None
    point_baseline: np.ndarray | None = None
    identity: np.ndarray | None = None
    descriptor: np.ndarray | None = None
    view: tuple[float, float, float]
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_offset: float = 0.0
    noise: dict[str, float] = field(default_factory=dict)
    start_pose: np.ndarray = field(default_factory=lambda: np.zeros(3))
    start_cov: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    truth: Truth | None = None
    plan: FloorPlan | None = None
    skipped: dict[str, int] = field(default_factory=dict)

    def __post_init__(self):
        if not isinstance(self.name, str) or not self.name.isprintable() or not self.name:
            raise ValueError(f"name: {self.name!r} is not one line of text")
        _check_odometry(self)
        _check_measurements(self)
        _check_sensor(self)
        _check_start(self)
        if self.truth is not None and self.truth.identity is not None:
            check_array("truth.identity", self.truth.identity, np.int64, (len(self.frame),))
        skipped = {
            str(k): check_number(f"skipped/{k}", v, least=0) for k, v in self.skipped.items()
        }
        assign(self, "skipped", {reason: int(count) for reason, count in skipped.items()})

    def __repr__(self):
        rows = f"{len(self.odometry)} odometry rows, {len(self.frame_time)} frames"
        return f"Log({self.name!r}: {rows}, {len(self.frame)} measurements)"

    @property
    def start(self) -> int:
        """Stamp [ns] at which `start_pose` holds: the first odometry or frame."""
        return min(int(self.odometry_time[0]), int(self.frame_time[0]))

    @cached_property
    def appearance_space(self) -> "AppearanceSpace":
        """`AppearanceSpace` of the log's descriptors, fitted when first used."""
        from jaxslam.logs.appearance_space import fit_appearance_space  # here: SciPy is slow

        return fit_appearance_space(self)

    def has(self, sensor: str) -> bool:
        """Whether the log can supply a sensor, one of `config.SENSORS`."""
        bearing, both = self.bearing is not None, self.range is not None  # a range needs a bearing
        supplies = {"position": self.has_points() or both, "range_bearing": both}
        return (supplies | {"bearing": bearing}).get(sensor, False)

    def has_points(self) -> bool:
        """Whether any measurement has a point."""
        return self.point is not None and bool((~np.isnan(self.point)).any() or not len(self.frame))


def _check_odometry(log):
    if log.odometry_kind not in KINDS:
        raise ValueError(f"odometry_kind: {log.odometry_kind!r} is not one of {', '.join(KINDS)}")
    assign(log, "odometry_time", check_array("odometry_time", log.odometry_time, np.int64, (None,)))
    rows = len(log.odometry_time)
    if rows == 0:
        raise ValueError("odometry_time: the log has no odometry")
    check_stamps("odometry_time", log.odometry_time)
    assign(log, "odometry", check_array("odometry", log.odometry, np.float64, (rows, 2)))


def _check_measurements(log):
    assign(log, "frame_time", check_array("frame_time", log.frame_time, np.int64, (None,)))
    frames = len(log.frame_time)
    if frames == 0:
        raise ValueError("frame_time: the log has no frames")
    check_stamps("frame_time", log.frame_time)
    frame = check_array("frame", log.frame, np.int64, (None,))
    assign(log, "frame", frame)
    check_rows("frame", frame, (frame >= 0) & (frame < frames), f"must be in 0..{frames - 1}")
    check_rows("frame", frame, np.diff(frame, prepend=frame[:1]) >= 0, "must not decrease")
    n = len(frame)
    for name, dtype, shape in (
        ("bearing", np.float64, (n,)),
        ("bearing_sigma", np.float64, (n,)),
        ("range", np.float64, (n,)),
        ("point", np.float64, (n, 2)),
        ("point_cov", np.float64, (n, 3)),
        ("point_baseline", np.float64, (n,)),
        ("identity", np.int64, (n,)),
        ("descriptor", np.float32, (n, None)),
    ):
        gaps = name.startswith("point")
        assign(log, name, check_array(name, getattr(log, name), dtype, shape, gaps))
    if log.bearing is None and log.point is None:
        raise ValueError("bearing: the log has neither bearings nor points")
    for name, needs in (
        ("bearing_sigma", "bearing"),
        ("range", "bearing"),
        ("point", "point_cov"),
        ("point_cov", "point"),
        ("point_baseline", "point"),
    ):
        if getattr(log, name) is not None and getattr(log, needs) is None:
            raise ValueError(f"{name}: given without {needs}")
    if log.bearing is not None:
        plausible = np.abs(log.bearing) <= 2 * math.pi
        check_rows("bearing", log.bearing, plausible, "is beyond 2 pi rad (degrees? times pi/180)")
    for name in ("bearing_sigma", "range"):
        value = getattr(log, name)
        if value is not None:
            check_rows(
                name, value, value > 0, f"must be above 0 {'m' if name == 'range' else 'rad'}"
            )
    if log.point is not None:
        _check_points(log)
    if log.identity is not None:
        check_rows("identity", log.identity, log.identity >= -1, "must be -1 or more")


def _check_points(log):
    xx, xy, yy = log.point_cov.T
    missing = np.isnan(xx)
    definite = (xx > 0) & (yy > 0) & (xx * yy > xy * xy)
    check_rows("point_cov", log.point_cov, definite | missing, "is not positive definite")
    alike = np.isnan(log.point[:, 0]) == missing
    check_rows("point", log.point, alike, "and its point_cov must both be given, or both be NaN")
    if log.bearing is None:
        check_rows("point", log.point, ~missing, "is no point, and the row has no bearing either")
    if log.point_baseline is not None:
        base = log.point_baseline
        good = np.isnan(base) | ((base > 0) & ~missing)
        check_rows("point_baseline", base, good, "must be above 0 m, and NaN without a point")


def _check_sensor(log):
    least, largest, reach = check_array("view", log.view, np.float64, (3,)).tolist()
    # The filter's bearings are in [-pi, pi): a rotated sensor has another mounting, not view.
    if not -math.pi - 1e-9 <= least < largest <= math.pi + 1e-9 or reach <= 0:
        rule = "must be least and largest bearing within -pi..pi rad, and a range above 0 m"
        raise ValueError(f"view: {(least, largest, reach)} {rule}")
    assign(log, "view", (least, largest, reach))
    assign(log, "mounting", tuple(check_array("mounting", log.mounting, np.float64, (3,)).tolist()))
    assign(log, "time_offset", check_number("time_offset", log.time_offset))
    for name in log.noise:
        if name not in Params._fields and name not in FORMER_NAMES:
            allowed = ", ".join(Params._fields)
            raise ValueError(f"noise/{name}: no such parameter; allowed: {allowed}")
    assign(log, "noise", {k: check_number(f"noise/{k}", v) for k, v in log.noise.items()})


def _check_start(log):
    assign(log, "start_pose", check_array("start_pose", log.start_pose, np.float64, (3,)))
    cov = check_array("start_cov", log.start_cov, np.float64, (3, 3))
    size = max(np.abs(cov).max(), 1e-300)
    if np.abs(cov - cov.T).max() > 1e-9 * size or np.linalg.eigvalsh(cov)[0] < -1e-9 * size:
        raise ValueError("start_cov: is not a covariance (symmetric, no negative variance)")
    assign(log, "start_cov", cov)
