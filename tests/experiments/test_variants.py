"""The table of experiments/variants.py: every variant's errors and times, side by side."""

from dataclasses import replace

import numpy as np
import pytest
import variants

from jaxslam.config import Config
from jaxslam.reference import compare
from jaxslam.simulation import planar


def test_variants_stand_side_by_side():
    log = planar.planar("field", 5, landmarks=15, length_m=12.0, rate_hz=2.0)
    config = Config(particles=30, measurements=10, landmarks=30)  # test_offline's: compiled once
    pose, marks = log.truth.pose[:40] + [0.25, 0, 0], log.truth.landmarks[:9]
    world = compare.PointMap(marks + [0.25, 0.1], np.full(9, -1))
    zeros = [0.0] * 4
    slow = compare.Agreement(40, 5, 40, *zeros[:3], 1, *zeros, pose, pose, 8.0, 0.1, 0.3, world)
    baselines = [compare.Comparison(slow, slow, 0.25, 0.25)]
    rows = variants.variants(log, config, None, 0, 40, 1, baselines)
    names = ["baseline, NumPy", "Config.paper()", "FastSLAM 1.0", "informed", "refined"]
    assert [row.name for row in rows] == names
    assert [row.particles for row in rows] == [5, 30, 30, 30, 30]
    found = (0, 0.25, 0.1, 0.2)  # m and s
    assert rows[0][2:5] + rows[0][6:] == pytest.approx(found, abs=1e-6)
    assert rows[0].counts == (9, 6, 0)
    for row in rows[1:]:
        assert 0 < row.aligned < row.unaligned < 0.5
        assert 0 < row.landmarks < 0.5
        matched, missed, _ = row.counts
        assert matched > 5 and matched + missed == len(log.truth.landmarks)
    assert rows[-1].unaligned < rows[2].unaligned
    assert rows[-1].seconds > rows[-2].seconds  # with what was spent before
    lines = variants.table(rows).splitlines()
    assert [line[:16].strip() for line in lines[1:]] == names
    assert "0.250 m" in lines[1] and "9/6/0" in lines[1] and "200 ms" in lines[1]


def test_variants_without_truth_have_times_only():
    log = planar.planar("field", 5, landmarks=15, length_m=3.0, rate_hz=2.0)
    pose = np.zeros((len(log.frame_time), 3))
    world = compare.PointMap(np.ones((2, 2)), np.array([-1, -1]))
    row = variants._measured("x", replace(log, truth=None), 7, pose, world, 3.0 * len(pose))
    assert np.isnan([row.aligned, row.unaligned, row.landmarks]).all()
    assert " ".join(variants.table([row]).splitlines()[1].split()) == "x 7 - - - - 3000 ms"
