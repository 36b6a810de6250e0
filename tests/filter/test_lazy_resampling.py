"""Lazy resampling and passing slots over: the same as without, whatever is looked at when."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter import candidate_slots, lazy_resampling
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames_from_log
from jaxslam.filter.landmarks import Landmarks
from jaxslam.filter.xla import nonzero_indices
from jaxslam.parameters import Params, default_params
from jaxslam.simulation.planar import planar

PARTICLES, SLOTS = 64, 48


@pytest.mark.parametrize("length", [1, 31, 32, 33, 700])
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_listed_is_nonzero(length, share):
    mask = np.random.default_rng(length).uniform(size=length) < share
    for size in (None, 5):
        index, count = nonzero_indices(jnp.asarray(mask), size)
        assert count == mask.sum()
        expected = np.full(length if size is None else size, length)
        found = np.flatnonzero(mask)[: len(expected)]
        expected[: len(found)] = found
        np.testing.assert_array_equal(index, expected)


def test_chains_give_what_copying_at_once_gives():
    """60 resamplings, some rows brought up to date in between and changed, against plain copies."""
    rng = np.random.default_rng(0)
    config = Config(particles=PARTICLES, landmarks=12, chains=3)
    world = Landmarks(
        mean=jnp.asarray(rng.normal(size=(2, 12, PARTICLES)), jnp.float32),
        factor=jnp.asarray(rng.normal(size=(3, 12, PARTICLES)), jnp.float32),
        anchor=None,
        log_odds=None,
        count=jnp.asarray(rng.integers(0, 9, (12, PARTICLES)), jnp.int32),
        landmark_id=jnp.asarray(rng.integers(0, 9, (12, PARTICLES)), jnp.int32),
    )
    past, plain = lazy_resampling.empty_ancestry(config), jax.tree.map(np.array, world)
    update = jax.jit(partial(lazy_resampling.apply_ancestry, config=config))
    resampled = jax.jit(lazy_resampling.compose)
    stale = 0
    for _ in range(60):
        looked = jnp.asarray(rng.uniform(size=12) < 0.2) | lazy_resampling.oldest_slots(past)
        world, past = update(world, past, looked)
        for slot in np.flatnonzero(looked):
            change = rng.normal(size=PARTICLES).astype("f")
            world = world._replace(mean=world.mean.at[0, slot].add(change))
            plain.mean[0, slot] += change
        ancestors = jnp.asarray(np.sort(rng.integers(0, PARTICLES, PARTICLES)), jnp.int32)
        wanted = bool(rng.uniform() < 0.8)
        past = resampled(past, ancestors, wanted)
        if wanted:
            plain = jax.tree.map(lambda leaf: leaf[..., ancestors], plain)  # noqa: B023
        stale += int((past.chain != lazy_resampling.CURRENT).sum())
    assert stale > 100
    world, _ = update(world, past, True)
    jax.tree.map(np.testing.assert_array_equal, world, plain)


def driven(config, log):
    """Final state, all resampled, and every step's `Info`."""
    params = default_params(config.sensor, log)
    data = frames_from_log(log, config, params)
    numbers = jax.tree.map(
        lambda v: jnp.asarray(v, jnp.float32) if np.asarray(v).dtype.kind == "f" else v,
        (data.odometry, data.measurements, Params(*map(np.asarray, params))),
    )
    key = jax.random.key(3)
    state = fastslam.init(config, key, log.start_pose, log.start_cov)
    state, info = fastslam.run(key, state, *numbers, config)
    return fastslam.settle(state, config), info


@pytest.fixture(scope="module")
def log():
    return planar("room", 5, length_m=6.0, landmarks=40, view=(-np.pi, np.pi, 4.0))


@pytest.mark.parametrize(
    ("sensor", "association"),
    [
        ("range_bearing", "maximum_likelihood"),
        ("bearing", "known"),
        pytest.param("range_bearing", "known", marks=pytest.mark.slow),
        pytest.param("bearing", "maximum_likelihood", marks=pytest.mark.slow),
    ],
)
def test_laziness_does_not_change_a_bit(log, sensor, association):
    base = Config(sensor=sensor, association=association, particles=PARTICLES, landmarks=SLOTS)
    state, info = driven(base, log)
    assert info.resampled.sum() >= 5
    there = state.landmarks.count > 0
    for change in ({"lazy": False}, {"chains": 2}):
        other, same = driven(dataclasses.replace(base, **change), log)
        for name in ("pose", "log_evidence", "ancestors", "landmark_id", "overflow", "forgotten"):
            mine, theirs = getattr(info, name), getattr(same, name)
            np.testing.assert_array_equal(theirs, mine, f"{change}: {name}")
        for mine, theirs in zip(*map(jax.tree.leaves, (state, other)), strict=False):
            if mine.shape[-2:] == there.shape:
                mine, theirs = jnp.where(there, mine, 0), jnp.where(there, theirs, 0)
                np.testing.assert_array_equal(theirs, mine)


@pytest.mark.parametrize(
    ("sensor", "association"),
    [
        ("range_bearing", "maximum_likelihood"),
        ("position", "known"),
        pytest.param("range_bearing", "known", marks=pytest.mark.slow),
        pytest.param("position", "maximum_likelihood", marks=pytest.mark.slow),
    ],
)
def test_slots_passed_over_change_nothing(monkeypatch, sensor, association):
    """A long corridor, most of it out of view, against looking at every slot."""
    log = planar(
        "field", 2, length_m=5.0, landmarks=90, view=(-np.pi, np.pi, 3.0), outlier=0.05,
    )  # fmt: skip
    if sensor == "position":
        point = log.range[:, None] * np.stack([np.cos(log.bearing), np.sin(log.bearing)], 1)
        log = dataclasses.replace(
            log, point=point, point_cov=np.tile([0.01, 0.0, 0.01], (len(point), 1))
        )
    config = Config(sensor=sensor, association=association, particles=PARTICLES, landmarks=100)
    concerned, seen = candidate_slots.select_candidates, []

    def watched(config, bounds, *rest):
        rows = concerned(config, bounds, *rest)
        jax.debug.callback(
            lambda n, m: seen.append((int(n), int(m))), rows.sum(), bounds.used.sum()
        )
        return rows

    jax.clear_caches()
    monkeypatch.setattr(candidate_slots, "select_candidates", watched)
    state, info = driven(config, log)
    jax.effects_barrier()
    monkeypatch.setattr(
        candidate_slots, "select_candidates", lambda config, bounds, *_: jnp.ones_like(bounds.used)
    )
    jax.clear_caches()
    other, same = driven(config, log)
    # A frame of fewer slots is another program, which may round differently.
    np.testing.assert_allclose(same.pose, info.pose, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(same.log_evidence, info.log_evidence, rtol=1e-5, atol=1e-5)
    for name in ("ancestors", "landmark_id"):
        np.testing.assert_array_equal(getattr(same, name), getattr(info, name))
    for mine, theirs in zip(
        *(map(jnp.sort, w.landmarks.count.T) for w in (state, other)), strict=True
    ):
        np.testing.assert_array_equal(theirs, mine)  # in which slots may differ
    looked, used = np.array(seen).T
    assert (looked < 0.8 * used).any()  # some were passed over


def test_bounds_hold_for_every_particle(log):
    """Of every slot with a landmark in some particle, at the end of a run."""
    config = Config(particles=PARTICLES, landmarks=SLOTS)
    state, _ = driven(config, log)
    bounds, exact = state.bounds, candidate_slots.bounds_of(state.landmarks)
    assert (bounds.used | ~exact.used).all() and exact.used.sum() > 5
    assert (bounds.low <= exact.low).all() and (bounds.high >= exact.high).all()
    assert (bounds.spread >= exact.spread * (1 - 1e-6)).all()  # worked out by another program
