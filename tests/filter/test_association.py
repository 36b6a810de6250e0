import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter.association import CLUTTER, NEW, PADDING, _possible, associate
from jaxslam.filter.landmarks import Scorer, log_likelihoods
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params

K, M, N = 5, 7, 300


def frame(value, identity=None, valid=None):
    k = len(value)
    return Measurements(
        value=jnp.stack([jnp.asarray(value, float), jnp.zeros(k)], 1),
        cov=jnp.zeros((k, 3)),
        identity=jnp.full(k, -1) if identity is None else jnp.asarray(identity),
        valid=jnp.ones(k, bool) if valid is None else jnp.asarray(valid),
        active=jnp.array(True),
    )


def scorer_of(bearing, occupied):
    """Bearing landmarks whose log density is -(difference)^2 / 2."""
    shape = bearing.shape
    return Scorer(
        value=(jnp.asarray(bearing),),
        matrix=(jnp.full(shape, -0.5),),
        constant=jnp.where(jnp.asarray(occupied), 0.0, -jnp.inf),
    )


def greedy(table, threshold):
    """Take the best free pair, over and over; by sorting all pairs."""
    match = np.full(table.shape[0], -1)
    for flat in np.argsort(-table, axis=None):
        k, m = np.unravel_index(flat, table.shape)
        if table[k, m] > threshold[k] and match[k] < 0 and m not in match:
            match[k] = m
    return match


def case(seed, spread):
    rng = np.random.default_rng(seed)
    bearing, occupied = rng.uniform(-spread, spread, (M, N)), rng.uniform(size=(M, N)) < 0.8
    value, valid = rng.uniform(-spread, spread, K), rng.uniform(size=K) < 0.8
    table = -0.5 * (value[:, None, None] - bearing) ** 2
    table = np.where(occupied & valid[:, None, None], table, -np.inf)
    return frame(value, valid=valid), scorer_of(bearing, occupied), table, valid


@pytest.mark.parametrize("spread", [0.05, 0.5, 1.5])
def test_exclusive_matching_takes_the_best_pair_first(x64, spread):
    config = Config(sensor="bearing", measurements=K, landmarks=M, particles=N)
    measurements, scorer, table, valid = case(int(100 * spread), spread)
    new = jnp.full(K, -0.02)
    match, _ = associate(config, scorer, measurements, new, -0.5, default_params("bearing"))
    conflicts = 0
    for i in range(N):
        expected = greedy(table[:, :, i], np.full(K, -0.02))
        conflicts += (table[:, :, i].argmax(1)[valid] != expected[valid]).any()
        expected = np.where(expected < 0, NEW, expected)
        np.testing.assert_array_equal(match[:, i], np.where(valid, expected, PADDING))
    assert conflicts > N / 10


def test_the_order_of_the_measurements_does_not_matter(x64):
    config = Config(sensor="bearing", measurements=K, landmarks=M, particles=N)
    measurements, scorer, _, _ = case(5, 0.3)
    order = np.array([3, 0, 4, 1, 2])
    shuffled = jax.tree.map(lambda leaf: leaf[order] if leaf.ndim else leaf, measurements)
    params, new = default_params("bearing"), jnp.full(K, -0.1)
    one, _ = associate(config, scorer, measurements, new, -9.0, params)
    other, _ = associate(config, scorer, shuffled, new, -9.0, params)
    np.testing.assert_array_equal(one[order], other)


def test_not_exclusive_every_measurement_takes_its_best(x64):
    config = Config(sensor="bearing", measurements=K, landmarks=M, particles=N, exclusive=False)
    measurements, scorer, table, valid = case(2, 0.5)
    match, _ = associate(config, scorer, measurements, jnp.full(K, -5.0), -9.0, default_params())
    expected = np.where(valid[:, None], table.argmax(1), PADDING)
    np.testing.assert_array_equal(match, expected)
    assert any(len(set(column[valid])) < valid.sum() for column in np.asarray(match).T)


def test_what_fits_nothing_is_new_or_clutter_whichever_is_likelier():
    config = Config(sensor="bearing", measurements=2, landmarks=1, particles=1)
    scorer = scorer_of(np.zeros((1, 1)), np.ones((1, 1), bool))
    far = frame([1.0, 1.5])
    new = jnp.array([-0.2, -0.9])
    match, _ = associate(config, scorer, far, new, -0.3, default_params())
    np.testing.assert_array_equal(match[:, 0], [NEW, CLUTTER])
    match, _ = associate(config, scorer, far, jnp.array([-0.6, -3.0]), -3.0, default_params())
    np.testing.assert_array_equal(match[:, 0], [0, NEW])  # one landmark, and it goes to the nearer


def test_known_identities_are_slots():
    config = Config(sensor="bearing", association="known", measurements=5, landmarks=3, particles=1)
    scorer = scorer_of(np.zeros((3, 1)), np.array([[True], [True], [False]]))
    measurements = frame([0.1, 3.0, 0.0, 0.0, 0.0], [1, 0, 2, 7, 1], [True] * 4 + [False])
    match, _ = associate(config, scorer, measurements, jnp.full(5, -1.0), -2.0, default_params())
    # fits; clutter is likelier; slot empty; no such slot; padding
    np.testing.assert_array_equal(match[:, 0], [1, CLUTTER, NEW, NEW, PADDING])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scatter", [0.01, 0.3, 4.0])
def test_slots_that_are_passed_over_could_not_have_matched(x64, seed, scatter):
    """Range and bearing, strongly correlated, across the seam at pi, against a dense table."""
    rng = np.random.default_rng(seed)
    slots, lanes, k = 40, 64, 6
    r = rng.uniform(1, 6, (slots, 1)) + scatter * rng.normal(size=(slots, lanes))
    b = rng.uniform(-np.pi, np.pi, (slots, 1)) + scatter * rng.normal(size=(slots, lanes))
    sd0, sd1 = rng.uniform(0.02, 0.1, (2, slots, lanes))
    s01 = sd0 * sd1 * rng.uniform(-0.999, 0.999, (slots, lanes))
    det = sd0**2 * sd1**2 - s01**2
    scorer = Scorer(
        value=(jnp.asarray(r), jnp.asarray((b + np.pi) % (2 * np.pi) - np.pi)),
        matrix=tuple(map(jnp.asarray, (-0.5 * sd1**2 / det, s01 / det, -0.5 * sd0**2 / det))),
        constant=jnp.where(rng.uniform(size=det.shape) < 0.9, -0.5 * np.log(det), -jnp.inf),
    )
    value = np.stack([r[:k, 0], b[:k, 0]], 1) + 0.03 * rng.normal(size=(k, 2))
    measurements = frame(np.zeros(k))._replace(value=jnp.asarray(value))
    config = Config(measurements=k, landmarks=slots, particles=lanes, exclusive=False)
    params, threshold = default_params(), jnp.full(k, -1.0)
    match, _ = associate(config, scorer, measurements, threshold, -9.0, params)
    columns = tuple(jnp.asarray(value[:, i, None, None]) for i in range(2))
    table = np.asarray(log_likelihoods("range_bearing", scorer, columns, None, params))
    expected = np.where(table.max(1) > -1, table.argmax(1), NEW)
    np.testing.assert_array_equal(match, expected)
    possible = _possible(config, scorer, measurements, threshold)
    assert (match >= 0).any()
    assert possible[(table > -1).any(-1)].all()
    assert not possible.all() or scatter > 0.01  # a tight block passes most over
