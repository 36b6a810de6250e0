"""Read a log from CSV files: one of odometry, one of measurements, and optionally truth.

Each starts with a header row that is exactly one of these:

    odometry      time_s,forward_m_s,yaw_rate_rad_s   velocities, held until the next row
                  time_s,distance_m,turn_rad          commands: drive, then turn, done at time_s
    measurements  time_s,bearing_rad[,range_m][,identity]
                  time_s,x_m,y_m,sxx,sxy,syy[,identity]    point in sensor frame, covariance m^2
    truth         time_s,x_m,y_m,theta_rad
    landmarks     id,x_m,y_m                          true landmarks

Measurements may have further columns look_NAME, numbers that describe appearance: the log's
descriptors. Rows of one stamp are one frame; a row with nothing but its stamp is an empty frame. An
empty `identity` means none. `#` begins a comment.
"""

from math import pi
from pathlib import Path

import numpy as np

from jaxslam.logs.log import Log, Truth
from jaxslam.logs.readers.text_table import (
    drop_bad_rows,
    drop_rows,
    in_order,
    parse,
    pose_at,
    read_lines,
    to_integers,
    wrap_bearings,
)

VELOCITY = ("forward_m_s", "yaw_rate_rad_s")
COMMAND = ("distance_m", "turn_rad")
BEARING = ("bearing_rad",)
RANGE_BEARING = ("bearing_rad", "range_m")
POINT = ("x_m", "y_m", "sxx", "sxy", "syy")
POSE = ("x_m", "y_m", "theta_rad")
LAYOUTS = {
    "odometry": [("time_s", *VELOCITY), ("time_s", *COMMAND)],
    "measurements": [
        ("time_s", *columns, *identity)
        for columns in (BEARING, RANGE_BEARING, POINT)
        for identity in ((), ("identity",))
    ],
    "truth": [("time_s", *POSE)],
    "landmarks": [("id", "x_m", "y_m")],
}
LOOK = "look_"
VIEW_RANGE = 10.0  # m, declared when there are no ranges
MAX_YAW_RATE = 6 * pi  # rad/s


def read_csv(paths, view=None, mounting=(0.0, 0.0, 0.0)):
    """Read the `Log` of two to four CSV files, distinguished by their headers.

    `view` (least bearing, largest bearing [rad], range [m]) of the sensor; None: the smallest that
    holds all measurements. The start pose is the truth at the start, else zero. Raises `ValueError`
    naming file and line.
    """
    files = _open_all(paths)
    skipped = {}
    kind, odometry = _odometry(files["odometry"], skipped)
    columns, measured = _measurements(files["measurements"], skipped)
    order = in_order(odometry.time, "odometry row", skipped)
    frame_time, frame = np.unique(measured.time, return_inverse=True)
    seen = ~np.isnan(measured.value[:, 0])
    value = measured.value[seen]
    column = {name: value[:, i] for i, name in enumerate(columns)}
    identity = column.get("identity")
    if identity is not None:
        identity = np.where(np.isnan(identity), -1, identity).astype(np.int64)
    described = [name.startswith(LOOK) for name in columns]
    bearing, distance = column.get("bearing_rad"), column.get("range_m")
    if bearing is not None:
        bearing = wrap_bearings(bearing)
    truth = _truth(files, skipped)
    start = min(odometry.time.min(), frame_time[0])
    known = truth is not None and truth.time is not None
    pose = pose_at(start, truth.time, truth.pose) if known else None
    return Log(
        name=files["measurements"][0].stem,
        odometry_time=odometry.time[order],
        odometry=odometry.value[order],
        odometry_kind=kind,
        frame_time=frame_time,
        frame=frame[seen],
        bearing=bearing,
        range=distance,
        point=value[:, :2] if bearing is None else None,
        point_cov=value[:, 2:5] if bearing is None else None,
        identity=identity,
        descriptor=value[:, described] if any(described) else None,
        view=_view(value, bearing, distance) if view is None else view,
        mounting=mounting,
        start_pose=np.zeros(3) if pose is None else pose,
        truth=truth,
        skipped=skipped,
    )


def read_odometry(path, skipped):
    """Read the kind ("velocity" or "command") and the `Table` in order of time.

    Counts bad rows in `skipped`.
    """
    name, file = _open(Path(path), ["odometry"])
    if name != "odometry":
        header = " or ".join(",".join(layout) for layout in LAYOUTS["odometry"])
        raise ValueError(f"{path}: is a {name} file; odometry has the header {header}")
    kind, table = _odometry(file, skipped)
    order = in_order(table.time, "odometry row", skipped)
    return kind, table._replace(time=table.time[order], value=table.value[order])


def read_truth(paths, skipped):
    """Read the `Truth` in a file of poses, one of landmarks, or both; None without files."""
    files = {}
    for path in map(Path, paths):
        name, file = _open(path, ["truth", "landmarks"])
        if name not in ("truth", "landmarks") or name in files:
            allowed = "give at most one of truth and one of landmarks"
            raise ValueError(f"{path}: is a {name} file; {allowed}")
        files[name] = file
    return _truth(files, skipped)


def _open(path, wanted=LAYOUTS):
    """Read a file: its kind by the header; its path, columns, lines and completeness."""
    lines, complete = read_lines(path, ",")
    header = tuple(cell.strip('"').lower() for cell in lines[0][1])
    kinds = [kind for kind, layouts in LAYOUTS.items() if _without_looks(header, kind) in layouts]
    if not kinds:
        found = ",".join(header)[:80]
        allowed = " or ".join(",".join(row) for kind in wanted for row in LAYOUTS[kind])
        if "measurements" in wanted:
            allowed += "; of measurements also look_NAME columns at the end"
        where = f"{path}, line {lines[0][0]}"
        raise ValueError(f"{where}: {found!r} is no known header; allowed: {allowed}")
    return kinds[0], (path, header, lines[1:], complete)


def _without_looks(header, kind):
    """The header without look_NAME columns, if it may have them: measurements, at the end, once."""
    described = [name.startswith(LOOK) for name in header]
    size = described.index(True) if True in described else len(header)
    fits = kind == "measurements" and all(described[size:]) and len(set(header)) == len(header)
    return header[:size] if fits else header


def _open_all(paths):
    """Read the file of each kind: path, columns, lines and completeness."""
    files = {}
    for path in map(Path, paths):
        kind, file = _open(path)
        if kind in files:
            raise ValueError(f"{path}: is a second {kind} file, after {files[kind][0]}")
        files[kind] = file
    for kind in ("odometry", "measurements"):
        if kind not in files:
            listed = ", ".join(str(path) for path in paths)
            header = ",".join(LAYOUTS[kind][0])
            raise ValueError(f"{listed}: no {kind} file among them (header {header})")
    return files


def _parse(file, **options):
    path, header, lines, complete = file
    return parse(path, lines, len(header), complete, **options)


def _odometry(file, skipped):
    table = _parse(file)
    velocity = file[1][1:] == VELOCITY
    limit = MAX_YAW_RATE if velocity else 2 * pi
    reason = f"turn beyond {limit:.1f} rad{'/s' * velocity} (degrees? multiply by pi/180)"
    table = drop_rows(table, np.abs(table.value[:, 1]) > limit, reason, unit=True)
    return "velocity" if velocity else "command", drop_bad_rows(table, skipped)


def _measurements(file, skipped):
    """Columns after the stamp, and the rows in order of time; a row of NaN is an empty frame."""
    table, columns = _parse(file, blanks=True), file[1][1:]
    needed = [name != "identity" for name in columns]
    blank = np.isnan(table.value)
    partly = ~blank.all(axis=1) & blank[:, needed].any(axis=1)
    table = drop_rows(table, partly, "a measurement with empty cells")
    if "identity" in columns:
        number = table.value[:, columns.index("identity")]
        wrong = ~np.isnan(number) & (~to_integers(number) | (number < -1))
        table = drop_rows(table, wrong, "identity is not a whole number from -1")
    beyond = np.abs(table.value) > np.finfo(np.float32).max
    table = drop_rows(table, beyond.any(axis=1), "a number too large")
    if "bearing_rad" in columns:
        reason = "bearing beyond 2 pi rad (degrees? multiply by pi/180)"
        table = drop_rows(table, np.abs(table.value[:, 0]) > 2 * pi, reason, unit=True)
    if "range_m" in columns:
        table = drop_rows(table, table.value[:, 1] <= 0, "range not above 0 m")
    if "sxx" in columns:
        xx, xy, yy = table.value[:, 2:5].T
        indefinite = (xx <= 0) | (yy <= 0) | (xx * yy <= xy * xy)
        table = drop_rows(table, indefinite, "covariance is not positive definite")
    table = drop_bad_rows(table, skipped)
    order = in_order(table.time, "measurement", skipped, unique=False)
    return columns, table._replace(time=table.time[order], value=table.value[order])


def _view(value, bearing, distance):
    """The smallest view that holds all measurements."""
    if len(value) == 0:
        return -pi, pi, VIEW_RANGE
    angle = np.arctan2(value[:, 1], value[:, 0]) if bearing is None else bearing
    far = np.hypot(value[:, 0], value[:, 1]) if bearing is None else distance
    least, largest = float(angle.min()), float(angle.max())
    narrow = 0 < largest - least < 1.8 * pi
    return *((least, largest) if narrow else (-pi, pi)), VIEW_RANGE if far is None else float(
        far.max()
    )


def _truth(files, skipped):
    known = {}
    if "truth" in files:
        table = drop_bad_rows(_parse(files["truth"]), skipped)
        order = in_order(table.time, "truth row", skipped)
        known = {"time": table.time[order], "pose": table.value[order]}
    if "landmarks" in files:
        table = _parse(files["landmarks"], stamped=False)
        table = drop_rows(table, ~to_integers(table.value[:, 0]), "id is not a whole number")
        table = drop_bad_rows(table, skipped)
        known |= {"landmarks": table.value[:, 1:], "landmark_id": table.value[:, 0].astype(int)}
    return Truth(**known) if known else None
