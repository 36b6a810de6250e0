"""The commands, run in this process on small logs: results, exit codes, one line per error."""

import dataclasses
import inspect
import json
import os
import pickle
import zipfile

import numpy as np
import pytest
from small_run import make_refined

from jaxslam.cli import main as cli
from jaxslam.logs.log_file import load_log, save_log
from jaxslam.reference import compare
from jaxslam.results import load
from jaxslam.runs import run as runner
from jaxslam.simulation import planar as simulate

MANY = ("--particles", "50", "--no-smoothing")


@pytest.fixture(scope="session")
def short():
    """A log of 30 frames."""
    return simulate.planar(length_m=3.0, landmarks=12, outlier=0.0)


@pytest.fixture
def log(at, short):
    save_log("log.npz", short)
    return "log.npz"


def bearings_only(log):
    """What is left of a log whose sensor gave bearings and nothing else, and nobody the truth."""
    names = ("odometry_time", "odometry", "frame_time", "frame", "bearing", "view")
    return type(log)(name="plain", **{name: getattr(log, name) for name in names})


def write_csv(at):
    """Eight seconds of a robot driving straight past three posts, measured twice a second."""
    odometry = [f"{t / 10:.1f},0.5,0.0" for t in range(80)]
    rows = []
    for t in np.arange(0.5, 8.1, 0.5):
        for identity, (x, y) in enumerate([(2.0, 2.0), (5.0, -1.5), (7.0, 1.0)]):
            dx = x - 0.5 * t
            rows.append(f"{t},{np.arctan2(y, dx):.6f},{np.hypot(dx, y):.6f},{identity}")
    truth = [f"{t},{0.5 * t},0,0" for t in np.arange(0, 8.1, 0.5)]
    for name, head, lines in (
        ("odometry.csv", "time_s,forward_m_s,yaw_rate_rad_s", odometry),
        ("seen.csv", "time_s,bearing_rad,range_m,identity", rows),
        ("truth.csv", "time_s,x_m,y_m,theta_rad", truth),
    ):
        (at / name).write_text("\n".join([head, *lines, ""]))


def test_from_csv_files_to_errors_and_figures(at, call):
    write_csv(at)
    code, out, _ = call("convert", "odometry.csv", "seen.csv", "truth.csv", "robot.npz")
    assert code == 0
    assert "jaxslam check robot.npz" in out
    code, out, _ = call("check", "robot.npz")
    assert code == 0
    assert "48 measurements" in out
    run = "run", "robot.npz", "--association", "known", "--particles", "50", "--out", "result"
    code, out, err = call(*run)
    assert code == 0
    for label in ("path, filter", "path, ancestral", "path, refined", "dead reckoning"):
        assert label in out
    assert "; refined in " in out.splitlines()[-2]
    assert "result" in out.splitlines()[-1]
    summary = json.loads((at / "result" / "summary.json").read_text())
    assert (summary["n_particles"], summary["n_landmarks"]) == (50, 3)
    assert summary["n_landmarks_refined"] == 3
    assert [f"note: {line}" for line in summary["advice"]] == err.splitlines()
    assert len((at / "result" / "landmarks_refined.csv").read_text().splitlines()) == 4
    errors = json.loads(call("evaluate", "result", "--json")[1])
    assert errors["truth_frames"] == 16
    assert errors["ate_filtered_unaligned_rmse_m"] < 0.2
    assert errors["ate_refined_unaligned_rmse_m"] < 0.1
    assert errors.items() <= summary.items()
    (at / "result" / "map.png").unlink()
    assert call("plot", "result")[1].splitlines()[0].endswith("map.png")
    assert (at / "result" / "map.png").stat().st_size > 1000


def test_simulate_run_again_and_moved_log(at, call, refuse):
    planar = "simulate", "planar", "world.npz", "--length", "3", "--landmarks", "12"
    assert call(*planar, "--seed", "4", "--outlier", "0")[0] == 0
    assert load_log("world.npz").name == "planar-room-4"
    assert "world.npz: exists; choose another name or add --overwrite" in refuse(*planar)
    run = "run", "world.npz", *MANY, "--sensor", "position", "--paper", "--seed", "3"
    assert call(*run)[0] == 0
    folder = at / "runs" / "world-position-3"
    told = (folder / "run.toml").read_text()
    assert "exclusive = false" in told
    assert "seed = 3" in told
    assert not (folder / "trajectory_refined.tum").exists()  # as asked
    assert "exists; choose another folder or add --overwrite" in refuse(*run)
    (at / "world.npz").rename(at / "moved.npz")
    assert "--log" in refuse("evaluate", folder)
    code, out, _ = call("evaluate", folder, "--log", "moved.npz")
    assert code == 0
    assert "path, filter" in out


def test_informed_and_drawn(log, call):
    run = "run", log, *MANY, "--association", "sampled", "--proposal", "informed"
    code, out, _ = call(*run, "--out", "result")
    assert code == 0
    assert "path, filter" in out
    config = load.load_result("result").config
    assert (config.association, config.proposal) == ("sampled", "informed")


def test_a_part_of_a_log_is_kept_beside_its_results(log, call, refuse):
    part = "run", log, *MANY, "--out", "part", "--start", "4", "--end", "6"
    assert call(*part)[0] == 0
    whole, used = load_log(log), load_log("part/log.npz")
    assert used.start == whole.start + 4 * 10**9
    assert len(used.frame_time) == 10  # 5 per second
    errors = json.loads(call("evaluate", "part", "--json")[1])
    assert errors["truth_frames"] == 10
    assert errors["ate_filtered_unaligned_rmse_m"] < 0.2
    assert "no frame between 90 and 99 s" in refuse("run", log, "--start", "90", "--end", "99")


def test_overwriting_keeps_the_old_folder_until_the_new_one_is_there(log, call):
    run = "run", log, *MANY, "--out", "result"
    assert call(*run)[0] == 0
    assert call(*run, "--overwrite", "--seed", "1")[0] == 0
    assert load.load_result("result").seed == 1


def test_options_of_simulate_are_those_of_the_library(at, call, monkeypatch):
    renamed = {"length": "length_m", "rate": "rate_hz", "odometry_rate": "odometry_hz"}
    renamed |= {"stop": "stop_m"}
    options = inspect.signature(cli.planar).parameters.values()
    library = inspect.signature(simulate.planar).parameters.values()
    library = {o.name: o.default for o in library} | simulate.NOISE
    defaults = {renamed.get(o.name, o.name): o.default for o in options}
    assert defaults.pop("view_range") == library["view"][2]
    del defaults["out"], defaults["overwrite"]
    assert defaults == {name: library[name] for name in defaults}

    seen, planar = {}, simulate.planar

    def spy(world, seed, **given):
        seen.update(given, world=world, seed=seed, view_range=given["view"][2])
        return planar(world, seed, **given)

    monkeypatch.setattr(simulate, "planar", spy)
    words = []
    for option in options:
        if isinstance(option.default, float | int) and not isinstance(option.default, bool):
            value = option.default * 3 // 4 if option.default >= 1 else 0.125
            words += ["--" + option.name.replace("_", "-"), 5 if option.name == "seed" else value]
    code, _, err = call("simulate", "planar", "x.npz", "--world", "grid", "--commands", *words)
    assert (code, err) == (0, "")
    told = dict(zip(words[::2], words[1::2], strict=True))
    for option, value in told.items():
        name = option[2:].replace("-", "_")
        assert seen[renamed.get(name, name)] == value, option
    assert len(told) == len(defaults) - 1  # all but world and commands, and the view
    assert (seen["world"], seen["commands"]) == ("grid", True)


def test_demo_maps_the_bundled_log(at, call, monkeypatch, short):
    asked = []
    monkeypatch.setattr("jaxslam.logs.log_file.load_log", lambda name: asked.append(name) or short)
    config_for = runner.config_for

    def fewer(log, sensor, association, particles):
        asked.append((sensor, association, particles))
        return config_for(log, sensor, association, particles=50)

    monkeypatch.setattr(runner, "config_for", fewer)
    code, out, _ = call("demo")
    assert code == 0
    assert asked == ["lost-in-the-woods", ("bearing", "maximum_likelihood", 1000)]
    assert "path, dead reckoning" in out
    assert os.path.join("runs", "demo", "map.png") in out
    assert (at / "runs" / "demo" / "map.png").exists()
    (at / "runs" / "demo" / "notes.txt").write_text("mine")
    code, _, err = call("demo")  # a second demo replaces the first, but nothing else
    assert code == 2
    assert "notes.txt" in err


@pytest.mark.parametrize("same", [7, 8])
def test_compare_shows_both(log, call, monkeypatch, same):
    asked = []

    def stub(given, config, params, seed, steps, every, progress):
        asked.append((config.particles, config.sensor, config.exclusive, seed, steps, every))
        poses = np.zeros((8, 3))
        double = compare.Agreement(
            8, config.particles, same, *[0.0] * 3, 1, *[0.0] * 4, poses, poses, 2.0, 0.1, 0.3, None
        )
        return compare.Comparison(double, double, 0.125, 0.25)

    monkeypatch.setattr(compare, "compare", stub)

    words = ["--particles", "3,5", "--paper", "--seed", 2, "--steps", 8, "--every", 4]
    code, out, err = call("compare", log, *words)
    assert asked == [(n, "position", False, 2, 8, 4) for n in (3, 5)]
    assert out.splitlines()[0].split() == ["3", "particles", "5", "particles"]
    assert out.count(f"{same} of 8 steps") == 4
    for text in ("0.125 m RMSE", "0.250 m RMSE", "250 ms", "50 ms", "12.5 ms", "20 times"):
        assert out.count(text) >= 2, text
    assert code == (same < 8)
    assert ("3 particles: the two part at step 7\n" in err) == (same < 8)


def test_lost_data_are_warnings(at, call, short):
    save_log("log.npz", short)
    run = "run", "log.npz", *MANY, "--out", "result"
    code, out, err = call(*run, "--landmarks", "2")
    assert code == 1
    assert "path, filter" in out
    assert err.splitlines()[-1].startswith("warning: the map was full from frame ")
    assert err.count("warning:") == 1
    write_csv(at)
    lines = (at / "seen.csv").read_text().splitlines()
    (at / "seen.csv").write_text("\n".join([*lines[:9], "oops,1,1,1", *lines[9:], ""]))
    code, _, err = call("convert", "odometry.csv", "seen.csv", "robot.npz")
    assert code == 1
    assert err.startswith("warning: 1 rows skipped: ")


def test_advice_is_a_note_and_no_warning(log, call, monkeypatch):
    asked = []

    def filtered(*given, refine, checkpoints):
        asked.append(refine)
        return dataclasses.replace(make_refined(), dropped={})

    monkeypatch.setattr(runner, "run", filtered)
    monkeypatch.setattr(runner, "refine_result", lambda result, progress: result)
    code, out, err = call("run", log, "--out", "result")
    assert (code, asked) == (0, [False])  # it refines by itself, with a progress bar of its own
    assert err.startswith("note: all particles share one past ") and err.count("\n") == 1
    assert out.splitlines()[-2].endswith("; refined in 0.8 s")


def test_check_tells_by_its_exit_code(at, call, short):
    late = short.frame_time + 3600 * 10**9
    for code, line, changes in (
        (0, "ok       30 frames", {}),
        (1, "warning  3 rows: bad row", {"skipped": {"bad row": 3}}),
        (2, "error    odometry and frames do not overlap", {"frame_time": late}),
    ):
        save_log("log.npz", dataclasses.replace(short, **changes))
        found, out, _ = call("check", "log.npz")
        assert found == code
        assert line in out


def pickled(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("schema.npy", pickle.dumps({"a": 1}))


def truncated(path):
    with open(path, "rb") as file:
        content = file.read()
    with open(path, "wb") as file:
        file.write(content[: len(content) // 2])


@pytest.mark.parametrize("command", ["run", "check", "compare"])
def test_logs_that_are_none(log, refuse, command):
    assert "nowhere.npz: no such file" in refuse(command, "nowhere.npz")
    truncated(log)
    assert "log.npz: not a log, or damaged" in refuse(command, log)
    pickled(log)
    assert "log.npz: not a log, or damaged" in refuse(command, log)
    assert not os.path.exists("runs")


def test_folders_that_are_none(at, refuse):
    for command in ("evaluate", "plot"):
        assert "no run.toml; not a run folder" in refuse(command, at)
        assert "no run.toml; not a run folder" in refuse(command, "nowhere")


def test_a_place_that_is_locked(log, refuse, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # as root sees no locks
    assert "choose another with --out" in refuse("run", log, "--out", "result")


def test_a_place_that_is_no_folder(log, at, refuse):
    assert "choose another with --out" in refuse("run", log, "--out", "log.npz/result")
    assert "is not a folder" in refuse("run", log, "--out", "log.npz", "--overwrite")
    (at / "mine").mkdir()
    (at / "mine" / "letter.txt").write_text("dear")
    assert "not a run folder" in refuse("run", log, "--out", "mine", "--overwrite")
    assert "cannot write" in refuse("simulate", "planar", "no/x.npz", "--length", "2")
    assert sorted(os.listdir()) == ["log.npz", "mine"]


def test_what_the_log_does_not_have(at, refuse, short):
    save_log("plain.npz", bearings_only(short))
    run = "run", "plain.npz"
    assert "'position' is not in this log; it has bearing" in refuse(*run, "--sensor", "position")
    assert "'known' needs identities" in refuse(*run, "--association", "known")
    assert os.listdir() == ["plain.npz"]


def test_a_log_without_truth(at, call, short):
    save_log("plain.npz", bearings_only(short))
    code, out, _ = call("run", "plain.npz", *MANY)
    assert code == 0
    assert "no truth" in out
    assert call("evaluate", "runs/plain-bearing-0", "--json")[:2] == (0, "{}\n")


def test_parameters(log, at, call, refuse):
    (at / "p.toml").write_text("sigma_rage = 0.2\n")
    line = refuse("run", log, "--params", "p.toml")
    assert "p.toml: sigma_rage is no parameter; did you mean sigma_range?" in line
    assert "none.toml: no such file" in refuse("compare", log, "--params", "none.toml")
    (at / "p.toml").write_text("sigma_range = 0.25\n")
    assert call("run", log, *MANY, "--params", "p.toml", "--out", "result")[0] == 0
    found = load.load_result("result").params
    assert found.sigma_range == 0.25
    assert found.err_tran == load_log(log).noise["err_tran"]


def test_usage(log, refuse):
    assert "--particels. Did you mean --particles?" in refuse("run", log, "--particels", "9")
    assert 'Did you mean "run"?' in refuse("rnu", log)
    assert "LOG" in refuse("run")
    assert '"range_bearing", "position", "bearing"' in refuse("run", log, "--sensor", "sonar")
    assert "--particles" in refuse("run", log, "--particles", "0")
    assert "--seed" in refuse("run", log, "--seed", "-1")
    assert "--particles is '20,x'" in refuse("compare", log, "--particles", "20,x")
    assert "length_m is -1.0" in refuse("simulate", "planar", "x.npz", "--length", "-1")
    assert "needed" in refuse("convert", "x.csv")
    assert "x.csv: a log is a .npz file" in refuse("convert", "y.csv", "x.csv")
    assert "y.csv: no such file" in refuse("convert", "y.csv", "x.npz")


def test_too_little_memory_is_told_and_a_fault_of_ours_not_hidden(log, refuse, monkeypatch):
    texts = ["RESOURCE_EXHAUSTED: Out of memory allocating 64 GB.\nmore lines", "a bug"]

    def run(*given, **named):
        raise RuntimeError(texts.pop(0))

    monkeypatch.setattr(runner, "run", run)
    assert "not enough memory; ask for fewer --particles" in refuse("run", log)
    with pytest.raises(RuntimeError, match="a bug"):
        cli.main(["run", log])


@pytest.mark.parametrize("place", ["runs.run.run", "results.run_folder.summarise"])
def test_interrupted_while_filtering_or_writing_leaves_nothing(log, call, monkeypatch, place):
    def interrupted(*given, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"jaxslam.{place}", interrupted)
    found = call("run", log, *MANY, "--out", "result")
    assert found == (130, "", "jaxslam: interrupted\n")
    assert os.listdir() == [log]
