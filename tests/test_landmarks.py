"""The map of a particle, against plain NumPy in double precision and numbers worked out by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxslam import association, baseline_ekf, births, geometry, landmarks, matched, sensors
from jaxslam.baseline import make_model
from jaxslam.config import SENSORS, Config, default_params
from jaxslam.sensors import Measurements

PARAMS = default_params()._replace(
    growth=0.02, position_scale=1.3, mount_x=0.2, mount_yaw=0.1, caution=0.0
)
COV = (0.04, -0.015, 0.02)  # of a position: correlated
SENSOR_POSE = np.array([0.5, -0.3, 0.8])


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def predict(sensor, mean, anchor):
    """What the sensor should read, from the geometry."""
    if sensor == "bearing":
        point = anchor + np.array([np.cos(mean[0]), np.sin(mean[0])]) / mean[1]
    else:
        point = mean
    dx, dy = point - SENSOR_POSE[:2]
    r, bearing = np.hypot(dx, dy), wrap(np.arctan2(dy, dx) - SENSOR_POSE[2])
    if sensor == "position":
        return r * np.array([np.cos(bearing), np.sin(bearing)]), r
    return np.array([bearing] if sensor == "bearing" else [r, bearing]), r


def jacobian(sensor, mean, anchor, h=1e-6):
    columns = []
    for step in h * np.eye(2):
        ends = [predict(sensor, mean + sign * step, anchor)[0] for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * h))
    return np.array(columns).T


def kalman(sensor, mean, cov, anchor, value):
    """Textbook EKF in covariance form: mean, covariance, log density of the measurement."""
    expected, r = predict(sensor, mean, anchor)
    bearing_var = PARAMS.sigma_bearing**2 + (PARAMS.growth / r) ** 2
    xx, xy, yy = PARAMS.position_scale**2 * np.array(COV)
    noise = {
        "bearing": np.array([[bearing_var]]),
        "range_bearing": np.diag([PARAMS.sigma_range**2, bearing_var]),
        "position": np.array([[xx, xy], [xy, yy]]),
    }[sensor]
    h = jacobian(sensor, mean, anchor)
    s = h @ cov @ h.T + noise
    innovation = value - expected
    if sensor != "position":
        innovation[-1] = wrap(innovation[-1])
    gain = cov @ h.T @ np.linalg.inv(s)
    after = (np.eye(2) - gain @ h) @ cov
    density = multivariate_normal(np.zeros(len(s)), s).logpdf(innovation)
    return mean + gain @ innovation, after, density


def case(sensor, seed):
    """A landmark (mean, lower factor, anchor) and a measurement of it that is some way off."""
    rng = np.random.default_rng(seed)
    low, high = ((-3, 0.2), (3, 1.0)) if sensor == "bearing" else ((2, 2), (5, 5))
    mean, anchor = rng.uniform(low, high), rng.uniform(-1, 1, 2)
    size = 0.05 if sensor == "bearing" else 0.5
    factor = size * np.array([rng.uniform(0.5, 2), rng.uniform(-1, 1), rng.uniform(0.5, 2)])
    value = predict(sensor, mean, anchor)[0] + rng.normal(0, 0.1, 1 if sensor == "bearing" else 2)
    return mean, factor, anchor, value


def matrix(parts):
    xx, xy, yy = (np.asarray(p) for p in parts)
    return np.array([[xx, xy], [xy, yy]])


def padded(value):
    return tuple(np.append(value, 0.0)[:2])


@pytest.mark.parametrize("sensor", ["position", "range_bearing"])
@pytest.mark.parametrize("seed", range(4))
def test_update_is_the_kalman_filter_in_covariance_form(x64, sensor, seed):
    mean, factor, anchor, value = case(sensor, seed)
    cov = matrix(geometry.covariance(factor))
    got, root, density = landmarks.update(
        sensor, SENSOR_POSE, tuple(mean), tuple(factor), anchor, padded(value), COV, PARAMS
    )
    want_mean, want_cov, want_density = kalman(sensor, mean, cov, anchor, value)
    np.testing.assert_allclose(got, want_mean, atol=1e-8)
    np.testing.assert_allclose(matrix(geometry.covariance(root)), want_cov, atol=1e-8)
    assert float(density) == pytest.approx(want_density, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_well_known_bearing_landmark_is_a_kalman_filter(x64, seed):
    mean, factor, anchor, value = case("bearing", seed)
    factor = factor / 100
    cov = matrix(geometry.covariance(factor))
    got, root, density = landmarks.update(
        "bearing", SENSOR_POSE, tuple(mean), tuple(factor), anchor, padded(value), COV, PARAMS
    )
    want_mean, want_cov, want_density = kalman("bearing", mean, cov, anchor, value)
    np.testing.assert_allclose(got - mean, want_mean - mean, rtol=0.02, atol=1e-8)
    np.testing.assert_allclose(matrix(geometry.covariance(root)), want_cov, rtol=2e-3, atol=1e-11)
    assert float(density) == pytest.approx(want_density, abs=1e-3)


def on_a_grid(first, sigma, growth, values, x, size=200):
    """Mean and covariance of (direction, inverse depth) given bearings at (x, 0), sensor ahead."""
    phi = (first + np.linspace(-5, 5, size) * sigma)[:, None]
    rho = np.linspace(1e-3, PARAMS.inv_depth_mean + 5 * PARAMS.inv_depth_sd, size)[None]
    log_p = -0.5 * ((phi - first) ** 2 / (sigma**2 + growth**2 * rho**2))
    log_p = log_p - 0.5 * np.log(sigma**2 + growth**2 * rho**2)
    log_p = log_p - 0.5 * ((rho - PARAMS.inv_depth_mean) / PARAMS.inv_depth_sd) ** 2
    for value, at in zip(values, x, strict=True):
        dx, dy = np.cos(phi) - rho * at, np.sin(phi)
        variance = sigma**2 + growth**2 * rho**2 / (dx**2 + dy**2)
        log_p = log_p - 0.5 * wrap(value - np.arctan2(dy, dx)) ** 2 / variance
        log_p = log_p - 0.5 * np.log(variance)
    p = np.exp(log_p - log_p.max())
    p = p / p.sum()
    mean = np.array([(p * phi).sum(), (p * rho).sum()])
    d0, d1 = phi - mean[0], rho - mean[1]
    return mean, [
        [(p * d0 * d0).sum(), (p * d0 * d1).sum()],
        [(p * d0 * d1).sum(), (p * d1**2).sum()],
    ]


@pytest.mark.parametrize("ahead", [0.0, 3.0, 10.0, 60.0])
def test_a_bearing_landmark_stays_with_the_exact_posterior(ahead):
    """2 m driven past it or towards it, depth drawn from the prior: expected NEES under the exact
    posterior, which should be 2. One EKF has hundreds straight ahead."""
    rng, draws, sigma, growth = np.random.default_rng(5), 40, np.deg2rad(4), 0.02
    params = PARAMS._replace(sigma_bearing=float(sigma), growth=growth)
    first = np.deg2rad(ahead)
    rho = np.abs(rng.normal(params.inv_depth_mean, params.inv_depth_sd, draws))
    phi = first + rng.normal(size=draws) * np.hypot(sigma, growth * rho)
    x = 0.1 * np.arange(1, 21)
    dx, dy = np.cos(phi) - rho * x[:, None], np.sin(phi) + 0 * x[:, None]
    noise = np.sqrt(sigma**2 + growth**2 * rho**2 / (dx**2 + dy**2))
    values = np.arctan2(dy, dx) + noise * rng.normal(size=dx.shape)

    zero = jnp.zeros(draws)
    mean, factor, anchor = sensors.locate("bearing", (zero, zero, zero), (first, 0.0), None, params)

    def look(state, seen):
        at, value = seen
        pose = (zero + at, zero, zero)
        after = landmarks.update("bearing", pose, *state, anchor, (value, 0.0), None, params)
        return after[:2], after[2]

    given = jnp.asarray(x, jnp.float32), jnp.asarray(values, jnp.float32)
    (mean, factor), _ = jax.jit(lambda s, g: jax.lax.scan(look, s, g))((mean, factor), given)
    cov = np.moveaxis(matrix(np.asarray(geometry.covariance(factor), float)), -1, 0)
    nees = []
    for i in range(draws):
        exact_mean, exact_cov = on_a_grid(first, sigma, growth, values[:, i], x)
        off = exact_mean - np.asarray(mean, float)[:, i]
        nees.append(np.trace(np.linalg.solve(cov[i], exact_cov + np.outer(off, off))))
    assert 1.0 < np.median(nees) < 3.0
    assert np.mean(nees) < 10.0


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("seed", range(4))
def test_update_is_the_baselines(x64, sensor, seed):
    mean, factor, anchor, value = case(sensor, seed)
    cov = matrix(geometry.covariance(factor))
    got, root, density = landmarks.update(
        sensor, SENSOR_POSE, tuple(mean), tuple(factor), anchor, padded(value), COV, PARAMS
    )
    other = baseline_ekf.Landmark(mean.copy(), cov.copy(), anchor, 1, 0.0, 0)
    measured = type("Measured", (), {"value": value, "cov": matrix(COV)})
    model = make_model(PARAMS, Config(sensor=sensor))
    expected = baseline_ekf.update(other, measured, SENSOR_POSE, model)
    np.testing.assert_allclose(got, other.mean, atol=1e-11)
    np.testing.assert_allclose(matrix(geometry.covariance(root)), other.cov, atol=1e-11)
    assert float(density) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_two_whitened_scalars_have_the_joint_density(x64, seed):
    rng = np.random.default_rng(seed)
    mean, factor, anchor, value = case("position", seed)
    spread = rng.normal(size=(2, 2))
    noise = spread @ spread.T + 0.01 * np.eye(2)  # of any correlation
    cov = noise[0, 0], noise[0, 1], noise[1, 1]
    *_, density = landmarks.update(
        "position", SENSOR_POSE, tuple(mean), tuple(factor), anchor, tuple(value), cov, PARAMS
    )
    c, s = np.cos(SENSOR_POSE[2]), np.sin(SENSOR_POSE[2])
    turn = np.array([[c, s], [-s, c]])
    prior = turn @ matrix(geometry.covariance(factor)) @ turn.T
    joint = multivariate_normal(
        turn @ (mean - SENSOR_POSE[:2]), prior + PARAMS.position_scale**2 * noise
    )
    assert float(density) == pytest.approx(joint.logpdf(value), abs=1e-9)


def test_bearings_far_behind_never_push_a_landmark_through_infinity(x64):
    anchor, mean, factor = np.array([0.5, -1.5]), (0.9, 0.01), (0.02, 0.0, 0.5)
    value = predict("bearing", np.array(mean), anchor)[0]
    depths = []
    for off in (-0.5, 0.5):
        (_, depth), _, _ = landmarks.update(
            "bearing", SENSOR_POSE, mean, factor, anchor, (value[0] + off, 0.0), COV, PARAMS
        )
        depths.append(float(depth))
    assert min(depths) == sensors.LEAST_INVERSE_DEPTH < max(depths)


def test_bearings_across_the_cut_are_close(x64):
    mean, factor = (
        (SENSOR_POSE[0] - 3 * np.cos(0.8), SENSOR_POSE[1] - 3 * np.sin(0.8)),
        (0.1, 0, 0.1),
    )
    kept = [
        landmarks.update(
            "range_bearing", SENSOR_POSE, mean, factor, None, (3.0, bearing), COV, PARAMS
        )
        for bearing in (np.pi - 0.01, -np.pi - 0.01)
    ]
    np.testing.assert_allclose(kept[0][0], kept[1][0], atol=1e-9)
    assert np.hypot(*(np.array(kept[0][0]) - mean)) < 0.1


# --- maps of several slots (rows) and particles (columns)


def world_of(sensor, count, seed=0, forgetting=True):
    """A map with landmarks in the slots where `count` [M, N] is not zero."""
    count = np.asarray(count)
    slots, particles = count.shape
    rng = np.random.default_rng(seed)
    cases = [[case(sensor, rng.integers(1 << 30)) for _ in range(particles)] for _ in range(slots)]

    def stack(i):
        return jnp.asarray(np.moveaxis([[np.asarray(c[i]) for c in row] for row in cases], -1, 0))

    return landmarks.Landmarks(
        mean=stack(0),
        factor=stack(1),
        anchor=stack(2) if sensor == "bearing" else None,
        log_odds=jnp.full(count.shape, 2.0) if forgetting else None,
        count=jnp.asarray(count, jnp.int32),
        birth=jnp.asarray(rng.integers(0, 100, count.shape), jnp.int32),
    )


def frame_of(sensor, world, match):
    """Measurements that are near what is matched in particle 0; the rest anywhere."""
    rng = np.random.default_rng(9)
    anchor = np.zeros(2)
    values = []
    for slot in np.asarray(match)[:, 0]:
        if slot >= 0:
            anchor = np.zeros(2) if world.anchor is None else np.asarray(world.anchor[:, slot, 0])
            value = predict(sensor, np.asarray(world.mean[:, slot, 0]), anchor)[0]
            values.append(padded(value + rng.normal(0, 0.02, len(value))))
        else:
            values.append((rng.uniform(1, 4), 0.0 if sensor == "bearing" else rng.uniform(-1, 1)))
    k = len(values)
    return Measurements(
        value=jnp.asarray(values),
        cov=jnp.tile(jnp.asarray(COV), (k, 1)),
        identity=jnp.full(k, -1, jnp.int32),
        valid=jnp.asarray(np.asarray(match)[:, 0] != association.PADDING),
        active=jnp.array(True),
    )


def poses(particles):
    return tuple(jnp.full(particles, v) for v in SENSOR_POSE)


def anchors(world):
    return None if world.anchor is None else tuple(world.anchor)


@pytest.mark.parametrize("sensor", SENSORS)
def test_score_is_the_updates_log_density(x64, sensor):
    """Of a bearing it is one normal's, to second order: the baseline's."""
    world = world_of(sensor, [[1, 0, 3], [2, 1, 0]])
    seen = sensors.observe(sensor, poses(3), tuple(world.mean), anchors(world), PARAMS)
    scorer = landmarks.scorer(sensor, seen, world, np.log(0.9))
    value = (2.5, 0.4)
    got = landmarks.score(sensor, scorer, value, COV, PARAMS)
    for m in range(2):
        for n in range(3):
            anchor = None if world.anchor is None else world.anchor[:, m, n]
            *_, density = landmarks.update(
                sensor, SENSOR_POSE, tuple(world.mean[:, m, n]), tuple(world.factor[:, m, n]),
                anchor, value, COV, PARAMS,
            )  # fmt: skip
            if sensor == "bearing":
                cov = matrix(geometry.covariance(world.factor[:, m, n]))
                mark = baseline_ekf.Landmark(world.mean[:, m, n], cov, anchor, 1, 0.0, 0)
                model = make_model(PARAMS, Config(sensor=sensor))
                expected = baseline_ekf.predict(mark, SENSOR_POSE, model)
                measured = SimpleNamespace(value=np.array(value[:1]), cov=None)
                density = baseline_ekf.innovation(mark, measured, expected, model)[2].item()
            expected = np.log(0.9) + float(density) if world.count[m, n] else -np.inf
            assert float(got[m, n]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("sensor", SENSORS)
def test_matched_landmarks_are_updated_marked_and_weighed(x64, sensor):
    world = world_of(sensor, [[1, 0], [2, 5], [4, 1]])
    # The last two measurements share a landmark in the second particle.
    match = jnp.array([[1, -1], [-2, 2], [0, 2], [-3, -3]])
    frame = frame_of(sensor, world, match)
    got, density = matched.updated(sensor, poses(2), world, match, frame, PARAMS, True)
    for n in range(2):
        total = 0.0
        mean, factor = np.array(world.mean[:, :, n]), np.array(world.factor[:, :, n])
        count = np.array(world.count[:, n])
        for k in np.flatnonzero(np.asarray(match)[:, n] >= 0):
            m = int(match[k, n])
            anchor = None if world.anchor is None else world.anchor[:, m, n]
            mean[:, m], factor[:, m], log_density = landmarks.update(
                sensor, SENSOR_POSE, tuple(mean[:, m]), tuple(factor[:, m]), anchor,
                tuple(frame.value[k]), COV, PARAMS,
            )  # fmt: skip
            total += float(log_density) + np.log1p(-PARAMS.outlier)
            count[m] = -1 - abs(count[m])
        np.testing.assert_allclose(got.mean[:, :, n], mean, atol=1e-12)
        np.testing.assert_allclose(got.factor[:, :, n], factor, atol=1e-12)
        np.testing.assert_array_equal(got.count[:, n], count)
        assert float(density[n]) == pytest.approx(total, abs=1e-9)
    np.testing.assert_array_equal(got.count, [[-2, 0], [-3, 5], [4, -3]])
    for name in ("birth", "log_odds"):
        np.testing.assert_array_equal(getattr(got, name), getattr(world, name))


@pytest.mark.parametrize("sensor", SENSORS)
def test_births_take_slots_that_no_particle_uses_in_the_measurements_order(x64, sensor):
    config = Config(sensor=sensor, particles=5, landmarks=5, measurements=4)
    world = world_of(sensor, [[1, 1, 1], [0, 0, 0], [7, 1, 0], [0, 1, 1], [0, 0, 0]])
    match = jnp.array([[-1, -1, -1], [-1, -2, -1], [-2, 0, -1], [-3, -3, -3]])
    frame = frame_of(sensor, world, match)
    free = jnp.array([1, 4, 5, 5])  # slot 3 is in use elsewhere
    whole = jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, 0)] * (leaf.ndim - 1) + [(1, 1)]), world)
    whole, touched, lost = births.create(config, whole, 1, poses(3), match, free, frame, PARAMS, 10)
    got = jax.tree.map(lambda leaf: leaf[..., 1:-1], whole)
    np.testing.assert_array_equal(whole.count[:, [0, -1]], 0)
    np.testing.assert_array_equal(lost, [0, 0, 1])
    np.testing.assert_array_equal(touched, [False, True, False, False, True])
    expected = [[1, 1, 1], [1, 1, 1], [7, 1, 0], [0, 1, 1], [1, 0, 1]]
    np.testing.assert_array_equal(got.count, expected)
    for slot, lane, k in ((1, 0, 0), (4, 0, 1), (1, 1, 0), (1, 2, 0), (4, 2, 1)):
        mean, factor, anchor = sensors.locate(
            sensor, tuple(SENSOR_POSE), tuple(frame.value[k]), COV, PARAMS
        )
        np.testing.assert_allclose(got.mean[:, slot, lane], mean, atol=1e-12)
        np.testing.assert_allclose(got.factor[:, slot, lane], factor, atol=1e-12)
        assert int(got.birth[slot, lane]) == 10 * 4 + k
        assert float(got.log_odds[slot, lane]) == pytest.approx(PARAMS.existence_new)
        if sensor == "bearing":
            np.testing.assert_allclose(got.anchor[:, slot, lane], anchor)
    kept = np.array([[1, 1, 1], [0, 0, 0], [1, 1, 1], [1, 1, 1], [0, 1, 0]], bool)
    for name in ("mean", "factor", "log_odds", "birth"):
        old, new = (np.asarray(getattr(w, name))[..., kept] for w in (world, got))
        np.testing.assert_array_equal(new, old)


def test_what_has_odds_against_it_from_the_start_is_no_landmark(x64):
    config = Config(sensor="range_bearing", particles=2, landmarks=1, measurements=1)
    world = world_of("range_bearing", [[0, 0]])
    match = jnp.array([[-1, -1]])
    frame = frame_of("range_bearing", world, match)
    params = PARAMS._replace(existence_new=-0.1)
    free = jnp.array([0])
    got, *_ = births.create(config, world, 0, poses(2), match, free, frame, params, 0)
    np.testing.assert_array_equal(got.count, [[0, 0]])


def test_known_identities_go_to_their_slot(x64):
    config = Config(association="known", particles=2, landmarks=3, measurements=4)
    world = world_of("range_bearing", [[1, 0], [0, 0], [0, 0]], forgetting=False)
    match = jnp.array([[-1, -1], [0, -1], [-1, -1], [-3, -3]])
    frame = frame_of("range_bearing", world, match)
    frame = frame._replace(identity=jnp.array([2, 0, 5, -1], jnp.int32))
    got, touched, lost = births.create(config, world, 0, poses(2), match, None, frame, PARAMS, 1)
    np.testing.assert_array_equal(got.count, [[1, 1], [0, 0], [1, 1]])
    np.testing.assert_array_equal(lost, [1, 1])  # identity 5 has no slot
    np.testing.assert_array_equal(touched, [True, False, True])
    np.testing.assert_array_equal(got.birth[2], [4, 4])
    assert int(got.birth[0, 1]) == 5
    assert got.log_odds is None
    np.testing.assert_array_equal(got.mean[:, 0, 0], world.mean[:, 0, 0])


def test_existence_by_hand(x64):
    params = PARAMS._replace(
        view_min=-1.0, view_max=1.5, view_range=8.0, detection=0.9,
        existence_seen=0.5, existence_miss=0.1, existence_max=4.0,
    )  # fmt: skip
    log1p = np.log1p
    rows = [
        # count, log-odds, range, bearing -> log-odds, count
        (3, 2.0, 2.0, 0.0, 2 + 0.1 * log1p(-0.9 * 0.75), 3),  # expected and missed
        (3, 2.0, 6.0, 0.0, 2 + 0.1 * log1p(-0.9 * 0.25), 3),  # far away a miss says less
        (3, 2.0, 2.0, -1.0, 2 + 0.1 * log1p(-0.9 * 0.75), 3),  # the view's edges belong to it
        (3, 2.0, 2.0, 1.5, 2 + 0.1 * log1p(-0.9 * 0.75), 3),
        (3, 2.0, 2.0, -1.0001, 2.0, 3),  # beyond them nothing is expected
        (3, 2.0, 2.0, 1.5001, 2.0, 3),
        (3, 2.0, 8.0, 0.0, 2.0, 3),
        (-4, 2.0, 2.0, 0.0, 2.5, -4),  # matched
        (-4, 2.0, 9.0, 3.0, 2.5, -4),  # wherever it was expected
        (-4, 3.8, 2.0, 0.0, 4.0, -4),  # up to a limit
        (-1, 0.5, 2.0, 0.0, 1.0, -1),  # born in this frame: nothing is taken off
        (3, 0.1, 0.5, 0.0, 0.1 + 0.1 * log1p(-0.9 * 0.9375), 0),  # below zero: freed
        (3, 0.3, 0.5, 0.0, 0.3 + 0.1 * log1p(-0.9 * 0.9375), 3),
        (0, -1.0, 2.0, 0.0, -1.0, 0),  # an empty slot is not freed again
    ]
    count, log_odds, r, bearing, want_odds, want_count = map(np.array, zip(*rows, strict=True))
    world = world_of("range_bearing", count[:, None])._replace(log_odds=log_odds[:, None])
    seen = sensors.Seen((), (), (), r[:, None], bearing[:, None])
    got, freed = landmarks.existence(world, seen, params)
    np.testing.assert_allclose(got.log_odds[:, 0], want_odds, atol=1e-12)
    np.testing.assert_array_equal(got.count[:, 0], want_count)
    np.testing.assert_array_equal(freed, [1])


def test_existence_frees_each_particles_own(x64):
    world = world_of("range_bearing", [[1, 1], [1, 1]])
    world = world._replace(log_odds=jnp.array([[1e-3, 1e-3], [1e-3, 5.0]]))
    near = sensors.Seen((), (), (), jnp.ones((2, 2)), jnp.zeros((2, 2)))
    got, freed = landmarks.existence(world, near, PARAMS)
    np.testing.assert_array_equal(freed, [2, 1])
    np.testing.assert_array_equal(got.count, [[0, 0], [0, 1]])


def test_settle_takes_the_marks_off(x64):
    world = world_of("range_bearing", [[-3, 0], [2, -1]])
    got = landmarks.settle(world)
    np.testing.assert_array_equal(got.count, [[3, 0], [2, 1]])
    np.testing.assert_array_equal(got.mean, world.mean)


@pytest.mark.parametrize("sensor", ["range_bearing", "bearing"])
def test_a_given_map_fills_the_first_slots_of_every_particle(x64, sensor):
    config = Config(sensor=sensor, particles=3, landmarks=4)
    rng = np.random.default_rng(0)
    given = rng.normal(size=(2, 2)), rng.uniform(0.1, 1, (3, 2)), rng.normal(size=(2, 2))
    given = given if sensor == "bearing" else given[:2]
    world = births.given(landmarks.empty(config, jnp.zeros(()).dtype), given)
    for n in range(3):
        np.testing.assert_array_equal(world.mean[:, :2, n], given[0])
        np.testing.assert_array_equal(world.factor[:, :2, n], given[1])
        np.testing.assert_array_equal(world.count[:, n], [1, 1, 0, 0])
        # No birth of a frame, nor NEW, CLUTTER or PADDING.
        np.testing.assert_array_equal(world.birth[:2, n], [-4, -5])
        if sensor == "bearing":
            np.testing.assert_array_equal(world.anchor[:, :2, n], given[2])
    np.testing.assert_array_equal(world.mean[:, 2:], 0)


def test_a_given_map_must_fit():
    world = landmarks.empty(Config(particles=2, landmarks=1), jnp.float32)
    with pytest.raises(ValueError, match="2 landmarks given, but the map has 1 slots"):
        births.given(world, (np.zeros((2, 2)), np.ones((3, 2))))


# --- one map for all particles


def test_inverse_depth_in_the_world_against_draws(x64):
    rng = np.random.default_rng(1)
    mean, factor, anchor = (0.7, 0.4), (0.01, 0.004, 0.012), (1.0, -2.0)
    world = landmarks.Landmarks(
        *(jnp.asarray(v)[:, None, None] for v in (mean, factor, anchor)),
        None, jnp.ones((1, 1), jnp.int32), jnp.zeros((1, 1), jnp.int32),
    )  # fmt: skip
    point, cov, known = landmarks.to_world("bearing", world)
    l11, l21, l22 = factor
    draws = np.array(mean) + rng.normal(size=(200_000, 2)) @ np.array([[l11, l21], [0, l22]])
    ray = np.column_stack([np.cos(draws[:, 0]), np.sin(draws[:, 0])])
    drawn = np.array(anchor) + ray / draws[:, 1:]
    assert bool(known[0, 0])
    np.testing.assert_allclose(np.ravel(point), drawn.mean(0), atol=0.01)
    # To first order: the depth's own 3 % make up for the rest.
    want = np.cov(drawn.T)
    np.testing.assert_allclose(matrix(cov)[..., 0, 0], want, atol=0.03 * np.abs(want).max())


@pytest.mark.parametrize("sensor", ["position", "range_bearing"])
def test_points_in_the_world_are_what_they_are(x64, sensor):
    world = world_of(sensor, [[1, 0], [2, 1]])
    point, cov, known = landmarks.to_world(sensor, world)
    np.testing.assert_array_equal(np.array(point), world.mean)
    np.testing.assert_array_equal(np.array(cov), np.array(geometry.covariance(world.factor)))
    assert known.all()


def brute_force(sensor, world, weight, birth):
    """Mean and covariance of the mixture of all particles' landmarks of this birth."""
    point, cov, known = (np.asarray(v) for v in landmarks.to_world(sensor, world))
    shares, means, covs = [], [], []
    for m, n in np.argwhere(np.asarray(world.birth) == birth):
        if world.count[m, n] > 0 and known[m, n]:
            shares.append(weight[n])
            means.append(point[:, m, n])
            covs.append(matrix(cov[:, m, n]))
    shares, means = np.array(shares) / np.sum(shares), np.array(means)
    mean = shares @ means
    own = np.einsum("i,ijk->jk", shares, np.array(covs))
    return mean, own + (means - mean).T @ np.diag(shares) @ (means - mean)


@pytest.mark.parametrize("sensor", ["range_bearing", "bearing"])
def test_the_summary_is_the_mixture_over_the_particles(x64, sensor):
    rng = np.random.default_rng(4)
    particles, slots, best = 6, 5, 2
    count = rng.integers(0, 4, (slots, particles))
    count[:, best] = [2, 1, 0, 3, 1]
    world = world_of(sensor, count)
    # The same births, in each particle in other slots; some in none, some emptied.
    birth = np.array([rng.permutation([3, 14, 15, 92, 65]) for _ in range(particles)]).T
    log_odds = np.full(count.shape, 9.0)
    log_odds[3, best] = 4.9  # not confirmed yet
    factor = np.array(world.factor)
    if sensor == "bearing":
        factor[2, 4, best] = 5.0  # of unknown depth
        factor[2, 0, 0] = 5.0  # and one that another particle must not average in
        birth[[0, *np.flatnonzero(birth[:, 0] == birth[0, best])], 0] = birth[
            [*np.flatnonzero(birth[:, 0] == birth[0, best]), 0], 0
        ]
        count[0, 0] = 2
    world = world._replace(
        birth=jnp.asarray(birth),
        log_odds=jnp.asarray(log_odds),
        factor=jnp.asarray(factor),
        count=jnp.asarray(count),
    )
    weight = rng.dirichlet(np.ones(particles))
    config = Config(sensor=sensor, particles=particles, landmarks=slots)
    table = landmarks.summarise(world, jnp.asarray(weight), best, PARAMS, config)
    ripe = sensor != "bearing"
    np.testing.assert_array_equal(table.kept, [True, True, False, False, ripe])
    np.testing.assert_array_equal(table.birth, birth[:, best])
    np.testing.assert_array_equal(table.count, count[:, best])
    for m in np.flatnonzero(table.kept):
        mean, cov = brute_force(sensor, world, weight, birth[m, best])
        np.testing.assert_allclose(table.mean[:, m], mean, atol=1e-10)
        np.testing.assert_allclose(matrix(table.cov[:, m]), cov, atol=1e-10)


def test_without_existence_every_landmark_is_confirmed(x64):
    world = world_of("range_bearing", [[1, 1], [0, 1]], forgetting=False)
    config = Config(association="known", particles=2, landmarks=2)
    table = landmarks.summarise(world, jnp.array([0.5, 0.5]), 0, PARAMS, config)
    np.testing.assert_array_equal(table.kept, [True, False])


@pytest.mark.parametrize("sensor", SENSORS)
def test_an_empty_map_has_the_arrays_it_needs_and_no_more(sensor):
    for forgetting in (True, False):
        config = Config(sensor=sensor, particles=3, landmarks=2, forgetting=forgetting)
        world = landmarks.empty(config, jnp.float32)
        assert (world.anchor is None) == (sensor != "bearing")
        assert (world.log_odds is None) != forgetting
        assert all(leaf.shape[-2:] == (2, 3) for leaf in jax.tree.leaves(world))
        assert not world.count.any()
