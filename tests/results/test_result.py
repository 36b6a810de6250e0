"""A result for users: what it says of itself, and its columns."""

import dataclasses

import numpy as np
from small_run import make_refined, make_result


def test_it_says_what_it_is():
    result = make_result()
    assert repr(result) == "Result('circle', range_bearing, 40 frames, 5 landmarks)"
    assert repr(result.landmarks) == "MapEstimate(5 landmarks)"
    assert repr(make_refined().refined) == "Refined(40 frames, 4 landmarks)"


def test_the_trajectory_as_columns():
    result = make_refined()
    columns = result.trajectory_columns()
    assert {len(column) for column in columns.values()} == {40}
    np.testing.assert_array_equal(columns["time_ns"], result.time)
    np.testing.assert_array_equal(columns["heading_rad"], result.pose[:, 2])
    np.testing.assert_allclose(columns["sd_y_m"], np.sqrt(0.02))
    np.testing.assert_array_equal(columns["smoothed_x_m"], result.refined.pose[:, 0])
    plain = make_result().trajectory_columns()
    assert set(plain) == {name for name in columns if not name.startswith("smoothed_")}


def test_the_map_as_columns():
    result = make_refined()
    refined, filtered = result.landmark_columns(), result.landmark_columns(smoothed=False)
    assert len(refined["x_m"]) == len(result.refined.mean) == 4
    np.testing.assert_array_equal(refined["syy"], result.refined.landmark_cov[:, 2])
    np.testing.assert_array_equal(filtered["id"], result.landmarks.id)
    np.testing.assert_array_equal(filtered["y_m"], result.landmarks.mean[:, 1])
    assert make_result().landmark_columns().keys() == refined.keys()
    nothing = result.landmarks._replace(
        id=np.zeros(0, int),
        mean=np.zeros((0, 2)),
        cov=np.zeros((0, 3)),
        n=np.zeros(0, int),
        identity=np.zeros(0, int),
    )
    empty = dataclasses.replace(make_result(), landmarks=nothing).landmark_columns()
    assert {len(column) for column in empty.values()} == {0}
