"""The University of Toronto course's log (AER1513 `dataset2.mat`, "Lost in the Woods")."""

from math import pi
from pathlib import Path

import numpy as np
import scipy.io

from jaxslam.log import Log, Truth
from jaxslam.readers.table import in_order, pose_at

NEEDED = ("t", "v", "om", "r", "b", "d")
OPTIONAL = ("l", "x_true", "y_true", "th_true", "true_valid")
MAX_NUMBERS = 1 << 26
VIEW = (-2 * pi / 3, 2 * pi / 3, 6.0)  # rad, rad, m: 240 deg laser scanner, 5.6 m seen at most
STEP_NS = 1000  # stamps are read to the microsecond: float64 seconds hold no more that is meant


def read_mat(path, lag=1, time_offset=0.0):
    """`Log` of the course's `.mat`: odometry, ranges and bearings with identities, truth.

    The speed `v[k]` and yaw rate `om[k]` are stamped t[k - lag]: the course lets them act on
    (t[k-1], t[k]], lag 1. `r[k, i]` and `b[k, i]` are landmark i's range and bearing at t[k] (plus
    `time_offset` s), 0 where not seen, in the frame of a scanner `d` ahead of the axle. Every step
    is a frame. The start pose is the truth at the first step (zero without). Raises `ValueError`
    naming the file and variable.
    """
    path = Path(path)
    data = _load(path)
    skipped = {}
    usable = np.isfinite(data["t"])
    if (~usable).any():
        skipped["step without a stamp"] = int((~usable).sum())
    if np.abs(data["t"][usable]).max(initial=0) >= 9e9:
        raise ValueError(f"{path}: t: is not in seconds (nanoseconds? divide them by 1e9)")
    time = np.round(data["t"][usable] * (1e9 / STEP_NS)).astype(np.int64) * STEP_NS
    order = in_order(time, "step", skipped)
    steps, time = np.flatnonzero(usable)[order], time[order]
    if len(steps) < 2:
        raise ValueError(f"{path}: t: {len(steps)} usable steps; at least 2 are needed")
    odometry = np.column_stack([data["v"], data["om"]])[steps[lag:]]
    driven = np.isfinite(odometry).all(axis=1)
    if (~driven).any():
        skipped["odometry that is not finite"] = int((~driven).sum())
    ranges, bearings = data["r"][steps], data["b"][steps]
    seen = (ranges != 0) | (bearings != 0)
    good = seen & np.isfinite(ranges) & np.isfinite(bearings) & (ranges > 0)
    if (seen & ~good).any():
        skipped["range or bearing that is not finite, or range not above 0"] = int(
            (seen & ~good).sum()
        )
    if np.abs(bearings[good]).max(initial=0) > 2 * pi:
        raise ValueError(f"{path}: b: beyond 2 pi rad (degrees? multiply by pi/180)")
    frame, identity = np.nonzero(good)
    truth = _truth(data, steps, time, identity)
    start = None if truth.time is None else pose_at(time[0], truth.time, truth.pose)
    return Log(
        name=path.stem,
        odometry_time=time[: len(driven)][driven],
        odometry=odometry[driven],
        frame_time=time + round(time_offset * 1e9),
        frame=frame,
        bearing=bearings[good],
        range=ranges[good],
        identity=identity,
        view=VIEW,
        mounting=(data["d"].item(), 0.0, 0.0),
        time_offset=time_offset,
        start_pose=np.zeros(3) if start is None else start,
        truth=truth,
        skipped=skipped,
    )


def _truth(data, steps, time, identity):
    """Poses where the course calls them valid, landmarks and identities."""
    known = {}
    if {"x_true", "y_true", "th_true"} <= set(data):
        pose = np.column_stack([data["x_true"], data["y_true"], data["th_true"]])[steps]
        valid = np.isfinite(pose).all(axis=1)
        if "true_valid" in data:
            valid &= data["true_valid"][steps] != 0
        known = {"time": time[valid], "pose": pose[valid]} if valid.any() else {}
    if "l" in data:
        known |= {"landmarks": data["l"], "landmark_id": np.arange(len(data["l"]))}
    return Truth(**known, identity=identity)


def _load(path):
    """Variables by name, shapes and sizes checked before they are read."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        listed = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(path)}
        sizes = {name: np.prod(listed[name][0], dtype=float) for name in listed}
        wanted = [name for name in NEEDED + OPTIONAL if name in listed]
        small = sum(sizes[name] for name in wanted) <= MAX_NUMBERS
        data = scipy.io.loadmat(path, variable_names=wanted) if small else {}
    except Exception as err:  # foreign bytes: scipy raises whatever it likes
        reason = (str(err).splitlines() or [type(err).__name__])[0]
        raise ValueError(f"{path}: not a MATLAB file of version 5, or damaged: {reason}") from err
    missing = [name for name in NEEDED if name not in wanted]
    if missing:
        raise ValueError(f"{path}: has no variable {', '.join(missing)}; is it the course's log?")
    if not small:
        raise ValueError(f"{path}: more than {MAX_NUMBERS} numbers")
    for name in wanted:
        plain = isinstance(data[name], np.ndarray) and data[name].dtype.kind in "iufb"
        if not plain:
            raise ValueError(f"{path}: {name}: is not a plain array of numbers")
    return _shaped(path, {name: np.asarray(data[name], float) for name in wanted})


def _shaped(path, data):
    """Columns as vectors, after a look at every shape."""
    steps, landmarks = data["t"].size, data["r"].shape[-1]
    shapes = {"r": (steps, landmarks), "b": (steps, landmarks), "l": (landmarks, 2), "d": (1, 1)}
    for name, array in data.items():
        shape = shapes.get(name, (steps, 1))
        if array.shape != shape:
            raise ValueError(f"{path}: {name}: shape {array.shape}; must be {shape}")
        data[name] = array if name in ("r", "b", "l") else array.ravel()
    return data
