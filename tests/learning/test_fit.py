"""Learning: the free scale, the fit, its checkpoint, several devices, the even association."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter import step as fastslam
from jaxslam.learning import fit, likelihood, transforms
from jaxslam.logs.odometry import Odometry
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import Params, default_params
from jaxslam.simulation import planar

NAMES = ("sigma_bearing", "sigma_range", "mount_yaw")
CONFIG = Config(
    association="known", clutter=False, proposal="informed", particles=32, landmarks=12,
    measurements=6,
)  # fmt: skip


def drive(seed):
    return planar.planar(
        "field", seed, landmarks=12, length_m=8, rate_hz=2.5, odometry_hz=12.5, max_per_frame=6,
        outlier=0.0, sigma_bearing=0.03, sigma_range=0.1, mounting=(0.0, 0.0, 0.1),
    )  # fmt: skip


@pytest.fixture(scope="module")
def logs():
    return [drive(1), drive(2)]


@pytest.fixture(scope="module")
def start(logs):
    true = default_params("range_bearing", logs[0])
    return true._replace(sigma_bearing=0.09, sigma_range=0.035, mount_yaw=0.0)


@pytest.mark.parametrize("name", ["err_rot", "outlier", "mount_yaw", "gain_rot"])
def test_the_free_scale_there_and_back(x64, name):
    for value in (0.02, 0.3):
        free = transforms.to_free(name, value)
        assert float(transforms.from_free(name, free)) == pytest.approx(value, rel=1e-12)
    assert float(transforms.from_free(name, -40.0)) >= (-4.0 if name == "mount_yaw" else 0.0)


def test_what_starts_at_zero_has_no_logarithm(start):
    with pytest.raises(
        ValueError, match="landmark_extent is 0: to be learned it must start above 0"
    ):
        transforms.free_vector(start, ("landmark_extent",))


def test_the_usual_choice_leaves_the_scale_to_the_odometry_when_there_are_bearings_only():
    assert "gain_tran" not in fit.default_names(Config(sensor="bearing"))
    assert "gain_tran" in fit.default_names(Config(sensor="range_bearing"))
    assert "outlier" not in fit.default_names(CONFIG)


def test_a_fit_comes_close_and_goes_on_from_its_checkpoint(logs, start, tmp_path):
    told = dict(held_out=[drive(3)], seeds=2, steps=40, rate=0.2, every=20, held_out_seeds=2)
    told |= dict(bounds={"sigma_range": (0.03, 0.2)}, checkpoint=tmp_path / "fit.npz")
    whole = fit.fit(logs, CONFIG, start, NAMES, **told)
    found = whole.params
    # The last iterates still swing about what 200 measurements tell.
    assert found.sigma_bearing == pytest.approx(0.03, rel=0.3)
    assert found.sigma_range == pytest.approx(0.1, rel=0.5)
    assert found.mount_yaw == pytest.approx(0.1, abs=0.03)
    assert found.err_tran == start.err_tran
    assert whole.history.held_out[-1] > fit.evidence([drive(3)], CONFIG, start, 2).mean() + 20
    assert whole.history.log_likelihood[-1] > whole.history.log_likelihood[0]
    assert (whole.steps, len(whole.history.free), whole.stopped) == (40, 40, "all steps done")

    class Cut(Exception):
        pass

    def stop(done, total, record):
        if done == 27:
            raise Cut

    with pytest.raises(Cut):
        fit.fit(logs, CONFIG, start, NAMES, progress=stop, **told)
    again = fit.fit(logs, CONFIG, start, NAMES, resume=True, **told)
    np.testing.assert_array_equal(again.free, whole.free)
    np.testing.assert_array_equal(again.history.free, whole.history.free)
    with pytest.raises(ValueError, match="belongs to a fit of other logs or settings"):
        fit.fit(logs, CONFIG, start, NAMES, resume=True, **(told | {"seeds": 3}))
    (tmp_path / "fit.npz").write_bytes(b"PK no zip")
    with pytest.raises(ValueError, match="not a checkpoint, or damaged"):
        fit.fit(logs, CONFIG, start, NAMES, resume=True, **told)


def test_bounds_hold_and_priors_pull(logs, start):
    told = dict(seeds=2, steps=8, rate=0.2)
    low = start.sigma_range
    bound = fit.fit(logs, CONFIG, start, NAMES, bounds={"sigma_range": (0.01, 1.2 * low)}, **told)
    assert bound.params.sigma_range == pytest.approx(1.2 * low, rel=1e-3)
    free = fit.fit(logs, CONFIG, start, NAMES, **told)
    pulled = fit.fit(logs, CONFIG, start, NAMES, priors={"mount_yaw": (0.0, 1e-3)}, **told)
    assert abs(pulled.params.mount_yaw) < 0.05 < free.params.mount_yaw


@pytest.mark.parametrize(
    ("names", "told", "found"),
    [
        ((), {}, "parameters to learn: none"),
        (("sigma_range", "sigma_range"), {}, "name each once"),
        (
            ("extra_bearing_noise",),
            {},
            "'extra_bearing_noise' can't be learned with sensor range_bearing; these can: err",
        ),
        (("sigma_range",), {"bounds": {"sigma_range": (1.0, 2.0)}}, "outside its bounds 1 to 2"),
        (("sigma_range",), {"priors": {"err_rot": (1.0, 2.0)}}, "err_rot has bounds or a prior"),
        (("sigma_range",), {"seeds": 0}, "seeds is 0; must be 1 or more"),
    ],
)
def test_what_can_not_be_learned_is_refused(logs, start, names, told, found):
    with pytest.raises(ValueError, match=found):
        fit.fit(logs, CONFIG, start, names, **told)
    with pytest.raises(ValueError, match="no log"):
        fit.fit([], CONFIG, start, ("sigma_range",))


def test_the_best_match_is_learned_with_a_warning(logs, start):
    biased = dataclasses.replace(CONFIG, association="maximum_likelihood", forgetting=None)
    with pytest.warns(UserWarning, match="biases the score"), pytest.raises(ValueError):
        fit.fit([], biased, start, ("sigma_range",))


TWO_DEVICES = Path(__file__).parents[1] / "programs" / "scores_on_devices.py"


@pytest.mark.slow
def test_two_devices_give_what_one_gives(pytestconfig):
    outs = [
        subprocess.run(
            [sys.executable, TWO_DEVICES, devices],
            capture_output=True, text=True, check=True, cwd=pytestconfig.rootpath,
        ).stdout.split()
        for devices in ("1", "2")
    ]  # fmt: skip
    one, two = (np.array(out, float) for out in outs)
    assert len(one) == 12
    np.testing.assert_allclose(two, one, rtol=2e-3)


@pytest.mark.parametrize("even", [False, True])
def test_a_landmark_held_twice_gains_nothing_where_association_is_even(x64, even):
    config = Config(
        sensor="position", association="sampled", uniform_association_prior=even, clutter=False,
        forgetting=False, particles=1, landmarks=8, measurements=1, resample_threshold=0,
    )  # fmt: skip
    steps, zero = 5, np.zeros(5)
    params = default_params("position")._replace(
        err_tran=0.0, err_rot=0.0, err_drift=0.0, floor_tran=0.0, floor_rot=0.0, density_new=1e-9
    )
    rng = np.random.default_rng(0)
    measurements = Measurements(
        np.array([1.0, 0.5]) + 0.1 * rng.standard_normal((steps, 1, 2)),
        np.tile([0.01, 0.0, 0.01], (steps, 1, 1)), np.full((steps, 1), -1, np.int32),
        np.ones((steps, 1), bool), np.ones(steps, bool),
    )  # fmt: skip
    odometry = Odometry(zero, zero, zero, zero, zero, zero + 0.1, zero + 0.5, zero + 1 / 12)
    world = np.array([[1.0, -4.0], [0.5, 3.0]])
    factor = np.tile([[1e-6], [0.0], [1e-6]], 2)

    def evidence(times):
        given = tuple(jnp.asarray(np.tile(part, times)) for part in (world, factor))
        state = fastslam.init(config, jax.random.key(0), landmarks_given=given)
        numbers = Params(*(jnp.asarray(v) for v in params))
        _, info = fastslam.run(jax.random.key(1), state, odometry, measurements, numbers, config)
        return float(info.log_evidence.sum())

    gained = evidence(2) - evidence(1)
    assert gained == pytest.approx(0 if even else steps * np.log(2), abs=1e-4)


def test_density_of_new_landmarks_has_a_finite_best_value(logs, start):
    """The score by it is the number of new landmarks over it, less the frames' area."""
    data = likelihood.data_from_log(logs[0], CONFIG, start)
    found = likelihood.score(start, data, jax.random.key(0), CONFIG, ("density_new",))
    seen = len(np.unique(logs[0].identity))
    frames, area = len(logs[0].frame_time), np.pi * start.view_range**2
    expected = seen / start.density_new - frames * area
    assert float(found.total[0]) == pytest.approx(expected, rel=1e-3)
