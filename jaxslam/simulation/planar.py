"""Simulated planar worlds with known truth, drawn from the filter's own model; NumPy alone.

A controller drives the robot. Over every odometry interval the true pose moves by what was
commanded and one draw of the motion model; the log records the command. So nothing but the draws
is hidden from the filter, and its uncertainty can be checked against the truth.
Metres, radians (CCW, x forward), seconds; poses are (x, y, heading).
"""

from itertools import pairwise
from math import atan2, ceil, cos, hypot, inf, pi, sin, sqrt
from types import SimpleNamespace

import numpy as np

from jaxslam.logs.log import FloorPlan, Log, Truth
from jaxslam.logs.truth import wrap
from jaxslam.parameters import current_names

ROOM = (10.0, 4.0)  # m, lower-left corner at the origin
MARGIN, CORNER = 1.0, 0.8  # m between path and walls, and the radius of the path's corners
GRID_SPACING = 2.0  # m between the nodes of a grid
FIELD_AREA = 4.0  # m^2 of an open field per landmark

# Defaults of the noise, a part of `Params` (`PARAMETERS` has the units), declared by the log.
NOISE = {
    "err_tran": 0.02,
    "err_rot": 0.02,
    "err_drift": 0.02,
    "floor_tran": 0.001,
    "floor_rot": 0.001,
    "landmark_extent": 0.0,
    "bias_drift": 0.0,
    "gain_tran": 1.0,
    "gain_rot": 1.0,
    "sigma_range": 0.05,
    "sigma_bearing": 0.02,
    "detection": 0.9,
    "outlier": 0.02,
}
NOT_NEGATIVE = ("err_tran", "err_rot", "err_drift", "floor_tran", "floor_rot")
NOT_NEGATIVE += ("sigma_range", "sigma_bearing", "landmark_extent", "truth_resolution")


def planar(
    world: str = "room",  # room: 10 x 4 m, edges on walls; grid: 2 m apart; field: at random
    seed: int = 0,  # the same arguments and seed give the same log
    *,
    landmarks: int = 40,  # how many point landmarks; their ids are 0, 1, ...
    clearance: float = 0.0,  # m, field only: least distance of landmarks from the path
    length_m: float = 60.0,  # m to drive, round and round a smooth closed loop
    speed: float = 0.5,  # m/s
    rate_hz: float = 5.0,  # frames per second (with commands: one at every stop instead)
    odometry_hz: float = 50.0,  # odometry samples per second (with commands: one per stop)
    commands: bool = False,  # stop and go: the log holds (distance, turn) commands
    stop_m: float = 0.3,  # m between stops
    closed_loop: bool = True,  # steer by the true pose; False: blindly, so that noise adds up
    max_per_frame: int | None = 16,  # keep at most so many measurements, at random; None: all
    view: tuple[float, float, float] = (-pi, pi, 5.0),  # rad, rad, m: limits of bearing and range
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0),  # m, m, rad: sensor in the robot frame
    start_cov: np.ndarray | None = None,  # [3, 3], the true start is drawn from it; None: exact
    truth_resolution: float = 0.0,  # m: truth is read off tiles of this size, once a tile; 0: exact
    **noise: float,  # fields of `Params`, instead of the values of `NOISE`
) -> Log:
    """Simulate a drive through a planar world.

    Returns a `Log` of ranges, bearings and identities with its truth. The first frame of a velocity
    log comes one period after the start, that of a command log at the start. Nothing hides a
    landmark from the sensor. With `closed_loop`, the commands react to the noise; a filter takes
    them as independent of it, so only without `closed_loop` is the joint model exact.

    Raises `ValueError` for a value that is not allowed, `TypeError` for an unknown parameter.
    """
    settings = locals()  # the arguments, and nothing else yet
    noise = NOISE | current_names(settings.pop("noise"))
    if unknown := sorted(set(noise) - set(NOISE)):
        raise TypeError(f"planar: no parameter {unknown[0]!r}; allowed: {', '.join(NOISE)}")
    return _simulate(SimpleNamespace(**settings, **noise))


def _simulate(settings):
    _check(settings)
    rng = np.random.default_rng(settings.seed)
    landmarks, area, loop, plan = WORLDS[settings.world](rng, settings.landmarks)
    cov = settings.start_cov
    start_cov = np.zeros((3, 3)) if cov is None else np.array(cov, float)
    (x, y), ahead = _along(loop, np.array([0, settings.stop_m if settings.commands else 0.01]))
    mean = np.array([x, y, atan2(ahead[1] - y, ahead[0] - x)])
    # eigh: unlike Cholesky's, its factor exists for a singular covariance too
    start = rng.multivariate_normal(mean, start_cov, method="eigh", check_valid="raise")
    run = _stop_and_go if settings.commands else _roll
    odometry_time, odometry, frame_time, pose = run(rng, loop, settings, mean, start)
    if settings.clearance:
        landmarks = _keep_clear(rng, landmarks, sqrt(area), pose, settings.clearance)
    frames = [_measure(rng, p, landmarks, settings) for p in pose]
    ranges, bearings, identity = (np.concatenate(column) for column in zip(*frames, strict=True))
    noise = {name: getattr(settings, name) for name in NOISE}
    # Drawn from the model itself, so that the filter needs no further noise.
    noise |= {"density_new": settings.landmarks / area, "extra_bearing_noise": 0.0}
    return Log(
        name=f"planar-{settings.world}-{settings.seed}",
        odometry_time=odometry_time,
        odometry=odometry,
        odometry_kind="command" if settings.commands else "velocity",
        frame_time=frame_time,
        frame=np.repeat(np.arange(len(pose)), [len(frame[0]) for frame in frames]),
        bearing=bearings,
        range=ranges,
        identity=identity,
        view=settings.view,
        mounting=settings.mounting,
        noise=noise,
        start_pose=mean,
        start_cov=start_cov,
        truth=_truth(settings, frame_time, pose, landmarks, identity),
        plan=plan,
    )


def _keep_clear(rng, landmarks, side, pose, clearance):
    """Redraw landmarks of a square until none is closer to the path than `clearance` [m]."""
    path = np.vstack([np.linspace(a, b, 9) for a, b in pairwise(pose[:, :2])] or [pose[:, :2]])
    for _ in range(1000):
        near = np.hypot(*(landmarks[:, None] - path).transpose(2, 0, 1)).min(1) < clearance
        if not near.any():
            return landmarks
        landmarks = np.where(near[:, None], rng.uniform(0, side, landmarks.shape), landmarks)
    raise ValueError(f"planar: clearance is {clearance:g}: the path leaves no room for that")


def _truth(settings, frame_time, pose, landmarks, identity):
    """`Truth` of every frame, or, as read off floor tiles, rounded and at one frame per tile."""
    resolution = settings.truth_resolution
    step = settings.stop_m if settings.commands else settings.speed / settings.rate_hz
    kept = slice(None, None, max(1, round(resolution / step)))
    pose = pose[kept].copy()
    if resolution:
        pose[:, :2] = np.round(pose[:, :2] / resolution) * resolution
    time, ids = frame_time[kept], np.arange(len(landmarks))
    return Truth(time, pose, landmarks, ids, identity, resolution)


def _room(rng, count):
    """Landmarks spread over the walls, like vertical edges; path: a rounded rectangle."""
    width, height = ROOM
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    fraction = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count
    landmarks = _along(corners, fraction * 2 * (width + height))
    low, wide, high = MARGIN + CORNER, width - MARGIN - CORNER, height - MARGIN - CORNER
    centres = np.array([(wide, low), (wide, high), (low, high), (low, low)])
    angle = np.linspace(-pi / 2, 3 * pi / 2, 361)[:-1]
    loop = centres.repeat(90, axis=0) + CORNER * np.column_stack([np.cos(angle), np.sin(angle)])
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    return landmarks, width * height, loop, FloorPlan(walls)


def _grid(rng, count):
    """Landmarks on nodes of a square grid, some left empty; path: a circle."""
    nodes = ceil(sqrt(count))
    node = np.sort(rng.choice(nodes**2, count, replace=False))
    landmarks = GRID_SPACING * np.column_stack([node % nodes, node // nodes])
    middle, side = GRID_SPACING * (nodes - 1) / 2, GRID_SPACING * nodes
    angle = np.linspace(-pi, pi, 361)[:-1]
    radius = max(1.5, 0.35 * side)
    loop = middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return landmarks.astype(float), side**2, loop, None


def _field(rng, count):
    """Landmarks anywhere in a square; path: a circle with random low harmonics in its radius."""
    side = max(10.0, sqrt(count * FIELD_AREA))
    landmarks = rng.uniform(0, side, (count, 2))
    angle, order = np.linspace(-pi, pi, 721)[:-1, None], np.arange(2, 5)
    bend = np.sum(0.3 / order**2 * np.cos(order * angle + rng.uniform(-pi, pi, 3)), axis=1)
    radius = 0.3 * side * (1 + bend[:, None])
    return landmarks, side**2, side / 2 + radius * np.hstack([np.cos(angle), np.sin(angle)]), None


WORLDS = {"room": _room, "grid": _grid, "field": _field}  # -> landmarks, area, loop, plan


def _along(loop, distance):
    """Points [n, 2] at these distances [n] along the closed polyline `loop` [v, 2]."""
    closed = np.vstack([loop, loop[:1]])
    length = np.append(0, np.cumsum(np.hypot(*np.diff(closed, axis=0).T)))
    at = distance % length[-1]
    return np.column_stack([np.interp(at, length, column) for column in closed.T])


def _roll(rng, loop, settings, mean, start):
    """Drive smoothly: odometry stamps and velocities, frame stamps, true poses [F, 3] at them."""
    count = max(1, int(settings.length_m / settings.speed * settings.rate_hz + 1e-9))
    frame_time = _stamps(np.arange(1, count + 1), settings.rate_hz)
    samples = np.arange(ceil(frame_time[-1] * 1e-9 * settings.odometry_hz) + 1)
    odometry_time = _stamps(samples, settings.odometry_hz)
    odometry_time = odometry_time[odometry_time < frame_time[-1]]
    spacing = settings.speed / settings.odometry_hz
    path = _along(loop, np.arange(len(odometry_time) + 2) * spacing).tolist()
    stamps = np.union1d(odometry_time, frame_time)
    commanded, framed = np.isin(stamps, odometry_time), np.isin(stamps, frame_time)
    odometry, poses = [], []
    pose, known = tuple(start), tuple(start if settings.closed_loop else mean)
    for i, (begin, end) in enumerate(pairwise(stamps.tolist())):
        if commanded[i]:
            k = len(odometry)
            v, w = _follow(known, path[k : k + 3], 1 / settings.odometry_hz)
            odometry.append((v, w))
        duration = (end - begin) * 1e-9
        turn = w * duration
        chord = v * duration * np.sinc(turn / (2 * pi))
        piece = chord, turn / 2, turn, v * duration, duration, 0.5, 1 / 12
        pose = _move(pose, *piece, settings, rng.standard_normal(3))
        known = pose if settings.closed_loop else _move(known, *piece, settings, (0, 0, 0))
        if framed[i + 1]:
            poses.append(pose)
    return odometry_time, np.array(odometry), frame_time, np.array(poses)


def _stop_and_go(rng, loop, settings, mean, start):
    """Drive from stop to stop: stamps and commands, frame stamps, true poses [F, 3] at them."""
    stops = max(1, int(settings.length_m / settings.stop_m + 1e-9))
    time = _stamps(np.arange(stops + 1), settings.speed / settings.stop_m)
    path = _along(loop, np.arange(stops + 2) * settings.stop_m)
    commands, poses = [], [tuple(start)]
    known = tuple(start if settings.closed_loop else mean)
    for i, duration in enumerate(np.diff(time) * 1e-9):
        x, y, heading = known
        dx, dy = path[i + 1] - (x, y)
        distance = max(0.0, cos(heading) * dx + sin(heading) * dy)
        dx, dy = path[i + 2] - (x + cos(heading) * distance, y + sin(heading) * distance)
        turn = wrap(atan2(dy, dx) - heading)
        commands.append((distance, turn))
        piece = distance, 0.0, turn, distance, duration, 0.0, 0.0
        poses.append(_move(poses[-1], *piece, settings, rng.standard_normal(3)))
        known = poses[-1] if settings.closed_loop else _move(known, *piece, settings, (0, 0, 0))
    return time[1:], np.array(commands), time, np.array(poses)


def _follow(pose, path, period):
    """Velocities (v >= 0, w) along `path`, 3 points: the control law of Kanayama et al. (1990)."""
    x, y, heading = pose
    (ax, ay), (bx, by), (cx, cy) = path
    speed, direction = hypot(bx - ax, by - ay) / period, atan2(by - ay, bx - ax)
    rate = wrap(atan2(cy - by, cx - bx) - direction) / period
    ahead = cos(heading) * (ax - x) + sin(heading) * (ay - y)
    left = cos(heading) * (ay - y) - sin(heading) * (ax - x)
    off = wrap(direction - heading)
    v = min(max(speed * cos(off) + ahead, 0.0), 2 * speed)
    return v, rate + speed * (4 * left + 3 * sin(off))


def _move(pose, length, chord, turn, distance, duration, lever, lever_var, settings, draw):
    """True pose after an interval: displacement `length` towards `chord`, turned by `turn`.

    `lever`, `lever_var`: mean and variance, over the turning, of the fraction of `distance` still
    to come. `draw`: three standard normals (along, heading, across given heading).
    """
    x, y, heading = pose
    bias = settings.bias_drift * distance
    chord += heading + lever * (settings.gain_rot - 1) * turn + bias / 2
    length *= settings.gain_tran
    floor = settings.floor_tran**2 * duration
    drift = settings.err_drift**2 * distance + settings.floor_rot**2 * duration
    spin = settings.err_rot**2 * abs(turn)
    both = length * (drift / 2 + lever * spin)
    slope = both / (drift + spin) if drift + spin else 0.0
    across_var = length**2 * (drift / 3 + (lever**2 + lever_var) * spin) + floor
    along = length + sqrt(settings.err_tran**2 * distance + floor) * draw[0]
    error = sqrt(drift + spin) * draw[1]
    across = slope * error + sqrt(max(across_var - slope * both, 0.0)) * draw[2]
    x += cos(chord) * along - sin(chord) * across
    y += sin(chord) * along + cos(chord) * across
    return x, y, wrap(heading + settings.gain_rot * turn + bias + error)


def _measure(rng, pose, landmarks, settings):
    """Measure one frame: ranges, bearings and identities (-1: clutter), in random order."""
    x, y, heading = pose
    mx, my, yaw = settings.mounting
    low, high, reach = settings.view
    dx = landmarks[:, 0] - (x + mx * cos(heading) - my * sin(heading))
    dy = landmarks[:, 1] - (y + mx * sin(heading) + my * cos(heading))
    r, b = np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - heading - yaw)
    inside = (low <= b) & (b <= high)
    detected = inside & (rng.random(len(r)) < settings.detection * np.maximum(0, 1 - r / reach))
    identity = np.flatnonzero(detected)
    r, b = r[identity], b[identity]
    sigma = np.hypot(settings.sigma_bearing, settings.landmark_extent / r)
    b = wrap(b + sigma * rng.standard_normal(len(b)))
    r = r + settings.sigma_range * rng.standard_normal(len(r))
    r, b, identity = r[r > 0], b[r > 0], identity[r > 0]  # no sensor reports a negative range
    # Clutter before the last true one, if each measurement is clutter with probability `outlier`.
    clutter = rng.negative_binomial(len(r), 1 - settings.outlier) if len(r) else 0
    r = np.append(r, reach * (1 - rng.random(clutter)))
    b = np.append(b, rng.uniform(low, high, clutter))
    kept = rng.permutation(len(r))[: settings.max_per_frame]
    return r[kept], b[kept], np.append(identity, np.full(clutter, -1))[kept]


def _stamps(count, rate):
    return np.rint(count * (1e9 / rate)).astype(np.int64)


def _check(settings):
    """Raise for values that neither NumPy nor `Log` would name."""
    limit, cov, (low, high, reach) = settings.max_per_frame, settings.start_cov, settings.view
    rules = {
        "world": (settings.world in WORLDS, f"one of {', '.join(WORLDS)}"),
        "landmarks": (settings.landmarks >= 1, "1 or more"),
        "clearance": (
            0 <= settings.clearance < inf and (settings.world == "field" or not settings.clearance),
            "0 or more, other than 0 in a field only",
        ),
        "max_per_frame": (limit is None or limit >= 1, "1 or more, or None"),
        "detection": (0 < settings.detection <= 1, "in (0, 1]"),
        "outlier": (0 <= settings.outlier < 1, "in [0, 1)"),
        "view": (-pi <= low < high <= pi and 0 < reach < inf, "-pi <= min < max <= pi, range > 0"),
        "start_cov": (cov is None or np.shape(cov) == (3, 3), "a 3 x 3 covariance, or None"),
    }
    for name in ("length_m", "speed", "rate_hz", "odometry_hz", "stop_m", "gain_tran", "gain_rot"):
        rules[name] = 0 < getattr(settings, name) < inf, "above 0"
    for name in NOT_NEGATIVE:
        rules[name] = 0 <= getattr(settings, name) < inf, "0 or more"
    for name, (good, allowed) in rules.items():
        if not good:
            value = np.asarray(getattr(settings, name)).tolist()  # an array's repr has many lines
            raise ValueError(f"planar: {name} is {value!r}, allowed: {allowed}")
