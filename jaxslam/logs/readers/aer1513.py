"""Read the log of a University of Toronto course (AER1513 `dataset2.mat`, "Lost in the Woods")."""

from math import pi
from pathlib import Path

import numpy as np

from jaxslam.logs.log import Log, Truth
from jaxslam.logs.readers.mat5 import read_variables
from jaxslam.logs.readers.text_table import LAST_STAMP_S, NANOSECONDS, in_order, pose_at

NEEDED = ("t", "v", "om", "r", "b", "d")
OPTIONAL = ("l", "x_true", "y_true", "th_true", "true_valid")
VIEW = (-2 * pi / 3, 2 * pi / 3, 6.0)  # rad, rad, m: 240 deg laser scanner, ranges to 5.6 m
STEP_NS = 1000  # stamps are rounded to the microsecond: float64 seconds are no more precise


def read_mat(path, lag=1, time_offset=0.0):
    """Read the course's `.mat`: odometry, ranges and bearings with identities, truth.

    The speed `v[k]` and yaw rate `om[k]` are stamped t[k - lag]; in the course they act on
    (t[k-1], t[k]], lag 1. `r[k, i]` and `b[k, i]` are landmark i's range and bearing at t[k] (plus
    `time_offset` s), 0 where not seen, in the frame of a scanner `d` ahead of the axle. Every step
    is a frame. The start pose is the truth at the first step (zero without truth). Raises
    `ValueError` naming the file and variable.
    """
    path, skipped = Path(path), {}
    data = _load(path)
    steps, time = _steps(path, data["t"], skipped)
    odometry = np.column_stack([data["v"], data["om"]])[steps[lag:]]
    driven = np.isfinite(odometry).all(axis=1)
    if (~driven).any():
        skipped["odometry that is not finite"] = int((~driven).sum())
    ranges, bearings = data["r"][steps], data["b"][steps]
    good = _seen(path, ranges, bearings, skipped)
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


def _steps(path, t, skipped):
    """Indices of the rows in order of time, and their stamps [ns]."""
    usable = np.isfinite(t)
    if not usable.all():
        skipped["step without a stamp"] = int((~usable).sum())
    if np.abs(t[usable]).max(initial=0) >= LAST_STAMP_S:
        raise ValueError(f"{path}: t: {NANOSECONDS}")
    time = np.round(t[usable] * (1e9 / STEP_NS)).astype(np.int64) * STEP_NS
    order = in_order(time, "step", skipped)
    if len(order) < 2:
        raise ValueError(f"{path}: t: {len(order)} usable steps; at least 2 are needed")
    return np.flatnonzero(usable)[order], time[order]


def _seen(path, ranges, bearings, skipped):
    """Mask of the valid measurements; counts the others in `skipped`."""
    measured = (ranges != 0) | (bearings != 0)
    good = measured & np.isfinite(ranges) & np.isfinite(bearings) & (ranges > 0)
    lost = int((measured & ~good).sum())
    if lost:
        skipped["range or bearing that is not finite, or range not above 0"] = lost
    if np.abs(bearings[good]).max(initial=0) > 2 * pi:
        raise ValueError(f"{path}: b: beyond 2 pi rad (degrees? multiply by pi/180)")
    return good


def _truth(data, steps, time, identity):
    """`Truth`: poses where the course calls them valid, landmarks and identities."""
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
    """Load the variables by name, each of the right shape."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        data = read_variables(path, NEEDED + OPTIONAL)
    except ValueError as err:
        raise ValueError(f"{path}: not a MATLAB file of version 5, or damaged: {err}") from err
    missing = [name for name in NEEDED if name not in data]
    if missing:
        raise ValueError(f"{path}: has no variable {', '.join(missing)}; is it the course's log?")
    for name, array in data.items():
        if array is None:
            raise ValueError(f"{path}: {name}: is not a plain array of numbers")
    return _check_shapes(path, data)


def _check_shapes(path, data):
    """Check every shape and flatten columns to vectors."""
    steps, landmarks = data["t"].size, data["r"].shape[-1]
    shapes = {"r": (steps, landmarks), "b": (steps, landmarks), "l": (landmarks, 2), "d": (1, 1)}
    for name, array in data.items():
        shape = shapes.get(name, (steps, 1))
        if array.shape != shape:
            raise ValueError(f"{path}: {name}: shape {array.shape}; must be {shape}")
        data[name] = array if name in ("r", "b", "l") else array.ravel()
    return data
