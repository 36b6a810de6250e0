"""Many runs in one program: each is the run it would be alone; and what they are told, and tell."""

import csv

import numpy as np
import pytest

from jaxslam.cli import main as cli
from jaxslam.logs.log_file import load_log
from jaxslam.logs.slicing import cut
from jaxslam.parameters import default_params
from jaxslam.results.load import load_result
from jaxslam.runs import batch, compiled, memory, run

CONFIG = dict(particles=30, landmarks=30, measurements=10)  # test_offline's: compiled once


@pytest.fixture(scope="module")
def woods():
    return cut(load_log("lost-in-the-woods"), 20, 32)


@pytest.fixture(scope="module")
def three(woods):
    """Three tasks, worked off in programs of two, and their results."""
    config = run.config_for(woods, "range_bearing", **CONFIG)
    todo = batch.plan_tasks("1,4", default_params("range_bearing", woods), ["err_rot=0.05,0.2"])[:3]
    before, batch.STATE_BYTES = batch.STATE_BYTES, 2 * state_bytes(config)
    try:
        return config, todo, batch.run_tasks(woods, config, todo, refine=False)
    finally:
        batch.STATE_BYTES = before


def state_bytes(config):
    return memory.bytes_of(compiled.state_shapes(config))


def test_each_run_is_bit_for_bit_what_it_is_alone(woods, three):
    config, todo, results = three
    assert [(task.seed, task.swept) for task in todo] == [
        (1, {"err_rot": 0.05}), (4, {"err_rot": 0.05}), (1, {"err_rot": 0.2}),
    ]  # fmt: skip
    assert len(results) == 3
    for i in (1, 2):
        alone = run.run(woods, config, todo[i].params, todo[i].seed, refine=False)
        for name in ("pose", "cov", "log_evidence", "ess", "match"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(results[i], name))
        np.testing.assert_array_equal(alone.landmarks.mean, results[i].landmarks.mean)
        np.testing.assert_array_equal(alone.ancestral.pose, results[i].ancestral.pose)
        assert results[i].seed == todo[i].seed and results[i].params == todo[i].params
    assert not np.array_equal(results[0].pose, results[2].pose)  # the sweep makes a difference


def test_the_table_has_a_line_for_each_run_and_its_mean_and_spread(three):
    _, todo, results = three
    found = batch.summary_rows(todo, results)
    lines = batch.format_runs(found).splitlines()
    assert [line.split()[0] for line in lines] == ["seed", "1", "4", "mean", "sd", "1"]
    evidence = [row["log_likelihood"] for row in found[:2]]
    assert float(lines[3].split()[2]) == pytest.approx(np.mean(evidence), abs=0.06)
    assert float(lines[4].split()[2]) == pytest.approx(np.std(evidence, ddof=1), abs=0.06)


def test_saved_are_the_table_and_each_runs_folder(three, woods, tmp_path):
    _, todo, results = three
    batch.save(todo, results, tmp_path / "all")
    with open(tmp_path / "all" / "runs.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["err_rot"] for row in rows] == ["0.05", "0.05", "0.2"]
    again = load_result(tmp_path / "all" / "seed-4-err_rot-0.05")
    np.testing.assert_array_equal(again.pose, results[1].pose)
    with pytest.raises(ValueError, match="exists; choose another"):
        batch.save(todo, results, tmp_path / "all")
    batch.save(todo[:1], results[:1], tmp_path / "all", overwrite=True)
    assert len(list((tmp_path / "all").iterdir())) == 2
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(ValueError, match=r"holds no runs.csv"):
        batch.save(todo, results, tmp_path / "other", overwrite=True)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(
    ("text", "found"), [("3", [3]), ("0-3", [0, 1, 2, 3]), ("7, 1-2,1", [7, 1, 2])]
)
def test_seeds(text, found):
    assert batch.parse_seeds(text) == found


@pytest.mark.parametrize("text", ["", "3-1", "a", "1,", "-1", "0-4294967296"])
def test_what_are_no_seeds(text):
    with pytest.raises(ValueError, match=r"--seeds is .*must be whole numbers"):
        batch.parse_seeds(text)


@pytest.mark.parametrize(
    ("sweeps", "problem"),
    [
        (["err_rot"], "must be a parameter's name and values"),
        (["speed=1"], "must be a parameter's name and values"),
        (["err_rot=a"], "'a' are not numbers"),
        (["err_rot=0.1,-1"], "--sweep: err_rot is -1; must be 0"),
        (["err_rot=1", "err_rot=2"], "named twice"),
    ],
)
def test_what_is_no_sweep(sweeps, problem):
    with pytest.raises(ValueError, match=problem):
        batch.plan_tasks("0", default_params(), sweeps)


def test_seeds_are_for_runs_without_checkpoints(capsys):
    told = ["run", "lost-in-the-woods", "--seeds", "0-1", "--resume"]
    assert cli.main(told) == 2
    assert "without checkpoints" in capsys.readouterr().err
