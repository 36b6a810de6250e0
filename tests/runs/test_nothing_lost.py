"""What was computed is not lost: not by refinement that fails, nor by names, folders, signals."""

import os
import signal

import numpy as np
import pytest

from jaxslam.logs.log_file import save_log
from jaxslam.logs.slicing import cut
from jaxslam.parameters import default_params
from jaxslam.results import load
from jaxslam.runs import batch, checkpoint_file, checkpoints, run
from jaxslam.simulation.planar import planar
from jaxslam.smoother import reassociation, refine

RUN = "run", "log.npz", "--particles", 30, "--landmarks", 30
LONG = *RUN, "--out", "out", "--checkpoint-every", 1


@pytest.fixture
def log(at):
    made = planar("field", 5, landmarks=25, length_m=6.0, rate_hz=2.0, outlier=0.05)
    save_log("log.npz", made)
    return made


@pytest.mark.parametrize("error", [MemoryError, np.linalg.LinAlgError])
def test_what_was_filtered_outlives_a_refinement_that_fails(log, call, monkeypatch, error):
    def fails(*_, **__):
        raise error

    monkeypatch.setattr(refine, "refine", fails)
    code, _, err = call(*RUN, "--out", "out")
    line = "path and map could not be refined: too little memory, or no solution"
    assert (code, err.splitlines()[-1]) == (1, f"warning: {line}")
    again = load.load_result("out")
    assert np.isfinite(again.pose).all() and again.refined is None
    assert again.flags == [line]


def test_where_they_are_too_many_landmarks_seen_once_are_left_out(log, monkeypatch):
    config = run.config_for(log, "range_bearing", particles=30, landmarks=30)
    whole = run.run(log, config)
    assignment, ids = np.array([0, 2, -1, 2, 1, 0]), np.array([7, 8, 9])
    groups = reassociation.Groups(assignment, ids, np.arange(6.0).reshape(3, 2))
    fewer = refine._drop_single_measurements(groups)
    np.testing.assert_array_equal(fewer.assignment, [0, 1, -1, 1, -1, 0])
    np.testing.assert_array_equal(fewer.landmark_id, [7, 9])
    np.testing.assert_array_equal(fewer.point, [[0, 1], [4, 5]])
    monkeypatch.setattr(refine, "LARGE", 0)
    few = run.run(log, config)
    assert len(few.refined.mean) > 5
    np.testing.assert_allclose(few.refined.pose, whole.refined.pose, atol=0.05)


def test_identities_without_a_slot_do_not_stop_rejuvenation(log):
    settings = dict(particles=30, landmarks=6, association="known", rejuvenate=1.0)
    found = run.run(log, run.config_for(log, "range_bearing", **settings), refine=False)
    assert len(found.events) > 0
    assert any("the map was full" in line for line in found.flags)


def test_values_of_a_sweep_have_folders_of_their_own(log):
    params = default_params("range_bearing", log)
    todo = batch.plan_tasks("3", params, ["gain_rot=1.0000001,1.0000002,1.0000001"])
    assert len(todo) == 2
    names = [batch._short(task.swept["gain_rot"]) for task in todo]
    assert names == ["1.0000001", "1.0000002"]
    assert batch._short(0.1) == "0.1"


def test_many_runs_replace_runs_alone(log, call, refuse):
    words = *RUN, "--no-refine", "--seeds", "1", "--out", "many"
    assert call(*words)[0] == 0
    assert call(*words, "--overwrite")[0] == 0
    os.mkdir("many/mine")
    assert "holds mine, which is no run's; it is not overwritten" in refuse(*words, "--overwrite")
    os.rmdir("many/mine")
    os.rename("log.npz", "many/log.npz")
    inside = "run", "many/log.npz", *words[2:], "--overwrite"
    assert "is in many, where results are replaced" in refuse(*inside)


def test_a_finished_run_is_not_that_of_another_log(log, call, refuse):
    words = *LONG, "--no-refine"
    assert call(*words)[0] == 0
    assert call(*words, "--resume")[1].endswith("nothing to do\n")
    with open("out/steps.npz", "r+b") as file:
        whole = file.read()
        file.truncate(100)
    assert "out: is finished, but broken (" in refuse(*words, "--resume")
    with open("out/steps.npz", "wb") as file:
        file.write(whole)
    os.remove("log.npz")
    save_log("log.npz", cut(log, 0, 5))
    assert "is finished, but of another log, or part of it" in refuse(*words, "--resume")


def test_a_signal_during_the_last_checkpoint_stops_the_run(log, monkeypatch):
    write = checkpoint_file.write_checkpoint

    def signalled(*given):
        write(*given)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(checkpoint_file, "write_checkpoint", signalled)
    config = run.config_for(log, "range_bearing", particles=30, landmarks=30)
    with pytest.raises(KeyboardInterrupt, match="--resume"), checkpoints.Checkpoints("out") as kept:
        run.run(log, config, None, 0, None, True, kept)
    assert len(os.listdir("out/checkpoints")) == 1
