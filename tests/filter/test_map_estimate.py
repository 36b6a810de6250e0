"""One map for all particles: landmarks in the world, and their summary."""

import jax.numpy as jnp
import numpy as np
import pytest
from landmark_cases import PARAMS, matrix, world_of

from jaxslam.config import Config
from jaxslam.filter import landmarks, map_estimate
from jaxslam.models import geometry


def test_inverse_depth_in_the_world_against_draws(x64):
    rng = np.random.default_rng(1)
    mean, factor, anchor = (0.7, 0.4), (0.01, 0.004, 0.012), (1.0, -2.0)
    world = landmarks.Landmarks(
        *(jnp.asarray(v)[:, None, None] for v in (mean, factor, anchor)),
        None, jnp.ones((1, 1), jnp.int32), jnp.zeros((1, 1), jnp.int32),
    )  # fmt: skip
    point, cov, known = map_estimate.to_world("bearing", world)
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
    point, cov, known = map_estimate.to_world(sensor, world)
    np.testing.assert_array_equal(np.array(point), world.mean)
    np.testing.assert_array_equal(np.array(cov), np.array(geometry.covariance(world.factor)))
    assert known.all()


def brute_force(sensor, world, weight, landmark_id):
    """Mean and covariance of the mixture of all particles' landmarks of this id."""
    point, cov, known = (np.asarray(v) for v in map_estimate.to_world(sensor, world))
    shares, means, covs = [], [], []
    for m, n in np.argwhere(np.asarray(world.landmark_id) == landmark_id):
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
    # The same landmarks, in each particle in other slots; some in none, some emptied.
    landmark_id = np.array([rng.permutation([3, 14, 15, 92, 65]) for _ in range(particles)]).T
    log_odds = np.full(count.shape, 9.0)
    log_odds[3, best] = 4.9  # not confirmed yet
    factor = np.array(world.factor)
    if sensor == "bearing":
        factor[2, 4, best] = 5.0  # of unknown depth
        factor[2, 0, 0] = 5.0  # and one that another particle must not average in
        landmark_id[[0, *np.flatnonzero(landmark_id[:, 0] == landmark_id[0, best])], 0] = (
            landmark_id[[*np.flatnonzero(landmark_id[:, 0] == landmark_id[0, best]), 0], 0]
        )
        count[0, 0] = 2
    world = world._replace(
        landmark_id=jnp.asarray(landmark_id),
        log_odds=jnp.asarray(log_odds),
        factor=jnp.asarray(factor),
        count=jnp.asarray(count),
    )
    weight = rng.dirichlet(np.ones(particles))
    config = Config(sensor=sensor, particles=particles, landmarks=slots)
    table = map_estimate.summarise(world, jnp.asarray(weight), best, PARAMS, config)
    ripe = sensor != "bearing"
    np.testing.assert_array_equal(table.kept, [True, True, False, False, ripe])
    np.testing.assert_array_equal(table.landmark_id, landmark_id[:, best])
    np.testing.assert_array_equal(table.count, count[:, best])
    for m in np.flatnonzero(table.kept):
        mean, cov = brute_force(sensor, world, weight, landmark_id[m, best])
        np.testing.assert_allclose(table.mean[:, m], mean, atol=1e-10)
        np.testing.assert_allclose(matrix(table.cov[:, m]), cov, atol=1e-10)


def test_without_existence_every_landmark_is_confirmed(x64):
    world = world_of("range_bearing", [[1, 1], [0, 1]], forgetting=False)
    config = Config(association="known", particles=2, landmarks=2)
    table = map_estimate.summarise(world, jnp.array([0.5, 0.5]), 0, PARAMS, config)
    np.testing.assert_array_equal(table.kept, [True, False])
