"""Simulated planar worlds with known truth, drawn from the filter's own model; NumPy alone.

The robot is driven by a controller. Over every odometry interval the true pose moves by what was
commanded and one draw of the motion model; the log records the command. So nothing but the draws
is hidden from the filter, and its uncertainty can be held against the truth.
Metres, radians (CCW, x forward), seconds; poses are (x, y, heading).
"""

from itertools import pairwise
from math import atan2, ceil, cos, hypot, inf, pi, sin, sqrt
from types import SimpleNamespace

import numpy as np

from jaxslam.logs.log import FloorPlan, Log, Truth
from jaxslam.logs.truth import wrap

ROOM = (10.0, 4.0)  # m, lower-left corner at the origin
MARGIN, CORNER = 1.0, 0.8  # m between path and walls, and the radius of the path's corners
GRID_SPACING = 2.0  # m between the nodes of a grid
FIELD_AREA = 4.0  # m^2 of an open field per landmark

# what is handed on to the filter, under the names of `Params`
NOISE = (
    "err_tran",
    "err_rot",
    "err_drift",
    "floor_tran",
    "floor_rot",
    "landmark_extent",
    "bias_drift",
)
NOISE += ("gain_tran", "gain_rot", "sigma_range", "sigma_bearing", "detection", "outlier")


def planar(
    world: str = "room",  # room: 10 x 4 m, edges on walls; grid: 2 m apart; field: at random
    seed: int = 0,  # the same arguments and seed give the same log
    *,
    landmarks: int = 40,  # how many point landmarks; their ids are 0, 1, ...
    clearance: float = 0.0,  # m, field only: none of them is closer to where the robot has been
    length_m: float = 60.0,  # m to drive, round and round a smooth closed loop
    speed: float = 0.5,  # m/s
    rate_hz: float = 5.0,  # frames per second (with commands: one at every stop instead)
    odometry_hz: float = 50.0,  # odometry samples per second (with commands: one per stop)
    commands: bool = False,  # stop and go: the log holds (distance, turn) commands
    stop_m: float = 0.3,  # m between stops
    closed_loop: bool = True,  # steer by the true pose; False: blindly, noise takes the robot away
    err_tran: float = 0.02,  # m/sqrt m, along the path
    err_rot: float = 0.02,  # rad/sqrt rad, heading, by turning
    err_drift: float = 0.02,  # rad/sqrt m, heading, by driving
    floor_tran: float = 0.001,  # m/sqrt s
    floor_rot: float = 0.001,  # rad/sqrt s
    gain_tran: float = 1.0,  # true over recorded distance
    gain_rot: float = 1.0,  # true over recorded turn
    bias_drift: float = 0.0,  # rad/m, systematic
    sigma_range: float = 0.05,  # m, standard deviation
    sigma_bearing: float = 0.02,  # rad, standard deviation at a distance
    landmark_extent: float = 0.0,  # m: bearing variance = sigma_bearing^2 + (landmark_extent / true range)^2
    detection: float = 0.9,  # probability of being seen at range 0, linearly to 0 at view[2]
    outlier: float = 0.02,  # probability of a measurement to be clutter
    max_per_frame: int | None = 16,  # of more measurements so many are kept, at random; None: all
    view: tuple[float, float, float] = (-pi, pi, 5.0),  # rad, rad, m: limits of bearing and range
    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0),  # m, m, rad: sensor in the robot frame
    start_cov: np.ndarray | None = None,  # [3, 3], the true start is drawn from it; None: exact
    truth_resolution: float = 0.0,  # m: truth is read off tiles of this size, once a tile; 0: exact
) -> Log:
    """A run through a planar world, as a log of ranges, bearings and identities, with its truth.

    A velocity log's first frame comes one period after the start, a command log's at the start.
    Nothing hides a landmark from the sensor. With `closed_loop`, commands answer to the noise; a
    filter takes them as given, so only without it is the joint model exact in the strictest sense.
    Raises `ValueError` for a value that is not allowed.
    """
    return _draw(SimpleNamespace(**locals()))  # the arguments, handed on as one


def _draw(given):
    _check(given)
    rng = np.random.default_rng(given.seed)
    marks, area, loop, plan = WORLDS[given.world](rng, given.landmarks)
    start_cov = np.zeros((3, 3)) if given.start_cov is None else np.array(given.start_cov, float)
    (x, y), ahead = _along(loop, np.array([0, given.stop_m if given.commands else 0.01]))
    mean = np.array([x, y, atan2(ahead[1] - y, ahead[0] - x)])
    # eigh: unlike Cholesky's, its factor exists for a singular covariance too
    start = rng.multivariate_normal(mean, start_cov, method="eigh", check_valid="raise")
    run = _stop_and_go if given.commands else _roll
    odometry_time, odometry, frame_time, pose = run(rng, loop, given, mean, start)
    if given.clearance:
        marks = _keep_clear(rng, marks, sqrt(area), pose, given.clearance)
    looks = [_look(rng, p, marks, given) for p in pose]
    ranges, bearings, identity = (np.concatenate(column) for column in zip(*looks, strict=True))
    noise = {name: getattr(given, name) for name in NOISE}
    # Drawn from the model itself: nothing to be cautious of.
    noise |= {"density_new": given.landmarks / area, "extra_bearing_noise": 0.0}
    return Log(
        name=f"planar-{given.world}-{given.seed}",
        odometry_time=odometry_time,
        odometry=odometry,
        odometry_kind="command" if given.commands else "velocity",
        frame_time=frame_time,
        frame=np.repeat(np.arange(len(pose)), [len(look[0]) for look in looks]),
        bearing=bearings,
        range=ranges,
        identity=identity,
        view=given.view,
        mounting=given.mounting,
        noise=noise,
        start_pose=mean,
        start_cov=start_cov,
        truth=_truth(given, frame_time, pose, marks, identity),
        plan=plan,
    )


def _keep_clear(rng, marks, side, pose, clearance):
    """Landmarks in a square of this side, those in the way moved elsewhere at random."""
    path = np.vstack([np.linspace(a, b, 9) for a, b in pairwise(pose[:, :2])] or [pose[:, :2]])
    for _ in range(1000):
        near = np.hypot(*(marks[:, None] - path).transpose(2, 0, 1)).min(1) < clearance
        if not near.any():
            return marks
        marks = np.where(near[:, None], rng.uniform(0, side, marks.shape), marks)
    raise ValueError(f"planar: clearance is {clearance:g}: the path leaves no room for that")


def _truth(given, frame_time, pose, marks, identity):
    """Exact at every frame, or as read off the floor's tiles: rounded, at a frame per tile."""
    resolution = given.truth_resolution
    step = given.stop_m if given.commands else given.speed / given.rate_hz
    read = slice(None, None, max(1, round(resolution / step)))
    pose = pose[read].copy()
    if resolution:
        pose[:, :2] = np.round(pose[:, :2] / resolution) * resolution
    time, ids = frame_time[read], np.arange(len(marks))
    return Truth(time, pose, marks, ids, identity, resolution)


def _room(rng, count):
    """Landmarks spread over the walls, as vertical edges are; path: a rounded rectangle."""
    width, height = ROOM
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    place = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count
    marks = _along(corners, place * 2 * (width + height))
    low, wide, high = MARGIN + CORNER, width - MARGIN - CORNER, height - MARGIN - CORNER
    centres = np.array([(wide, low), (wide, high), (low, high), (low, low)])
    angle = np.linspace(-pi / 2, 3 * pi / 2, 361)[:-1]
    loop = centres.repeat(90, axis=0) + CORNER * np.column_stack([np.cos(angle), np.sin(angle)])
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    return marks, width * height, loop, FloorPlan(walls)


def _grid(rng, count):
    """Landmarks on nodes of a square grid, some left empty; path: a circle."""
    nodes = ceil(sqrt(count))
    place = np.sort(rng.choice(nodes**2, count, replace=False))
    marks = GRID_SPACING * np.column_stack([place % nodes, place // nodes])
    middle, side = GRID_SPACING * (nodes - 1) / 2, GRID_SPACING * nodes
    angle = np.linspace(-pi, pi, 361)[:-1]
    radius = max(1.5, 0.35 * side)
    loop = middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return marks.astype(float), side**2, loop, None


def _field(rng, count):
    """Landmarks anywhere in a square; path: a circle with its first harmonics bent at random."""
    side = max(10.0, sqrt(count * FIELD_AREA))
    marks = rng.uniform(0, side, (count, 2))
    angle, order = np.linspace(-pi, pi, 721)[:-1, None], np.arange(2, 5)
    bend = np.sum(0.3 / order**2 * np.cos(order * angle + rng.uniform(-pi, pi, 3)), axis=1)
    radius = 0.3 * side * (1 + bend[:, None])
    return marks, side**2, side / 2 + radius * np.hstack([np.cos(angle), np.sin(angle)]), None


WORLDS = {"room": _room, "grid": _grid, "field": _field}  # -> landmarks, area, loop, plan


def _along(loop, distance):
    """Points [n, 2] at these distances [n] along the closed polyline `loop` [v, 2]."""
    closed = np.vstack([loop, loop[:1]])
    length = np.append(0, np.cumsum(np.hypot(*np.diff(closed, axis=0).T)))
    at = distance % length[-1]
    return np.column_stack([np.interp(at, length, column) for column in closed.T])


def _roll(rng, loop, given, mean, start):
    """Drive smoothly: odometry stamps and velocities, frame stamps, true poses [F, 3] at them."""
    count = max(1, int(given.length_m / given.speed * given.rate_hz + 1e-9))
    frame_time = _stamps(np.arange(1, count + 1), given.rate_hz)
    samples = np.arange(ceil(frame_time[-1] * 1e-9 * given.odometry_hz) + 1)
    odometry_time = _stamps(samples, given.odometry_hz)
    odometry_time = odometry_time[odometry_time < frame_time[-1]]
    spacing = given.speed / given.odometry_hz
    path = _along(loop, np.arange(len(odometry_time) + 2) * spacing).tolist()
    stamps = np.union1d(odometry_time, frame_time)
    commanded, framed = np.isin(stamps, odometry_time), np.isin(stamps, frame_time)
    odometry, poses = [], []
    pose, known = tuple(start), tuple(start if given.closed_loop else mean)
    for i, (begin, end) in enumerate(pairwise(stamps.tolist())):
        if commanded[i]:
            k = len(odometry)
            v, w = _follow(known, path[k : k + 3], 1 / given.odometry_hz)
            odometry.append((v, w))
        duration = (end - begin) * 1e-9
        turn = w * duration
        chord = v * duration * np.sinc(turn / (2 * pi))
        piece = chord, turn / 2, turn, v * duration, duration, 0.5, 1 / 12
        pose = _move(pose, *piece, given, rng.standard_normal(3))
        known = pose if given.closed_loop else _move(known, *piece, given, (0, 0, 0))
        if framed[i + 1]:
            poses.append(pose)
    return odometry_time, np.array(odometry), frame_time, np.array(poses)


def _stop_and_go(rng, loop, given, mean, start):
    """Drive from stop to stop: stamps and commands, frame stamps, true poses [F, 3] at them."""
    stops = max(1, int(given.length_m / given.stop_m + 1e-9))
    time = _stamps(np.arange(stops + 1), given.speed / given.stop_m)
    path = _along(loop, np.arange(stops + 2) * given.stop_m)
    commands, poses = [], [tuple(start)]
    known = tuple(start if given.closed_loop else mean)
    for i, duration in enumerate(np.diff(time) * 1e-9):
        x, y, heading = known
        dx, dy = path[i + 1] - (x, y)
        distance = max(0.0, cos(heading) * dx + sin(heading) * dy)
        dx, dy = path[i + 2] - (x + cos(heading) * distance, y + sin(heading) * distance)
        turn = wrap(atan2(dy, dx) - heading)
        commands.append((distance, turn))
        piece = distance, 0.0, turn, distance, duration, 0.0, 0.0
        poses.append(_move(poses[-1], *piece, given, rng.standard_normal(3)))
        known = poses[-1] if given.closed_loop else _move(known, *piece, given, (0, 0, 0))
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


def _move(pose, length, chord, turn, distance, duration, lever, lever_var, given, draw):
    """True pose after an interval: displacement `length` towards `chord`, turned by `turn`.

    `lever`, `lever_var`: mean and variance, over the turning, of the fraction of `distance` still
    to come. `draw`: three standard normals (along, heading, across given heading).
    """
    x, y, heading = pose
    bias = given.bias_drift * distance
    chord += heading + lever * (given.gain_rot - 1) * turn + bias / 2
    length *= given.gain_tran
    floor = given.floor_tran**2 * duration
    drift = given.err_drift**2 * distance + given.floor_rot**2 * duration
    spin = given.err_rot**2 * abs(turn)
    both = length * (drift / 2 + lever * spin)
    slope = both / (drift + spin) if drift + spin else 0.0
    across_var = length**2 * (drift / 3 + (lever**2 + lever_var) * spin) + floor
    along = length + sqrt(given.err_tran**2 * distance + floor) * draw[0]
    error = sqrt(drift + spin) * draw[1]
    across = slope * error + sqrt(max(across_var - slope * both, 0.0)) * draw[2]
    x += cos(chord) * along - sin(chord) * across
    y += sin(chord) * along + cos(chord) * across
    return x, y, wrap(heading + given.gain_rot * turn + bias + error)


def _look(rng, pose, marks, given):
    """One frame: ranges, bearings and identities (-1: clutter), in random order."""
    x, y, heading = pose
    mx, my, yaw = given.mounting
    low, high, reach = given.view
    dx = marks[:, 0] - (x + mx * cos(heading) - my * sin(heading))
    dy = marks[:, 1] - (y + mx * sin(heading) + my * cos(heading))
    r, b = np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - heading - yaw)
    inside = (low <= b) & (b <= high)
    found = inside & (rng.random(len(r)) < given.detection * np.maximum(0, 1 - r / reach))
    identity = np.flatnonzero(found)
    r, b = r[identity], b[identity]
    b = wrap(
        b + np.hypot(given.sigma_bearing, given.landmark_extent / r) * rng.standard_normal(len(b))
    )
    r = r + given.sigma_range * rng.standard_normal(len(r))
    r, b, identity = r[r > 0], b[r > 0], identity[r > 0]  # no sensor reports a negative range
    # clutter met before the last true one, each measurement being clutter with that probability
    clutter = rng.negative_binomial(len(r), 1 - given.outlier) if len(r) else 0
    r = np.append(r, reach * (1 - rng.random(clutter)))
    b = np.append(b, rng.uniform(low, high, clutter))
    kept = rng.permutation(len(r))[: given.max_per_frame]
    return r[kept], b[kept], np.append(identity, np.full(clutter, -1))[kept]


def _stamps(count, rate):
    return np.rint(count * (1e9 / rate)).astype(np.int64)


def _check(given):
    """Raise for what neither NumPy nor `Log` would name."""
    limit, cov, (low, high, reach) = given.max_per_frame, given.start_cov, given.view
    rules = {
        "world": (given.world in WORLDS, f"one of {', '.join(WORLDS)}"),
        "landmarks": (given.landmarks >= 1, "1 or more"),
        "clearance": (
            0 <= given.clearance < inf and (given.world == "field" or not given.clearance),
            "0 or more, other than 0 in a field only",
        ),
        "max_per_frame": (limit is None or limit >= 1, "1 or more, or None"),
        "detection": (0 < given.detection <= 1, "in (0, 1]"),
        "outlier": (0 <= given.outlier < 1, "in [0, 1)"),
        "view": (-pi <= low < high <= pi and 0 < reach < inf, "-pi <= min < max <= pi, range > 0"),
        "start_cov": (cov is None or np.shape(cov) == (3, 3), "a 3 x 3 covariance, or None"),
    }
    for name in ("length_m", "speed", "rate_hz", "odometry_hz", "stop_m", "gain_tran", "gain_rot"):
        rules[name] = 0 < getattr(given, name) < inf, "above 0"
    for name in ("sigma_range", "sigma_bearing", "landmark_extent", "truth_resolution", *NOISE[:5]):
        rules[name] = 0 <= getattr(given, name) < inf, "0 or more"
    for name, (good, allowed) in rules.items():
        if not good:
            found = np.asarray(getattr(given, name)).tolist()  # an array's repr has many lines
            raise ValueError(f"planar: {name} is {found!r}, allowed: {allowed}")
