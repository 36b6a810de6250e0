import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2
from small_run import LANDMARKS, make_refined, make_result

from jaxslam.logs.log import Truth
from jaxslam.results import metrics

SECOND = 1_000_000_000


def wiggle(rng, rows=60):
    """A path [T, 3] that goes somewhere."""
    path = np.cumsum(rng.normal(0.2, 0.3, (rows, 3)), 0)
    path[:, 2] = metrics.wrap(path[:, 2])
    return path


def test_alignment_is_what_a_brute_force_optimiser_finds():
    rng = np.random.default_rng(0)
    for _ in range(5):
        truth = wiggle(rng)[:, :2]
        estimate = metrics.apply_se2(rng.normal(0, 2, 3), truth) + rng.normal(0, 0.3, truth.shape)

        def cost(motion, estimate=estimate, truth=truth):
            return ((metrics.apply_se2(motion, estimate) - truth) ** 2).sum()

        found = metrics.align_se2(estimate, truth)
        starts = [(0.0, 0.0, yaw) for yaw in np.arange(-3, 3)]
        best = min((minimize(cost, start) for start in starts), key=lambda tried: tried.fun)
        assert cost(found) <= best.fun * (1 + 1e-9)
        np.testing.assert_allclose(found[:2], best.x[:2], atol=1e-4)
        assert abs(metrics.wrap(found[2] - best.x[2])) < 1e-4


def test_ate_ignores_where_the_path_lies_only_when_aligned():
    truth = wiggle(np.random.default_rng(1))
    moved = metrics.apply_se2((3.0, -1.0, 2.5), truth[:, :2])
    assert metrics.ate(moved, truth)[0] < 1e-12
    distance = np.hypot(*(moved - truth[:, :2]).T)
    rmse, most = metrics.ate(moved, truth, align=False)
    assert rmse == pytest.approx(np.sqrt(np.mean(distance**2)))
    assert most == pytest.approx(distance.max())


def test_a_mirrored_path_is_not_aligned_away():
    truth = wiggle(np.random.default_rng(2))[:, :2]
    assert metrics.ate(truth * [1, -1], truth)[0] > 0.5


def test_ate_without_enough_truth_is_nan():
    truth = wiggle(np.random.default_rng(3))
    truth[2:, :2] = np.nan
    assert np.isnan(metrics.ate(truth, truth)[0])
    assert metrics.ate(truth, truth, align=False)[0] == 0
    standing = np.ones((9, 3))
    assert np.isnan(metrics.ate(standing, standing)[0])


def test_truth_is_interpolated_across_the_turn_and_not_across_gaps():
    seconds = np.array([0.0, 0.5, 1.0, 5.0, 5.5])
    pose = np.array([[0, 0, 3.0], [1, 2, -3.0], [2, 2, -2.8], [9, 9, 0], [10, 9, 0.2]])
    truth = Truth((seconds * SECOND).astype(np.int64), pose)
    asked = np.array([-0.1, 0.0, 0.25, 1.01, 1.1, 3.0, 5.25, 5.6])
    found = metrics.truth_at(truth, (asked * SECOND).astype(np.int64))
    half = metrics.wrap((3.0 + (2 * np.pi - 3.0)) / 2)  # between 3 and -3 lies pi, not 0
    np.testing.assert_allclose(found[2], [0.5, 1.0, half], atol=1e-9)
    np.testing.assert_allclose(found[6], [9.5, 9, 0.1], atol=1e-9)
    np.testing.assert_array_equal(found[[1, 3]], pose[[0, 2]])  # the sample itself; within 20 ms
    assert np.isnan(found[[0, 4, 5, 7]]).all()


def test_single_readings_count_at_their_stops():
    time = np.arange(5) * 10 * SECOND
    truth = Truth(time, np.arange(15.0).reshape(5, 3) / 5, resolution=0.3)
    between = np.sort(np.concatenate([time, time + 4 * SECOND]))
    found = metrics.truth_at(truth, between)
    np.testing.assert_allclose(found[::2], truth.pose)
    assert np.isnan(found[1::2]).all()
    single = Truth(time[:1], truth.pose[:1])
    assert np.isfinite(metrics.truth_at(single, time)).all(1).tolist() == [True] + [False] * 4


def test_relative_error_is_that_of_a_scale_and_of_a_bend():
    steps = np.arange(0, 20, 0.05)
    truth = np.stack([steps, 0 * steps, 0 * steps], 1)
    length, turn = metrics.rpe(truth * [1.03, 1, 1], truth, distance=2.0)
    assert length == pytest.approx(0.06, rel=0.03)
    assert turn == 0
    bent = np.stack([np.sin(steps / 10) * 10, 10 - np.cos(steps / 10) * 10, steps / 10], 1)
    assert metrics.rpe(bent, truth, distance=2.0)[1] == pytest.approx(0.2, rel=0.03)
    time = np.arange(steps.size) * SECOND // 10
    by_time = metrics.rpe(truth * [1.03, 1, 1], truth, time=time, seconds=4.0)
    assert by_time[0] == pytest.approx(0.06, rel=0.03)


def test_relative_error_does_not_care_for_frames_nor_for_standing_still():
    rng = np.random.default_rng(4)
    truth = wiggle(rng, 300)
    estimate = truth + np.cumsum(rng.normal(0, 0.01, truth.shape), 0)
    plain = metrics.rpe(estimate, truth)
    c, s = np.cos(1.0), np.sin(1.0)
    turned = estimate @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [5, 5, 1.0]
    np.testing.assert_allclose(metrics.rpe(turned, truth), plain, rtol=1e-9)
    stood = np.repeat(np.arange(300), np.where(np.arange(300) == 0, 1000, 1))
    np.testing.assert_allclose(metrics.rpe(estimate[stood], truth[stood]), plain, rtol=0.02)


def test_relative_error_skips_pieces_that_span_missing_truth():
    steps = np.arange(0, 10, 0.1)
    truth = np.stack([steps, 0 * steps, 0 * steps], 1)
    estimate = truth.copy()
    estimate[50:, 0] += 100.0
    estimate[45:55] = truth[45:55] = np.nan
    assert metrics.rpe(estimate, truth, distance=0.5)[0] == pytest.approx(0, abs=1e-9)


def test_nees_of_drawn_gaussians_is_chi_squared():
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(4000, 3, 3)) * np.array([0.3, 0.01, 0.05])[:, None]
    cov = factor @ factor.transpose(0, 2, 1) + 1e-6 * np.eye(3)
    truth = rng.uniform(-3, 3, size=(4000, 3))
    pose = truth + np.einsum("tij,tj->ti", np.linalg.cholesky(cov), rng.normal(size=(4000, 3)))
    pose[:, 2] = metrics.wrap(pose[:, 2])  # across the turn an error is still small
    found = metrics.nees(pose, cov, truth)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 3 * 4000) / 4000
    assert low < found.mean() < high
    assert np.mean(found < chi2.ppf(0.99, 3)) == pytest.approx(0.99, abs=0.006)


def test_nees_is_nan_without_truth_or_with_a_singular_covariance():
    truth, pose = np.zeros((4, 3)), np.full((4, 3), 0.1)
    cov = np.tile(np.eye(3), (4, 1, 1))
    truth[1] = np.nan
    cov[2, 0, 1] = cov[2, 1, 0] = 1
    cov[3] = 0
    found = metrics.nees(pose, cov, truth)
    assert found[0] == pytest.approx(0.03)
    assert np.isnan(found[1:]).all()
    rounded = metrics.nees(pose, cov, truth, resolution=np.sqrt(12))
    assert rounded[0] == pytest.approx(0.01 + 2 * 0.005)


def test_gate_is_half_the_smallest_spacing_and_at_most_half_a_metre():
    assert metrics.landmark_gate(np.array([[0, 0], [9, 0], [9, 0.4]])) == pytest.approx(0.2)
    assert metrics.landmark_gate(LANDMARKS) == 0.5
    assert metrics.landmark_gate(LANDMARKS[:1]) == 0.5


def test_hidden_identities_pair_one_to_one_within_the_gate():
    truth = Truth(landmarks=np.array([[0, 0], [0.8, 0], [5, 5], [9, 9]]))
    mean = np.array([[0.1, 0], [0.2, 0], [0.7, 0.1], [5, 5.41], [7, 7]])
    found = metrics.map_error(mean, np.full(5, -1), truth)
    assert (found["matched"], found["missed"], found["spurious"]) == (2, 2, 3)
    assert found["gate_m"] == pytest.approx(0.4)
    assert found["rmse_m"] == pytest.approx(np.sqrt((0.1**2 + 0.1**2 + 0.1**2) / 2))


def test_pairing_is_the_best_over_all_and_not_greedy():
    landmarks = np.array([[0.0, 0], [1, 0], [2, 0]])
    mean = np.array([[0.6, 0], [1.6, 0], [2.7, 0]])  # the nearest pairs leave the last alone
    pairs = metrics.pair_by_distance(mean, landmarks, 0.75)
    assert sorted(map(tuple, pairs)) == [(0, 0), (1, 1), (2, 2)]
    assert metrics.pair_by_distance(np.zeros((0, 2)), landmarks, 1).shape == (0, 2)


def test_known_identities_pair_by_identity_without_a_gate():
    truth = Truth(landmarks=LANDMARKS, landmark_id=np.array([4, 3, 2, 1]))
    found = metrics.map_error(LANDMARKS[::-1] + np.array([2, 0]), np.array([1, 2, 3, 99]), truth)
    assert found == dict(matched=3, missed=1, spurious=1, rmse_m=pytest.approx(2.0))
    swapped = metrics.map_error(LANDMARKS, np.array([1, 2, 3, 4]), truth)
    assert swapped["rmse_m"] > 4  # right places, wrong names


def test_an_empty_map_misses_everything():
    found = metrics.map_error(np.zeros((0, 2)), np.zeros(0, int), Truth(landmarks=LANDMARKS))
    assert found == dict(matched=0, missed=4, spurious=0, gate_m=0.5)


def test_errors_of_a_shifted_run_are_the_shift_and_nothing_after_alignment():
    found = metrics.compute_errors(make_result(shift=0.1))
    assert found["ate_filtered_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert found["ate_filtered_unaligned_rmse_m"] == pytest.approx(0.1)
    assert found["ate_filtered_unaligned_max_m"] == pytest.approx(0.1)
    assert found["landmark_filtered_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert found["landmark_filtered_unaligned_rmse_m"] == pytest.approx(0.1)
    assert found["landmark_gate_m"] == 0.5
    counts = [found[f"landmarks_{kind}"] for kind in ("matched", "missed", "spurious")]
    assert counts == [4, 0, 1]
    assert found["dead_reckoning_end_m"] == pytest.approx(np.hypot(0.6, 0.5))
    assert found["dead_reckoning_ate_m"] > 0.05
    assert found["rpe_1m_m"] == pytest.approx(0, abs=1e-9)
    assert found["nees_median"] == pytest.approx(0.1**2 / 0.01)
    assert found["association_accuracy"] == 1
    assert all(isinstance(value, int | float) for value in found.values())


def test_what_looks_back_is_measured_as_the_filter_is():
    plain, found = metrics.compute_errors(make_result()), metrics.compute_errors(make_refined())
    assert plain.items() <= found.items()
    assert not [key for key in plain if "refined" in key or "ancestral" in key]
    for name, off in (("filtered", 0.1), ("ancestral", 0.08), ("refined", 0.05)):
        assert found[f"ate_{name}_rmse_m"] == pytest.approx(0, abs=1e-9)
        for kind in ("rmse", "max"):
            assert found[f"ate_{name}_unaligned_{kind}_m"] == pytest.approx(off)
        assert found[f"{name}_end_m"] == pytest.approx(off)
        assert found[f"heading_{name}_rmse_rad"] == pytest.approx(0, abs=1e-9)
    for name in ("ancestral", "refined", "dead_reckoning"):
        assert found[f"{name}_rpe_1m_m"] >= 0
    assert found["landmark_refined_unaligned_rmse_m"] == pytest.approx(0.05)
    assert found["landmark_refined_rmse_m"] == pytest.approx(0, abs=1e-9)
    for counts in ("landmarks_refined", "landmarks_refined_unaligned"):
        told = [found[f"{counts}_{kind}"] for kind in ("matched", "missed", "spurious")]
        assert told == [4, 0, 0]
    assert found["nees_refined_median"] == pytest.approx(0.05**2 / (0.01 / 4))
    assert found["nees_refined_within_99"] == 1
    assert found["association_accuracy_refined"] == pytest.approx(1 - 1 / 80)


def test_errors_leave_out_what_cannot_be_computed():
    result = make_result()
    assert metrics.compute_errors(make_result(truth=False)) == {}
    only_map = dataclasses.replace(result.log, truth=Truth(landmarks=LANDMARKS))
    assert set(metrics.compute_errors(result, only_map)) == {
        "landmark_filtered_unaligned_rmse_m",
        "landmark_gate_m",
        *(f"landmarks_unaligned_{kind}" for kind in ("matched", "missed", "spurious")),
    }
    coarse = dataclasses.replace(result.log.truth, resolution=0.3, landmarks=None, landmark_id=None)
    found = metrics.compute_errors(result, dataclasses.replace(result.log, truth=coarse))
    assert found["truth_resolution_m"] == 0.3
    assert not [key for key in found if key.startswith(("rpe", "landmark"))]


def with_match(result, frame, slot, value):
    match = np.array(result.landmark_id)
    match[frame, slot] = value
    return dataclasses.replace(result, landmark_id=match)


@pytest.mark.parametrize(
    ("frame", "slot", "value"),
    [
        (8, 0, 3),  # landmark 0, matched to the one that a measurement of landmark 1 made
        (8, 0, -2),  # a landmark called clutter
        (8, 0, -1),  # a landmark that was there already, called new
        (8, 1, 0),  # clutter called a landmark
        (8, 1, -1),  # clutter called new
        (8, 0, 1),  # matched to what clutter made
    ],
)
def test_association_accuracy_counts_each_kind_of_mistake(frame, slot, value):
    result = make_result()
    wrong = with_match(result, frame, slot, value)
    assert metrics.association_accuracy(wrong) == pytest.approx(1 - 1 / 80)


def test_association_accuracy_falls_back_on_measured_identities():
    result = make_result()
    measured = dataclasses.replace(result.log, truth=None, identity=result.log.truth.identity)
    wrong = with_match(result, 8, 0, -2)
    # Without truth, -1 is a measurement without identity, so 40 of 80 count.
    assert metrics.association_accuracy(wrong, measured) == pytest.approx(1 - 1 / 40)
    assert np.isnan(metrics.association_accuracy(make_result(truth=False)))
