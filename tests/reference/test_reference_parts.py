"""The baseline's parts: motion, association and weights against closed forms and brute force."""

import ast
import itertools
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jaxslam.reference import ekf, fastslam

STILL = {"dx": 0, "dy": 0, "dtheta": 0, "distance": 0, "turn": 0, "duration": 0}
STILL |= {"lever": 0.5, "lever_var": 1 / 12}
MOTION = {"err_tran": 0, "err_rot": 0, "err_drift": 0, "floor_tran": 0, "floor_rot": 0}
MOTION |= {"gain_tran": 1, "gain_rot": 1, "bias_drift": 0}
SENSING = {"outlier": 0.02, "density_new": 0.1, "view_min": -2, "view_max": 2, "view_range": 10}
SENSING |= {"sigma_bearing": 0.05, "extra_bearing_noise": 0.0}


def make_model(config=None, **changes):
    rules = {"sensor": "range_bearing", "clutter": True, "association": "known"} | (config or {})
    params = SimpleNamespace(**MOTION | SENSING | changes)
    return fastslam.make_model(params, SimpleNamespace(**rules))


def make_landmark(mean):
    cov = np.array([[0.05, 0.01], [0.01, 0.02]])
    return ekf.Landmark(np.array(mean), cov, np.zeros(2), 1, 1.0, 0)


def test_imports_numpy_and_itself_only():
    allowed = {"copy", "math", "dataclasses", "types", "typing", "numpy", "jaxslam.reference.ekf"}
    for module in (fastslam, ekf):
        for node in ast.walk(ast.parse(Path(module.__file__).read_text())):
            if isinstance(node, ast.Import):
                assert {name.name for name in node.names} <= allowed
            if isinstance(node, ast.ImportFrom):
                names = {node.module} | {f"{node.module}.{name.name}" for name in node.names}
                assert names & allowed


# Motion


@pytest.mark.parametrize("forward", [1.5, -1.5])
def test_move_without_noise_translates_then_rotates(forward):
    o = SimpleNamespace(**STILL | {"dx": forward, "dtheta": 4.0, "distance": 1.5, "turn": 4.0})
    pose = fastslam.move(np.array([1.0, 2.0, 0.5]), o, np.ones(3), make_model())
    expected = [1 + forward * math.cos(0.5), 2 + forward * math.sin(0.5), 4.5 - 2 * math.pi]
    np.testing.assert_allclose(pose, expected, atol=1e-14)


def test_move_applies_systematic_gains():
    o = SimpleNamespace(**STILL | {"dx": 3.0, "dy": 4.0, "dtheta": 0.2, "distance": 6.0})
    model = make_model(gain_tran=1.1, gain_rot=1.5, bias_drift=0.01)
    pose = fastslam.move(np.zeros(3), o, np.zeros(3), model)
    angle = math.atan2(4, 3) + 0.5 * 0.5 * 0.2 + 0.01 * 6 / 2
    expected = [5.5 * math.cos(angle), 5.5 * math.sin(angle), 1.5 * 0.2 + 0.06]
    np.testing.assert_allclose(pose, expected, atol=1e-14)


@pytest.mark.parametrize("noisy", ["err_tran", "err_rot", "err_drift", "floor_tran", "floor_rot"])
def test_move_covariance_is_that_of_many_small_steps(noisy):
    """Along the chord: unit normals one by one give the columns of a root of the covariance."""
    o = {"dx": 2.0, "dtheta": 0.3, "distance": 2.0, "turn": 0.3, "duration": 4.0}
    model = make_model(**{noisy: 0.1})
    o = SimpleNamespace(**STILL | o)
    centre = fastslam.move(np.zeros(3), o, np.zeros(3), model)
    root = np.array([fastslam.move(np.zeros(3), o, n, model) - centre for n in np.eye(3)]).T
    # integrals over the path: heading noise at fraction f of the way moves the end by 2 (1 - f)
    heading = {"err_rot": 0.01 * 0.3, "err_drift": 0.01 * 2, "floor_rot": 0.01 * 4}.get(noisy, 0)
    along = {"err_tran": 0.01 * 2, "floor_tran": 0.01 * 4}.get(noisy, 0)
    across = along if noisy == "floor_tran" else 0
    expected = np.diag([along, across + heading * 4 / 3, heading])
    expected[1, 2] = expected[2, 1] = heading * 2 / 2
    np.testing.assert_allclose(root @ root.T, expected, atol=1e-12)


@pytest.mark.parametrize("size", [1.0, 0.0])
def test_start_has_the_given_covariance(size):
    """A root with L L' = cov, also when a variance is zero (known heading) or all are."""
    rank_two = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.0]])
    for cov in (size * rank_two, size * (rank_two + np.diag([0, 0, 0.01]))):
        made = fastslam.start(np.array([1.0, 2.0, 0.5]), cov, np.eye(3), 2)
        root = np.array([particle.pose - [1, 2, 0.5] for particle in made]).T
        np.testing.assert_allclose(root @ root.T, cov, atol=1e-15)
        assert made[0].landmarks == [None, None]
        assert made[0].landmarks is not made[1].landmarks


# Association


def best_first(table, floor):
    """Of all one-to-one choices of admissible pairs, the one whose sorted scores come first."""
    rows, slots = table.shape
    best = ([], [fastslam.NEW] * rows)
    for choice in itertools.product([fastslam.NEW, *range(slots)], repeat=rows):
        pairs = [(row, slot) for row, slot in enumerate(choice) if slot >= 0]
        distinct = len({slot for _, slot in pairs}) == len(pairs)
        if distinct and all(table[pair] > floor[pair[0]] for pair in pairs):
            best = max(best, (sorted((table[pair] for pair in pairs), reverse=True), list(choice)))
    return best[1]


@pytest.mark.parametrize("seed", range(30))
def test_exclusive_association_is_best_pair_first(seed):
    draw = np.random.default_rng(seed)
    table = draw.normal(size=draw.integers(1, 5, size=2))
    table[draw.uniform(size=table.shape) < 0.2] = -np.inf
    new, clutter = draw.normal(-0.5, 0.5, len(table)), np.full(len(table), -np.inf)
    assert fastslam.associate_likeliest(table, new, clutter, True) == best_first(table, new)


def test_best_match_may_share_and_the_rest_is_new_or_clutter():
    table = np.array([[3.0, 2.0], [4.0, 1.0], [0.5, 0.0], [-1.0, -1.0], [np.nan, -np.inf]])
    new, clutter = np.array([0.0, 0, 1, 0, 0]), np.array([-1.0, 0, 0, 1, 0])
    shared = fastslam.associate_likeliest(table, new, clutter, False)
    assert shared == [0, 0, fastslam.NEW, fastslam.CLUTTER, fastslam.NEW]
    assert fastslam.associate_likeliest(table, new, clutter, True)[:2] == [1, 0]


def test_of_hidden_bearings_one_a_frame_is_expected_to_be_new():
    model = make_model({"sensor": "bearing", "association": "maximum_likelihood"})
    new, _ = fastslam.alternatives(SimpleNamespace(value=np.array([3.0, 0.5])), model)
    assert new == pytest.approx(math.log(0.98 / 4.0))


@pytest.mark.parametrize("sensor", ["position", "range_bearing", "bearing"])
def test_alternatives_by_hand(sensor):
    model = make_model({"sensor": sensor})
    new, clutter = fastslam.alternatives(SimpleNamespace(value=np.array([3.0, 0.5])), model)
    area = {"position": 1.0, "range_bearing": 3.0, "bearing": 50.0}[sensor]
    volume = {"position": 4 * 50.0, "range_bearing": 40.0, "bearing": 4.0}[sensor]
    assert new == pytest.approx(math.log(0.98 * 0.1 * area))
    assert clutter == pytest.approx(math.log(0.02 / volume))
    without = make_model({"sensor": sensor, "clutter": False})
    new, clutter = fastslam.alternatives(SimpleNamespace(value=np.array([3.0, 0.5])), without)
    assert (new, clutter) == (pytest.approx(math.log(0.1 * area)), -np.inf)


# Weights


def make_particles(weights, landmarks=1):
    marks = [make_landmark([float(i), 0.0]) for i in range(landmarks)]
    with np.errstate(divide="ignore"):
        logs = np.log(weights)
    return [
        fastslam.Particle(np.full(3, 0.1 * i), [*marks, None], float(log))
        for i, log in enumerate(logs)
    ]


def test_resampling_known_weights():
    weights = np.array([0.0, 0.5, 0.0, 0.125, 0.375, 0.0])
    for uniform, expected in ((0.0, [1, 1, 1, 3, 4, 4]), (0.8, [1, 1, 1, 4, 4, 4])):
        children, ancestors = fastslam.resample(make_particles(weights), weights, uniform)
        assert ancestors == expected  # 3 / 6 is not below c_1 = 0.5
        assert [child.pose[0] for child in children] == [0.1 * j for j in ancestors]
        assert {child.log_weight for child in children} == {-math.log(6)}


def test_resampling_never_picks_a_zero_weight():
    draw = np.random.default_rng(0)
    for uniform in (0.0, 0.5, np.nextafter(1, 0)):
        weights = draw.dirichlet(np.full(9, 0.3))
        weights[[0, 4, 8]] = 0
        weights /= weights.sum()
        _, ancestors = fastslam.resample(make_particles(weights), weights, uniform)
        assert np.all(weights[ancestors] > 0)
        assert np.all(np.abs(np.bincount(ancestors, minlength=9) - 9 * weights) <= 1.1)


def test_children_share_nothing():
    particles = make_particles([1.0, 0.0], landmarks=2)
    (a, b), _ = fastslam.resample(particles, np.array([1.0, 0.0]), 0.5)
    a.pose[0], a.landmarks[0].mean[0], a.landmarks[0].cov[0, 0] = 50.0, 51.0, 52.0
    a.landmarks[0].anchor[0], a.landmarks[0].count, a.landmarks[1] = 53.0, 54, None
    for other in (b, particles[0]):
        mark = other.landmarks[0]
        assert other.pose[0] == 0.0
        assert (mark.mean[0], mark.cov[0, 0], mark.anchor[0], mark.count) == (0.0, 0.05, 0.0, 1)
        assert other.landmarks[1] is not None


def test_estimate_by_hand_across_the_wrap():
    particles = make_particles([0.25, 0.75])
    particles[0].pose, particles[1].pose = np.array([0, 0, 3.1]), np.array([4, 0, -3.1])
    row = fastslam.estimate(particles, np.array([0.25, 0.75]))
    gap = 2 * (math.pi - 3.1)
    heading = math.atan2(-0.5 * math.sin(3.1), math.cos(3.1))
    np.testing.assert_allclose(row["pose_mean"], [3, 0, heading], atol=1e-12)
    assert row["cov"][0, 0] == pytest.approx(3.0)
    assert row["cov"][0, 2] == pytest.approx(4 * gap * 0.25 * 0.75)
    assert row["cov"][2, 2] == pytest.approx(gap**2 * 0.25 * 0.75, rel=1e-3)
    assert (row["best"], row["ess"]) == (1, pytest.approx(1.6))


def test_lost_weights_are_counted():
    particles = make_particles([0.5, 0.5, 0.5])
    particles[1].log_weight = np.nan
    row = fastslam.normalise(particles)
    assert (row["nonfinite"], row["degenerate"]) == (1, False)
    assert row["log_evidence"] == pytest.approx(0.0)
    assert [p.log_weight for p in particles] == [math.log(0.5), -np.inf, math.log(0.5)]
