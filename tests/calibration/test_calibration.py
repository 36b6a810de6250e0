"""Drives -> error model: known parameters come back, and the bundled log's known numbers."""

import functools
from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

from calibration.odometry import motion_residuals
from calibration.sensor import fit
from jaxslam.logs.log import Truth
from jaxslam.logs.log_file import load_log
from jaxslam.models import motion
from jaxslam.parameter_file import load_params, save_params
from jaxslam.parameters import Params, default_params
from jaxslam.simulation.planar import planar

MOUNTING = (0.2, -0.1, 0.3)
NOISE = dict(
    err_tran=0.03,
    err_rot=0.04,
    err_drift=0.03,
    gain_tran=1.02,
    gain_rot=0.95,
    bias_drift=0.02,
    sigma_range=0.04,
    sigma_bearing=0.015,
    landmark_extent=0.03,
    outlier=0.03,
)


@functools.cache
def drive(seed=0, **changes):
    """Driven blindly: a controller that answers to the noise would bias the gains."""
    given = dict(length_m=150.0, odometry_hz=20.0, mounting=MOUNTING, closed_loop=False) | NOISE
    return planar("field", seed, **(given | changes))


@functools.cache
def model(seed=0, **changes):
    return fit(drive(seed, **changes))


def errors(found):
    """Estimates minus what is true, in standard errors."""
    true = NOISE | {"mount_yaw": MOUNTING[2]}
    assert set(found.values) == set(found.standard_errors) == set(true)
    z = {name: (v - true[name]) / found.standard_errors[name] for name, v in found.values.items()}
    return z | {"drive_yaw": found.drive_yaw[0] / found.drive_yaw[1]}


@pytest.mark.parametrize("commands", [False, True])
def test_parameters_come_back_within_their_standard_errors(commands):
    found = [errors(model(seed, commands=commands)) for seed in range(3)]
    z = np.array([[f[name] for name in sorted(f)] for f in found])
    # 39 numbers of unit variance: none beyond 4, and their mean square within 4 of its sd of 1.
    assert np.abs(z).max() < 4, found
    assert abs(np.mean(z**2) - 1) < 4 * np.sqrt(2 / z.size)


def test_a_yaw_that_the_log_does_not_know_is_found():
    log = replace(drive(), mounting=(*MOUNTING[:2], 0.25))
    yaw = fit(log).values["mount_yaw"]
    assert yaw == pytest.approx(MOUNTING[2], abs=4 * model().standard_errors["mount_yaw"])


def test_no_growth_is_found_where_there_is_none():
    found = model(landmark_extent=0.0)
    assert (
        0 <= found.values["landmark_extent"] <= 4 * found.standard_errors["landmark_extent"] < 0.02
    )
    assert found.values["sigma_bearing"] == pytest.approx(0.015, rel=0.1)


def test_gross_errors_are_counted_and_do_not_spoil_the_rest():
    log = drive(outlier=0.0)
    spoilt = np.arange(0, len(log.frame), 40)
    bearing, distance = np.array(log.bearing), np.array(log.range)
    bearing[spoilt[::2]] = np.clip(bearing[spoilt[::2]] + 1.0, -3.1, 3.1)
    distance[spoilt[1::2]] += 2.0
    clean, found = model(outlier=0.0), fit(replace(log, bearing=bearing, range=distance))
    extra = found.counts["outliers"] - clean.counts["outliers"]
    assert 0.98 * len(spoilt) <= extra <= len(spoilt)
    assert sum(b.outliers for b in found.by_range) == found.counts["outliers"]
    for name in ("sigma_range", "sigma_bearing", "landmark_extent", "mount_yaw"):
        near = 2 * clean.standard_errors[name]
        assert found.values[name] == pytest.approx(clean.values[name], abs=near), name


def test_residuals_by_range_show_what_the_model_says():
    bins = model().by_range
    assert len(bins) == 12
    assert sum(b.count + b.outliers for b in bins) < model().counts["measurements"]
    assert all(a.high == b.low for a, b in pairwise(bins))
    for b in bins:
        assert b.bearing_sd == pytest.approx(b.model_sd, rel=4 / np.sqrt(2 * b.count) + 0.02)
        assert b.range_sd == pytest.approx(0.04, rel=4 / np.sqrt(2 * b.count))
        assert abs(b.range_mean) < 4 * b.range_sd / np.sqrt(b.count)
    assert bins[0].bearing_sd > 1.5 * bins[-1].bearing_sd


def test_measured_identities_serve_where_true_ones_are_missing():
    log = drive()
    truth = log.truth
    without = Truth(truth.time, truth.pose, truth.landmarks, truth.landmark_id)
    found = fit(replace(log, truth=without))
    # What has no measured identity may be anything: it is not called clutter.
    assert found.counts["measurements"] == (log.identity >= 0).sum()
    assert found.values["outlier"] < 1e-3
    assert found.values["landmark_extent"] == model().values["landmark_extent"]


def test_bearings_alone_are_enough():
    found = fit(replace(drive(), range=None))
    assert "sigma_range" not in found.values
    assert np.isnan([b.range_sd for b in found.by_range]).all()
    for name in ("sigma_bearing", "landmark_extent", "mount_yaw", "err_drift"):
        near = 0.3 * found.standard_errors[name]  # outliers in range are no longer left out
        assert found.values[name] == pytest.approx(model().values[name], abs=near), name


def turn_frame(log, yaw):
    """Turn the robot's frame in a log by `yaw` [rad]: by `drive_yaw`, it then drives along x."""
    (x, y, heading), c, s = log.mounting, np.cos(yaw), np.sin(yaw)
    turn, truth = np.array([0, 0, yaw]), log.truth
    if truth is not None and truth.pose is not None:
        truth = replace(truth, pose=truth.pose + turn)
    mounting = c * x + s * y, c * y - s * x, heading - yaw
    return replace(log, mounting=mounting, start_pose=log.start_pose + turn, truth=truth)


def test_turning_the_robots_frame_changes_only_where_it_drives():
    turned = turn_frame(drive(), 0.1)
    found, straight = fit(turned), model()
    assert found.drive_yaw[0] == pytest.approx(straight.drive_yaw[0] - 0.1, abs=1e-4)
    assert found.values["mount_yaw"] == pytest.approx(straight.values["mount_yaw"] - 0.1, abs=1e-6)
    for name in ("sigma_range", "sigma_bearing", "landmark_extent", "err_drift", "gain_rot"):
        assert found.values[name] == pytest.approx(straight.values[name], rel=1e-3), name
    back = turn_frame(turned, -0.1)
    np.testing.assert_allclose(back.mounting, drive().mounting, atol=1e-12)
    np.testing.assert_allclose(back.start_pose, drive().start_pose, atol=1e-12)


def test_the_likelihood_is_the_motion_models(x64):
    rng = np.random.default_rng(0)
    n = 20
    distance, turn = rng.uniform(0.1, 2, n), rng.uniform(0.1, 2, n)
    o = motion.Odometry(
        dx=rng.uniform(-1, 1, n),
        dy=rng.uniform(-1, 1, n),
        dtheta=turn * rng.choice([-1, 1], n),
        distance=distance,
        turn=turn,
        duration=rng.uniform(0.5, 2, n),
        lever=rng.uniform(0, 1, n),
        lever_var=rng.uniform(0, 1 / 12, n),
    )
    params = default_params()._replace(gain_tran=1.1, gain_rot=0.9, bias_drift=0.05, err_rot=0.1)
    before, after = rng.uniform(-3, 3, (2, n, 3))
    floors = params.floor_tran**2 * o.duration, params.floor_rot**2 * o.duration
    squares = params.err_tran**2, params.err_rot**2, params.err_drift**2
    e, cov = motion_residuals([1.1, 0.9, 0.05, *squares, 0.0], o, before, after, floors)
    squared = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e)
    density = -0.5 * (squared + np.linalg.slogdet(cov)[1] + 3 * np.log(2 * np.pi))
    expected = motion.log_density(
        *(tuple(jnp.asarray(pose.T)) for pose in (after, before)), o, params
    )
    np.testing.assert_allclose(density, expected, rtol=1e-9)


def test_results_can_be_stored_as_parameters(tmp_path):
    path, found = tmp_path / "params.toml", model()
    params = default_params()._replace(**found.values)
    save_params(path, params, found.standard_errors)
    assert load_params(path, default_params()) == params
    assert set(found.values) <= set(Params._fields)


def test_bundled_log_has_the_errors_others_found():
    found = fit(load_log("lost-in-the-woods"))
    v, bins = found.values, found.by_range
    assert 59_900 <= found.counts["measurements"] <= 60_100
    assert v["sigma_range"] == pytest.approx(0.033, abs=0.0015)
    # 0.04 m sideways is a tube's radius; far away hardly anything is left.
    assert v["landmark_extent"] == pytest.approx(0.04, abs=0.005)
    assert v["sigma_bearing"] < 0.005
    assert np.degrees(bins[0].bearing_sd) == pytest.approx(2.8, abs=0.3)
    assert np.degrees(bins[-1].bearing_sd) == pytest.approx(0.4, abs=0.1)
    assert v["outlier"] < 0.01
    assert np.degrees(v["mount_yaw"]) == pytest.approx(0, abs=0.2)
    assert v["gain_rot"] == pytest.approx(0.95, abs=0.04)
    assert v["gain_tran"] == pytest.approx(1.01, abs=0.02)
    # Its true headings point 4.6 degrees to the left of where it drives.
    assert found.drive_yaw[0] == pytest.approx(-0.08, abs=0.005)


def without(log, **parts):
    truth = log.truth
    kept = {name: getattr(truth, name) for name in ("time", "pose", "landmarks", "landmark_id",
                                                   "identity", "resolution")}  # fmt: skip
    return replace(log, truth=Truth(**(kept | parts)))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda log: replace(log, truth=None), "true poses"),
        (lambda log: without(log, time=None, pose=None), "true poses"),
        (lambda log: without(log, resolution=0.3), r"finer than 0.02 m \(they have 0.3 m\)"),
        (lambda log: without(log, landmarks=None, landmark_id=None), "true landmarks"),
        (lambda log: without(log, landmarks=np.empty((0, 2)), landmark_id=np.empty(0, int)),
         "30 measurements of known landmarks"),
        (lambda log: replace(without(log, identity=None), identity=None), "identities"),
        (lambda log: replace(log, bearing=None, range=None, point=np.ones((len(log.frame), 2)),
                             point_cov=np.tile([1.0, 0, 1], (len(log.frame), 1))), "bearings"),
        (lambda log: without(log, identity=np.full(len(log.frame), 999)), "30 measurements"),
        (lambda log: replace(log, odometry=np.zeros_like(log.odometry)), "1 m driven"),
        (lambda log: replace(log, odometry=log.odometry[:9], odometry_time=log.odometry_time[:9]),
         "odometry and true poses together"),
    ],
)  # fmt: skip
def test_what_the_log_lacks_is_named(change, message):
    log = change(drive())
    with pytest.raises(ValueError, match=message) as caught:
        fit(log)
    assert str(caught.value).startswith(f"{log.name}: calibration needs ")


@pytest.mark.parametrize("interval", [0.0, -1.0, float("nan")])
def test_an_interval_is_above_zero(interval):
    with pytest.raises(ValueError, match="interval"):
        fit(drive(), interval)
