"""The accuracy that docs/results claims on the bundled log, one seed of each sensor.

All seeds: experiments/real_logs.py.
"""

import dataclasses

import numpy as np
import pytest

from jaxslam import config_for, errors, load_log, run


@pytest.fixture(scope="module")
def log():
    return load_log("lost-in-the-woods")


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["range_bearing", "position"])
def test_the_room_is_mapped_with_identities_hidden(log, sensor):
    result = run(log, config_for(log, sensor, particles=1000), seed=0)
    found = errors(result)
    assert found["ate_filtered_rmse_m"] <= 0.15
    assert found["landmark_filtered_rmse_m"] <= 0.10
    assert found["ate_refined_rmse_m"] <= 0.06
    assert found["landmark_refined_rmse_m"] <= 0.06
    assert found["landmarks_refined_matched"] == 17
    assert found["landmarks_refined_spurious"] <= 1
    assert found["association_accuracy"] > 0.99
    assert found["dead_reckoning_end_m"] == pytest.approx(4.6, abs=0.1)
    assert result.flags == []


@pytest.mark.slow
def test_the_room_is_mapped_from_bearings_when_identities_are_known(log):
    found = errors(run(log, config_for(log, "bearing", "known", particles=1000), seed=0))
    assert found["ate_filtered_rmse_m"] <= 0.20
    assert found["ate_refined_rmse_m"] <= 0.065
    assert found["landmark_refined_rmse_m"] <= 0.08
    assert found["landmarks_refined_matched"] == 17


def test_a_minute_of_it_beats_dead_reckoning_by_far(log):
    """The first 100 s with few particles: quick enough for every run of the tests."""
    n = int(np.searchsorted(log.frame_time, 100 * 10**9))
    rows = log.frame < n
    part = dataclasses.replace(
        log,
        frame_time=log.frame_time[:n],
        frame=log.frame[rows],
        bearing=log.bearing[rows],
        range=log.range[rows],
        identity=log.identity[rows],
        truth=dataclasses.replace(log.truth, identity=log.truth.identity[rows]),
    )
    found = errors(run(part, config_for(part, particles=200), seed=0))
    assert (
        found["ate_filtered_unaligned_rmse_m"] < 0.3 * found["dead_reckoning_ate_unaligned_rmse_m"]
    )
