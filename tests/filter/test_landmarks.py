"""The map of a particle, against plain NumPy in double precision and numbers worked out by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from landmark_cases import COV, PARAMS, SENSOR_POSE, matrix, padded, predict, world_of

from jaxslam.config import SENSORS, Config
from jaxslam.filter import association, landmark_updates, landmarks, new_landmarks
from jaxslam.models import geometry, sensors
from jaxslam.models.sensors import Measurements
from jaxslam.reference import ekf
from jaxslam.reference.fastslam import make_model


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
    scorer = landmarks.make_scorer(sensor, seen, world, np.log(0.9))
    value = (2.5, 0.4)
    got = landmarks.log_likelihoods(sensor, scorer, value, COV, PARAMS)
    for m in range(2):
        for n in range(3):
            anchor = None if world.anchor is None else world.anchor[:, m, n]
            *_, density = landmarks.update(
                sensor, SENSOR_POSE, tuple(world.mean[:, m, n]), tuple(world.factor[:, m, n]),
                anchor, value, COV, PARAMS,
            )  # fmt: skip
            if sensor == "bearing":
                cov = matrix(geometry.covariance(world.factor[:, m, n]))
                mark = ekf.Landmark(world.mean[:, m, n], cov, anchor, 1, 0.0, 0)
                model = make_model(PARAMS, Config(sensor=sensor))
                expected = ekf.predict(mark, SENSOR_POSE, model)
                measured = SimpleNamespace(value=np.array(value[:1]), cov=None)
                density = ekf.innovation(mark, measured, expected, model)[2].item()
            expected = np.log(0.9) + float(density) if world.count[m, n] else -np.inf
            assert float(got[m, n]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("sensor", SENSORS)
def test_matched_landmarks_are_updated_marked_and_weighed(x64, sensor):
    world = world_of(sensor, [[1, 0], [2, 5], [4, 1]])
    # The last two measurements share a landmark in the second particle.
    match = jnp.array([[1, -1], [-2, 2], [0, 2], [-3, -3]])
    frame = frame_of(sensor, world, match)
    got, density = landmark_updates.update_matched(
        sensor, poses(2), world, match, frame, PARAMS, True
    )
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
    for name in ("landmark_id", "log_odds"):
        np.testing.assert_array_equal(getattr(got, name), getattr(world, name))


@pytest.mark.parametrize("sensor", SENSORS)
def test_rows_of_known_identities_are_updated_as_the_map_is(x64, sensor):
    """Also where a frame names a landmark three times, or one that no map has."""
    world = world_of(sensor, [[1, 2], [2, 5], [4, 1]])._replace(log_odds=None)
    match = jnp.array([[1, -1], [1, 1], [0, -2], [-3, -3], [-1, -1], [1, 1]])
    identity = jnp.array([1, 1, 0, 2, 7, 1])
    frame = frame_of(sensor, world, match)._replace(identity=identity)
    rows = landmark_updates.known_slots(frame, 3)
    np.testing.assert_array_equal(rows.slot, [1, 1, 0, 3, 3, 1])
    np.testing.assert_array_equal(rows.earlier, [0, 1, 0, 0, 0, 2])
    part = jax.tree.map(lambda leaf: leaf[..., jnp.minimum(rows.slot, 2), :], world)
    fit = landmark_updates.fit_known(sensor, poses(2), part, frame, PARAMS)
    given = rows, match, frame, PARAMS
    got, density = landmark_updates.update_known(sensor, poses(2), part, *given, fit)
    whole, expected = landmark_updates.update_matched(
        sensor, poses(2), world, match, frame, PARAMS, True
    )
    whole = landmarks.unmark_matched(whole)
    for k, slot in ((0, 1), (2, 0)):
        for name in ("mean", "factor", "count"):
            row = getattr(got, name)[..., k, :]
            np.testing.assert_allclose(row, getattr(whole, name)[..., slot, :], atol=1e-12)
    np.testing.assert_allclose(density, expected, atol=1e-9)
    np.testing.assert_array_equal(got.count[0], [5, 7])


@pytest.mark.parametrize("sensor", SENSORS)
def test_births_take_slots_that_no_particle_uses_in_the_measurements_order(x64, sensor):
    config = Config(sensor=sensor, particles=5, landmarks=5, measurements=4)
    world = world_of(sensor, [[1, 1, 1], [0, 0, 0], [7, 1, 0], [0, 1, 1], [0, 0, 0]])
    match = jnp.array([[-1, -1, -1], [-1, -2, -1], [-2, 0, -1], [-3, -3, -3]])
    frame = frame_of(sensor, world, match)
    free = jnp.array([1, 4, 5, 5])  # slot 3 is in use elsewhere
    whole = jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, 0)] * (leaf.ndim - 1) + [(1, 1)]), world)
    whole, touched, lost = new_landmarks.create(
        config, whole, 1, poses(3), match, free, frame, PARAMS, 10
    )
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
        assert int(got.landmark_id[slot, lane]) == 10 * 4 + k
        assert float(got.log_odds[slot, lane]) == pytest.approx(PARAMS.existence_new)
        if sensor == "bearing":
            np.testing.assert_allclose(got.anchor[:, slot, lane], anchor)
    kept = np.array([[1, 1, 1], [0, 0, 0], [1, 1, 1], [1, 1, 1], [0, 1, 0]], bool)
    for name in ("mean", "factor", "log_odds", "landmark_id"):
        old, new = (np.asarray(getattr(w, name))[..., kept] for w in (world, got))
        np.testing.assert_array_equal(new, old)


def test_what_has_odds_against_it_from_the_start_is_no_landmark(x64):
    config = Config(sensor="range_bearing", particles=2, landmarks=1, measurements=1)
    world = world_of("range_bearing", [[0, 0]])
    match = jnp.array([[-1, -1]])
    frame = frame_of("range_bearing", world, match)
    params = PARAMS._replace(existence_new=-0.1)
    free = jnp.array([0])
    got, *_ = new_landmarks.create(config, world, 0, poses(2), match, free, frame, params, 0)
    np.testing.assert_array_equal(got.count, [[0, 0]])


def test_known_identities_go_to_their_slot(x64):
    config = Config(association="known", particles=2, landmarks=3, measurements=4)
    world = world_of("range_bearing", [[1, 0], [0, 0], [0, 0]], forgetting=False)
    match = jnp.array([[-1, -1], [0, -1], [-1, -1], [-3, -3]])
    frame = frame_of("range_bearing", world, match)
    frame = frame._replace(identity=jnp.array([2, 0, 5, -1], jnp.int32))
    got, touched, lost = new_landmarks.create(
        config, world, 0, poses(2), match, None, frame, PARAMS, 1
    )
    np.testing.assert_array_equal(got.count, [[1, 1], [0, 0], [1, 1]])
    np.testing.assert_array_equal(lost, [1, 1])  # identity 5 has no slot
    np.testing.assert_array_equal(touched, [True, False, True])
    np.testing.assert_array_equal(got.landmark_id[2], [4, 4])
    assert int(got.landmark_id[0, 1]) == 5
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
        (-1, 0.5, 2.0, 0.0, 1.0, -1),  # begun in this frame: nothing is subtracted
        (3, 0.1, 0.5, 0.0, 0.1 + 0.1 * log1p(-0.9 * 0.9375), 0),  # below zero: freed
        (3, 0.3, 0.5, 0.0, 0.3 + 0.1 * log1p(-0.9 * 0.9375), 3),
        (0, -1.0, 2.0, 0.0, -1.0, 0),  # an empty slot is not freed again
    ]
    count, log_odds, r, bearing, want_odds, want_count = map(np.array, zip(*rows, strict=True))
    world = world_of("range_bearing", count[:, None])._replace(log_odds=log_odds[:, None])
    seen = sensors.Prediction((), (), (), r[:, None], bearing[:, None])
    got, freed = landmarks.update_existence(world, seen, params)
    np.testing.assert_allclose(got.log_odds[:, 0], want_odds, atol=1e-12)
    np.testing.assert_array_equal(got.count[:, 0], want_count)
    np.testing.assert_array_equal(freed, [1])


def test_existence_frees_each_particles_own(x64):
    world = world_of("range_bearing", [[1, 1], [1, 1]])
    world = world._replace(log_odds=jnp.array([[1e-3, 1e-3], [1e-3, 5.0]]))
    near = sensors.Prediction((), (), (), jnp.ones((2, 2)), jnp.zeros((2, 2)))
    got, freed = landmarks.update_existence(world, near, PARAMS)
    np.testing.assert_array_equal(freed, [2, 1])
    np.testing.assert_array_equal(got.count, [[0, 0], [0, 1]])


def test_settle_takes_the_marks_off(x64):
    world = world_of("range_bearing", [[-3, 0], [2, -1]])
    got = landmarks.unmark_matched(world)
    np.testing.assert_array_equal(got.count, [[3, 0], [2, 1]])
    np.testing.assert_array_equal(got.mean, world.mean)


@pytest.mark.parametrize("sensor", ["range_bearing", "bearing"])
def test_a_given_map_fills_the_first_slots_of_every_particle(x64, sensor):
    config = Config(sensor=sensor, particles=3, landmarks=4)
    rng = np.random.default_rng(0)
    given = rng.normal(size=(2, 2)), rng.uniform(0.1, 1, (3, 2)), rng.normal(size=(2, 2))
    given = given if sensor == "bearing" else given[:2]
    world = new_landmarks.place_given(landmarks.empty(config, jnp.zeros(()).dtype), given)
    for n in range(3):
        np.testing.assert_array_equal(world.mean[:, :2, n], given[0])
        np.testing.assert_array_equal(world.factor[:, :2, n], given[1])
        np.testing.assert_array_equal(world.count[:, n], [1, 1, 0, 0])
        # No id of a frame, nor NEW, CLUTTER or PADDING.
        np.testing.assert_array_equal(world.landmark_id[:2, n], [-4, -5])
        if sensor == "bearing":
            np.testing.assert_array_equal(world.anchor[:, :2, n], given[2])
    np.testing.assert_array_equal(world.mean[:, 2:], 0)


def test_a_given_map_must_fit():
    world = landmarks.empty(Config(particles=2, landmarks=1), jnp.float32)
    with pytest.raises(ValueError, match="2 landmarks given, but the map has 1 slots"):
        new_landmarks.place_given(world, (np.zeros((2, 2)), np.ones((3, 2))))


@pytest.mark.parametrize("sensor", SENSORS)
def test_an_empty_map_has_the_arrays_it_needs_and_no_more(sensor):
    for forgetting in (True, False):
        config = Config(sensor=sensor, particles=3, landmarks=2, forgetting=forgetting)
        world = landmarks.empty(config, jnp.float32)
        assert (world.anchor is None) == (sensor != "bearing")
        assert (world.log_odds is None) != forgetting
        assert all(leaf.shape[-2:] == (2, 3) for leaf in jax.tree.leaves(world))
        assert not world.count.any()
