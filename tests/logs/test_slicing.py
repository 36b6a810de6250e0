"""Parts of a log: nothing lost, nothing twice, and each a log of its own."""

import dataclasses
import itertools

import numpy as np
import pytest

from jaxslam.logs.log import Log, Truth
from jaxslam.logs.log_file import load_log, save_log
from jaxslam.logs.odometry import increments
from jaxslam.logs.slicing import PER_ROW, cut, spaced, windows
from jaxslam.logs.truth import truth_at
from jaxslam.simulation import planar

S, MS = 10**9, 10**6


def drive(commands=False):
    return planar.planar(
        length_m=12.0, landmarks=12, commands=commands, mounting=(0.1, 0.0, 0.2), seed=3
    )


def logs():
    yield drive()
    yield drive(commands=True)
    yield load_log("lost-in-the-woods")


def ragged():
    """Odometry at odd times, that ends before the frames do; frames from before it began."""
    return Log(
        name="ragged",
        odometry_time=np.array([310, 500, 1700, 2200]) * MS,
        odometry=[[1.0, 0.1], [2.0, -0.4], [0.5, 1.0], [1.5, 0.3]],
        frame_time=np.array([100, 900, 1400, 2100, 2900, 4000]) * MS,
        frame=[0, 1, 1, 3, 5],
        bearing=np.linspace(-0.4, 0.4, 5),
        view=(-1.0, 1.0, 5.0),
    )


def joined(pieces):
    """The pieces' increments, one after the other."""
    parts = zip(*(increments(piece) for piece in pieces), strict=True)
    return [np.concatenate(part) for part in parts]


@pytest.mark.parametrize("log", [*logs()], ids=lambda log: log.name)
def test_windows_part_a_log(log):
    """Cut at stamps of frames, so that no interval is divided."""
    seconds = (log.frame_time[len(log.frame_time) // 3] - log.start) / S
    pieces = windows(log, seconds)
    assert len(pieces) == 3
    whole, found = increments(log), joined(pieces)
    count = len(found[0])
    for name, one, all_ in zip(whole._fields, found, whole, strict=True):
        np.testing.assert_allclose(one, all_[:count], atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(
        np.concatenate([piece.frame_time for piece in pieces]), log.frame_time[:count]
    )
    rows = log.frame < count
    first = np.cumsum([0, *(len(piece.frame_time) for piece in pieces[:-1])])
    frame = np.concatenate([p.frame + f for p, f in zip(pieces, first, strict=True)])
    np.testing.assert_array_equal(frame, log.frame[rows])
    for name in PER_ROW:
        value = getattr(log, name)
        if value is not None:
            parts = np.concatenate([getattr(piece, name) for piece in pieces])
            np.testing.assert_array_equal(parts, value[rows], err_msg=name)
    identity = np.concatenate([piece.truth.identity for piece in pieces])
    np.testing.assert_array_equal(identity, log.truth.identity[rows])
    for index, piece in enumerate(pieces):
        assert piece.start == log.start + round(index * seconds * S)
        true = truth_at(log.truth, piece.frame_time)
        np.testing.assert_array_equal(truth_at(piece.truth, piece.frame_time), true)
        assert len(piece.truth.time) < len(log.truth.time) / 2
    np.testing.assert_array_equal(pieces[0].start_pose, log.start_pose)
    for before, after in itertools.pairwise(pieces):
        end = truth_at(log.truth, before.frame_time[-1:])[0]
        np.testing.assert_allclose(after.start_pose, end, atol=1e-12)


@pytest.mark.parametrize("edge", [0.05, 0.2, 0.31, 1.0, 1.65, 2.5, 3.2])
def test_nothing_of_the_motion_is_lost_anywhere(edge):
    """Also within an interval: its halves add up to it."""
    log = ragged()
    log = dataclasses.replace(log, frame_time=np.append(log.frame_time, 5 * S))
    stamp = log.start + round(edge * S)
    marked = np.sort(np.append(log.frame_time, stamp))
    full = dataclasses.replace(log, frame_time=marked, frame=[], bearing=[])
    empty = dataclasses.replace(log, frame=[], bearing=[])
    place = int(np.searchsorted(marked, stamp))
    after = cut(empty, edge)
    for name, found, whole in zip(
        increments(full)._fields, increments(after), increments(full), strict=True
    ):
        np.testing.assert_allclose(found, whole[place + 1 :], atol=1e-12, err_msg=name)
    before = cut(full, 0, edge)
    for found, whole in zip(increments(before), increments(full), strict=True):
        np.testing.assert_allclose(found, whole[: place + 1], atol=1e-12)


def test_the_whole_is_itself():
    log = load_log("lost-in-the-woods")
    whole = cut(log)
    for name in ("frame_time", "frame", "bearing", "start_pose"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(log, name), err_msg=name)
    for one, other in zip(increments(whole), increments(log), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_a_command_that_is_under_way_is_kept_whole():
    """It begins at the stop before the cut, and so does the cut's start pose."""
    log = drive(commands=True)
    stop, after = log.odometry_time[[4, 5]]
    middle = ((stop + after) / 2 - log.start) / S
    part = cut(log, middle)
    np.testing.assert_array_equal(part.odometry[0], [0, 0])
    np.testing.assert_array_equal(part.odometry[1:], log.odometry[5:])
    np.testing.assert_allclose(part.start_pose, truth_at(log.truth, [stop])[0])
    assert part.start == log.start + round(middle * S)
    assert increments(part).dx[0] == pytest.approx(increments(log).dx[6])  # frame 0: the start


def test_start_without_truth_and_between_readings():
    log = ragged()
    log = dataclasses.replace(log, start_pose=(1, 2, 3), start_cov=np.eye(3))
    part = cut(log, 0.5, 3.0)
    np.testing.assert_array_equal(part.start_pose, np.zeros(3))
    np.testing.assert_array_equal(part.start_cov, np.zeros((3, 3)))
    first = cut(log, 0, 3.0)
    np.testing.assert_array_equal(first.start_cov, np.eye(3))
    np.testing.assert_array_equal(first.start_pose, [1, 2, 3])
    known = Truth(np.array([0, 2, 4]) * S, [[0, 0, 3], [2, 4, -3], [4, 8, -3]])
    part = cut(dataclasses.replace(log, truth=known), 0.9)  # 1 s after 0
    np.testing.assert_allclose(part.start_pose, [1, 2, -np.pi], atol=1e-9)
    short = Truth(np.array([0, 1]) * S, [[0, 0, 0], [2, 4, 1]])
    part = cut(dataclasses.replace(log, truth=short), 2.0)
    np.testing.assert_allclose(part.start_pose, [2, 4, 1])


def test_the_last_piece_is_dropped_if_shorter_than_half():
    log = drive()
    length = (log.frame_time[-1] - log.start) / S
    assert len(windows(log, length / 2.4)) == 2
    assert len(windows(log, length / 2.6)) == 3
    assert len(windows(log, 10 * length)) == 1


def test_pieces_without_frames_are_left_out():
    log = ragged()
    log = dataclasses.replace(log, frame_time=log.frame_time + np.array([0, 0, 0, 0, 0, 8]) * S)
    assert [len(piece.frame_time) for piece in windows(log, 3.0)] == [5, 1]


def test_a_cut_is_saved_and_read(tmp_path):
    part = cut(drive(), 3.0, 7.0)
    save_log(tmp_path / "part.npz", part)
    again = load_log(tmp_path / "part.npz")
    assert again.name == "planar-room-3, 3 to 7 s"
    assert again.start == part.start
    for name in ("odometry_time", "frame_time", "range", "identity", "start_pose"):
        np.testing.assert_array_equal(getattr(again, name), getattr(part, name))


@pytest.mark.parametrize(
    ("start", "end", "found"),
    [
        (-1, None, "cut from -1 to 3.9 s; must be 0 or more"),
        (2, 2, "cut from 2 to 2 s"),
        (5, None, "cut from 5 to 3.9 s"),
        (0, float("nan"), "cut from 0 to nan s"),
        (2.9, 3.5, "ragged: no frame between 2.9 and 3.5 s; it is 3.9 s long"),
    ],
)
def test_times_that_hold_nothing_are_refused(start, end, found):
    with pytest.raises(ValueError, match="^" + found):
        cut(ragged(), start, end)


@pytest.mark.parametrize("seconds", [0, -1, float("inf"), float("nan")])
def test_a_window_of_no_length_is_refused(seconds):
    with pytest.raises(ValueError, match="must be above 0"):
        windows(ragged(), seconds)


def test_frames_some_time_apart():
    log = load_log("lost-in-the-woods")
    part = spaced(log, 1.0)
    gaps = np.diff(part.frame_time) * 1e-9
    assert gaps.min() >= 1.0
    assert gaps.max() < 1.2
    kept = np.isin(log.frame_time[log.frame], part.frame_time)
    np.testing.assert_array_equal(part.range, log.range[kept])
    np.testing.assert_array_equal(part.frame_time[part.frame], log.frame_time[log.frame][kept])
    np.testing.assert_array_equal(part.odometry, log.odometry)
    # The same drive: what moves between two frames is all there.
    assert increments(part).distance.sum() == pytest.approx(
        increments(log).distance.sum(), rel=0.01
    )
    assert len(spaced(log, 0).frame) == len(log.frame)
    with pytest.raises(ValueError, match="frames -1 s apart; must be 0 or more"):
        spaced(log, -1)
