"""Matching lines of two frames: precision and recall in changing light, and what makes them."""

import numpy as np
import pytest

from jaxslam.vision.lines import Lines
from jaxslam.vision.matching import assign_pairs, light_gain, match

ROOM = (10.0, 4.0)
SIGMA = 0.002  # rad
HEIGHT = 0.6  # m of the camera


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Scene:
    """Edges on the walls of a room: some alone, some in pairs 6 cm apart as door frames have.

    The colour between two neighbours is one surface's, so that they share it.
    """

    def __init__(self, seed, doors=8, alone=24):
        rng = np.random.default_rng(seed)
        around = 2 * sum(ROOM)
        alone = (np.arange(alone) + rng.uniform(0.2, 0.8, alone)) * around / alone
        doors = rng.uniform(0, around, doors)
        place = np.sort(np.concatenate([alone, doors, doors + 0.06]))
        corners = np.array([(0, 0), (ROOM[0], 0), ROOM, (0, ROOM[1]), (0, 0)])
        path = np.cumsum([0, ROOM[0], ROOM[1], ROOM[0], ROOM[1]])
        wrapped = place % around
        self.point = np.column_stack([np.interp(wrapped, path, column) for column in corners.T])
        surface = rng.uniform(0.15, 0.85, (len(place), 3))  # to the right of each edge
        # Walls are walked counter-clockwise, so bearings grow along them: left of an edge is next.
        self.right, self.left = np.roll(surface, 1, axis=0), surface
        self.low = rng.uniform(-0.6, 0.2, len(place))  # m, above the camera
        self.high = self.low + rng.uniform(0.6, 2.0, len(place))

    def look(self, rng, pose, gain, seen=0.92):
        """`Lines` from a pose in light of a gain [3], and the true edge of each."""
        dx, dy = (self.point - pose[:2]).T
        r = np.hypot(dx, dy)
        edge = np.flatnonzero(rng.random(len(r)) < seen)
        bearing = wrap(np.arctan2(dy, dx) - pose[2] + SIGMA * rng.standard_normal(len(r)))[edge]
        colour = np.stack([self.left, self.right], 1)[edge] * gain
        colour = np.clip(colour + 0.02 * rng.standard_normal(colour.shape), 0, 1)
        brighter = self.left.mean(1) > self.right.mean(1)
        ends = [
            np.arctan(h / r) + 0.01 * rng.standard_normal(len(r)) for h in (self.low, self.high)
        ]
        order = np.argsort(bearing)
        edge = edge[order]
        polarity = np.where(brighter, 1, -1)[edge]
        sigma, strength = np.full(len(edge), SIGMA), np.ones(len(edge))
        lines = Lines(bearing[order], sigma, ends[0][edge], ends[1][edge], polarity,
                      colour[order].astype(np.float32), strength)  # fmt: skip
        return lines, edge


def drive(seed, step, frames=60):
    """Frames on a path round the room with light that changes; the motion as odometry says it."""
    rng, scene = np.random.default_rng(seed), Scene(seed)
    pose, before, motion = np.array([2.0, 1.2, 0.1]), None, None
    for _ in range(frames):
        gain = np.exp(0.15 * rng.standard_normal() + 0.05 * rng.standard_normal(3))
        now = scene.look(rng, pose, gain)
        if before is not None:
            yield *before, *now, motion
        turn = rng.normal(0.0, 0.15)
        ahead = pose[:2] + step * np.array([np.cos(pose[2]), np.sin(pose[2])])
        if not 0.8 < ahead[0] < 9.2 or not 0.8 < ahead[1] < 3.2:
            turn, ahead = wrap(np.arctan2(2 - pose[1], 5 - pose[0]) - pose[2]), pose[:2]
        moved = np.hypot(*(ahead - pose[:2]))
        pose = np.array([*ahead, wrap(pose[2] + turn)])
        motion = (moved * (1 + 0.02 * rng.standard_normal()), 0.0, turn + rng.normal(0, 0.005))
        before = now


def scores(step, **settings):
    """Precision and recall over three rooms."""
    right = given = possible = 0
    for seed in range(3):
        for a, edge_a, b, edge_b, motion in drive(seed, step):
            pairs = match(a, b, motion, **settings)
            right += (edge_a[pairs[:, 0]] == edge_b[pairs[:, 1]]).sum()
            given += len(pairs)
            possible += len(np.intersect1d(edge_a, edge_b))
    return right / given, right / possible


@pytest.mark.parametrize(("step", "least"), [(0.1, 0.98), (0.2, 0.96)])
def test_precision_and_recall_under_changing_light(step, least):
    precision, recall = scores(step)
    assert precision >= least
    assert recall >= least


def test_colour_is_what_makes_it_work():
    precision, recall = scores(0.2, use_colour=False)
    assert precision < 0.93
    assert recall < 0.93


def lines(bearing, colour=0.5, polarity=1, low=-0.1, high=0.5, sigma=SIGMA):
    n = len(bearing)
    colour = np.broadcast_to(np.asarray(colour, float).reshape(-1, 1, 1), (n, 2, 3))
    return Lines(
        np.asarray(bearing, float), np.full(n, sigma), np.full(n, low), np.full(n, high),
        np.broadcast_to(polarity, n), colour.astype(np.float32), np.ones(n),
    )  # fmt: skip


def after(bearing, depth, motion):
    """Bearings from which marks at a bearing and depth are seen after the motion."""
    x, y = depth * np.cos(bearing) - motion[0], depth * np.sin(bearing) - motion[1]
    return wrap(np.arctan2(y, x) - motion[2])


def test_lines_move_from_front_to_back():
    motion = (0.2, 0.0, 0.0)
    side = np.array([1.0, -1.0])  # left and right
    near = after(side, 1.0, motion)
    assert near[0] > side[0] and near[1] < side[1]
    assert len(match(lines(side), lines(near), motion)) == 2
    assert len(match(lines(side), lines(side), motion)) == 2  # at infinity
    assert len(match(lines(side), lines(2 * side - near), motion)) == 0  # back to front


def test_a_pure_turn_shifts_every_line_by_the_turn():
    b = np.sort(np.random.default_rng(3).uniform(-np.pi, np.pi, 40))
    turned = wrap(b - 0.7)
    pairs = match(lines(b), lines(turned), (0.0, 0.0, 0.7))
    assert np.array_equal(pairs, np.column_stack([np.arange(40)] * 2))
    assert len(match(lines([0.0]), lines([0.3]), (0.0, 0.0, 0.0))) == 0


def test_across_the_seam():
    b = np.array([-3.1, 3.1])
    motion = (0.3, 0.0, 0.05)
    pairs = match(lines(b), lines(after(b, 2.0, motion)), motion)
    assert pairs.tolist() == [[0, 0], [1, 1]]


def test_edges_of_a_door_frame_keep_to_their_own():
    """6 cm apart at 2 m; both move by more than they are apart."""
    b, motion = np.array([1.55, 1.58]), (0.2, 0.0, 0.0)
    seen = after(b, 2.0, motion)
    assert seen[0] - b[0] > b[1] - b[0]
    frame = lines(b, polarity=np.array([1, -1]))
    pairs = match(frame, lines(seen, polarity=np.array([1, -1])), motion)
    assert pairs.tolist() == [[0, 0], [1, 1]]
    pairs = match(frame, lines(seen[1:], polarity=np.array([-1])), motion)
    assert pairs.tolist() == [[1, 0]]  # the other one was not seen
    alike = match(lines(b), lines(seen), motion)
    assert alike.tolist() == [[0, 0], [1, 1]]  # in order, though nothing tells them apart


def test_what_is_known_of_the_depth_narrows_the_search():
    b, motion = np.array([1.5]), (0.4, 0.0, 0.0)
    both = after(b, np.array([1.0, 2.0]), motion)
    for depth, want in ((1.0, 0), (2.0, 1)):
        known = np.array([[0.9, 1.1]]) / depth
        assert match(lines(b), lines(both), motion, inverse_depth=known).tolist() == [[0, want]]
    nothing = np.array([[0.0, 0.2]])
    assert len(match(lines(b), lines(both), motion, inverse_depth=nothing)) == 0


def test_every_line_may_have_a_motion_of_its_own():
    b = np.array([0.5, 1.5, -2.0])
    motions = np.array([[0.2, 0.0, 0.1], [0.4, 0.1, -0.2], [0.6, 0.0, 0.3]])
    seen = np.array([after(x, 2.0, m) for x, m in zip(b, motions, strict=True)])
    order = np.argsort(seen)
    pairs = match(lines(b), lines(seen[order]), motions)
    assert np.array_equal(order[pairs[:, 1]], pairs[:, 0])
    assert len(pairs) == 3


def test_the_light_is_found_from_lines_that_are_partly_wrong():
    rng = np.random.default_rng(0)
    before, gain = rng.uniform(0.1, 0.6, (30, 2, 3)), np.array([1.5, 1.2, 0.8])
    now = before * gain
    cost = np.full((30, 30), 50.0)
    np.fill_diagonal(cost, 1.0)
    now[:8] = rng.uniform(0, 1, (8, 2, 3))
    np.testing.assert_allclose(light_gain(before, now, cost), gain, rtol=0.05)
    assert light_gain(before, now, np.full((30, 30), 50.0)).tolist() == [1, 1, 1]


def test_assignment_is_one_to_one_and_leaves_what_is_dear():
    cost = np.array([[1.0, 2.0, 90.0], [1.5, 9.0, 90.0], [90.0, 90.0, 21.0]])
    assert assign_pairs(cost, 5.0).tolist() == [[0, 1], [1, 0]]
    assert assign_pairs(cost, 12.0).tolist() == [[0, 1], [1, 0], [2, 2]]


@pytest.mark.parametrize(("a", "b"), [([], [0.1]), ([0.1], []), ([], [])])
def test_no_lines_no_pairs(a, b):
    assert match(lines(a), lines(b), (0.1, 0.0, 0.0)).shape == (0, 2)
