"""Check rows resampled lazily on four devices, with ancestors shifted by every AMOUNT."""

import sys
from functools import partial

import jax
import jax.numpy as jnp

jax.config.update("jax_num_cpu_devices", 4)
import numpy as np

from jaxslam.config import Config
from jaxslam.filter import halo_exchange, lazy_resampling, sharding
from jaxslam.filter.landmarks import Landmarks

config = Config(particles=160, landmarks=24, chains=2, devices=4)
rng = np.random.default_rng(0)
world = Landmarks(
    mean=rng.normal(size=(2, 24, 160)).astype("f"),
    factor=rng.normal(size=(3, 24, 160)).astype(jnp.result_type(float)),
    anchor=None,
    log_odds=None,
    count=rng.integers(0, 9, (24, 160)).astype("i"),
    landmark_id=rng.integers(0, 9, (24, 160)).astype("i"),
)
behind = rng.integers(-1, 2, 24).astype("i")
for amount in map(int, sys.argv[1:]):
    chains = np.arange(160) + amount + rng.integers(-2, 3, (2, 160))
    chains = np.sort(np.clip(chains, 0, 159), -1).astype("i")
    ancestry = lazy_resampling.empty_ancestry(config)._replace(
        chains=jnp.asarray(chains), chain=jnp.asarray(behind)
    )
    wanted = rng.uniform(size=24) < 0.8
    updated, updated_ancestry = sharding.shard_map(
        partial(lazy_resampling.apply_ancestry, config=config),
        (sharding.particle_sharded(world), sharding.replicated(ancestry), sharding.ALL),
        (sharding.particle_sharded(world), sharding.replicated(ancestry)),
        config,
    )(jax.tree.map(jnp.asarray, world), ancestry, jnp.asarray(wanted))
    due = wanted & (behind >= 0)
    for before, leaf in zip(jax.tree.leaves(world), jax.tree.leaves(updated), strict=True):
        expected = before.copy()
        for slot in np.flatnonzero(due):
            expected[..., slot, :] = before[..., slot, chains[behind[slot]]]
        np.testing.assert_array_equal(leaf, expected)
    assert (np.asarray(updated_ancestry.chain) == np.where(due, -1, behind)).all()
    print(bool(halo_exchange.suffices(ancestry.chains, config).all()), int(due.sum()))
