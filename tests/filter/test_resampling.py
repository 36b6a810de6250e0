from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter.resampling import gather, systematic


def test_known_weights_give_known_ancestors():
    with np.errstate(divide="ignore"):
        log_weight = jnp.log(jnp.array([0.5, 0.0, 0.125, 0.375]))
    np.testing.assert_array_equal(systematic(log_weight, 0.1), [0, 0, 2, 3])
    np.testing.assert_array_equal(systematic(log_weight, 0.3), [0, 0, 2, 3])
    np.testing.assert_array_equal(systematic(log_weight, 0.9), [0, 0, 3, 3])


@pytest.mark.parametrize("n", [1, 2, 1000, 1_000_003])
@pytest.mark.parametrize("kind", ["even", "random", "heavy", "one", "with zeros"])
def test_counts_are_the_weights_rounded(n, kind):
    rng = np.random.default_rng(n)
    weight = {
        "even": np.ones(n),
        "random": rng.uniform(size=n),
        "heavy": rng.pareto(0.7, n) + 1e-9,
        "one": np.eye(1, n, n // 2)[0],
        "with zeros": rng.uniform(size=n) * (rng.uniform(size=n) < 0.3) + np.eye(1, n, 0)[0],
    }[kind]
    weight = weight / weight.sum()
    with np.errstate(divide="ignore"):
        log_weight = jnp.asarray(np.log(weight), "f")
    for uniform in (0.0, 0.37, np.nextafter(np.float32(1), np.float32(0))):
        ancestors = np.asarray(systematic(log_weight, jnp.float32(uniform)))
        assert ancestors.dtype == np.int32
        assert (np.diff(ancestors) >= 0).all()
        count = np.bincount(ancestors, minlength=n)
        assert len(count) == n
        assert not count[weight == 0].any()
        # FACTS: float32 sums err by up to 0.36 counts at a million
        assert np.abs(count - n * weight).max() <= 1.1 + 5e-7 * n


def test_scale_of_the_weights_does_not_matter():
    log_weight = jnp.asarray(np.random.default_rng(1).normal(size=500), "f")
    np.testing.assert_array_equal(systematic(log_weight, 0.4), systematic(log_weight - 1000, 0.4))


def test_gather_takes_rows_at_the_ancestors_or_leaves_them():
    rng = np.random.default_rng(0)
    tree = {
        "map": jnp.asarray(rng.normal(size=(2, 5, 40))),
        "count": jnp.asarray(rng.integers(0, 9, (5, 40))),
    }
    ancestors = jnp.asarray(np.sort(rng.integers(0, 40, 40)))
    copy = jax.jit(partial(gather, config=Config(particles=40)))
    taken, left = copy(tree, ancestors, True), copy(tree, ancestors, False)
    for name, leaf in tree.items():
        np.testing.assert_array_equal(taken[name], leaf[..., ancestors])
        np.testing.assert_array_equal(left[name], leaf)
