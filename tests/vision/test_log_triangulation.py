"""The error model of triangulated points: the right candidate wins, with the right numbers."""

import math
from dataclasses import replace

import numpy as np
import pytest

from calibration import sensor, sensor_report
from calibration.points import apply_model, compare, coverage, identify_lines, point_errors
from jaxslam.logs.log import Log, Truth

STEP, SIGMA = 0.3, math.radians(0.2)
STAMPS = np.arange(61) * 10**9


def straight(seed, noise, gain=1.0):
    """A straight drive past surveyed lines; `noise(rng, sight, r)` draws each point's error."""
    rng = np.random.default_rng(seed)
    lines = np.column_stack([rng.uniform(0, 18, 24), rng.choice([-2.0, 2.5], 24)])
    x = gain * STEP * np.arange(61)
    rows = []
    for frame in range(1, 61):
        for i, (lx, ly) in enumerate(lines):
            true = np.array([lx - x[frame], ly])
            r = np.hypot(*true)
            if r > 5 or abs(math.atan2(ly, true[0])) < 0.3 or abs(true[0]) > 4:
                continue
            first = true + [gain * STEP, 0]
            u1, u2 = first / np.hypot(*first), true / r
            sine = u1[0] * u2[1] - u1[1] * u2[0]
            one, other = r / sine * u1, np.hypot(*first) / sine * u2
            cov = SIGMA**2 * (np.outer(one, one) + np.outer(other, other))
            point = true + noise(rng, cov, true)
            rows.append((frame, i, *(point / gain), cov[0, 0], cov[0, 1], cov[1, 1]))
    rows = np.array(rows)
    pose = np.column_stack([x, np.zeros(61), np.zeros(61)])
    return Log(
        name="straight",
        odometry_time=STAMPS[1:],
        odometry=np.column_stack([np.full(60, STEP), np.zeros(60)]),
        odometry_kind="command",
        frame_time=STAMPS,
        frame=rows[:, 0].astype(int),
        bearing=np.arctan2(rows[:, 3], rows[:, 2]),
        point=rows[:, 2:4],
        point_cov=rows[:, 4:7] / gain**2,
        point_baseline=np.full(len(rows), STEP),
        view=(-math.pi, math.pi, 8.0),
        truth=Truth(
            time=STAMPS,
            pose=pose,
            landmarks=lines,
            landmark_id=np.arange(24),
            identity=rows[:, 1].astype(int),
        ),
    )


def normal(rng, cov, true):
    return rng.multivariate_normal(np.zeros(2), 1.5**2 * cov)


def tailed(rng, cov, true):
    return rng.multivariate_normal(np.zeros(2), cov) / math.sqrt(rng.chisquare(3) / 3)


def by_range(rng, cov, true):
    r = np.hypot(*true)
    along, across = true / r, np.array([-true[1], true[0]]) / r
    return 0.01 * r**2 * rng.normal() * along + 0.02 * r * rng.normal() * across


def same(rng, cov, true):
    along = true / np.hypot(*true)
    across = np.array([-along[1], along[0]])
    return (0.05 + 0.1 * rng.normal()) * along + 0.03 * rng.normal() * across


@pytest.mark.parametrize(
    ("noise", "winners", "values"),
    [
        (normal, {"propagated normal", "bearing normal", "heavy-tailed"}, {"position_scale": 1.5}),
        (tailed, {"heavy-tailed"}, {"position_scale": 1.0, "degrees_of_freedom": 3.0}),
        (by_range, {"range-dependent"}, {"along_per_m": 0.01, "across_rad": 0.02}),
        (same, {"one fitted normal"}, {"mean_along_m": 0.05, "sd_along_m": 0.1}),
    ],
)
def test_the_data_prefer_the_model_they_come_from(noise, winners, values):
    models = compare(point_errors(straight(3, noise)))
    assert len(models) == 5
    assert models[0].name in winners
    best = next(m for m in models if set(values) <= set(m.values) and m.name in winners)
    for name, value in values.items():
        allowed = 0.4 if name == "degrees_of_freedom" else 0.15
        assert abs(best.values[name] - value) < allowed * max(abs(value), 0.1), name
    assert 0.92 < best.coverage < 0.98
    held = [model.held_out for model in models]
    assert held == sorted(held, reverse=True)


def test_bearing_noise_is_found():
    models = compare(point_errors(straight(4, normal)))
    bearing = next(model for model in models if model.name == "bearing normal")
    assert abs(bearing.values["sigma_bearing_rad"] / (1.5 * SIGMA) - 1) < 0.1


def test_a_translation_gain_rescales_the_points():
    log = straight(5, lambda rng, cov, true: np.zeros(2), gain=0.9)
    assert np.abs(point_errors(log, 0.9).point - point_errors(log, 0.9).true).max() < 1e-9
    off = point_errors(log)
    assert np.abs(off.point - off.true / 0.9).max() < 1e-9


def test_lines_are_found_without_identities():
    log = straight(6, lambda rng, cov, true: rng.multivariate_normal(np.zeros(2), cov))
    named = point_errors(log)
    hidden = point_errors(replace(log, truth=replace(log.truth, identity=None)))
    assert len(hidden.row) > 0.97 * len(named.row)
    place = np.searchsorted(named.row, hidden.row)
    assert np.isclose(named.true[place], hidden.true).all(1).mean() > 0.95


def test_a_straight_drive_tells_nothing_of_turns():
    model = sensor.fit(straight(10, normal, gain=0.97))
    assert abs(model.values["gain_tran"] - 0.97) < 1e-3
    assert {"gain_rot", "err_rot"}.isdisjoint(model.values)
    assert set(model.values) >= {"err_tran", "err_drift", "sigma_bearing", "outlier"}
    assert model.counts["intervals"] == 59


def test_bearings_are_named_by_the_surveyed_line_they_point_at():
    log = straight(9, lambda rng, cov, true: np.zeros(2))
    bearing = log.bearing.copy()
    bearing[0] += 0.8
    unnamed = replace(log, bearing=bearing, truth=replace(log.truth, identity=None))
    found = identify_lines(unnamed).truth.identity
    assert (found[1:] == log.truth.identity[1:]).mean() > 0.95
    assert found[0] != log.truth.identity[0]


def test_the_filter_gets_the_models_covariances():
    log = straight(7, same)
    model = next(m for m in compare(point_errors(log)) if m.name == "one fitted normal")
    point = apply_model(model, log)
    off = point.point - log.point
    along = (off * log.point).sum(1) / np.linalg.norm(log.point, axis=1)
    assert np.allclose(along, -model.values["mean_along_m"], atol=1e-6)
    xx, xy, yy = point.point_cov.T
    determinant = (model.values["sd_along_m"] * model.values["sd_across_m"]) ** 2
    assert np.allclose(xx * yy - xy * xy, determinant)


def test_what_is_missing_is_named():
    log = straight(8, normal)
    with pytest.raises(ValueError, match="needs true poses"):
        point_errors(replace(log, truth=None))
    with pytest.raises(ValueError, match="needs triangulated points"):
        point_errors(replace(log, point=None, point_cov=None, point_baseline=None))
    with pytest.raises(ValueError, match="needs surveyed lines"):
        truth = replace(log.truth, landmarks=None, landmark_id=None, identity=None)
        point_errors(replace(log, truth=truth))
    few = point_errors(log)
    with pytest.raises(ValueError, match="40 points; at least 60"):
        compare(few.part(np.arange(len(few.row)) < 40))


def test_the_report_says_what_was_found_and_draws_it(tmp_path):
    log = straight(11, normal)
    report = sensor_report.calibrate_sensor(log)
    found, errors = sensor_report.values(report)
    assert abs(found["position_scale"] - 1.5) < 0.1
    assert abs(found["gain_tran"] - 1) < 1e-3 and "gain_tran" in errors
    text = sensor_report.text(report)
    assert f"preferred: {report.models[0].name}, by " in text
    assert all(model.name in text for model in report.models)
    path = sensor_report.draw(report, log, tmp_path / "points.png")
    assert path.read_bytes()[:4] == b"\x89PNG" and path.stat().st_size > 20_000


def test_a_log_without_points_tells_of_bearings_only(tmp_path):
    log = replace(straight(12, normal), point=None, point_cov=None, point_baseline=None)
    report = sensor_report.calibrate_sensor(log)
    assert report.errors is None and report.models == []
    assert "position_scale" not in sensor_report.values(report)[0]
    with pytest.raises(ValueError, match="no triangulated points"):
        sensor_report.draw(report, log, tmp_path / "points.png")


def test_coverage_is_the_share_within_the_ellipses():
    true_to_size = point_errors(
        straight(13, lambda rng, cov, t: rng.multivariate_normal((0, 0), cov))
    )
    assert 0.93 < coverage(true_to_size) < 0.97
    assert coverage(point_errors(straight(13, normal))) < 0.80  # errors half as large again
