import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.models import motion
from jaxslam.models.motion import Odometry
from jaxslam.parameters import default_params

QUIET = default_params()._replace(
    err_tran=0.0, err_rot=0.0, err_drift=0.0, floor_tran=0.0, floor_rot=0.0
)
NOISY = default_params()._replace(
    err_tran=0.06, err_rot=0.08, err_drift=0.05, floor_tran=0.01, floor_rot=0.02
)


def command(distance, turn, duration=1.0):
    """Translate, then rotate: the paper's fig. 9."""
    return Odometry(distance, 0.0, turn, abs(distance), abs(turn), duration, 0.0, 0.0)


def small_steps(v, w, dt=0.01):
    """`Odometry` of many small steps of speed v and yaw rate w, and the steps themselves."""
    turn = w * dt
    heading = np.cumsum(turn) - turn
    x, y = np.sum(v * dt * np.cos(heading)), np.sum(v * dt * np.sin(heading))
    path, turned = np.abs(v) * dt, np.abs(turn)
    ahead = (path.sum() - np.cumsum(path)) / max(path.sum(), 1e-12)
    share = turned / max(turned.sum(), 1e-12)
    lever = np.sum(share * ahead) if turned.sum() else 0.5
    lever_var = np.sum(share * (ahead - lever) ** 2) if turned.sum() else 1 / 12
    interval = Odometry(x, y, turn.sum(), path.sum(), turned.sum(), len(v) * dt, lever, lever_var)
    return interval, turn


@pytest.mark.parametrize(
    ("distance", "turn"), [(0.5, 0.3), (-0.5, 0.3), (0.5, 0.0), (0.0, 0.7), (0.0, 0.0)]
)
def test_a_command_translates_then_turns(x64, distance, turn):
    pose = jnp.array([1.0, -2.0, 0.8])
    after = motion.sample(pose, command(distance, turn), QUIET, jnp.ones(3))
    expected = [1 + distance * np.cos(0.8), -2 + distance * np.sin(0.8), 0.8 + turn]
    np.testing.assert_allclose(jnp.stack(after), expected, atol=1e-12)


def test_fig_9_noise_of_a_command(x64):
    """Rotation noise comes after the translation and moves nothing; drift moves it sideways."""
    rotation = QUIET._replace(err_rot=0.1)
    after = motion.sample(jnp.zeros(3), command(0.5, 0.4), rotation, jnp.ones(3))
    np.testing.assert_allclose(jnp.stack(after), [0.5, 0, 0.4 + 0.1 * np.sqrt(0.4)], atol=1e-12)
    along = QUIET._replace(err_tran=0.1)
    after = motion.sample(jnp.zeros(3), command(0.5, 0.4), along, jnp.ones(3))
    np.testing.assert_allclose(jnp.stack(after), [0.5 + 0.1 * np.sqrt(0.5), 0, 0.4], atol=1e-12)
    drift = motion.model(command(0.5, 0.4), QUIET._replace(err_drift=0.1))
    variance = 0.01 * 0.5
    np.testing.assert_allclose(drift.var_heading, variance)
    np.testing.assert_allclose(drift.slope, 0.25)
    np.testing.assert_allclose(drift.slope**2 * variance + drift.var_rest, 0.25 * variance / 3)


def test_turning_on_the_spot_and_standing_keep_the_place(x64):
    params = QUIET._replace(err_rot=0.1, err_drift=0.1, err_tran=0.1)
    x, y, heading = motion.sample(jnp.zeros(3), command(0.0, 1.0), params, jnp.ones(3))
    assert (float(x), float(y)) == (0, 0)
    assert float(heading) == pytest.approx(1.1)
    still = motion.sample(jnp.ones(3), command(0.0, 0.0, 0.0), NOISY, jnp.ones(3))
    np.testing.assert_array_equal(jnp.stack(still), 1)


def test_a_composed_increment_keeps_its_chord(x64):
    interval, _ = small_steps(np.full(200, 0.3), np.full(200, 0.6))
    pose = jnp.array([0.0, 0.0, 1.0])
    x, y, heading = motion.sample(pose, interval, QUIET, jnp.zeros(3))
    c, s = np.cos(1.0), np.sin(1.0)
    expected = [c * interval.dx - s * interval.dy, s * interval.dx + c * interval.dy]
    np.testing.assert_allclose([x, y, heading], [*expected, 1.0 + interval.dtheta], atol=1e-12)


@pytest.mark.parametrize("reverse", [1, -1])
def test_noise_of_an_interval_is_that_of_its_many_small_steps(x64, reverse):
    """Against a simulation of the small steps, each with noise of its own, over a gentle bend."""
    rng = np.random.default_rng(7)
    v, w = reverse * np.full(200, 0.4), 0.3 * np.sin(np.linspace(0, 4, 200))
    interval, turn = small_steps(v, w)
    runs, p = 40_000, NOISY
    pose = np.zeros((3, runs))
    for step_v, step_turn in zip(v, turn, strict=True):
        d = step_v * 0.01
        ahead = d + np.sqrt(p.err_tran**2 * abs(d) + p.floor_tran**2 * 0.01) * rng.normal(size=runs)
        aside = p.floor_tran * 0.1 * rng.normal(size=runs)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        pose[0] += c * ahead - s * aside
        pose[1] += s * ahead + c * aside
        drift = np.sqrt(p.err_drift**2 * abs(d) + p.floor_rot**2 * 0.01) * rng.normal(size=runs)
        pose[2] += step_turn + drift + p.err_rot * np.sqrt(abs(step_turn)) * rng.normal(size=runs)
    drawn = motion.sample(jnp.zeros(3), interval, p, jnp.asarray(rng.normal(size=(3, runs))))
    drawn = np.asarray(jnp.stack(drawn))
    m = motion.model(interval, p)
    rotate = np.array(
        [[np.cos(m.chord), np.sin(m.chord), 0], [-np.sin(m.chord), np.cos(m.chord), 0]]
    )
    rotate = np.vstack([rotate, [0, 0, 1]])
    many, one = np.cov(rotate @ pose), np.cov(rotate @ drawn)
    scale = np.sqrt(np.outer(np.diag(many), np.diag(many)))
    # 40,000 runs: a correlation is known to 0.005; what remains is the bend itself.
    np.testing.assert_allclose(one / scale, many / scale, atol=0.06)
    np.testing.assert_allclose(pose.mean(1), drawn.mean(1), atol=2e-3)


def test_gains_bend_and_stretch_the_path(x64):
    v, w = np.full(200, 0.4), np.full(200, 0.2)
    interval, _ = small_steps(v, w)
    gains = QUIET._replace(gain_tran=1.1, gain_rot=0.9, bias_drift=0.05)
    expected, _ = small_steps(1.1 * v, 0.9 * w + 0.05 * v)
    got = motion.sample(jnp.zeros(3), interval, gains, jnp.zeros(3))
    np.testing.assert_allclose(got, [expected.dx, expected.dy, expected.dtheta], atol=5e-3)
    plain = motion.sample(jnp.zeros(3), interval, QUIET, jnp.zeros(3))
    assert np.abs(np.subtract(got, plain)).max() > 0.05


def test_log_density_is_that_of_the_samples(x64):
    """Change of variables: the density times the Jacobian of the draw is the standard normal's."""
    interval, _ = small_steps(np.full(50, 0.4), np.full(50, 0.5))
    before, normals = jnp.array([0.2, 0.1, -2.0]), jnp.array([0.3, -1.2, 0.7])

    def draw(n):
        return jnp.stack(motion.sample(before, interval, NOISY, n))

    jacobian = jax.jacobian(draw)(normals)
    expected = jax.scipy.stats.norm.logpdf(normals).sum() - jnp.linalg.slogdet(jacobian)[1]
    got = motion.log_density(draw(normals), before, interval, NOISY)
    assert float(got) == pytest.approx(float(expected), abs=1e-9)
