"""The simulator's identities for extracted lines (experiments/line_truth.py)."""

from dataclasses import replace

import numpy as np
import pytest
from line_truth import identified

from jaxslam.logs.log import Log, Truth
from jaxslam.logs.truth import truth_at, wrap
from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.geometry import visible_edges

SEED, SECOND = 7, 1_000_000_000


@pytest.fixture(scope="module")
def world():
    return furnish(SEED)


@pytest.fixture
def log(world):
    """Two frames: exact bearings of all visible edges, sorted, with headings that differ."""
    pose = np.array([[2.0, 2.0, 0.3], [5.0, 2.0, -2.0]])
    bearing = [visible_edges(world, p).bearing for p in pose]
    time = np.array([0, SECOND])
    return Log(
        name="exact",
        odometry_time=time,
        odometry=np.zeros((2, 2)),
        odometry_kind="velocity",
        frame_time=time,
        frame=np.repeat([0, 1], [len(b) for b in bearing]),
        bearing=np.concatenate(bearing),
        view=(-np.pi, np.pi, 12.0),
        truth=Truth(time=time, pose=pose),
    )


def test_every_line_has_the_edge_that_is_seen_there(log, world):
    found = identified(log, world)
    assert (found.identity >= 0).all()
    pose = truth_at(log.truth, log.frame_time)[log.frame]
    to = world.edges.point[found.identity] - pose[:, :2]
    off = wrap(np.arctan2(to[:, 1], to[:, 0]) - pose[:, 2] - log.bearing)
    assert np.abs(off).max() < 1e-9
    assert np.array_equal(found.truth.identity, found.identity)
    assert np.array_equal(found.truth.landmarks, world.edges.point)


def test_no_two_lines_of_a_frame_are_one_edge(log, world):
    twice = replace(
        log, frame=np.repeat(log.frame, 2), bearing=np.repeat(log.bearing, 2), truth=log.truth
    )
    found = identified(twice, world)
    for k in (0, 1):
        named = found.identity[(twice.frame == k) & (found.identity >= 0)]
        assert len(np.unique(named)) == len(named)
        assert len(named) == (log.frame == k).sum()


def test_lines_of_no_edge_have_no_identity(log, world):
    seen = visible_edges(world, log.truth.pose[0]).bearing
    gap = np.diff(seen)
    between = seen[gap.argmax()] + gap.max() / 2
    near = seen[gap.argmax()] + np.radians(0.1)
    assert gap.max() > np.radians(1)
    two = replace(log, frame=np.array([0, 0]), bearing=np.array([near, between]))
    found = identified(two, world)
    assert found.identity[0] == visible_edges(world, log.truth.pose[0]).id[gap.argmax()]
    assert found.identity[1] == -1
