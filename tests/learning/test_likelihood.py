"""The score of the log likelihood: its modes agree, its memory stays, and what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import score_estimators
from test_proposal import ODOMETRY, drive_among_marks

from jaxslam.config import Config
from jaxslam.filter import blocks, resampling
from jaxslam.filter import step as fastslam
from jaxslam.learning import likelihood
from jaxslam.learning.likelihood import Data
from jaxslam.models import motion
from jaxslam.parameters import default_params, learned_by
from jaxslam.simulation.planar import planar

KEY = jax.random.key(4)


FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # compiling
forward = jax.jit(
    likelihood.score_and_value.__wrapped__,
    static_argnames=("config", "names"),
    compiler_options=FAST,
)


def config_of(sensor="range_bearing", association="sampled", particles=8, **changes):
    settings = dict(proposal="informed", landmarks=8, measurements=4, forgetting=False)
    return Config(
        sensor=sensor, association=association, particles=particles, **(settings | changes)
    )


def among_marks(sensor, steps):
    """Parameters and `Data` of a drive past four landmarks; two are given, two are new."""
    position = sensor == "position"
    (odometry, measurements, _), given = drive_among_marks(
        "range_bearing" if position else sensor, steps
    )
    if position:
        r, bearing = measurements.value[..., 0], measurements.value[..., 1]
        value = np.stack([r * np.cos(bearing), r * np.sin(bearing)], -1)
        cov = np.broadcast_to([0.02, 0.005, 0.03], (*r.shape, 3))
        scale = np.broadcast_to([1.0, 0.0, 1.0, 0.0], r.shape)
        measurements = measurements._replace(value=value, cov=cov, scale=scale)
    params = default_params(sensor)._replace(
        err_tran=0.15, err_rot=0.2, err_drift=0.1, floor_tran=0.1, floor_rot=0.05, gain_tran=1.05,
        gain_rot=0.9, bias_drift=0.02, sigma_range=0.1, sigma_bearing=0.08, landmark_extent=0.05,
        position_scale=1.2, mount_x=0.1, mount_y=-0.05, mount_yaw=0.1, outlier=0.1,
        density_new=0.05, view_range=4.0, correlation=0.5, extra_bearing_noise=0.03,
    )  # fmt: skip
    start = np.array([0.02, 0.01, 0.0]), np.diag([0.01, 0.02, 0.01])
    given = tuple(part[:, :2] + 0.1 * (i == 1) for i, part in enumerate(given))
    return jax.tree.map(jnp.asarray, (params, Data(*start, odometry, measurements, given)))


def bounded(cond, body, start, most=8):
    """`jax.lax.while_loop` of at most so many rounds, which can be differentiated backwards."""

    def one(carry, _):
        after = body(carry)
        going = cond(carry)
        return jax.tree.map(lambda new, old: jnp.where(going, new, old), after, carry), None

    return jax.lax.scan(one, start, None, length=most)[0]


def backwards(params, data, config, names, discount):
    """The Fisher score of the whole log, by reverse mode through everything at once.

    Poses are held and judged by `motion.log_density`; weights, draws and ancestors are held.
    """
    start, key = jax.random.split(KEY)
    eager = dataclasses.replace(config, lazy=False)
    hold = jax.lax.stop_gradient

    def total(values):
        given = params._replace(**values)
        state = fastslam.init(eager, start, *data[:2], data.landmarks_given)

        def step(carry, frame):
            state, inherited = carry
            chance = likelihood.draw_for_frame(key, state.step, config)
            seen = blocks.observe(state, chance, *frame, given, config, True)
            drawn = motion.log_density(hold(seen.pose), hold(state.pose), frame[0], given)
            own = discount * inherited + seen.density + drawn
            after, info = fastslam.weigh_and_resample(
                chance, *hold((state, seen)), frame[1], config
            )
            before, weight = hold((jnp.exp(state.log_weight), jnp.exp(info.log_weight)))
            gain = own @ weight - discount * inherited @ before
            common = likelihood.frame_terms(frame[1], given)
            world, own = jax.tree.map(lambda leaf: leaf[..., info.ancestors], (seen.landmarks, own))
            state = after._replace(landmarks=world)
            return (state, own), (gain + common, common, info.resampled)

        zero = jnp.zeros(config.particles)
        last, (gains, common, resampled) = jax.lax.scan(
            step, (state, zero), (data.odometry, data.measurements)
        )
        at_end = last[1] @ jnp.exp(hold(last[0].log_weight)) + common.sum()
        return jnp.where(discount == 1, at_end, gains.sum()), resampled.sum()

    return jax.grad(total, has_aux=True)({name: getattr(params, name) for name in names})


@pytest.mark.parametrize(
    "sensor",
    [
        pytest.param("position", marks=pytest.mark.slow),
        pytest.param("range_bearing", marks=pytest.mark.slow),
        "bearing",
    ],
)
def test_the_forward_score_is_that_of_reverse_mode(x64, monkeypatch, sensor):
    params, data = among_marks(sensor, 4)
    association = "known" if sensor == "position" else "sampled"
    config = config_of(sensor, association, resample_threshold=0.8)
    names = likelihood.learnable(config)
    with monkeypatch.context() as patch:
        patch.setattr(jax.lax, "while_loop", bounded)
        back = quick(lambda alpha: backwards(params, data, config, names, alpha))
        expected = {alpha: back(alpha) for alpha in (1.0, 0.9)}
    for alpha, (gradient, resampled) in expected.items():
        found = likelihood.score(params, data, KEY, config, names, discount=alpha)
        assert 0 < resampled < 4
        wanted = np.array([gradient[name] for name in names])
        assert np.isfinite(wanted).all() and (wanted != 0).all()
        np.testing.assert_allclose(found.total, wanted, rtol=1e-8)


def small(steps=6):
    """A small problem that compiles fast: log, parameters, configuration."""
    log = planar("grid", 1, landmarks=4, length_m=0.1 * steps + 0.05, view=(-np.pi, np.pi, 9.0))
    config = Config(
        sensor="range_bearing", association="known", proposal="prior", particles=16, landmarks=4,
        measurements=4, resample_threshold=0.8,
    )  # fmt: skip
    return log, default_params("range_bearing", log), config


@pytest.fixture(scope="module")
def scored():
    """A small problem, what can be learned, and its `Score`."""
    with jax.enable_x64(True):
        log, params, config = small()
        names, data = likelihood.learnable(config), likelihood.data_from_log(log, config)
        return log, params, config, names, forward(numbers(params), data, KEY, config, names)


def numbers(params):
    return jax.tree.map(jnp.asarray, params)


def quick(function):
    return jax.jit(function, compiler_options=FAST)


def test_grad_is_the_score_of_what_is_learnable(x64, scored):
    log, params, config, names, found = scored

    def of(params):
        return likelihood.log_likelihood(params, log, KEY, config)

    value, gradient = quick(jax.value_and_grad(of))(params)
    assert value == pytest.approx(float(found.log_likelihood), rel=1e-12)
    for name, slope in gradient._asdict().items():
        wanted = found.total[names.index(name)] if name in names else 0.0
        np.testing.assert_allclose(slope, wanted, rtol=1e-10, err_msg=name)
        assert slope != 0 or name not in names or name == "landmark_extent"  # which is 0 here


@pytest.mark.parametrize("name", ["err_rot", "sigma_bearing", "extra_bearing_noise"])
def test_grad_by_one_parameter(x64, scored, name):
    log, params, config, names, found = scored

    @quick
    @jax.grad
    def slope(x):
        return likelihood.log_likelihood(params._replace(**{name: jnp.exp(x)}), log, KEY, config)

    value = getattr(params, name)
    wanted = value * found.total[names.index(name)] if name in names else 0.0
    at = np.log(value) if value else 0.0
    assert slope(at) == pytest.approx(float(wanted), rel=1e-10)


def test_plain_is_what_differentiation_of_the_value_gives(x64, scored, monkeypatch):
    log, params, config, *_ = scored
    data, names = likelihood.data_from_log(log, config), ("err_tran", "sigma_bearing", "outlier")
    plain = quick(lambda p: score_estimators.score(p, data, KEY, config, names, "plain"))
    found = plain(numbers(params))
    choose = resampling.systematic  # has no derivative at all
    monkeypatch.setattr(
        resampling, "systematic", lambda *chances: choose(*jax.lax.stop_gradient(chances))
    )

    def of(values):
        given = params._replace(**dict(zip(names, values, strict=True)))
        return likelihood.value.__wrapped__(given, data, KEY, config)

    at = jnp.array([getattr(params, name) for name in names])
    np.testing.assert_allclose(found.total, quick(jax.jacfwd(of))(at), rtol=1e-9)
    np.testing.assert_allclose(found.steps.sum(0), found.total, rtol=1e-9)


def test_frames_of_nothing_at_the_end_change_nothing(x64, scored):
    log, params, config, names, bare = scored
    data = likelihood.data_from_log(log, config, steps=len(log.frame_time) + 3)
    assert data.measurements.active.sum() == len(log.frame_time)
    padded = forward(numbers(params), data, KEY, config, names)
    np.testing.assert_allclose(padded.total, bare.total, rtol=1e-12)
    assert padded.log_likelihood == pytest.approx(float(bare.log_likelihood), rel=1e-12)
    np.testing.assert_allclose(padded.steps[-3:], 0, atol=1e-12)


def test_temporary_memory_does_not_grow_with_the_log():
    log, params, config = small()
    data, used = likelihood.data_from_log(log, config), []

    def repeated(steps):
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct((steps, *leaf.shape[1:]), leaf.dtype), data[2:4]
        )

    for steps in (500, 5000):
        long = Data(*data[:2], *repeated(steps))
        lowered = forward.lower(numbers(params), long, KEY, config, ("err_tran", "sigma_range"))
        used.append(lowered.compile().memory_analysis().temp_size_in_bytes)
    assert used[0] > 0
    assert used[1] == used[0]


def test_the_motions_score_is_the_slope_of_its_density(x64):
    params = default_params()._replace(
        err_tran=0.1, err_rot=0.2, err_drift=0.15, floor_tran=0.05, floor_rot=0.04, gain_tran=1.1,
        gain_rot=0.9, bias_drift=0.05,
    )  # fmt: skip
    before, u = (0.4, -0.3, 0.7), np.random.default_rng(0).normal(size=(3, 5))
    after = motion.sample(before, ODOMETRY, params, u)
    found = likelihood.motion_score(u, ODOMETRY, params, learned_by("motion"))
    for name in learned_by("motion"):
        value, step = getattr(params, name), 1e-6
        more, less = (
            motion.log_density(after, before, ODOMETRY, params._replace(**{name: value + s}))
            for s in (step, -step)
        )
        np.testing.assert_allclose(found[name], (more - less) / (2 * step), rtol=1e-6, atol=1e-6)


def test_directions_without_noise_have_no_score(x64):
    params = default_params()._replace(
        err_tran=0.1, floor_tran=0.05, err_rot=0.0, err_drift=0.0, floor_rot=0.0, gain_tran=1.1
    )
    u = np.random.default_rng(0).normal(size=(3, 50_000))
    found = likelihood.motion_score(u, ODOMETRY, params, learned_by("motion"))
    for name in ("err_rot", "err_drift", "floor_rot"):
        assert (found[name] == 0).all()
    for name in ("err_tran", "floor_tran", "gain_tran"):  # a score's mean is zero
        assert abs(found[name].mean()) < 4 * found[name].std() / np.sqrt(u.shape[1])
        assert found[name].std() > 0


def test_what_is_refused():
    log, params, config = small()
    for names, told in (
        (
            ("extra_bearing_noise",),
            "'extra_bearing_noise' can't be learned with sensor range_bearing; these can: err_tran",
        ),
        (("inv_depth_sd",), "'inv_depth_sd' can't be learned"),
        (("position_scale",), "'position_scale' can't be learned"),
    ):
        with pytest.raises(ValueError, match=told):
            likelihood.score(params, log, KEY, config, names)
    certain = Config(clutter=False)
    assert "outlier" not in likelihood.learnable(certain)
    with pytest.raises(ValueError, match="'outlier' can't be learned"):
        likelihood.score(params, log, KEY, certain, ("outlier",))
    with pytest.raises(ValueError, match="estimator: 'score' is not one of fisher, pathwise, pla"):
        score_estimators.score(params, log, KEY, config, (), "score")
    with pytest.raises(ValueError, match="has 6 frames, more than the 5 asked for"):
        likelihood.data_from_log(log, config, steps=5)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["range_bearing", "bearing"])
def test_the_mean_score_is_that_of_particles_that_are_never_resampled(x64, sensor):
    """Where nothing is linear: E[Zhat score] is grad Z whatever proposes the poses.

    Without resampling and draws of associations Zhat is smooth, and its own derivative is right.
    """
    params, data = among_marks(sensor, 3)
    names = ("err_rot", "gain_tran", "sigma_bearing", "mount_x", "mount_yaw")

    def runs(config, estimator, count):
        def one(key):
            found = score_estimators.score(params, data, key, config, names, estimator, 1.0)
            return found.log_likelihood, found.total, found.min_ess

        keys = jax.random.split(jax.random.key(3), count)
        return jax.tree.map(
            np.asarray, jax.jit(lambda keys: jax.lax.map(one, keys, batch_size=500))(keys)
        )

    known = dict(clutter=False, landmarks=4)
    few = config_of(sensor, "known", 4, resample_threshold=0.8, **known)
    many = config_of(sensor, "known", 32, resample_threshold=0, **known | dict(proposal="prior"))
    found, wanted = runs(few, "fisher", 20_000), runs(many, "plain", 5_000)
    assert np.mean(found[2] < 0.8 * 4) > 0.5
    scale = np.exp(wanted[0] - wanted[0].max()).mean()
    ratio, right = (np.exp(one[0] - wanted[0].max()) / scale for one in (found, wanted))
    slope = right @ wanted[1] / right.sum()
    off = [w[:, None] * np.insert(one[1] - slope, 0, 1.0, 1)
           for w, one in ((ratio, found), (right, wanted))]  # fmt: skip
    error = np.sqrt(sum(part.var(0) / len(part) for part in off))
    z = (off[0].mean(0) - off[1].mean(0)) / error
    assert np.abs(z).max() < 4 and error.max() < 0.5
