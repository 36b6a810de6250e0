"""What experiments/room.py makes of a run: errors by stage, and limits held or broken."""

import numpy as np
import pytest
import room

from jaxslam.results.result import MapEstimate
from jaxslam.simulation.room.furniture import furnish

SEED = 7


@pytest.fixture
def edges(monkeypatch):
    """Of a room in which all landmarks count as in view."""
    every = furnish(SEED).edges
    wanted = every.point[every.landmark]
    monkeypatch.setattr(room, "edges_in_view", lambda seed, log: (wanted, every.point))
    return every


def _map(mean, identity):
    count = len(mean)
    return MapEstimate(np.arange(count), mean, np.zeros((count, 3)), np.ones(count), identity)


def test_hidden_landmarks_count_within_the_gate_and_known_ones_wherever_they_are(edges):
    true = np.column_stack([np.linspace(1, 5, 9), np.sin(np.arange(9)), np.zeros(9)])
    path = true + [0.03, 0.04, 0.0]
    mean = edges.point + [0.02, 0.0]
    mean[0] += [-30.0, 0.0]
    hidden = room._of_stage("refined", path, _map(mean, np.full(len(mean), -1)), true, SEED, None)
    assert hidden["path_refined_m"] == pytest.approx(0.05)
    assert hidden["path_refined_aligned_m"] == pytest.approx(0, abs=1e-6)
    assert hidden["landmarks_refined_m"] <= 0.02 + 1e-9
    assert hidden["spurious_refined"] == 1
    assert hidden["landmarks_refined_identified_m"] is None
    known = room._of_stage("refined", path, _map(mean, np.arange(len(mean))), true, SEED, None)
    far = np.append(np.full(len(mean) - 1, 0.02), 29.98)
    assert known["landmarks_refined_m"] == hidden["landmarks_refined_m"]
    assert known["landmarks_refined_identified_m"] == pytest.approx(np.sqrt(np.mean(far**2)))
    assert known["landmark_refined_max_m"] == pytest.approx(29.98)


def test_a_limit_is_broken_by_its_worst_run():
    good = {"path_refined_m": 0.01, "landmarks_refined_m": 0.039}
    rows = [("position hidden, room 1, run 0", good)]
    assert room.limits(rows).splitlines()[-1].endswith("| held |")
    for key in good:
        worse = [*rows, ("position hidden, room 2, run 0", good | {key: 0.041})]
        assert room.limits(worse).splitlines()[-1].endswith("| broken |")
    lost = [*rows, ("position hidden, room 2, run 0", good | {"path_refined_m": np.nan})]
    assert room.limits(lost).splitlines()[-1].endswith("| broken |")
