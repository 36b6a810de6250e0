"""From rendered images to the map of the room, the paper's claim: everything within 30 cm."""

import numpy as np
import pytest

from jaxslam import config_for, default_params, run
from jaxslam.logs.truth import truth_at
from jaxslam.results.metrics import pair_by_distance
from jaxslam.simulation.room.furniture import furnish
from jaxslam.simulation.room.render import render_room
from jaxslam.vision.camera_files import load_camera
from jaxslam.vision.extract import extract

# What experiments/room.py finds of this robot by its calibration drives.
MOTION = dict(gain_tran=0.976, gain_rot=0.997, err_tran=0.0045, err_rot=0.0094, err_drift=0.0)


@pytest.mark.slow
def test_a_room_is_mapped_from_images(tmp_path):
    seed, place = 3, tmp_path / "room"
    render_room(place, seed=seed)
    params = default_params("position")._replace(**MOTION)
    camera = load_camera(place / "camera.toml")
    log = extract(place / "images", camera, place / "odometry.csv", truth=place, params=params)
    config = config_for(log, "position", particles=1000, landmarks=192)
    result = run(log, config, default_params("position", log))
    assert result.flags == []
    true = truth_at(log.truth, result.time)
    off = np.hypot(*(result.pose - true)[:, :2].T)  # not aligned: the start is given
    reckoned = np.hypot(*(result.dead_reckoning - true)[:, :2].T)
    assert np.sqrt(np.mean(off**2)) < 0.10 < np.sqrt(np.mean(reckoned**2))
    assert off.max() < 0.30
    edges, mean = furnish(seed).edges.point, result.landmarks.mean
    nearest = np.hypot(*(mean[:, None] - edges).transpose(2, 0, 1)).min(axis=1)
    assert nearest.max() < 0.30
    pairs = pair_by_distance(mean, edges, 0.15)
    assert len(pairs) >= 60  # of 74 that are tall, have contrast and are often in view
    assert np.sqrt(np.mean(nearest[pairs[:, 0]] ** 2)) < 0.10
    assert len(mean) - len(pairs) <= 10
