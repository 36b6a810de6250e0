"""Read one robot's log of the MRCLAM data sets.

UTIAS Multi-Robot Cooperative Localization and Mapping (Leung et al., IJRR 2011).
"""

import re
from pathlib import Path

import numpy as np

from jaxslam.logs.log import NOT_USED, Log, Truth
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

ROBOTS = 5  # subjects 1-5 are robots, those above landmarks
VIEW = (-0.60, 0.60, 9.0)  # rad, rad, m: the camera's field of view


def read_mrclam(folder, robot=None):
    """Read the `Log` of one robot in an MRCLAM folder; `robot` may be None if there is only one.

    Odometry is the commanded velocity. Every stamp of the measurement file is a frame, also where
    only other robots were seen. Identities are subject numbers, looked up by barcode. The start
    pose is the truth at the start (zero where truth does not reach it); truth is optional. In the
    published Dataset 1 the true positions of landmarks 11 and 17 are exchanged. Raises
    `ValueError`.
    """
    folder = Path(folder)
    robot = _robot(folder, robot)
    skipped = {}
    odometry = _table(folder / f"Robot{robot}_Odometry.dat", 3, skipped)
    order = in_order(odometry.time, "odometry row", skipped)
    measured = _measurements(folder / f"Robot{robot}_Measurement.dat", skipped)
    subject = _subjects(folder / "Barcodes.dat", measured.value[:, 0].astype(np.int64), skipped)
    frame_time, frame = np.unique(measured.time, return_inverse=True)
    used = subject > ROBOTS
    truth = _truth(folder, robot, subject[used], skipped)
    start = min(odometry.time.min(), frame_time[0])
    pose = None if truth.time is None else pose_at(start, truth.time, truth.pose)
    return Log(
        name=f"{folder.name}-robot{robot}",
        odometry_time=odometry.time[order],
        odometry=odometry.value[order],
        frame_time=frame_time,
        frame=frame[used],
        bearing=measured.value[used, 2],
        range=measured.value[used, 1],
        identity=subject[used],
        view=VIEW,
        start_pose=np.zeros(3) if pose is None else pose,
        truth=truth,
        skipped=skipped,
    )


def _robot(folder, robot):
    names = [re.fullmatch(r"Robot(\d+)_Odometry\.dat", file.name) for file in folder.iterdir()]
    robots = sorted(int(name[1]) for name in names if name)
    if robot is None and len(robots) == 1:
        return robots[0]
    if robot not in robots:
        what = "choose a robot" if robot is None else f"no robot {robot}"
        raise ValueError(f"{folder}: {what}; there are {', '.join(map(str, robots)) or 'none'}")
    return robot


def _table(path, width, skipped, ids=0):
    """Read rows that begin with a stamp, or with `ids` whole numbers."""
    lines, complete = read_lines(path)
    table = parse(path, lines, width, complete, stamped=not ids)
    wrong = ~to_integers(table.value[:, :ids]).all(axis=1)
    return drop_bad_rows(drop_rows(table, wrong, "number is not whole"), skipped)


def _measurements(path, skipped):
    """Read barcode, range and bearing, in order of time."""
    lines, complete = read_lines(path)
    table = parse(path, lines, 4, complete)
    code, distance, bearing = table.value.T
    degrees = np.abs(bearing) > 2 * np.pi
    table = drop_rows(table, degrees, "bearing beyond 2 pi rad (degrees? times pi/180)", unit=True)
    code, distance, bearing = table.value.T
    wrong = (distance <= 0) | ~to_integers(code)
    table = drop_rows(table, wrong, "range not above 0 m, or barcode not a whole number")
    table = drop_bad_rows(table, skipped)
    order = in_order(table.time, "measurement", skipped, unique=False)
    value = table.value[order]
    value[:, 2] = wrap_bearings(value[:, 2])
    return table._replace(line=table.line[order], time=table.time[order], value=value)


def _subjects(path, codes, skipped):
    """Subject of each barcode, 0 if it is not listed; counts in `skipped` what is no landmark."""
    table = _table(path, 2, skipped, ids=2)
    subjects = {int(code): int(subject) for subject, code in table.value}
    if len(subjects) != len(table.value):
        raise ValueError(f"{path}: two subjects have the same barcode")
    subject = np.array([subjects.get(code, 0) for code in codes.tolist()], np.int64)
    robots = int(((subject > 0) & (subject <= ROBOTS)).sum())
    if robots:
        skipped[NOT_USED + "measurement of another robot"] = robots
    if (subject == 0).any():
        unknown = sorted(set(codes[subject == 0].tolist()))
        listed = ", ".join(map(str, unknown[:5])) + (", ..." if len(unknown) > 5 else "")
        skipped[f"measurement of an unknown barcode ({listed})"] = int((subject == 0).sum())
    return subject


def _truth(folder, robot, identity, skipped):
    known = {}
    path = folder / f"Robot{robot}_Groundtruth.dat"
    if path.exists():
        table = _table(path, 4, skipped)
        order = in_order(table.time, "truth row", skipped)
        known = {"time": table.time[order], "pose": table.value[order]}
    path = folder / "Landmark_Groundtruth.dat"
    if path.exists():
        table = _table(path, 5, skipped, ids=1)
        known |= {"landmarks": table.value[:, 1:3], "landmark_id": table.value[:, 0].astype(int)}
    return Truth(**known, identity=identity)
