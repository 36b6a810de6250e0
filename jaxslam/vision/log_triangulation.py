"""The paper's way for a whole log: follow lines from frame to frame, triangulate them, add points.

Every bearing may get one point: from it and an earlier bearing of the same line, when the robot has
driven far enough in between. Works on any log of bearings, with the colours of its lines if it has
them (a descriptor of 9 columns, as `extract` writes it).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from jaxslam.logs.log import NOT_USED
from jaxslam.logs.odometry import increments, moments
from jaxslam.parameters import default_params
from jaxslam.vision.matching import Appearance, MatchSettings, match_bearings
from jaxslam.vision.triangulation import (
    OK,
    PARALLEL,
    REASONS,
    STILL,
    TriangulationSettings,
    compose,
    sensor_motion,
    triangulate,
)

PAIRS = ("disjoint", "consecutive", "overlapping")
NEW, SHORT, MISFIT = range(len(REASONS), len(REASONS) + 3)
OUTCOMES = (
    *REASONS,
    "first seen here",
    "driven less than the baseline since first seen",
    "the line was elsewhere in between (a false match)",
)
MISFIT_SIGMAS = 3.0
MOST_FRAMES = 400  # looked back, however little the robot has moved
DEPTH_SIGMAS = 4.0  # of a track's own depth, within which it is looked for again


@dataclass(frozen=True)
class PointSettings:
    """`baseline` m: the least path by odometry between the two frames of a point; `longest` m: the
    most. `pairs` of one line: "disjoint" (no two share a frame), "consecutive" (the next begins
    where the last ended) or "overlapping" (from every frame back). `memory`: frames for which a
    line may stay unseen. `sigma` rad: of bearings, for a log that states none.

    Points over the same stretch of road share its error, one line's and all lines' alike, and a
    filter that takes them as independent grows too sure. A point's covariance stays its own; the
    log declares a `position_scale` for the filter: the root of `inflation` times the number of
    points of a line that overlap. Inflating all mapped 80 % of a simulated room's landmarks where
    thinning to disjoint pairs left 11 %, with paths as good (experiments/points.py).
    """

    baseline: float = 0.4
    longest: float = 2.0
    pairs: str = "overlapping"
    inflation: float = 16.0
    memory: int = 3
    sigma: float | None = None
    matching: MatchSettings = field(default_factory=MatchSettings)
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
    """One line followed: its sightings (frame, row), the place among them from which the next pair
    may begin, and bounds of its inverse depth at the last sighting, 1/m."""

    seen: list
    begin: int
    depth: tuple


class _Window:
    """The frames looked back on: numbers [w], and the sensor's motion from each to now."""

    def __init__(self):
        self.frame = np.empty(0, int)
        self.motion, self.cov, self.path = np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0)

    def advance(self, frame, motion, cov, distance, longest):
        """Append the frame before `frame`, then carry all of them over the interval to `frame`."""
        self.frame = np.append(self.frame, frame - 1)
        start = np.vstack([self.motion, np.zeros((1, 3))])
        start_cov = np.vstack([self.cov, np.zeros((1, 3, 3))])
        self.motion, self.cov = compose(start, start_cov, motion, cov)
        self.path = np.append(self.path, 0.0) + distance
        kept = self.path <= longest
        kept[:-MOST_FRAMES] = False
        for name in ("frame", "motion", "cov", "path"):
            setattr(self, name, getattr(self, name)[kept])

    def index(self, frames):
        """Places of frames in the window; they must be in it."""
        return np.searchsorted(self.frame, frames)


def triangulate_log(log, params=None, settings=None, use_identity=False, progress=None):
    """The log with `point`, `point_cov` and `point_baseline`, the bearings without a point counted
    by reason in `skipped`, and a `position_scale` for the filter unless it declares one.

    `params`: the motion's noise and turning gain (None: what the log declares, else the defaults).
    `use_identity`: lines are told apart by the measured identities. `progress(done, total)` in
    frames. Raises `ValueError` for a log without bearings, or without identities if asked for.
    """
    settings = PointSettings() if settings is None else settings
    if log.bearing is None:
        raise ValueError(f"{log.name}: has no bearings to triangulate from")
    if use_identity and (log.identity is None or not (log.identity >= 0).any()):
        raise ValueError(f"{log.name}: has no measured identities; leave them out")
    params = default_params("position", log) if params is None else params
    odometry = increments(log)
    mounting = (params.mount_x, params.mount_y, params.mount_yaw)
    motion, motion_cov = sensor_motion(*moments(odometry, params), mounting)
    lines = _LogLines(log, params, settings, use_identity)
    first = np.searchsorted(log.frame, np.arange(len(log.frame_time) + 1))
    window, tracks = _Window(), []
    point, cov = np.full((len(log.frame), 2), np.nan), np.full((len(log.frame), 3), np.nan)
    base, why = np.full(len(log.frame), np.nan), np.full(len(log.frame), NEW)
    for j in range(len(log.frame_time)):
        if j:
            step = motion[j], motion_cov[j], odometry.distance[j]
            window.advance(j, *step, settings.longest)
        rows = np.arange(first[j], first[j + 1])
        tracks = _follow(tracks, j, rows, window, lines, settings)
        now = [track for track in tracks if track.seen[-1][0] == j and len(track.seen) > 1]
        _measure(now, window, lines, settings, (point, cov, base, why))
        if progress and (j % 50 == 0 or j + 1 == len(log.frame_time)):
            progress(j + 1, len(log.frame_time))
    skipped = {k: v for k, v in log.skipped.items() if not k.startswith(_PREFIX)}
    counts = np.bincount(why, minlength=len(OUTCOMES))
    skipped |= {
        _PREFIX + OUTCOMES[i]: int(counts[i]) for i in range(len(OUTCOMES)) if i != OK and counts[i]
    }
    noise = {"position_scale": _position_scale(base, odometry.distance, settings)} | log.noise
    found = {"point": point, "point_cov": cov, "point_baseline": base}
    return replace(log, **found, noise=noise, skipped=skipped)


def _position_scale(base, distance, settings):
    """`position_scale` for points on these baselines [n] m, of frames these distances [T] apart."""
    shared = 1.0
    if settings.pairs == "overlapping" and np.isfinite(base).any():
        shared = max(1.0, float(np.nanmedian(base) / np.median(distance[distance > 0])))
    return float(np.sqrt(settings.inflation * shared))


_PREFIX = NOT_USED + "bearing without a point: "


class _LogLines:
    """What matching needs of all rows of a log."""

    def __init__(self, log, params, settings, use_identity):
        self.bearing = np.asarray(log.bearing)
        self.identity = log.identity if use_identity else None
        usual = params.sigma_bearing if settings.sigma is None else settings.sigma
        given = log.bearing_sigma if settings.sigma is None else None
        self.sigma = np.full(len(log.frame), usual) if given is None else np.asarray(given)
        self.looks = None
        coloured = log.descriptor is not None and log.descriptor.shape[1] == 9
        if coloured and settings.matching.use_colour:
            d = log.descriptor
            self.looks = Appearance(d[:, 0], d[:, 1], d[:, 2], d[:, 3:].reshape(-1, 2, 3))

    def match(self, before, after, motion, heading_sigma, depth, settings):
        """Pairs [m, 2] of places among the rows `before` and `after`."""
        if self.identity is not None:
            same = self.identity[before][:, None] == self.identity[after][None, :]
            return np.argwhere(same & (self.identity[before] >= 0)[:, None])
        looks = self.looks
        if looks is not None:
            looks = [Appearance(*(part[rows] for part in looks)) for rows in (before, after)]
        return match_bearings(
            (self.bearing[before], self.bearing[after]),
            (self.sigma[before], self.sigma[after]),
            motion,
            looks,
            settings.matching,
            heading_sigma,
            depth,
        )


def _follow(tracks, frame, rows, window, lines, settings):
    """The tracks with the frame's rows added, new ones begun, and those lost left out."""
    oldest = window.frame[0] if len(window.frame) else frame
    alive = []
    for track in tracks:
        if track.seen[-1][0] >= max(oldest, frame - settings.memory):
            gone = sum(seen[0] < oldest for seen in track.seen)
            del track.seen[:gone]
            track.begin = max(track.begin - gone, 0)
            alive.append(track)
    taken = np.zeros(len(rows), bool)
    if alive and len(rows):
        at = window.index([track.seen[-1][0] for track in alive])
        before = np.array([track.seen[-1][1] for track in alive])
        depth = np.array([track.depth for track in alive])
        sigma = np.sqrt(window.cov[at, 2, 2])
        for i, k in lines.match(before, rows, window.motion[at], sigma, depth, settings):
            alive[i].seen.append((frame, rows[k]))
            taken[k] = True
    unknown = (0.0, 1 / settings.matching.nearest)
    return alive + [_Track([(frame, row)], 0, unknown) for row in rows[~taken]]


def _measure(tracks, window, lines, settings, out):
    """Points of the rows the tracks have just got, into `out`; and the tracks' depths."""
    if not tracks:
        return
    row = np.array([track.seen[-1][1] for track in tracks])
    # The longest look back tells the depth best, which finds the line again.
    oldest = [track.seen[0] for track in tracks]
    far = _triangulate(oldest, row, window, lines, settings)
    inverse = 1 / np.where(far.reason == OK, np.hypot(*far.point.T), np.inf)
    for track, q, ratio in zip(tracks, inverse, far.parallax, strict=True):
        if q > 0:
            spread = DEPTH_SIGMAS * q / ratio
            most = 1 / settings.matching.nearest
            track.depth = (max(q - spread, 0.0), min(q + spread, most))
    point, cov, base, why = out
    start = [_pair_start(track, window, settings) for track in tracks]
    why[row] = SHORT
    moved = window.path[window.index([seen[0] for seen in oldest])]
    why[row[moved < settings.triangulation.least_baseline]] = STILL
    ready = [i for i, place in enumerate(start) if place is not None]
    if not ready:
        return
    seen = [tracks[i].seen[start[i]] for i in ready]
    row = row[ready]
    found = _triangulate(seen, row, window, lines, settings)
    between = [_sighting_between(tracks[i], start[i], window) for i in ready]
    fits = _confirmed_between(found.point, seen, between, window, lines)
    point[row] = np.where(fits[:, None], found.point, np.nan)
    cov[row] = np.where(fits[:, None], found.cov, np.nan)
    path = window.path[window.index([s[0] for s in seen])]
    base[row] = np.where(found.ok & fits, path, np.nan)
    why[row] = np.where(found.ok & ~fits, MISFIT, found.reason)
    for i, reason in zip(ready, found.reason, strict=True):
        # Rays still parallel: the same pair's begin may do later, from farther on.
        if reason != PARALLEL and settings.pairs != "overlapping":
            last = len(tracks[i].seen) - 1
            tracks[i].begin = last + (settings.pairs == "disjoint")


def _pair_start(track, window, settings):
    """Place in `track.seen` of the sighting that a pair with the newest begins at, or None."""
    frames = [seen[0] for seen in track.seen[track.begin : -1]]
    path = window.path[window.index(frames)] if frames else np.empty(0)
    far = np.flatnonzero(path >= settings.baseline - 1e-9)
    if len(far) == 0:
        return None
    # Overlapping pairs keep to the baseline; the others take all that they have.
    return track.begin + int(far[-1] if settings.pairs == "overlapping" else far[0])


def _sighting_between(track, start, window):
    """The sighting half-way between a pair's two, by path; the pair's first if there is none."""
    frames = [seen[0] for seen in track.seen[start:-1]]
    path = window.path[window.index(frames)]
    return track.seen[start + int(np.argmin(np.abs(path - path[0] / 2)))]


def _confirmed_between(point, seen, between, window, lines):
    """Whether the sightings between point to where the points are; most false pairs do not."""
    at, first = (window.index([s[0] for s in some]) for some in (between, seen))
    row = np.array([s[1] for s in between])
    x, y, turn = window.motion[at].T
    c, s = np.cos(turn), np.sin(turn)
    expected = np.arctan2(
        y + s * point[:, 0] + c * point[:, 1], x + c * point[:, 0] - s * point[:, 1]
    )
    off = np.abs((lines.bearing[row] - expected + np.pi) % (2 * np.pi) - np.pi)
    # Half-way the two ends hold the heading from either side: a quarter of its variance is left
    # (a Brownian bridge), and half a bearing's is added by each end's.
    sigma = np.sqrt(1.5 * lines.sigma[row] ** 2 + window.cov[first, 2, 2] / 4)
    return ~(off > MISFIT_SIGMAS * sigma)


def _triangulate(seen, row, window, lines, settings):
    at = window.index([frame for frame, _ in seen])
    first = np.array([earlier for _, earlier in seen])
    bearing = np.column_stack([lines.bearing[first], lines.bearing[row]])
    sigma = np.column_stack([lines.sigma[first], lines.sigma[row]])
    return triangulate(bearing, sigma, window.motion[at], window.cov[at], settings.triangulation)
