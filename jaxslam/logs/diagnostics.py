"""Describe what is in a log and what looks wrong with it: `jaxslam check`. No JAX."""

from typing import NamedTuple

import numpy as np

from jaxslam.config import SENSORS
from jaxslam.logs import clock_offset
from jaxslam.logs.log import NOT_USED

MAX_SPEED = 5.0  # m/s
MAX_YAW_RATE = 10.0  # rad/s
MAX_RANGE = 1000.0  # m
MAX_OFFSET_S = 0.25
SAME_CLOCK_S = 0.03  # parallax alone makes offsets up to this
LONG_RUN_S = 7 * 86400.0
MAX_RATE_HZ = 1e5
LEVELS = ("ok", "warning", "error")


class Finding(NamedTuple):
    severity: str  # ok, warning or error
    text: str  # one line


def check(log):
    """List the `Finding`s on a log: counts, rates, gaps, lost rows, implausible units, truth
    against odometry.

    A `Log` is already well formed (shapes, finite, stamps in order); this checks what its numbers
    mean.
    """
    findings = [*_measurements(log), *_odometry(log), *_time(log), *_clocks(log), *_lost(log)]
    findings += [*_view(log), *_identities(log), *_appearances(log), *_truth(log)]
    return findings


def status(findings):
    """Exit code of findings: 0 all ok, 1 warnings, 2 errors."""
    return max((LEVELS.index(finding.severity) for finding in findings), default=0)


def _finding(bad, text, severity="warning", hint=""):
    return Finding(severity, text + hint) if bad else Finding("ok", text)


def _rate(time):
    """Rows per second [Hz] and time span [s]."""
    span = float(time[-1] - time[0]) / 1e9
    return (len(time) - 1) / span if span > 0 else 0.0, span


def _measurements(log):
    frames, n = len(log.frame_time), len(log.frame)
    rate, span = _rate(log.frame_time)
    count = np.bincount(log.frame, minlength=frames)
    yield Finding("ok", f"{frames} frames over {span:.1f} s ({rate:.1f} Hz)")
    empty = 100 * float((count == 0).mean())
    each = f"{n / frames:.1f} per frame, at most {count.max()}; {empty:.1f} % of frames empty"
    yield _finding(n == 0, f"{n} measurements ({each})", "error")
    sensors = [name for name in SENSORS if log.has(name)]
    yield Finding("ok", f"sensors it can supply: {', '.join(sensors)}")
    if log.point is not None and n:
        yield from _points(log)


def _points(log):
    has_point = np.isfinite(log.point[:, 0])
    text = f"{has_point.sum()} of {len(has_point)} measurements have a point"
    if log.point_baseline is not None and np.isfinite(log.point_baseline).any():
        text += f", over {np.nanmedian(log.point_baseline):.2f} m of odometry in the median"
    yield _finding(not has_point.any(), text)


def _odometry(log):
    velocity = log.odometry_kind == "velocity"
    rate, span = _rate(log.odometry_time)
    what = "odometry rows" if velocity else "commands"
    yield Finding("ok", f"{len(log.odometry)} {what} over {span:.1f} s ({rate:.1f} Hz)")
    forward, turn = np.abs(log.odometry).max(axis=0)
    if velocity:
        hint = f", above {MAX_SPEED:g}: millimetres taken for metres?"
        yield _finding(forward > MAX_SPEED, f"largest speed {forward:.2f} m/s", hint=hint)
        hint = f", above {MAX_YAW_RATE:g}: degrees taken for radians?"
        yield _finding(turn > MAX_YAW_RATE, f"largest yaw rate {turn:.2f} rad/s", hint=hint)
    else:
        text = f"longest command {forward:.2f} m, largest turn {turn:.2f} rad"
        hint = f", above {MAX_RANGE:g} or 2 pi: millimetres, degrees?"
        yield _finding(turn > 2 * np.pi or forward > MAX_RANGE, text, hint=hint)
    if forward == 0 and turn == 0:
        yield Finding("warning", "the odometry says that the robot never moved")


def _time(log):
    span = _rate(log.frame_time)[1]
    if span > LONG_RUN_S:
        yield Finding("error", f"frames span {span:.3g} s: stamps are int64 nanoseconds")
    elif _rate(log.frame_time)[0] > MAX_RATE_HZ or _rate(log.odometry_time)[0] > MAX_RATE_HZ:
        yield Finding(
            "error", f"frames span {span:.3g} s: are the stamps seconds, not nanoseconds?"
        )
    first, last = int(log.odometry_time[0]), int(log.odometry_time[-1])
    if last < log.frame_time[0] or first > log.frame_time[-1]:
        yield Finding("error", "odometry and frames do not overlap in time: two clocks?")
    else:
        usual = _gaps(log.odometry_time)[0]
        late = int((log.frame_time > last + max(1.0, 10 * usual) * 1e9).sum())
        early = int((log.frame_time < first).sum())
        early -= early and log.odometry_kind == "command"  # the frame before the first command
        text = f"{early} frames before the first odometry, {late} well after the last"
        yield _finding(early + late > 0.01 * len(log.frame_time), text)
    for what, time, long in (("odometry", log.odometry_time, 1.0), ("frames", log.frame_time, 60)):
        if what == "odometry" and log.odometry_kind == "command":
            continue
        usual, longest, since = _gaps(time)
        text = f"{what}: usual step {usual:.3f} s, longest gap {longest:.3f} s"
        when = f" at {since - log.start / 1e9:.1f} s" if longest > 0 else ""
        yield _finding(longest > max(long, 10 * usual), text + when)


def _clocks(log):
    offset = clock_offset.estimate_clock_offset(log)
    if offset is not None:
        text = f"best as stamped ({offset.least:.2f} to {offset.most:.2f} s by parts of the log)"
        if abs(offset.seconds) > SAME_CLOCK_S:
            text = text.replace("as stamped", f"when moved by {offset.seconds:.2f} s")
            text += "; jaxslam convert LOG OUT.npz --time-offset S moves them"
        text = f"frames fit the odometry's turning {text}"
        yield _finding(abs(offset.seconds) > MAX_OFFSET_S, text, hint=": one clock is late?")


def _gaps(time):
    """Median step, longest step and its start [s]."""
    if len(time) < 2:
        return 0.0, 0.0, 0.0
    steps = np.diff(time) / 1e9
    return float(np.median(steps)), float(steps.max()), float(time[np.argmax(steps)] / 1e9)


def _lost(log):
    if not log.skipped:
        yield Finding("ok", "the reader skipped nothing: no bad rows, no duplicates, no reorders")
    for reason, count in log.skipped.items():
        yield _finding(not reason.startswith(NOT_USED), f"{count} rows: {reason}")


def _view(log):
    least, largest, reach = log.view
    hint = f", above {MAX_RANGE:g} m: millimetres taken for metres?"
    text = f"view {least:.2f}..{largest:.2f} rad to {reach:g} m"
    yield _finding(reach > MAX_RANGE, text, hint=hint)
    bearing = log.bearing if log.bearing is not None else np.arctan2(*log.point.T[::-1])
    if len(bearing) == 0:
        return
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    outside = (bearing < least - 0.02) | (bearing > largest + 0.02)
    if log.has("position"):
        distance = log.range if log.range is not None else np.hypot(*log.point.T)
        outside |= distance > 1.05 * reach
        far = float(np.nanmax(distance))
        yield _finding(far > MAX_RANGE, f"ranges {np.nanmin(distance):.2f}..{far:.2f} m", hint=hint)
    share = 100 * float(outside.mean())
    yield _finding(share > 1.0, f"{share:.1f} % of measurements are outside the declared view")


def _identities(log):
    if log.identity is None or not (log.identity >= 0).any():
        yield Finding("ok", "no measured identities: association 'known' is not possible")
        return
    known = log.identity >= 0
    pairs = np.column_stack([log.frame[known], log.identity[known]])
    twice = len(pairs) - len(np.unique(pairs, axis=0))
    yield Finding("ok", f"{len(np.unique(log.identity[known]))} measured identities")
    yield _finding(twice > 0, f"{twice} measurements repeat an identity of their frame")


def _appearances(log):
    if log.descriptor is not None and len(log.frame):
        count = len(log.appearance_space.within)
        text = f"descriptors of {log.descriptor.shape[1]} columns: "
        text += f"{count} coordinates tell" if count else "tell no"
        yield Finding("ok", text + " landmarks apart")


def _truth(log):
    truth = log.truth
    if truth is None or truth.time is None or len(truth.time) == 0:
        yield Finding("ok", "no true poses")
        return
    inside = (log.frame_time >= truth.time[0]) & (log.frame_time <= truth.time[-1])
    share = 100 * float(inside.mean())
    yield _finding(
        share == 0, f"{len(truth.time)} true poses; {share:.0f} % of frames in their time"
    )
    nearest = int(np.argmin(np.abs(truth.time - log.start)))
    apart = float(np.hypot(*(truth.pose[nearest, :2] - log.start_pose[:2])))
    later = abs(int(truth.time[nearest]) - log.start) / 1e9
    if later < 1:
        fastest = float(np.abs(log.odometry[:, 0]).max())
        driven = 1.2 * fastest * (later if log.odometry_kind == "velocity" else 1.0)
        spread = 3 * float(np.sqrt(np.trace(log.start_cov[:2, :2])))
        allowed = max(0.1, truth.resolution) + driven + spread
        yield _finding(apart > allowed, f"start pose is {apart:.2f} m from the truth there")
    if share > 0 and _rate(truth.time)[1] < LONG_RUN_S:
        yield from _paths(log)


def _paths(log):
    """Length of the path by odometry and in truth, between true poses a second apart."""
    time, pose = log.truth.time, log.truth.pose
    chosen = np.unique(np.searchsorted(time, np.arange(time[0], time[-1] + 1, 10**9)))
    chords = np.hypot(*np.diff(pose[chosen, :2], axis=0).T)
    if log.odometry_kind == "velocity":
        steps = np.abs(log.odometry[:-1, 0]) * np.diff(log.odometry_time) / 1e9
        driven = np.interp(time[chosen], log.odometry_time, np.append(0.0, np.cumsum(steps)))
    else:
        sums = np.append(0.0, np.cumsum(np.abs(log.odometry[:, 0])))
        driven = sums[np.searchsorted(log.odometry_time, time[chosen], side="right")]
    true, measured = float(chords.sum()), float(np.diff(driven).sum())
    if true < 1.0 or len(chords) == 0 or chords.mean() < 4 * log.truth.resolution:
        return
    text = f"path {measured:.1f} m by odometry, {true:.1f} m in truth"
    if not true / 10 < measured < true * 10:
        yield Finding("error", text + ": one of them is not in metres or seconds")
    else:
        yield _finding(not 0.75 * true < measured < 1.33 * true, text)
