"""The odometry's rate does not change the evidence: a small part of experiments/thinning.py."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from jaxslam.config import Config

THINNING = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "thinning.py"))
RATE = THINNING["RATE"]
CONFIG = Config(association="known", particles=1000, landmarks=36, measurements=6)


@pytest.mark.parametrize("noise", THINNING["NOISE"], ids=lambda noise: next(iter(noise)))
def test_thinned_odometry_and_steps_between_frames_have_the_same_evidence(noise):
    """Were a standard deviation to grow like the distance, a variance would shrink twentyfold."""
    log = THINNING["simulate"](15, **noise)
    arms = (RATE, None), (5, None), (RATE, 20)
    rows = THINNING["compare"](log, CONFIG, 10, arms)
    for row in rows[1:]:
        assert abs(row["z"]) < 4, rows  # by chance: one in 1,200, at 18 degrees of freedom


def test_thinned_rows_keep_distance_and_turn():
    log = THINNING["simulate"](5)
    thinned = THINNING["thin"](log, 10)
    assert len(thinned.odometry) == 50 and len(log.odometry) == 5 * RATE
    driven = log.odometry.sum(0) / RATE, thinned.odometry.sum(0) / 10
    np.testing.assert_allclose(*driven, rtol=1e-6)
