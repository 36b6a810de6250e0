"""Steps of the filter: invariances, shapes, flags, and that it compiles once."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import SENSORS, Config
from jaxslam.filter import association
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames_from_log
from jaxslam.models import motion
from jaxslam.parameters import default_params
from jaxslam.results.metrics import ate
from jaxslam.runs.run import config_for, run
from jaxslam.simulation.planar import planar

STEPS, PARTICLES, BLIND = 40, 16, 15
DRAWN = dict(proposal="informed", association="sampled")


@pytest.fixture(scope="module")
def log():
    return planar("field", 5, landmarks=25, length_m=12.0, rate_hz=2.0, outlier=0.05)


def setup(log, sensor="range_bearing", **settings):
    config = config_for(log, sensor, particles=PARTICLES, landmarks=30, block=8, **settings)
    params = default_params(sensor, log)
    data = frames_from_log(log, config, params)
    real = jnp.zeros(()).dtype
    data = jax.tree.map(
        lambda leaf: jnp.asarray(
            leaf[:STEPS].astype(real) if leaf.dtype.kind == "f" else leaf[:STEPS]
        ),
        (data.odometry, data.measurements),
    )
    return config, jax.tree.map(jnp.asarray, params), data


def chances(config, steps=STEPS):
    key = jax.random.key(0)
    return jax.vmap(lambda i: fastslam.draw_random_numbers(key, i, config))(jnp.arange(steps))


@partial(jax.jit, static_argnames="config")
def _scan(state, chance, data, params, config):
    def body(state, inputs):
        return fastslam.advance(inputs[0], state, *inputs[1], params, config)

    return jax.lax.scan(body, state, (chance, data))


def drive(config, params, data, chance, start=(0.0, 0.0, 0.0)):
    """All steps with given random numbers; the last state and every `Info`."""
    state = fastslam.init(config, jax.random.key(1), start)
    return _scan(state, chance, data, params, config)


def turned_and_shifted(state, sensor, angle, shift):
    """Poses [3, N] and landmarks' means [2, M, N] of the state in a turned and shifted world."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    pose, mean = np.array(state.pose), np.array(state.landmarks.mean)
    pose = np.vstack([turn @ pose[:2] + shift[:, None], pose[2] + angle])
    if sensor == "bearing":
        return pose, mean + np.array([angle, 0])[:, None, None]
    return pose, np.einsum("ij,jmn->imn", turn, mean) + shift[:, None, None]


def mirrored(params, data, chance, sensor):
    flip = jnp.array([1.0, -1.0, -1.0])[None, :, None]
    odometry, measurements = data
    odometry = odometry._replace(dy=-odometry.dy, dtheta=-odometry.dtheta)
    sign = jnp.array([-1.0, 1.0] if sensor == "bearing" else [1.0, -1.0])
    measurements = measurements._replace(
        value=measurements.value * sign, cov=measurements.cov * jnp.array([1.0, -1.0, 1.0])
    )
    params = params._replace(
        mount_y=-params.mount_y,
        mount_yaw=-params.mount_yaw,
        view_min=-params.view_max,
        view_max=-params.view_min,
    )
    return params, (odometry, measurements), chance._replace(normals=chance.normals * flip)


@pytest.mark.parametrize("settings", [{}, DRAWN], ids=["likeliest", "drawn"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_a_moved_or_mirrored_world_gives_the_answer_moved_or_mirrored(x64, log, sensor, settings):
    config, params, data = setup(log, sensor, **settings)
    data = data[0], data[1]._replace(active=data[1].active.at[BLIND].set(False))
    chance = chances(config)
    state, info = drive(config, params, data, chance)
    assert info.resampled.sum() > 3
    assert (info.log_choice.min() < -0.1) == (settings == DRAWN)
    # Without measurements informed particles, too, are drawn from the motion model.
    before = info.pose[BLIND - 1][:, info.ancestors[BLIND - 1]]
    odometry = jax.tree.map(lambda leaf: leaf[BLIND], data[0])
    expected = jnp.stack(motion.sample(before, odometry, params, chance.normals[BLIND]))
    np.testing.assert_allclose(info.pose[BLIND], expected, atol=1e-12)
    np.testing.assert_array_equal(info.match[BLIND], association.PADDING)

    angle, shift = 2.1, np.array([700.0, -400.0])
    moved, moved_info = drive(config, params, data, chance, (*shift, angle))
    np.testing.assert_array_equal(info.ancestors, moved_info.ancestors)
    np.testing.assert_array_equal(info.match, moved_info.match)
    np.testing.assert_allclose(info.log_evidence, moved_info.log_evidence, atol=1e-8)
    pose, mean = turned_and_shifted(state, sensor, angle, shift)
    np.testing.assert_allclose(moved.pose[:2], pose[:2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * np.asarray(moved.pose[2] - pose[2])), 1, atol=1e-11)
    used = np.asarray(state.landmarks.count > 0)
    off = np.asarray(moved.landmarks.mean - mean)[:, used]
    if sensor == "bearing":
        off[0] = np.abs(np.exp(1j * off[0]) - 1)
    np.testing.assert_allclose(off, 0, atol=1e-9)

    flipped, flipped_info = drive(config, *mirrored(params, data, chance, sensor))
    np.testing.assert_array_equal(info.ancestors, flipped_info.ancestors)
    np.testing.assert_array_equal(info.match, flipped_info.match)
    np.testing.assert_allclose(flipped.pose, state.pose * np.array([[1], [-1], [-1]]), atol=1e-10)


@pytest.mark.parametrize("kind", ["known", "maximum_likelihood"])
def test_the_order_within_a_frame_changes_nothing(x64, log, kind):
    config, params, data = setup(log, association=kind)
    chance = chances(config)
    state, info = drive(config, params, data, chance)
    order = np.random.default_rng(0).permutation(config.measurements)
    odometry, measurements = data
    shuffled = measurements._replace(
        **{
            name: getattr(measurements, name)[:, order]
            for name in ("value", "cov", "identity", "valid")
        }
    )
    other, other_info = drive(config, params, (odometry, shuffled), chance)
    np.testing.assert_array_equal(info.log_choice, 0)
    np.testing.assert_array_equal(info.ancestors, other_info.ancestors)
    np.testing.assert_allclose(info.log_evidence, other_info.log_evidence, atol=1e-9)
    np.testing.assert_allclose(state.pose, other.pose, atol=1e-12)
    for i in range(PARTICLES):  # the same landmarks, perhaps in other slots
        maps = [
            np.sort(np.where(s.landmarks.count[:, i] > 0, s.landmarks.mean[0, :, i], 99))
            for s in (state, other)
        ]
        np.testing.assert_allclose(*maps, atol=1e-9)


@pytest.mark.parametrize(("block", "settings"), [(1, {}), (1000, DRAWN)])
def test_the_block_changes_no_result(x64, log, block, settings):
    config, params, data = setup(log, **settings)
    chance = chances(config)
    state, info = drive(config, params, data, chance)
    other, other_info = drive(dataclasses.replace(config, block=block), params, data, chance)
    np.testing.assert_array_equal(info.match, other_info.match)
    np.testing.assert_allclose(info.log_choice, other_info.log_choice, atol=1e-9)
    np.testing.assert_allclose(state.pose, other.pose, atol=1e-12)
    np.testing.assert_array_equal(state.landmarks.count, other.landmarks.count)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("settings", [{}, {"association": "known"}, DRAWN])
def test_a_step_keeps_shapes_and_types(log, sensor, settings):
    config, params, data = setup(log, sensor, **settings)
    key = jax.random.key(0)
    state = fastslam.init(config, key)
    frame = jax.tree.map(lambda leaf: leaf[0], data)
    after, info = jax.eval_shape(
        lambda *args: fastslam.step(*args, config=config), key, state, *frame, params
    )
    before = jax.eval_shape(lambda: state)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert jax.tree.leaves(before) == jax.tree.leaves(after)
    assert info.match.shape == (config.measurements, PARTICLES)
    assert info.estimate.cov.shape == (3, 3)


def test_a_step_compiles_once_for_a_configuration(log):
    config, params, data = setup(log)
    key = jax.random.key(0)
    state = fastslam.init(config, key)
    before = fastslam.step._cache_size()
    for t in range(4):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], data)
        again = params._replace(err_tran=params.err_tran * (1 + t))
        state, _ = fastslam.step(key, state, *frame, again, config)
    assert fastslam.step._cache_size() == before + 1


def test_a_full_map_is_reported(log):
    config = config_for(log, particles=20, landmarks=3)
    result = run(log, config, refine=False)
    assert result.overflow.sum() > 1
    assert any("map was full" in line for line in result.flags)


def test_measurements_that_are_not_finite_are_flagged(log):
    config, params, data = setup(log)
    key = jax.random.key(0)
    state = fastslam.init(config, key)
    frame = jax.tree.map(lambda leaf: leaf[0], data)
    for t in range(3):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], data)
        state, info = fastslam.step(key, state, *frame, params, config)
    assert int(info.nonfinite) == 0
    assert not bool(info.degenerate)
    state = state._replace(pose=state.pose.at[0, :3].set(jnp.nan))
    frame = jax.tree.map(lambda leaf: leaf[4], data)
    after, info = fastslam.step(key, state, *frame, params, config)
    assert int(info.nonfinite) == 3
    assert not bool(info.degenerate)
    lost = state._replace(pose=state.pose.at[0].set(jnp.nan))
    after, info = fastslam.step(key, lost, *frame, params, config)
    assert bool(info.degenerate)
    np.testing.assert_allclose(jnp.exp(after.log_weight).sum(), 1, rtol=1e-5)


def test_a_frame_without_a_look_only_moves(log):
    config, params, data = setup(log)
    key = jax.random.key(0)
    state = fastslam.init(config, key)
    for t in range(5):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], data)
        state, _ = fastslam.step(key, state, *frame, params, config)
    odometry, measurements = jax.tree.map(lambda leaf: leaf[5], data)
    blind = measurements._replace(active=jnp.array(False))
    after, info = fastslam.step(key, state, odometry, blind, params, config)
    assert float(info.log_evidence) == pytest.approx(0, abs=1e-5)
    for old, new in zip(
        jax.tree.leaves(state.landmarks), jax.tree.leaves(after.landmarks), strict=True
    ):
        np.testing.assert_array_equal(old, new)
    assert not np.allclose(state.pose, after.pose)


def test_forward_gradients_flow_and_match_finite_differences(x64, log):
    """Along one fixed history (no resampling), by parameters that move everything smoothly."""
    config, params, data = setup(log, association="known", resample_threshold=0.0, clutter=False)
    data = jax.tree.map(lambda leaf: leaf[:10], data)
    chance = chances(config, 10)

    def total(sigma, gain):
        p = params._replace(sigma_bearing=sigma, gain_rot=gain)
        return drive(config, p, data, chance)[1].log_evidence.sum()

    at = (0.03, 1.0)
    got = jax.jacfwd(total, (0, 1))(*at)
    h = 1e-6
    for i in range(2):
        up, down = list(at), list(at)
        up[i], down[i] = up[i] + h, down[i] - h
        slope = (total(*up) - total(*down)) / (2 * h)
        assert float(got[i]) == pytest.approx(float(slope), rel=1e-5)


def test_start_poses_have_the_covariance_asked_for(x64):
    config = Config(particles=50_000, landmarks=1, measurements=1)
    cov = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.05]])
    state = fastslam.init(config, jax.random.key(0), (1.0, 2.0, 0.5), cov)
    np.testing.assert_allclose(np.cov(state.pose), cov, atol=2e-3)
    np.testing.assert_allclose(state.pose.mean(1), [1, 2, 0.5], atol=5e-3)
    flat = np.diag([0.04, 0.0, 0.0])
    state = fastslam.init(config, jax.random.key(0), (1.0, 2.0, 0.5), flat)
    np.testing.assert_allclose(np.cov(state.pose), flat, atol=2e-3)


def test_drawn_results_are_sound_and_do_not_depend_on_the_chunks(log, monkeypatch):
    config = config_for(log, particles=20, landmarks=60, **DRAWN)
    whole = run(log, config, refine=False)
    assert whole.flags == []
    assert whole.forgotten.sum() > 0
    assert ate(whole.pose, log.truth.pose, align=False)[0] < 0.5
    monkeypatch.setattr("jaxslam.runs.compiled.CHUNK", 7)
    parts = run(log, config, refine=False)
    np.testing.assert_allclose(whole.pose, parts.pose, atol=1e-6)
    np.testing.assert_array_equal(whole.match, parts.match)
