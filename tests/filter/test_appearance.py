"""Appearance: what descriptors tell of identity, how the filter averages and uses them."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm
from test_association import case, greedy

from jaxslam.config import Config
from jaxslam.filter import appearance
from jaxslam.filter.appearance import update_appearances
from jaxslam.filter.association import CLUTTER, NEW, PADDING, associate
from jaxslam.filter.candidate_slots import empty_bounds, select_candidates
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs import diagnostics
from jaxslam.logs.appearance_space import fit_appearance_space
from jaxslam.logs.log_file import save_log
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params
from jaxslam.results.metrics import compute_errors
from jaxslam.runs import run
from jaxslam.simulation.planar import planar

FULL = jnp.array([4, 4, 4])  # free slots: beyond the map
WITHIN = 0.3  # standard deviation of a landmark's colours, whose centres' is 1


def coloured(log, seed=0, columns=2, within=WITHIN):
    """The log with colours by landmark, and of clutter any; a column of noise, and a constant."""
    rng = np.random.default_rng(seed)
    of, n = log.truth.identity, len(log.frame)
    centre = rng.normal(size=(of.max() + 1, columns))
    colour = np.where(of[:, None] >= 0, centre[of], rng.normal(size=(n, columns)))
    colour = colour + within * rng.normal(size=colour.shape)
    return dataclasses.replace(
        log, descriptor=np.column_stack([colour, rng.normal(size=n), np.full(n, 7.0)])
    )


def lines(sigma, columns, rate=2.5):
    log = planar(
        "room", 4, landmarks=40, length_m=15.0, speed=0.5, rate_hz=rate, odometry_hz=20,
        sigma_bearing=sigma, detection=0.95, outlier=0.05, view=(-np.pi, np.pi, 6.0),
    )  # fmt: skip
    return coloured(dataclasses.replace(log, range=None), columns=columns)


@pytest.fixture(scope="module")
def room():
    return lines(0.01, 2, 10.0)


@pytest.fixture(scope="module")
def blurred():
    """Lines that their bearings can't tell apart."""
    return lines(0.03, 4)


def test_what_tells_landmarks_apart_is_found_whatever_the_units(room):
    found = fit_appearance_space(room)
    assert found.coordinates.shape == (len(room.frame), 2) and found.within.shape == (2,)
    np.testing.assert_allclose(found.coordinates.var(0), 1, rtol=0.01)
    np.testing.assert_allclose(found.coordinates.mean(0), 0, atol=0.01)
    # The root of the share that is not the landmark's own.
    share = WITHIN**2 / (1 + WITHIN**2)
    assert (found.within > 0.6 * share**0.5).all() and (found.within < 1.7 * share**0.5).all()
    other = fit_appearance_space(with_columns(room, room.descriptor * [1e-3, -900, 4, 1] + 100))
    np.testing.assert_allclose(other.within, found.within, rtol=0.02)
    assert np.abs((other.coordinates * found.coordinates).mean(0)).min() > 0.99


def with_columns(log, columns):
    return dataclasses.replace(log, descriptor=columns)


@pytest.mark.parametrize("seed", range(5))
def test_noise_tells_nothing_however_it_comes(room, seed):
    rng, n = np.random.default_rng(seed), len(room.frame)
    noise, kind = rng.normal(size=(n, 9)), rng.integers(0, 4, n)
    shares = rng.dirichlet([1, 1, 1], n)
    heavy = noise[:, :2] + 1e6 * (rng.uniform(size=(n, 2)) < 1e-3)
    flag = (np.arange(n) == 3)[:, None] * np.ones((1, 2))
    for columns in (
        noise, noise[:, [0, 0, 0]] * [1, 3.1, -7] + 2, 1.0 * (kind[:, None] == np.arange(4)),
        shares, heavy, flag, np.ones((n, 3)), np.column_stack([flag, noise[:, :3]]),
        rng.normal(size=(n, 25)),
        noise * 1e-30, noise * 1e30,
    ):  # fmt: skip
        assert fit_appearance_space(with_columns(room, columns)).coordinates.shape == (n, 0)


def test_columns_that_repeat_or_add_noise_change_little(room):
    found, rng = fit_appearance_space(room), np.random.default_rng(0)
    columns = room.descriptor
    more = [columns, columns * 3 + 1, columns @ rng.normal(size=(4, 3))]
    more.append(rng.normal(size=(len(columns), 4)))
    other = fit_appearance_space(with_columns(room, np.hstack(more)))
    assert len(other.within) == 2
    np.testing.assert_allclose(other.within, found.within, rtol=0.1)
    outliers = columns.copy()
    outliers[::100, 0] = 1e9
    np.testing.assert_allclose(
        fit_appearance_space(with_columns(room, outliers)).within, found.within, rtol=0.3
    )


def test_without_descriptors_or_links_there_are_no_looks(room):
    blind = with_columns(room, None)
    assert run.config_for(blind, "bearing").descriptors == 0
    few = {name: getattr(room, name)[:5] for name in ("frame", "bearing", "descriptor")}
    few = dataclasses.replace(room, **few, identity=None, truth=None)
    assert len(fit_appearance_space(few).within) == 0
    slow = dataclasses.replace(room, frame_time=room.frame_time[0] + 10**10 * np.arange(
        len(room.frame_time)), odometry_time=room.odometry_time[0] + 10**10 * np.arange(
        len(room.odometry_time)))  # fmt: skip
    assert len(fit_appearance_space(slow).within) == 0  # what was seen long ago is no link


def test_hidden_bearings_alone_get_looks_unless_told_otherwise(room):
    assert run.config_for(room, "bearing").descriptors == 2
    assert run.config_for(room, "bearing", descriptors=1).descriptors == 1
    assert run.config_for(planar(length_m=3.0)).descriptors == 0
    with pytest.raises(ValueError, match="3 descriptors are asked for, but 2 tell landmarks"):
        frames_from_log(room, run.config_for(room, "bearing", descriptors=3))
    with pytest.raises(ValueError, match="identities are known, so appearance decides nothing"):
        Config(association="known", descriptors=1)
    with pytest.raises(ValueError, match=r"Config\.descriptors: -1 is not a whole number"):
        Config(descriptors=-1)
    texts = [finding.text for finding in diagnostics.check(room)]
    assert "descriptors of 4 columns: 2 coordinates tell landmarks apart" in texts


def measured(descriptor, within, valid=None):
    descriptor = jnp.asarray(descriptor, float)
    k = len(descriptor)
    return jax.tree.map(jnp.asarray, Measurements(
        value=np.zeros((k, 2)), cov=np.zeros((k, 3)), identity=np.full(k, -1),
        valid=np.ones(k, bool) if valid is None else np.asarray(valid), active=np.array(True),
        descriptor=descriptor, within=np.asarray(within, float),
    ))  # fmt: skip


def test_the_gain_is_the_predictive_density_over_that_of_any_row(x64):
    """Against the joint normal of all sightings of a landmark, conditioned."""
    rng, within = np.random.default_rng(0), np.array([0.1, 0.4])
    sightings = [rng.normal(size=(n, 2)) for n in (1, 4, 0)]
    seen = rng.normal(size=(3, 2))
    known = appearance.Appearances(
        mean=jnp.array([s.mean(0) if len(s) else [5.0, 5.0] for s in sightings]).T,
        weight=jnp.array([float(len(s)) for s in sightings]),
        landmark_id=jnp.arange(3),
    )
    found = appearance.log_likelihood_ratio(known, measured(seen, within))
    for k, d in enumerate(seen):
        for m, before in enumerate(sightings):
            ratio = 0.0
            for j, own in enumerate(within):

                def joint(values, own=own):
                    size = len(values)
                    cov = own * np.eye(size) + (1 - own) * np.ones((size, size))
                    return multivariate_normal(np.zeros(size), cov).logpdf(values)

                rows = before[:, j]
                ratio += joint(np.append(rows, d[j])) - norm.logpdf(d[j])
                ratio -= joint(rows) if len(rows) else 0.0
            expected = np.logaddexp(
                np.log(1 - appearance.CHANGED) + ratio, np.log(appearance.CHANGED)
            )
            np.testing.assert_allclose(found[k, m], expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[:, 2], 0, atol=1e-9)


def test_a_look_is_the_mean_of_its_sightings_and_ends_with_its_landmark(x64):
    config = Config(sensor="bearing", landmarks=4, descriptors=2, measurements=3)
    known, rng = appearance.empty(config, float), np.random.default_rng(1)
    seen = rng.normal(size=(20, 3, 2))
    for t in range(20):
        match = jnp.array([2, CLUTTER, 0 if t % 2 else 1])
        frame = measured(seen[t], [0.1, 0.1], [True, True, t < 10])
        known = update_appearances(
            known, match, jnp.array([5, CLUTTER, 40 + t % 2]), FULL, t, frame
        )
        if t == 3:
            np.testing.assert_allclose(known.mean[:, 2], seen[:4, 0].mean(0))
            np.testing.assert_allclose(known.mean[:, 0], seen[1:4:2, 2].mean(0))
            assert known.weight.tolist() == [2, 2, 4, 0] and known.landmark_id.tolist() == [
                41,
                40,
                5,
                -1,
            ]
    assert known.weight.tolist() == [5, 5, appearance.LATEST, 0]  # not by what was not valid
    other = update_appearances(
        known, jnp.array([2, NEW, NEW]), jnp.array([6, NEW, NEW]), FULL, 20, frame
    )
    np.testing.assert_allclose(other.mean[:, 2], seen[19, 0])
    assert other.weight[2] == 1 and other.landmark_id[2] == 6
    # New landmarks have an appearance at once, and take the free slots in order.
    frame = measured(seen[0], [0.1, 0.1])
    match, free = jnp.array([NEW, CLUTTER, NEW]), jnp.array([1, 3, 4])
    updated = update_appearances(known, match, match, free, 30, frame)
    np.testing.assert_allclose(updated.mean[:, [1, 3]].T, seen[0, [0, 2]])
    assert updated.weight[1] == updated.weight[3] == 1
    assert updated.landmark_id[jnp.array([1, 3])].tolist() == [90, 92]
    gone = appearance.clear_slots(known, jnp.array([True, False, True, False]))
    assert gone.weight.tolist() == [0, 5, 0, 0]
    moved = appearance.reorder_slots(known, jnp.array([5, 77, 41, 6]))
    np.testing.assert_array_equal(moved.mean[:, [0, 2]], known.mean[:, [2, 0]])
    assert moved.weight.tolist() == [appearance.LATEST, 0, 5, 0]


@pytest.mark.parametrize("spread", [0.05, 1.5])
def test_matches_go_by_place_and_looks_together(x64, spread):
    measurements, scorer, table, valid = case(int(100 * spread), spread)
    config = Config(sensor="bearing", measurements=5, landmarks=7, particles=table.shape[2])
    ratios, new = np.random.default_rng(3).normal(size=(5, 7)), jnp.full(5, -0.02)
    given = measurements, new, -0.5, default_params("bearing")
    match, _ = associate(config, scorer, *given, None, jnp.asarray(ratios))
    without, _ = associate(config, scorer, *given)
    for i in range(table.shape[2]):
        expected = greedy(table[:, :, i] + ratios, np.full(5, -0.02))
        expected = np.where(expected < 0, NEW, expected)
        np.testing.assert_array_equal(match[:, i], np.where(valid, expected, PADDING))
    assert (match != without).mean() > 0.2


def test_a_slot_whose_looks_fit_is_not_passed_over():
    config = Config(landmarks=64, measurements=1, descriptors=1)
    bounds = empty_bounds(config, np.float32)
    bounds = bounds._replace(low=bounds.low.at[:, :2].set([[9.0, 9.0], [0, 0]]),
                             high=bounds.high.at[:, :2].set([[9.0, 9.0], [0, 0]]),
                             used=bounds.used.at[:2].set(True))  # fmt: skip
    frame = measured([[0.0]], [0.1])._replace(value=jnp.array([[8.4, 0.0]]))
    params = default_params()._replace(view_range=5.0)
    given = bounds, jnp.zeros((3, 1)), frame
    assert not select_candidates(config, *given, None, params, 0.0).any()
    ratios = jnp.zeros((1, 64)).at[0, 1].set(12.0)
    assert np.flatnonzero(select_candidates(config, *given, ratios, params, 0.0)).tolist() == [1]


def test_looks_find_lines_that_bearings_alone_confuse(blurred):
    settings = dict(particles=100, landmarks=96)
    right, wrong = [], []
    for changes in (dict(descriptors=0), dict()):
        config = run.config_for(blurred, "bearing", **settings, **changes)
        found = run.run(blurred, config, seed=0, refine=False)
        got = compute_errors(found)
        right.append(got["association_accuracy"])
        wrong.append(got["landmarks_missed"] + got["landmarks_spurious"])
    assert right[1] > right[0] and wrong[1] < wrong[0] / 2, (right, wrong)


def test_a_run_says_how_many_coordinates_it_went_by(room, call, tmp_path):
    save_log(tmp_path / "room.npz", room)
    words = "run", tmp_path / "room.npz", "--end", 12, "--particles", 20, "--no-refine"
    for option, used in ((), 2), (("--descriptors", 0), 0):
        out = tmp_path / f"looks-{used}"
        assert call(*words, *option, "--out", out)[0] in (0, 1)
        assert json.loads((out / "summary.json").read_text())["descriptors"] == used
