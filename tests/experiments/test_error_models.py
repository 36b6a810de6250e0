"""Error models of the sensor: what each learns, and that their evidences can be compared."""

import dataclasses

import error_models
import numpy as np
import pytest
from error_models import NAMES, Judged, compare, model_of, preferred, table

from jaxslam.config import Config
from jaxslam.learning import fit as learn
from jaxslam.learning import transforms
from jaxslam.parameters import default_params
from jaxslam.runs.run import config_for
from jaxslam.simulation import planar


def drive(seed=1, **settings):
    return planar.planar(
        length_m=8.0, landmarks=10, seed=seed, **({"outlier": 0.0} | settings), max_per_frame=4
    )


@pytest.mark.parametrize(
    ("model", "names", "clutter", "landmark_extent"),
    [
        ("normal", "sigma_range sigma_bearing", False, 0),
        ("range_dependent", "sigma_range sigma_bearing landmark_extent", False, 0.12),
        ("heavy_tailed", "sigma_range sigma_bearing outlier", True, 0),
        (
            "heavy_tailed+range_dependent",
            "sigma_range sigma_bearing landmark_extent outlier",
            True,
            0.12,
        ),
        ("point", "position_scale", False, 0.12),
    ],
)
def test_what_a_model_learns(model, names, clutter, landmark_extent):
    config, params, found = model_of(model, Config(), default_params())
    assert found == tuple(names.split())
    assert config.clutter == clutter
    assert config.sensor == ("position" if model == "point" else "range_bearing")
    assert params.landmark_extent == landmark_extent
    bearing = model_of(model, Config(sensor="bearing"), default_params("bearing"))
    if model != "point":
        assert bearing[2] == found[1:]
        assert bearing[1].extra_bearing_noise == 0
        assert bearing[1].sigma_bearing == pytest.approx(np.hypot(0.005, 0.06))


def test_what_is_learnt_as_a_logarithm_starts_above_zero():
    none = default_params()._replace(landmark_extent=0.0, outlier=0.0)
    _, params, names = model_of("heavy_tailed+range_dependent", Config(), none)
    assert np.isfinite(transforms.free_vector(params, names)).all()
    assert (params.landmark_extent, params.outlier) == (0.02, 0.01)


def rows(*means, spread=1.0, count=100):
    noise = spread * np.array([-1, 1, -1, 1, -1, 1, -1, 1])
    return [
        Judged(name, {"sigma_bearing": 0.02}, mean + noise, count)
        for name, mean in zip(NAMES, means, strict=False)
    ]


def test_the_table_begins_with_the_best():
    lines = table(rows(-20.0, -10.0, -30.0)).splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["range_dependent", "normal", "heavy_tailed"]
    assert lines[1].split()[1:] == ["-10.00", "±", "1.07", "0.00", "sigma_bearing", "0.02", "rad"]
    assert lines[3].split()[4] == "-20.00"


def test_the_preference_and_that_there_is_none():
    assert preferred(rows(-20.0, -10.0, -30.0)) == (
        "the held-out logs prefer range_dependent: ahead of normal by 10.0 nats, 0.1 per "
        "measurement"
    )
    assert preferred(rows(-20.0, -10.0, spread=9.0)).startswith(
        "no preference: range_dependent is ahead of normal by 10.0 nats"
    )
    assert "prefer heavy_tailed" in preferred(rows(np.nan, -30.0, -20.0))
    assert not rows(np.nan)[0].finite


def test_points_are_no_model_of_points():
    with pytest.raises(ValueError, match="error models of sensor position: need ranges"):
        compare([], [], Config(sensor="position"), default_params("position"))


def test_a_point_is_as_likely_as_its_range_and_bearing(monkeypatch):
    """With little noise a point's covariance is that of range and bearing: the evidences must then
    agree, which they do by 140 nats less without the logarithms of the ranges."""
    log = drive(sigma_range=0.02, sigma_bearing=0.01)
    log = dataclasses.replace(
        log, point=np.ones((len(log.frame), 2)), point_cov=np.tile([1.0, 0, 1], (len(log.frame), 1))
    )
    config = config_for(log, "range_bearing", "known", particles=50, proposal="informed")
    params = default_params("range_bearing", log)._replace(outlier=0.01)
    still = learn.Fit(*[None] * 10)

    def fit(logs, config, start, *_, **__):
        return still._replace(params=start)

    monkeypatch.setattr(learn, "fit", fit)
    monkeypatch.setattr(error_models, "NAMES", ("normal", "point"))
    found = {row.model: row for row in compare([log], [log], config, params)}
    normal, point = found["normal"].evidence, found["point"].evidence
    assert np.log(log.range).sum() > 100
    assert point.mean() == pytest.approx(normal.mean(), abs=5)
    assert found["point"].count == len(log.frame)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "settings", "best", "name", "true"),
    [
        ("range_bearing", {"landmark_extent": 0.2}, "range_dependent", "landmark_extent", 0.2),
        ("bearing", {"landmark_extent": 0.2}, "range_dependent", "landmark_extent", 0.2),
        ("range_bearing", {}, "normal", "sigma_bearing", 0.02),
    ],
)
def test_the_model_that_made_the_data_wins(sensor, settings, best, name, true):
    train, judge = drive(1, **settings), drive(2, **settings)
    config = config_for(train, sensor, "known", particles=100, proposal="informed")
    params = default_params(sensor, train)._replace(landmark_extent=0.05, outlier=0.01)
    found = compare([train], [judge], config, params, ("err_drift",), seeds=2, steps=40)
    by_name = {row.model: row for row in found}
    means = {row.model: row.evidence.mean() for row in found if row.model != "point"}
    assert means[best] >= max(means.values()) - 2
    assert by_name[best].values[name] == pytest.approx(true, rel=0.4)
    if "landmark_extent" in settings:
        assert means[best] > means["normal"] + 5
