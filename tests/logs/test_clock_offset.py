"""The offset between the clocks of frames and odometry, found without identities."""

import dataclasses

import numpy as np
import pytest

from jaxslam.logs import clock_offset
from jaxslam.logs.diagnostics import check
from jaxslam.logs.log_file import load_log, save_log
from jaxslam.simulation.planar import planar


@pytest.fixture(scope="module")
def room():
    return planar("room", 1)


@pytest.mark.parametrize("seconds", [-0.4, -0.1, 0.2])
def test_the_offset_that_was_made_is_found(room, seconds):
    as_it_is = clock_offset.estimate_clock_offset(room)
    assert abs(as_it_is.seconds) < clock_offset.FINE + 0.01 and as_it_is.least < 0 < as_it_is.most
    found = clock_offset.estimate_clock_offset(clock_offset.shift_frames(room, seconds))
    assert found.seconds == pytest.approx(as_it_is.seconds - seconds, abs=0.02)
    assert found.least <= found.seconds <= found.most
    # Identities and ranges play no part.
    hidden = dataclasses.replace(room, identity=None, range=None, truth=None)
    assert clock_offset.estimate_clock_offset(hidden) == as_it_is


def test_of_very_many_bearings_some_are_enough(room):
    """A scanner's: 300 a frame, compared each with each."""
    frame = np.repeat(np.arange(len(room.frame_time)), 300)
    rng = np.random.default_rng(0)
    bearing = rng.uniform(-3, 3, len(frame))
    bearing[np.searchsorted(frame, room.frame) + np.arange(len(room.frame)) % 16] = room.bearing
    crowd = dataclasses.replace(
        room, frame=frame, bearing=bearing, range=None, identity=None, truth=None
    )
    pairs = clock_offset._pairs(crowd)
    assert max(len(part.difference) for part in pairs) <= clock_offset.MAX_DIFFERENCES + 300**2
    assert clock_offset.estimate_clock_offset(crowd) is None  # among so many something always fits


def test_nothing_is_said_where_nothing_can_be_told(room):
    rng = np.random.default_rng(0)
    noise = dataclasses.replace(room, bearing=rng.uniform(-3, 3, len(room.bearing)))
    straight = dataclasses.replace(room, odometry=room.odometry * [1, 0])
    for log in (noise, straight, planar("room", 1, length_m=3.0), planar("room", 1, commands=True)):
        assert clock_offset.estimate_clock_offset(log) is None
        assert not any("turning" in finding.text for finding in check(log))
    far = clock_offset.shift_frames(room, 2.0)
    assert clock_offset.estimate_clock_offset(far) is None


def test_check_says_it_and_convert_mends_it(room, call, at):
    log = load_log("lost-in-the-woods")
    (finding,) = [finding for finding in check(log) if "turning" in finding.text]
    assert finding.severity == "ok" and "best when moved by -0.1" in finding.text
    save_log("late.npz", clock_offset.shift_frames(room, 0.4))
    code, out, _ = call("check", "late.npz")
    assert code == 1 and "best when moved by -0." in out and "--time-offset" in out
    assert call("convert", "late.npz", "mended.npz", "--time-offset", "-0.4")[0] == 0
    mended = load_log("mended.npz")
    np.testing.assert_array_equal(mended.frame_time, room.frame_time)
    assert mended.time_offset == pytest.approx(0)
    assert "best as stamped" in call("check", "mended.npz")[1]


def test_an_offset_that_is_no_number_is_refused(room, refuse, at):
    save_log("room.npz", room)
    line = refuse("convert", "room.npz", "out.npz", "--time-offset", "nan")
    assert "time offset nan s; must be a number of seconds" in line
