"""The furnished room: its edges and their visibility against plain ray casting, and the drive."""

import numpy as np
import pytest

from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.geometry import HEIGHT, VIEW, eye_at, trace_rays, visible_edges
from jaxslam.simulation.room.trajectory import RADIUS, stop_and_go

POSITION = (0.05, -0.02, 0.6)


@pytest.fixture(scope="module")
def rooms():
    return {seed: furnish(seed) for seed in range(4)}


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def nearest_hit(world, eye, azimuth, elevation):
    """Distance over ground to the first thing one ray meets: every rectangle, one by one."""
    d, slope, best = np.array([np.cos(azimuth), np.sin(azimuth)]), np.tan(elevation), np.inf
    for level in (0.0, HEIGHT):
        if (level - eye[2]) * slope > 0:
            best = min(best, (level - eye[2]) / slope)
    for face in world.faces:
        # both sides count: a box's back is hidden by its front
        matrix = np.column_stack([d, face.start - face.end])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        t, s = np.linalg.solve(matrix, face.start - eye[:2])
        if t > 0 and -1e-12 <= s <= 1 + 1e-12 and face.bottom <= eye[2] + t * slope <= face.top:
            best = min(best, t)
    return best


def test_enough_edges_and_the_doors_are_6_cm_wide(rooms):
    for world in rooms.values():
        edges = world.edges
        assert edges.landmark.sum() >= 40
        assert np.all(edges.top > edges.bottom)
        assert np.all((edges.top - edges.bottom >= 0.4) | ~edges.landmark)
        doors = edges.point[edges.kind == "door"]
        assert len(doors) == 8
        gap = np.linalg.norm(doors[:, None] - doors, axis=-1) + 9 * np.eye(8)
        np.testing.assert_allclose(gap.min(1), 0.06, atol=1e-9)
        gap = np.linalg.norm(edges.point[:, None] - edges.point, axis=-1)
        tall = edges.landmark[:, None] & edges.landmark & ~np.eye(len(gap), dtype=bool)
        assert gap[tall].min() > 0.03  # no landmark twice


def test_visible_edges_against_one_ray_at_a_time(rooms):
    """Just beside an edge's visible piece a ray reaches it or passes; below and above it does not
    meet anything at its distance."""
    world, rng = rooms[0], np.random.default_rng(1)
    poses = stop_and_go(seed=0, length=15.0).pose
    for pose in poses[rng.choice(len(poses), 4, replace=False)]:
        eye = eye_at(pose, POSITION)
        view = visible_edges(world, pose, POSITION)
        to = world.edges.point - eye[:2]
        distance, azimuth = np.hypot(*to.T), np.arctan2(to[:, 1], to[:, 0])
        assert np.all(np.diff(view.bearing) >= 0)
        np.testing.assert_allclose(wrap(view.bearing + pose[2] - azimuth[view.id]), 0, atol=1e-12)
        np.testing.assert_allclose(view.distance, distance[view.id])
        seen = dict(zip(view.id.tolist(), zip(view.low, view.high, strict=True), strict=True))
        for i in rng.choice(len(distance), 40, replace=False).tolist():
            low = np.arctan((world.edges.bottom[i] - eye[2]) / distance[i])
            high = np.arctan((world.edges.top[i] - eye[2]) / distance[i])
            low, high = max(low, VIEW[0]), min(high, VIEW[1])
            if high <= low:
                assert i not in seen
                continue
            for elevation in np.linspace(low, high, 9)[1:-1]:
                free = nearest_hit(world, eye, azimuth[i], elevation) > distance[i] - 1e-6
                piece = seen.get(i, (np.inf, -np.inf))
                inside = piece[0] < elevation < piece[1]
                near_end = min(abs(elevation - end) for end in piece) < 1e-6
                assert near_end or free == inside, (i, elevation, piece)


def test_look_meets_the_nearest_thing(rooms):
    world, rng = rooms[2], np.random.default_rng(2)
    eye = np.array([2.0, 1.0, 1.4])  # above the low furniture: its tops are seen too
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 200), rng.uniform(*VIEW, 200)
    distance, colour = trace_rays(world, eye, azimuth, elevation)
    plain = [nearest_hit(world, eye, a, e) for a, e in zip(azimuth, elevation, strict=True)]
    # tops are not among the vertical rectangles, and stop a ray before its next hit
    assert np.mean(np.abs(distance - plain) < 1e-9) > 0.95
    assert np.all(distance <= np.array(plain) + 1e-9)
    assert np.all((colour >= 0) & (colour <= 1))
    assert np.ptp(colour) > 0.3


def test_contrast_knows_edges_that_do_not_show():
    def share(plain):
        world = furnish(3, plain=plain)
        views = [visible_edges(world, (x, 1.0, 0.0)) for x in (2.0, 4.0, 6.0, 8.0)]
        low = [view.contrast[world.edges.landmark[view.id]] < 0.05 for view in views]
        return np.mean(np.concatenate(low))

    assert share(0.0) > 0.02  # corners of the walls
    assert share(1.0) > 1.5 * share(0.0)


def test_turning_on_the_spot_shifts_every_bearing(rooms):
    before, after = (visible_edges(rooms[1], (3.0, 1.0, turn)) for turn in (0.4, 1.1))
    assert sorted(before.id) == sorted(after.id)
    before, after = (
        [column[np.argsort(view.id)] for column in view[:6]] for view in (before, after)
    )
    np.testing.assert_allclose(wrap(before[1] - after[1]), 0.7, atol=1e-12)
    for a, b in zip(before[2:], after[2:], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_furniture_keeps_off_the_path(rooms):
    for seed, world in rooms.items():
        for kind, step in (("loop", 0.2), ("loop", 0.5), ("straight", 0.1), ("turn", 0.2)):
            pose = stop_and_go(kind, seed, step=step, length=7.0).pose
            between = np.linspace(pose[:-1, :2], pose[1:, :2], 5).reshape(-1, 2)
            assert world.clearance(between).min() > RADIUS + 0.05, (seed, kind)


def test_clearance_is_negative_inside(rooms):
    world = rooms[0]
    box = world.boxes[0]
    middle = box.corner + box.axis * box.width / 2 + np.array([-box.axis[1], box.axis[0]]) * 0.01
    assert world.clearance(middle)[0] < 0
    assert world.clearance((-0.1, 2.0))[0] < 0
    np.testing.assert_allclose(world.clearance((0.4, 0.02)), 0.02)  # near the south-west corner


def test_loop_comes_back_to_its_start():
    for seed in range(3):
        pose, command = stop_and_go(seed=seed)
        length = np.hypot(*np.diff(pose[:, :2], axis=0).T).sum()
        assert 60 <= length < 60.25
        assert np.hypot(*(pose[-1] - pose[0])[:2]) < 0.6
        assert len(command) == len(pose) - 1
        np.testing.assert_allclose(command[:, 0], 0.2)


def test_slip_is_in_the_truth_only():
    pose, command = stop_and_go(seed=4)
    moved = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    lost = 1 - moved / command[:, 0]
    assert 0.02 < lost.mean() < 0.03
    assert lost.min() >= 0 and lost.std() > 0.005
    turned = wrap(np.diff(pose[:, 2]) - command[:, 1])
    assert 0.7 < turned.std() / (0.01 * np.sqrt(0.2)) < 1.4
    exact = stop_and_go(seed=4, slip=0, turn_error=0, drift=0, length=10.0)
    x, y, heading = exact.pose[0]
    for (distance, turn), after in zip(exact.command, exact.pose[1:], strict=True):
        x, y = x + distance * np.cos(heading), y + distance * np.sin(heading)
        heading = wrap(heading + turn)
        np.testing.assert_allclose((x, y, heading), after, atol=1e-9)


def test_straight_and_turn():
    pose, command = stop_and_go("straight", seed=1, step=0.1, length=6.0)
    assert np.ptp(pose[:, 0]) > 5.9 and np.ptp(pose[:, 1]) < 0.1
    pose, command = stop_and_go("turn", seed=1)
    assert np.ptp(pose[:, :2], axis=0).max() == 0 and np.all(command[:, 0] == 0)
    np.testing.assert_allclose(command[:, 1].sum(), 2 * np.pi)


def test_seeds(rooms):
    again = furnish(1)
    assert all(
        np.array_equal(a.texture, b.texture)
        for a, b in zip(again.faces, rooms[1].faces, strict=True)
    )
    assert not np.array_equal(rooms[0].plan, rooms[1].plan)
    np.testing.assert_array_equal(stop_and_go(seed=1).pose, stop_and_go(seed=1).pose)
    assert not np.array_equal(stop_and_go(seed=1).command, stop_and_go(seed=2).command)


@pytest.mark.parametrize(
    "wrong",
    [
        dict(kind="circle"),
        dict(step=0.0),
        dict(step=0.6),
        dict(step=float("nan")),
        dict(length=0.0),
        dict(kind="straight", length=9.0),
        dict(slip=0.5),
        dict(turn_error=-0.1),
        dict(drift=1.0),
    ],
)
def test_bad_drives(wrong):
    with pytest.raises(ValueError, match="drive: ") as caught:
        stop_and_go(**wrong)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", [dict(shadows=2.0), dict(plain=-0.1)])
def test_bad_rooms(wrong):
    with pytest.raises(ValueError, match="allowed: 0 to 1"):
        furnish(0, **wrong)
