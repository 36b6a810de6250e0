"""experiments/spacing.py: its rooms, its rival filters and what it says of an estimate."""

import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
import spacing
import spacing_rivals as rivals
import spacing_world as world
from scipy.stats import chi2

from jaxslam import default_params
from jaxslam.results import metrics


@pytest.mark.parametrize("apart", world.SPACINGS)
def test_lines_stand_on_the_walls_as_far_apart_as_was_said(apart):
    lines = world.lines(3, apart)
    gap = np.hypot(*(lines[:, None] - lines).transpose(2, 0, 1)) + 99 * np.eye(len(lines))
    assert len(lines) == world.LINES
    np.testing.assert_allclose(gap.min(1), apart, atol=1e-9)
    assert ((gap < 1.5 * apart).sum(1) <= 2).all()  # a group's lines have no other neighbours
    x, y = lines.T
    on_wall = [np.abs(side) < 1e-9 for side in (x, x - 10, y, y - 4)]
    assert (np.sum(on_wall, 0) == 1).all()


def test_bearings_are_those_of_their_lines_and_a_seed_is_one_drive():
    log, other = world.room(0, 0.1, 3, 12.0), world.room(0, 1.0, 1, 12.0)
    np.testing.assert_array_equal(log.odometry, other.odometry)
    np.testing.assert_array_equal(log.truth.pose, other.truth.pose)
    who, at = log.truth.identity, log.truth.pose[log.frame]
    away = log.truth.landmarks[who] - at[:, :2]
    error = rivals.wrap(log.bearing - np.arctan2(away[:, 1], away[:, 0]) + at[:, 2])[who >= 0]
    assert error.std() == pytest.approx(np.deg2rad(3), rel=0.1)
    assert np.hypot(*away[who >= 0].T).max() < world.REACH
    assert 0 < (who < 0).mean() < 0.06
    assert log.noise["sigma_bearing"] == pytest.approx(np.deg2rad(3))
    assert not log.has("range_bearing")


def some_state(rng, points=3):
    size = 3 + 4 * points
    mean = rng.normal(0, 1, size)
    mean[6::4] = rng.uniform(0.2, 0.8, points)
    root = 0.05 * rng.normal(size=(size, size))
    names = list(range(points))
    return rivals.State(mean, root @ root.T, names, names, np.zeros(points), np.ones(points, int))


def test_the_predicted_bearings_derivatives():
    state = some_state(np.random.default_rng(0))
    seen = rivals.predicted(state)
    x, y, phi, rho = state.mean[3:].reshape(-1, 4).T
    point = np.column_stack([x + np.cos(phi) / rho, y + np.sin(phi) / rho]) - state.mean[:2]
    np.testing.assert_allclose(seen.far, np.hypot(*point.T))
    expected = rivals.wrap(np.arctan2(point[:, 1], point[:, 0]) - state.mean[2])
    np.testing.assert_allclose(seen.bearing, expected)
    start = state.mean.copy()
    for i, step in enumerate(1e-6 * np.eye(len(start))):
        state.mean = start + step
        more = rivals.predicted(state).bearing
        state.mean = start - step
        slope = rivals.wrap(more - rivals.predicted(state).bearing) / 2e-6
        np.testing.assert_allclose(seen.rows[:, i], slope, atol=1e-7)


def test_with_known_identities_the_ekf_is_exact_and_knows_how_exact():
    squares, errors = [], []
    for seed in range(3):
        log = world.room(seed, 1.0, 1, 20.0)
        found = rivals.run(log, default_params("bearing", log), "known")
        true = metrics.truth_at(log.truth, log.frame_time)
        squares.append(np.mean(metrics.nees(found.pose, found.cov, true)))
        told = spacing.measures(
            log, found.pose, found.row, found.landmark_id, found.mean, found.identity
        )
        assert min(told["right"], told["one_to_one"]) > 0.95  # not 1: points are dropped, too
        assert (told["matched"], told["spurious"]) == (world.LINES, 0)
        errors.append((told["path_m"], told["landmark_m"]))
    assert 1.5 < np.mean(squares) < 5  # chi-squared with 3 degrees of freedom
    assert np.max(errors) < 0.1
    lost = found.pose.copy()
    lost[:, 0] += np.linspace(0, 1, len(lost)) ** 2  # the test can tell a filter that went astray
    assert np.mean(metrics.nees(lost, found.cov, true)) > 50


def brute(off, within, order):
    """The best pairing by trying all, every set on the way being compatible; by plain inverses."""
    best = (0, 0.0, ())
    for points in itertools.product(range(-1, off.shape[1]), repeat=len(order)):
        paired = [(k, j) for k, j in zip(order, points, strict=True) if j >= 0]
        if len({j for _, j in paired}) < len(paired):
            continue
        square = 0.0
        for n in range(1, len(paired) + 1):
            k, j = np.transpose(paired[:n])
            square = off[k, j] @ np.linalg.inv(within[np.ix_(j, j)]) @ off[k, j]
            alone = off[k[-1], j[-1]] ** 2 / within[j[-1], j[-1]]
            if max(square - chi2.ppf(0.95, n), alone - chi2.ppf(0.95, 1)) > 0:
                break
        else:
            best = max(best, (len(paired), -square, points))
    return best


def test_joint_compatibility_finds_what_trying_everything_finds():
    rng, sizes, differs = np.random.default_rng(1), [], 0
    for _ in range(40):
        count, points = rng.integers(1, 5), rng.integers(1, 5)
        root = rng.normal(size=(points, points))
        within = root @ root.T + 0.3 * np.eye(points)
        off = rng.normal(0, 1.5, (count, points)) * np.sqrt(np.diag(within))
        choice, cut = rivals.joint(off, within)
        can = (off**2 / np.diag(within) <= chi2.ppf(0.95, 1)).sum(1)
        size, minus, _ = brute(off, within, sorted(range(count), key=lambda k: can[k]))
        k = np.flatnonzero(choice >= 0)
        j = choice[k]
        assert not cut
        assert len(k) == len(set(j)) == size
        square = off[k, j] @ np.linalg.solve(within[np.ix_(j, j)], off[k, j]) if size else 0.0
        assert square == pytest.approx(-minus)
        sizes.append(size)
        differs += list(choice) != list(rivals.nearest(off, within))
    assert {0, 1, 2, 3} <= set(sizes)
    assert differs > 10


def test_joint_compatibility_sees_through_a_turn_and_nearest_neighbour_does_not():
    """All bearings are off by the spacing of the points, as after an unnoticed turn."""
    at = np.array([0.0, 0.1, 0.2, 0.3])
    off = (at[:3] + 0.1 + 0.002 * np.array([1, -1, 1]))[:, None] - at
    within = 0.12**2 + 0.01**2 * np.eye(4)
    assert list(rivals.nearest(off, within)) == [1, 2, 3]
    off = (at + 0.1)[:, None] - at
    assert list(rivals.joint(off, within)[0]) == [0, 1, 2, 3]
    assert list(rivals.nearest(off, within)) != [0, 1, 2, 3]


def test_a_bearing_is_new_only_if_no_point_that_is_still_free_could_be_its():
    within, off = np.eye(2), np.array([[0.0, 9.0], [2.5, 9.0], [9.0, 3.0]])
    assert not rivals._another(off, within, np.array([0, -1, -1]))[1]  # its one point is taken
    assert rivals._another(off, within, np.array([-1, -1, -1]))[1]
    assert rivals._another(off, within, np.array([0, -1, -1]))[2]  # beyond the gate, yet not far


def test_a_search_that_would_take_too_long_is_cut_and_says_so():
    off, within = 1e-3 * np.arange(36.0).reshape(6, 6), np.eye(6)
    choice, cut = rivals.joint(off, within, nodes=4)
    assert cut
    assert 3 < (choice >= 0).sum() < 6
    assert not rivals.joint(off, within)[1]


def test_points_of_impossible_depth_are_dropped_and_the_others_stay_what_they_are():
    state = some_state(np.random.default_rng(2))
    state.mean[6::4] = 0.5, 3.0, 0.5
    before = rivals.predicted(state).bearing
    rivals.update(state, before + 1e-3, np.arange(3), 0.02, most=1.4)
    assert state.name == [0, 2]
    after = rivals.predicted(state).bearing
    assert (np.abs(rivals.wrap(after - before[[0, 2]])) < 2e-3).all()


def test_both_ways_of_associating_map_lines_that_stand_apart():
    log = world.room(0, 1.0, 1, 20.0)
    for rule in ("nearest", "joint"):
        found = rivals.run(log, default_params("bearing", log), rule)
        told = spacing.measures(
            log, found.pose, found.row, found.landmark_id, found.mean, found.identity
        )
        assert told["right"] > 0.7
        assert told["path_m"] < 0.1
        assert told["matched"] > 18
        assert (found.identity == -1).all()  # they were hidden


def test_what_is_said_of_associations():
    who = np.array([0, 0, 0, 0, 1, 1, -1, -1])
    # line 0 is held twice, its second landmark was begun by clutter; one bearing is left aside
    match = np.array([-1, 0, 6, -2, -1, 4, -1, 0])
    log = world.room(0, 1.0, 1, 6.0)
    truth = SimpleNamespace(**vars(log.truth) | {"identity": who})
    log = SimpleNamespace(truth=truth, frame_time=log.frame_time, identity=None)
    row = np.arange(8)[None]
    marks = truth.landmarks[:20] + [0.1, 0]
    given = truth.pose, row, match[None], marks, np.full(20, -1)
    told = spacing.measures(log, *given)
    assert told["right"] == 4 / 8
    assert told["wrong"] == 2 / 8
    assert told["aside"] == told["begun"] == 1 / 8
    assert told["one_to_one"] == 4 / 6
    assert (told["matched"], told["missed"], told["spurious"]) == (20, 4, 0)
    assert told["landmark_m"] == pytest.approx(0.1)
    assert told["ospa_m"] == pytest.approx(np.sqrt((20 * 0.01 + 4 * 0.25) / 24))
    assert told["path_m"] == pytest.approx(0, abs=1e-9)
    assert spacing.ospa(np.zeros((0, 2)), truth.landmarks) == spacing.CUT_OFF


def test_ours_is_judged_by_what_was_refined(monkeypatch):
    log, asked = world.room(0, 1.0, 1, 6.0), []
    names = np.full(24, -1)
    marks = SimpleNamespace(mean=log.truth.landmarks, identity=names)
    true, shape = log.truth.pose, (len(log.frame_time), world.MOST)

    def run(log, config, params, seed):
        asked.append((config, seed))
        refined = SimpleNamespace(pose=true, landmark_id=np.full(shape, -1))
        return SimpleNamespace(
            refined=refined, landmarks_refined=marks, landmarks=marks, pose=0 * true,
            row=np.full(shape, -1), landmark_id=np.full(shape, -2), flags=[],
        )  # fmt: skip

    monkeypatch.setattr(spacing.jaxslam, "run", run)
    for name in ("jaxslam", "jaxslam known"):
        stages, _ = spacing.estimate(name, log, None, 50, 7)
        assert list(stages) == ["refined", "filtered"]
        assert stages["refined"][0] is true
    (hidden, seed), (known, _) = asked
    assert (hidden.sensor, hidden.association, hidden.particles, seed) == (
        "bearing", "maximum_likelihood", 50, 7
    )  # fmt: skip
    assert known.association == "known"


def test_a_run_goes_on_where_it_was_and_writes_table_and_figure(at, monkeypatch, capsys):
    words = ["--quick", "--degrees", "3", "--filters", "nearest", "joint"]
    words += ["--spacings", "0.3", "1", "--out", "out"]
    spacing.main(words)
    file = at / "out" / "spacing.jsonl"
    assert len(spacing.read(file)) == 4
    table = (at / "out" / "spacing.md").read_text()
    assert table.count("EKF, nearest neighbour") == table.count("EKF, joint compatibility") == 2
    assert (at / "out" / "spacing.png").stat().st_size > 10_000

    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:-1], lines[-1][:40]]))  # killed while it wrote
    measured = []

    def cell(*which):
        measured.append(which)
        return json.loads(lines[-1])

    monkeypatch.setattr(spacing, "cell", cell)
    spacing.main(words)
    assert [which[:3] for which in measured] == [("joint", 1.0, 3.0)]
    assert (at / "out" / "spacing.md").read_text() == table
    spacing.main([*words, "--again"])
    assert len(measured) == 5
    with pytest.raises(SystemExit, match=r"no cells of 70 particles"):
        spacing.main(["--report", "--particles", "70", "--out", "out"])
    capsys.readouterr()
