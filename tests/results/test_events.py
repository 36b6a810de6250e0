"""Entropy of associations against counts by hand."""

import numpy as np
import pytest

from jaxslam.results.events import association_entropy


def test_entropy_counts_particles_as_often_as_they_go_on():
    landmark_id = np.array([[[7, 7, 7, 7], [3, 3, -2, 5]], [[1, 1, 2, 2], [-3, -3, -3, -3]]])
    ancestors = np.array([[0, 0, 2, 3], [0, 1, 2, 3]])
    found = association_entropy(landmark_id, ancestors)
    assert found[0, 0] == found[1, 1] == 0
    half, quarter = 0.5 * np.log(2), 0.25 * np.log(4)
    assert found[0, 1] == pytest.approx(half + 2 * quarter)
    assert found[1, 0] == pytest.approx(2 * half)


def test_what_dies_out_does_not_count():
    assert association_entropy(np.array([[[1, 1, 9]]]), np.array([[0, 1, 1]])).tolist() == [[0.0]]
