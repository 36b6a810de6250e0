"""Settings and numbers: what is allowed, what the defaults are, what a log declares."""

import dataclasses
import math

import numpy as np
import pytest

from jaxslam.config import ASSOCIATIONS, PROPOSALS, SENSORS, Config
from jaxslam.logs.log import Log
from jaxslam.parameters import FORMER_NAMES, PARAMETERS, Params, default_params


def make_log(**changes):
    return Log(
        name="a log",
        odometry_time=[0],
        odometry=[[0.0, 0.0]],
        frame_time=[0],
        frame=np.empty(0, int),
        bearing=np.empty(0),
        **({"view": (-1.0, 2.0, 7.0), "mounting": (0.1, -0.2, 0.3)} | changes),
    )


def settings(config):
    """All but what decides the speed alone."""
    values = dataclasses.asdict(config)
    return {k: v for k, v in values.items() if k not in ("block", "lazy", "chains", "devices")}


def test_defaults():
    assert settings(Config()) == {
        "sensor": "range_bearing",
        "association": "maximum_likelihood",
        "particles": 1000,
        "landmarks": 64,
        "measurements": 16,
        "resample_threshold": 0.5,
        "exclusive": True,
        "clutter": True,
        "forgetting": True,
        "proposal": "prior",
        "uniform_association_prior": False,
        "rejuvenate": 0.0,
        "descriptors": 0,
    }


def test_only_hidden_bearings_are_rejuvenated_unasked():
    assert Config(sensor="bearing").rejuvenate == 3.0
    assert Config(sensor="bearing", association="known").rejuvenate == 0
    assert Config(sensor="position", rejuvenate=2).rejuvenate == 2
    for wrong in (-1, float("inf"), True, "3"):
        with pytest.raises(ValueError, match=f"Config.rejuvenate: {wrong!r} is not a number"):
            Config(rejuvenate=wrong)


def test_even_is_for_sampled_associations():
    assert Config(association="sampled", uniform_association_prior=True).uniform_association_prior
    with pytest.raises(
        ValueError, match="uniform_association_prior: is for association sampled, not known"
    ):
        Config(association="known", uniform_association_prior=True)


def test_the_papers_preset_field_by_field():
    # Written out: when defaults change, the preset must not.
    assert settings(Config.paper()) == {
        "sensor": "position",
        "association": "maximum_likelihood",
        "particles": 1000,
        "landmarks": 64,
        "measurements": 16,
        "resample_threshold": 0.5,
        "exclusive": False,
        "clutter": False,
        "forgetting": False,
        "proposal": "prior",
        "uniform_association_prior": False,
        "rejuvenate": 0.0,
        "descriptors": 0,
    }
    assert Config.paper(particles=10, landmarks=3, measurements=2) == Config(
        sensor="position",
        particles=10,
        landmarks=3,
        measurements=2,
        exclusive=False,
        clutter=False,
        forgetting=False,
    )
    assert Config.paper(association="known", clutter=True).clutter
    with pytest.raises(ValueError, match=r"Config\.particles"):
        Config.paper(particles=0)


@pytest.mark.parametrize("name", ["particles", "landmarks", "measurements", "block"])
@pytest.mark.parametrize("value", [0, -1, 2.0, 1.5, "8", None, True, math.nan])
def test_sizes_are_whole_numbers_of_at_least_one(name, value):
    with pytest.raises(ValueError, match=rf"^Config\.{name}: .* whole number of at least 1$"):
        Config(**{name: value})
    assert getattr(Config(**{name: 1}), name) == 1


@pytest.mark.parametrize("value", [-0.1, math.inf, math.nan, "half", None])
def test_the_threshold_is_a_number_of_at_least_zero(value):
    with pytest.raises(ValueError, match=r"^Config\.resample_threshold: "):
        Config(resample_threshold=value)


@pytest.mark.parametrize("value", [0, 0.0, 0.5, 1, 2])
def test_thresholds_of_never_sometimes_and_always_are_allowed(value):
    assert Config(resample_threshold=value).resample_threshold == value


@pytest.mark.parametrize(
    "name, allowed",
    [("sensor", SENSORS), ("association", ASSOCIATIONS), ("proposal", PROPOSALS)],
)
def test_names_are_checked_and_the_allowed_ones_listed(name, allowed):
    for value in allowed:
        assert getattr(Config(**{name: value}), name) == value
    for value in ("camera", "", None, 3):
        with pytest.raises(ValueError) as caught:
            Config(**{name: value})
        assert str(caught.value) == (f"Config.{name}: {value!r} is not one of {', '.join(allowed)}")


@pytest.mark.parametrize("name", ["exclusive", "clutter", "forgetting"])
@pytest.mark.parametrize("value", [1, 0, "yes", 0.5])
def test_switches_are_true_or_false(name, value):
    with pytest.raises(ValueError, match=rf"^Config\.{name}: .* true or false$"):
        Config(**{name: value})


def test_forgetting_is_off_with_known_identities_unless_asked_for():
    assert Config().forgetting is True
    assert Config(association="known").forgetting is False
    assert Config(association="known", forgetting=True).forgetting is True
    assert Config(forgetting=False).forgetting is False


def test_equal_settings_are_one_key_for_the_compiler():
    assert hash(Config()) == hash(Config(forgetting=True))
    assert Config() == Config(forgetting=True) != Config(particles=7)
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().particles = 3


def test_the_table_has_a_row_for_every_parameter():
    assert tuple(row.name for row in PARAMETERS) == Params._fields
    assert all(row.unit and row.meaning for row in PARAMETERS)
    for row in PARAMETERS:
        assert row.low <= row.default <= row.high, row.name
        assert row.scale in ("log", "logit", "linear"), row.name
        assert set(row.of_sensor) <= set(SENSORS), row.name
        assert set(row.learned_by) <= {"motion", "alternatives", *SENSORS}, row.name
    assert FORMER_NAMES == {"growth": "landmark_extent", "caution": "extra_bearing_noise"}


def test_parameters_are_read_by_their_former_names():
    params = default_params("bearing")
    assert (params.growth, params.caution) == (0.03, 0.06)
    log = make_log(noise={"growth": 0.2, "caution": 0.3})
    told = default_params("bearing", log)
    assert (told.landmark_extent, told.extra_bearing_noise) == (0.2, 0.3)
    assert Config.from_dict({"association": "sampled", "even": True}) == Config(
        association="sampled", uniform_association_prior=True
    )


@pytest.mark.parametrize("sensor", SENSORS)
def test_default_params_are_finite_numbers(sensor):
    params = default_params(sensor)
    assert all(isinstance(value, float) and math.isfinite(value) for value in params)


def test_default_params_without_a_log_see_all_around():
    params = default_params()
    assert (params.view_min, params.view_max) == (-math.pi, math.pi)
    assert (params.mount_x, params.mount_y, params.mount_yaw) == (0, 0, 0)
    assert (params.gain_tran, params.gain_rot, params.bias_drift) == (1, 1, 0)


def test_a_log_declares_mounting_view_and_noise_and_nothing_else():
    log = make_log(noise={"sigma_bearing": 0.005, "err_rot": 0.2, "mount_x": 0.15})
    params, plain = default_params("bearing", log), default_params("bearing")
    declared = {
        "mount_x": 0.15,  # what is declared by name comes last
        "mount_y": -0.2,
        "mount_yaw": 0.3,
        "view_min": -1.0,
        "view_max": 2.0,
        "view_range": 7.0,
        "sigma_bearing": 0.005,
        "err_rot": 0.2,
    }
    for name in Params._fields:
        assert getattr(params, name) == declared.get(name, getattr(plain, name)), name


def test_default_params_of_no_sensor():
    with pytest.raises(ValueError, match=r"^sensor: 'sonar' is not one of range_bearing, position"):
        default_params("sonar")
