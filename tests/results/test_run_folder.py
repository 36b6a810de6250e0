import dataclasses
import errno
import json
import os
import shutil
import tomllib

import numpy as np
import pytest
from small_run import LANDMARKS, START, make_log, make_refined, make_result

from jaxslam.config import Config
from jaxslam.logs.log import Truth
from jaxslam.logs.log_file import save_log
from jaxslam.parameters import Params
from jaxslam.results import load, metrics, run_folder
from jaxslam.results.events import list_events as events_of
from jaxslam.results.tables import error_table

NAME = "lost-in-the-woods"
HEAD = ["aligned", "RMSE", "unaligned", "RMSE", "unaligned", "max", "at", "the", "end"]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def same(a, b):
    """Whether two values, arrays or tuples of arrays are equal to the last bit."""
    if isinstance(a, tuple):
        return all(same(x, y) for x, y in zip(a, b, strict=True))
    return np.array_equal(a, b) and np.asarray(a).dtype == np.asarray(b).dtype


@pytest.mark.parametrize("make", [make_result, make_refined])
def test_what_is_saved_is_loaded_again(tmp_path, make):
    result = make()
    run_folder.save(result, tmp_path / "run", figures=False)
    loaded = load.load_result(tmp_path / "run")
    for item in dataclasses.fields(result):
        if item.name not in ("log", "params"):
            assert same(getattr(loaded, item.name), getattr(result, item.name)), item.name
    assert loaded.params == tuple(map(float, result.params))
    assert load.evaluate_folder(tmp_path / "run") == metrics.compute_errors(result)


def test_what_was_refined_has_files_of_its_own(tmp_path):
    run_folder.save(make_result(), tmp_path / "run", figures=False)
    before = contents(tmp_path / "run")
    assert not [name for name in before if "refined" in name]
    run_folder.save(make_refined(), tmp_path / "run", overwrite=True, figures=False)
    after = contents(tmp_path / "run")
    assert set(after) - set(before) == {"trajectory_refined.tum", "landmarks_refined.csv"}
    for name in ("trajectory.tum", "landmarks.csv", "events.jsonl"):
        assert after[name] == before[name]  # the filter stays what it is
    result = make_refined()
    path = np.loadtxt(tmp_path / "run" / "trajectory_refined.tum")
    np.testing.assert_allclose(path[:, 1:3], result.refined.pose[:, :2], atol=1e-9)
    lines = after["landmarks_refined.csv"].decode().splitlines()
    assert lines[0] == "id,x,y,sxx,sxy,syy,n"
    table = np.loadtxt(lines[1:], delimiter=",")
    np.testing.assert_array_equal(table[:, 1:3], result.refined.mean)
    np.testing.assert_array_equal(table[:, 3:6], result.refined.landmark_cov)
    run_folder.save(make_result(), tmp_path / "run", overwrite=True, figures=False)
    assert not [name for name in contents(tmp_path / "run") if "refined" in name]


def test_summary_of_what_looks_back():
    plain, summary = run_folder.summarise(make_result()), run_folder.summarise(make_refined())
    told = dict(refine_seconds=0.75, refine_rounds=3, refine_converged=True, least_ancestors=1)
    told |= dict(n_landmarks_refined=4, n_landmarks=5)
    assert summary | told == summary
    assert not told.keys() - {"n_landmarks"} & plain.keys()
    assert summary["warnings"] == plain["warnings"]
    assert summary["advice"] == [
        "all particles share one past up to 6.0 s before the end (25.0% of the path): "
        "the ancestral covariance says nothing about it"
    ]


def test_run_toml_resolves_everything(tmp_path):
    source = tmp_path / 'a "log" \\ here.npz'
    save_log(source, make_log())
    result = dataclasses.replace(make_result(), seed=np.int64(7))
    run_folder.save(result, tmp_path / "run", log_source=source, figures=False)
    told = tomllib.loads((tmp_path / "run" / "run.toml").read_text(encoding="utf-8"))
    assert Config(**told["config"]) == result.config
    assert set(told["config"]) == {item.name for item in dataclasses.fields(Config)}
    assert Params(**told["params"]) == tuple(map(float, result.params))
    assert (told["seed"], told["log"], told["name"]) == (7, str(source), "circle")
    assert not (tmp_path / "run" / "log.npz").exists()
    assert load.load_result(tmp_path / "run").log.name == "circle"


def test_a_bundled_log_is_told_by_name(tmp_path):
    run_folder.save(make_result(), tmp_path / "run", log_source=NAME, figures=False)
    told = tomllib.loads((tmp_path / "run" / "run.toml").read_text(encoding="utf-8"))
    assert told["log"] == NAME
    with pytest.raises(ValueError, match="not the log of this run"):
        load.load_result(tmp_path / "run")


def test_trajectory_keeps_every_nanosecond_and_uses_plain_decimals():
    rng = np.random.default_rng(0)
    time = np.array([START, START + 1, 5, 0, -1, -1_500_000_000, 4_000_000_000_000_000_123])
    pose = rng.normal(size=(7, 3)) * [1e-9, 1e6, 1]
    lines = list(run_folder.tum_lines(time, pose))
    assert lines[0].startswith("1700000000.123456789 ")
    assert [line.split()[0] for line in lines[3:6]] == [
        "0.000000000",
        "-0.000000001",
        "-1.500000000",
    ]
    for line, stamp, (x, y, heading) in zip(lines, time, pose, strict=True):
        seconds, px, py, pz, qx, qy, qz, qw = line.split()
        assert "e" not in line.lower()
        assert int(seconds.replace(".", "")) == stamp
        np.testing.assert_allclose([float(px), float(py)], [x, y], atol=1e-9)
        assert float(pz) == float(qx) == float(qy) == 0
        turned = 2 * np.arctan2(float(qz), float(qw))
        assert metrics.wrap(turned - heading) == pytest.approx(0, abs=1e-8)


def test_landmarks_are_written_to_the_last_digit(tmp_path):
    result = make_result(shift=0.1 + 1e-15)
    run_folder.save(result, tmp_path / "run", figures=False)
    text = (tmp_path / "run" / "landmarks.csv").read_text()
    assert text.splitlines()[0] == "id,x,y,sxx,sxy,syy,n"
    table = np.loadtxt(text.splitlines()[1:], delimiter=",")
    np.testing.assert_array_equal(table[:, 0], result.landmarks.id)
    np.testing.assert_array_equal(table[:, 1:3], result.landmarks.mean)
    np.testing.assert_array_equal(table[:, 3:6], result.landmarks.cov)
    np.testing.assert_array_equal(table[:, 6], result.landmarks.n)


def test_summary_has_the_stable_keys_and_the_errors(tmp_path):
    result = make_result()
    run_folder.save(result, tmp_path / "run", figures=False)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    told = dict(n_particles=100, n_steps=40, n_measurements=80, seconds=1.25, compile_seconds=0.5)
    told |= dict(log_likelihood=-60.0, n_landmarks=5, min_ess=43.0, overflow=0)
    told |= dict(dropped_measurements=3, sensor="range_bearing", association="maximum_likelihood")
    told |= dict(proposal="prior", seed=7)
    assert summary | told == summary
    assert set(summary["versions"]) == {"jaxslam", "jax", "numpy", "python"}
    assert summary | metrics.compute_errors(result) == summary
    assert any("measurement slot" in line for line in summary["warnings"])


def test_numbers_json_lacks_become_null(tmp_path):
    result = dataclasses.replace(make_result(), log_evidence=np.full(40, -np.inf))
    run_folder.save(result, tmp_path / "run", figures=False)
    text = (tmp_path / "run" / "summary.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail)["log_likelihood"] is None


def test_events_tell_what_happened_and_when():
    result = make_result()
    overflow, degenerate = np.zeros(40), np.zeros(40, bool)
    overflow[10], degenerate[12] = 0.25, True
    result = dataclasses.replace(result, overflow=overflow, degenerate=degenerate)
    events = list(events_of(result))
    assert [event["step"] for event in events] == [0, 1, 2, 3, 10, 12, 19, 39]
    assert events[0] == {"step": 0, "t": 0, "ess": 100, "new": 1}
    assert events[4] == {"step": 10, "t": 2, "ess": 70, "overflow": 0.25}
    assert events[5]["degenerate"] is True
    assert events[6] == {"step": 19, "t": 3.8, "ess": 43, "resampled": True}


def test_an_existing_folder_is_kept_without_overwrite(tmp_path):
    run_folder.save(make_result(), tmp_path / "run", figures=False)
    before = contents(tmp_path / "run")
    with pytest.raises(ValueError, match="--overwrite"):
        run_folder.save(make_result(shift=0.5), tmp_path / "run", figures=False)
    assert contents(tmp_path / "run") == before
    run_folder.save(make_result(shift=0.5), tmp_path / "run", overwrite=True, figures=False)
    assert load.evaluate_folder(tmp_path / "run")["ate_filtered_unaligned_rmse_m"] > 0.4
    assert os.listdir(tmp_path) == ["run"]


@pytest.mark.parametrize("kept", ["thesis.txt", "run/notes.txt"])
def test_overwrite_never_deletes_what_is_not_a_runs(tmp_path, kept):
    folder = (tmp_path / kept).parent
    if kept.startswith("run"):
        run_folder.save(make_result(), folder, figures=False)
    (tmp_path / kept).write_text("years of work")
    with pytest.raises(ValueError, match="not overwritten"):
        run_folder.save(make_result(), folder, overwrite=True, figures=False)
    assert (tmp_path / kept).read_text() == "years of work"


def test_a_file_in_the_way_is_said(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(ValueError, match="run: is not a folder"):
        run_folder.save(make_result(), tmp_path / "run", overwrite=True)
    with pytest.raises(ValueError, match=r"can't be made in .*choose another"):
        run_folder.save(make_result(), tmp_path / "run" / "deeper")


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("step", ["savez_compressed", "fsync", "rename"])
def test_a_failed_save_leaves_nothing_new_and_loses_nothing_old(
    tmp_path, monkeypatch, step, overwrite
):
    if overwrite:
        run_folder.save(make_result(), tmp_path / "run", figures=False)
    before = contents(tmp_path / "run") if overwrite else None
    owner = np if step == "savez_compressed" else os
    real, calls = getattr(owner, step), []

    def fail(*args, **named):
        calls.append(args)
        # With overwriting the second rename is the one that puts the new folder in place.
        if step == "rename" and overwrite and len(calls) != 2:
            return real(*args, **named)
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(owner, step, fail)
    with pytest.raises(ValueError, match="can't be written"):
        run_folder.save(
            make_result(),
            tmp_path / "run",
            overwrite=overwrite,
            log_source=NAME,
            figures=False,
        )
    monkeypatch.undo()
    assert calls
    assert os.listdir(tmp_path) == (["run"] if overwrite else [])
    assert not overwrite or contents(tmp_path / "run") == before


def test_no_space_and_interruption_clean_up_and_keep_their_kind(tmp_path, monkeypatch):
    for error in (OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()):

        def fail(*_, error=error):
            raise error

        monkeypatch.setattr(os, "fsync", fail)
        with pytest.raises(type(error)):
            run_folder.save(make_result(), tmp_path / "run", log_source=NAME, figures=False)
        monkeypatch.undo()
        assert os.listdir(tmp_path) == []


def test_a_rerun_over_its_own_stored_log_keeps_the_log(tmp_path):
    folder = tmp_path / "run"
    run_folder.save(make_result(), folder, figures=False)
    run_folder.save(
        make_result(), folder, overwrite=True, log_source=folder / "log.npz", figures=False
    )
    shutil.move(folder, tmp_path / "elsewhere")
    assert load.load_result(tmp_path / "elsewhere").log.name == "circle"


def test_broken_folders_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere: no run\.toml"):
        load.load_result(tmp_path / "nowhere")
    run_folder.save(make_result(), tmp_path / "run", figures=False)
    for name, text in (
        ("steps.npz", b"PK\x03\x04"),
        ("summary.json", b"{}"),
        ("run.toml", b"seed = "),
        ("run.toml", b"[config]\nparticles = 0\n[params]\n"),
    ):
        kept = (tmp_path / "run" / name).read_bytes()
        (tmp_path / "run" / name).write_bytes(text)
        with pytest.raises(ValueError, match="a broken run folder"):
            load.load_result(tmp_path / "run")
        (tmp_path / "run" / name).write_bytes(kept)
    (tmp_path / "run" / "log.npz").unlink()
    with pytest.raises(ValueError, match="--log PATH"):
        load.load_result(tmp_path / "run")
    save_log(tmp_path / "moved.npz", make_log())
    assert load.load_result(tmp_path / "run", tmp_path / "moved.npz").seed == 7
    save_log(tmp_path / "other.npz", make_log(frames=20))
    with pytest.raises(ValueError, match="not the log of this run"):
        load.load_result(tmp_path / "run", tmp_path / "other.npz")


def test_error_table_puts_dead_reckoning_beside_the_filter():
    found = metrics.compute_errors(make_result())
    lines = error_table(found).splitlines()
    assert lines[0].split() == HEAD
    assert lines[1].split() == ["path,", "filter", "0.000", "m", *["0.100", "m"] * 3]
    assert lines[2].startswith("path, dead reckoning")
    assert lines[2].split()[-2] == f"{found['dead_reckoning_end_m']:.3f}"
    assert "4 matched, 0 missed, 1 spurious (gate 0.50 m)" in error_table(found)
    assert "refined" not in error_table(found) and "ancestral" not in error_table(found)
    only_map = dataclasses.replace(make_log(), truth=Truth(landmarks=LANDMARKS))
    table = error_table(metrics.compute_errors(make_result(), only_map))
    assert "path" not in table
    assert "0.100 m" in table
    assert "no truth" in error_table({})


def test_error_table_shows_every_path_and_both_maps():
    lines = error_table(metrics.compute_errors(make_refined())).splitlines()
    labels = [line[:24].strip() for line in lines[1:5]]
    assert labels == [f"path, {n}" for n in ("filter", "ancestral", "refined", "dead reckoning")]
    assert [line.split()[-2] for line in lines[1:4]] == ["0.100", "0.080", "0.050"]
    at = [line[:24].strip() for line in lines].index("landmarks, refined")
    assert lines[at].split()[2:] == ["0.000", "m", "0.050", "m"]
    assert lines[at + 1].endswith("4 matched, 0 missed, 0 spurious")
    assert [line.split()[-3] for line in lines if line.startswith("association")] == ["100", "98.8"]
