"""Triangulate a log as in the paper: track lines from frame to frame, and add points.

A bearing gets a point from an earlier bearing of the same line if the robot has driven far enough
in between. Works on any log of bearings, and uses the colours of lines if the log has them (a
descriptor of 9 columns, as written by `extract`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from jaxslam.logs.log import NOT_USED, Log
from jaxslam.logs.odometry import increments, moments
from jaxslam.parameters import Params, default_params
from jaxslam.vision import triangulation
from jaxslam.vision.matching import NEAREST, Appearance, match_bearings
from jaxslam.vision.triangulation import OK, PARALLEL, REASONS, STILL, TriangulationSettings

PAIRS = ("disjoint", "consecutive", "overlapping")
NEW, SHORT, MISFIT = range(len(REASONS), len(REASONS) + 3)
OUTCOMES = (
    *REASONS,
    "first seen here",
    "driven less than the baseline since first seen",
    "the line was elsewhere in between (a false match)",
)
MISFIT_SIGMAS = 3.0
MOST_FRAMES = 400  # kept in the window, however little the robot has moved
DEPTH_SIGMAS = 4.0  # standard deviations of a track's inverse depth within which it is matched


@dataclass(frozen=True)
class PointSettings:
    """Settings of a triangulation. `baseline` and `longest` m: least and largest path by odometry
    between the two frames of a point. `pairs` of frames of one line: "disjoint" (no two share a
    frame), "consecutive" (each starts where the last ended, as in the paper) or "overlapping" (a
    pair ends at every frame). `memory`: frames for which a line may be missed. `sigma` rad:
    standard deviation of bearings, for a log that has none. `use_colour`: match by colours too.
    Raises `ValueError` for values out of range.

    Points over the same stretch of road share the error of its odometry, so a filter that assumes
    independent errors becomes overconfident. The log therefore declares a `position_scale`: the
    square root of `inflation` times the number of overlapping points of a line. This mapped 80 % of
    a simulated room's landmarks, disjoint pairs 11 %, with equal paths (experiments/points.py).
    """

    baseline: float = 0.4
    longest: float = 2.0
    pairs: str = "overlapping"
    inflation: float = 16.0
    memory: int = 3
    sigma: float | None = None
    use_colour: bool = True
    triangulation: TriangulationSettings = field(default_factory=TriangulationSettings)

    def __post_init__(self):
        if self.pairs not in PAIRS:
            raise ValueError(f"pairs: {self.pairs!r} is not one of {', '.join(PAIRS)}")
        if not 0 < self.baseline < self.longest:
            found = f"baseline {self.baseline} m, longest {self.longest} m"
            raise ValueError(f"{found}: must be above 0 and the first below the second")
        for name, least in (("inflation", 0), ("memory", 1), ("sigma", 0)):
            value = getattr(self, name)
            if value is not None and not least <= value < np.inf:
                raise ValueError(f"{name}: {value!r} must be at least {least}")


@dataclass(eq=False)
class _Track:
    """A tracked line: its `sightings` (frame, row of the log), the index `begin` of the first that
    the next pair may use, and bounds of its inverse depth at the last sighting, 1/m."""

    sightings: list
    begin: int
    depth: tuple


class _Window:
    """The last w frames: numbers, and the sensor's motion and path from each to the present."""

    def __init__(self):
        self.frame = np.empty(0, int)
        self.motion, self.cov, self.path = np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0)

    def advance(self, frame, motion, cov, distance, longest):
        """Append the frame before `frame`, and extend all motions by the one to `frame`."""
        self.frame = np.append(self.frame, frame - 1)
        start = np.vstack([self.motion, np.zeros((1, 3))])
        start_cov = np.vstack([self.cov, np.zeros((1, 3, 3))])
        self.motion, self.cov = triangulation.compose(start, start_cov, motion, cov)
        self.path = np.append(self.path, 0.0) + distance
        kept = self.path <= longest
        kept[:-MOST_FRAMES] = False
        for name in ("frame", "motion", "cov", "path"):
            setattr(self, name, getattr(self, name)[kept])

    def index(self, frames):
        """Indices of frames in the window, where they must be."""
        return np.searchsorted(self.frame, frames)


def triangulate_log(
    log: Log,
    params: Params | None = None,
    settings: PointSettings | None = None,
    use_identity: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Log:
    """Add `point`, `point_cov` and `point_baseline` to a log; returns the new log.

    Bearings without a point are counted by reason in `skipped`. A `position_scale` is declared for
    the filter unless the log has one. `params`: noise and turning gain of the motion (None: the
    log's, or the defaults). `use_identity`: match lines by the measured identities.
    `progress(done, total)` in frames. Raises `ValueError` if the bearings or identities are absent.
    """
    settings = PointSettings() if settings is None else settings
    if log.bearing is None:
        raise ValueError(f"{log.name}: has no bearings to triangulate from")
    if use_identity and (log.identity is None or not (log.identity >= 0).any()):
        raise ValueError(f"{log.name}: has no measured identities; use use_identity=False")
    params = default_params("position", log) if params is None else params
    odometry = increments(log)
    mounting = (params.mount_x, params.mount_y, params.mount_yaw)
    motion, motion_cov = triangulation.sensor_motion(*moments(odometry, params), mounting)
    lines = _LogLines(log, params, settings, use_identity)
    first = np.searchsorted(log.frame, np.arange(len(log.frame_time) + 1))
    window, tracks = _Window(), []
    point, cov = np.full((len(log.frame), 2), np.nan), np.full((len(log.frame), 3), np.nan)
    base, outcome = np.full(len(log.frame), np.nan), np.full(len(log.frame), NEW)
    for j in range(len(log.frame_time)):
        if j:
            window.advance(j, motion[j], motion_cov[j], odometry.distance[j], settings.longest)
        rows = np.arange(first[j], first[j + 1])
        tracks = _extend_tracks(tracks, j, rows, window, lines, settings)
        current = [t for t in tracks if t.sightings[-1][0] == j and len(t.sightings) > 1]
        _triangulate_tracks(current, window, lines, settings, (point, cov, base, outcome))
        if progress and (j % 50 == 0 or j + 1 == len(log.frame_time)):
            progress(j + 1, len(log.frame_time))
    skipped = {k: v for k, v in log.skipped.items() if not k.startswith(_PREFIX)}
    counts = np.bincount(outcome[outcome != OK], minlength=len(OUTCOMES)).tolist()
    skipped |= {_PREFIX + why: n for why, n in zip(OUTCOMES, counts, strict=True) if n}
    noise = {"position_scale": _position_scale(base, odometry.distance, settings)} | log.noise
    points = {"point": point, "point_cov": cov, "point_baseline": base}
    return replace(log, **points, noise=noise, skipped=skipped)


def _position_scale(base, distance, settings):
    """`position_scale` of points with baselines `base` [n] m, of frames `distance` [T] m apart."""
    overlapping = 1.0
    if settings.pairs == "overlapping" and np.isfinite(base).any():
        overlapping = max(1.0, float(np.nanmedian(base) / np.median(distance[distance > 0])))
    return float(np.sqrt(settings.inflation * overlapping))


_PREFIX = NOT_USED + "bearing without a point: "


class _LogLines:
    """Bearings, standard deviations and appearances of all rows of a log, for matching."""

    def __init__(self, log, params, settings, use_identity):
        self.bearing = np.asarray(log.bearing)
        self.identity = log.identity if use_identity else None
        common = params.sigma_bearing if settings.sigma is None else settings.sigma
        sigma = log.bearing_sigma if settings.sigma is None else None
        self.sigma = np.full(len(log.frame), common) if sigma is None else np.asarray(sigma)
        self.appearance, d = None, log.descriptor
        if settings.use_colour and d is not None and d.shape[1] == 9:
            self.appearance = Appearance(d[:, 0], d[:, 1], d[:, 2], d[:, 3:].reshape(-1, 2, 3))

    def match(self, before, after, motion, heading_sigma, depth):
        """Match the rows `before` and `after`: pairs [m, 2] of indices into them."""
        if self.identity is not None:
            same = self.identity[before][:, None] == self.identity[after][None, :]
            return np.argwhere(same & (self.identity[before] >= 0)[:, None])
        seen, appearances = self.appearance, None
        if seen is not None:
            appearances = [Appearance(*(part[rows] for part in seen)) for rows in (before, after)]
        bearings, sigmas = ((part[before], part[after]) for part in (self.bearing, self.sigma))
        return match_bearings(bearings, sigmas, motion, appearances, heading_sigma, depth)


def _extend_tracks(tracks, frame, rows, window, lines, settings):
    """Add the rows of a frame to the tracks they match; start new tracks and drop lost ones."""
    oldest = window.frame[0] if len(window.frame) else frame
    alive = []
    for track in tracks:
        if track.sightings[-1][0] >= max(oldest, frame - settings.memory):
            outdated = sum(sighting[0] < oldest for sighting in track.sightings)
            del track.sightings[:outdated]
            track.begin = max(track.begin - outdated, 0)
            alive.append(track)
    matched = np.zeros(len(rows), bool)
    if alive and len(rows):
        at = window.index([track.sightings[-1][0] for track in alive])
        before = np.array([track.sightings[-1][1] for track in alive])
        depth = np.array([track.depth for track in alive])
        sigma = np.sqrt(window.cov[at, 2, 2])
        for i, k in lines.match(before, rows, window.motion[at], sigma, depth):
            alive[i].sightings.append((frame, rows[k]))
            matched[k] = True
    return alive + [_Track([(frame, row)], 0, (0.0, 1 / NEAREST)) for row in rows[~matched]]


def _triangulate_tracks(tracks, window, lines, settings, out):
    """Write the points of the tracks' last rows into `out`, and update the tracks' depths."""
    if not tracks:
        return
    row = np.array([track.sightings[-1][1] for track in tracks])
    # The longest baseline gives the best depth, for the next match.
    oldest = [track.sightings[0] for track in tracks]
    far = _triangulate(oldest, row, window, lines, settings)
    inverse = 1 / np.where(far.reason == OK, np.hypot(*far.point.T), np.inf)
    for track, q, ratio in zip(tracks, inverse, far.parallax, strict=True):
        if q > 0:
            spread = DEPTH_SIGMAS * q / ratio
            track.depth = (max(q - spread, 0.0), min(q + spread, 1 / NEAREST))
    point, cov, base, outcome = out
    start = [_pair_start(track, window, settings) for track in tracks]
    outcome[row] = SHORT
    moved = window.path[window.index([sighting[0] for sighting in oldest])]
    outcome[row[moved < settings.triangulation.least_baseline]] = STILL
    ready = [i for i, index in enumerate(start) if index is not None]
    if not ready:
        return
    first, row = [tracks[i].sightings[start[i]] for i in ready], row[ready]
    points = _triangulate(first, row, window, lines, settings)
    between = [_sighting_between(tracks[i], start[i], window) for i in ready]
    fits = _confirm_between(points.point, first, between, window, lines)
    point[row] = np.where(fits[:, None], points.point, np.nan)
    cov[row] = np.where(fits[:, None], points.cov, np.nan)
    path = window.path[window.index([frame for frame, _ in first])]
    base[row] = np.where(points.ok & fits, path, np.nan)
    outcome[row] = np.where(points.ok & ~fits, MISFIT, points.reason)
    for i, reason in zip(ready, points.reason, strict=True):
        # While the rays are parallel, the pair keeps its start: a later end may do.
        if reason != PARALLEL and settings.pairs != "overlapping":
            last = len(tracks[i].sightings) - 1
            tracks[i].begin = last + (settings.pairs == "disjoint")


def _pair_start(track, window, settings):
    """Index into `track.sightings` where the pair that ends at the last one starts, or None."""
    frames = [frame for frame, _ in track.sightings[track.begin : -1]]
    path = window.path[window.index(frames)] if frames else np.empty(0)
    far = np.flatnonzero(path >= settings.baseline - 1e-9)
    if len(far) == 0:
        return None
    # Overlapping pairs are as short as the baseline allows, others as long as possible.
    return track.begin + int(far[-1] if settings.pairs == "overlapping" else far[0])


def _sighting_between(track, start, window):
    """The sighting half-way along a pair's path, or the pair's first if there is none between."""
    frames = [frame for frame, _ in track.sightings[start:-1]]
    path = window.path[window.index(frames)]
    return track.sightings[start + int(np.argmin(np.abs(path - path[0] / 2)))]


def _confirm_between(point, first, between, window, lines):
    """Mask [m] of the points that agree with the sightings `between`; most false pairs do not."""
    at = window.index([frame for frame, _ in between])
    start = window.index([frame for frame, _ in first])
    row = np.array([row for _, row in between])
    x, y, turn = window.motion[at].T
    c, s = np.cos(turn), np.sin(turn)
    px, py = point.T
    expected = np.arctan2(y + s * px + c * py, x + c * px - s * py)
    off = np.abs((lines.bearing[row] - expected + np.pi) % (2 * np.pi) - np.pi)
    # Half-way, the two ends constrain the heading (a Brownian bridge): a quarter of its variance
    # remains, and each end adds a quarter of a bearing's variance.
    sigma = np.sqrt(1.5 * lines.sigma[row] ** 2 + window.cov[start, 2, 2] / 4)
    return ~(off > MISFIT_SIGMAS * sigma)


def _triangulate(first, row, window, lines, settings):
    """`Points` of rows [m] of the present frame, each from an earlier sighting (frame, row)."""
    at = window.index([frame for frame, _ in first])
    pair = np.column_stack([[earlier for _, earlier in first], row])
    motion, cov, limits = window.motion[at], window.cov[at], settings.triangulation
    return triangulation.triangulate(lines.bearing[pair], lines.sigma[pair], motion, cov, limits)
