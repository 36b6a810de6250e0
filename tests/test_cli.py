"""The commands, run in this process on small logs: results, exit codes, one line per error."""

import inspect
import json
import os
import pickle
import subprocess
import sys
import time
import zipfile

import numpy as np
import pytest

from jaxslam import cli, report, runner, simulate
from jaxslam.log import load_log, save_log

COMMANDS = ("demo", "run", "compare", "convert", "check", "evaluate", "plot")
MANY = ("--particles", "50")


@pytest.fixture
def at(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def short():
    """A log of 30 frames."""
    return simulate.planar(length_m=3.0, landmarks=12, outlier=0.0)


@pytest.fixture
def log(at, short):
    save_log("log.npz", short)
    return "log.npz"


@pytest.fixture
def call(capsys):
    """Runs a command; gives exit code, stdout, stderr."""

    def run(*argv):
        code = cli.main([str(word) for word in argv])
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def refuse(call):
    """Runs a command that must be refused with 2 and one line; gives the line."""

    def run(*argv):
        code, out, err = call(*argv)
        assert (code, out) == (2, "")
        assert err.startswith("jaxslam: ")
        assert err.count("\n") == 1
        return err

    return run


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
    code, out, err = call("run", "robot.npz", "--association", "known", *MANY, "--out", "result")
    assert (code, err) == (0, "")
    assert "path, filter" in out
    assert "result" in out.splitlines()[-1]
    summary = json.loads((at / "result" / "summary.json").read_text())
    assert (summary["n_particles"], summary["n_landmarks"]) == (50, 3)
    assert summary["ate_filtered_unaligned_rmse_m"] < 0.2
    code, out, _ = call("evaluate", "result", "--json")
    errors = json.loads(out)
    assert code == 0
    assert (
        errors["landmark_gate_m"] if "landmark_gate_m" in errors else errors["truth_frames"] == 16
    )
    assert errors.items() <= summary.items()
    (at / "result" / "map.png").unlink()
    code, out, _ = call("plot", "result")
    assert code == 0
    assert out.splitlines()[0].endswith("map.png")
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
    assert "exists; choose another folder or add --overwrite" in refuse(*run)
    (at / "world.npz").rename(at / "moved.npz")
    assert "--log" in refuse("evaluate", folder)
    code, out, _ = call("evaluate", folder, "--log", "moved.npz")
    assert code == 0
    assert "path, filter" in out


def test_overwriting_keeps_the_old_folder_until_the_new_one_is_there(log, call):
    run = "run", log, *MANY, "--out", "result"
    assert call(*run)[0] == 0
    assert call(*run, "--overwrite", "--seed", "1")[0] == 0
    assert report.load("result").seed == 1


def test_options_of_simulate_are_those_of_the_library():
    ours = inspect.signature(cli.planar).parameters
    theirs = inspect.signature(simulate.planar).parameters
    renamed = {"length": "length_m", "rate": "rate_hz", "odometry_rate": "odometry_hz"}
    renamed |= {"stop": "stop_m"}
    for name, parameter in ours.items():
        if name in ("out", "overwrite", "view_range"):
            continue
        assert parameter.default == theirs[renamed.get(name, name)].default, name
    assert ours["view_range"].default == theirs["view"].default[2]


def test_every_simulated_option_arrives(at, call, monkeypatch):
    numbers = {"--seed": 7, "--landmarks": 9, "--length": 1.5, "--speed": 0.4, "--rate": 4}
    numbers |= {"--odometry-rate": 20, "--stop": 0.5, "--err-tran": 0.01, "--err-rot": 0.03}
    numbers |= {"--err-drift": 0.04, "--sigma-range": 0.06, "--sigma-bearing": 0.07}
    numbers |= {"--view-range": 4, "--detection": 0.8, "--outlier": 0.1}
    numbers |= {"--truth-resolution": 0.2}
    seen, planar = {}, simulate.planar

    def spy(world, seed, **given):
        seen.update(given, world=world, seed=seed, view_range=given["view"][2])
        return planar(world, seed, **given)

    monkeypatch.setattr(simulate, "planar", spy)
    words = [str(word) for pair in numbers.items() for word in pair]
    assert call("simulate", "planar", "x.npz", "--world", "grid", "--commands", *words)[0] == 0
    units = {"length": "length_m", "rate": "rate_hz", "odometry-rate": "odometry_hz"}
    units |= {"stop": "stop_m"}
    for option, value in numbers.items():
        name = option[2:]
        assert seen[units.get(name, name.replace("-", "_"))] == value, option
    assert (seen["world"], seen["commands"]) == ("grid", True)


def test_demo_maps_the_bundled_log(at, call, monkeypatch, short):
    asked = []
    monkeypatch.setattr("jaxslam.log.load_log", lambda name: asked.append(name) or short)
    config_for = runner.config_for

    def fewer(log, sensor, association, particles):
        asked.append((sensor, association, particles))
        return config_for(log, sensor, association, particles=50)

    monkeypatch.setattr(runner, "config_for", fewer)
    code, out, _ = call("demo")
    assert code == 0
    assert asked == ["lost-in-the-woods", ("range_bearing", "maximum_likelihood", 1000)]
    assert "path, dead reckoning" in out
    assert os.path.join("runs", "demo", "map.png") in out
    assert (at / "runs" / "demo" / "map.png").exists()
    (at / "runs" / "demo" / "notes.txt").write_text("mine")
    code, _, err = call("demo")  # a second demo replaces the first, but nothing else
    assert code == 2
    assert "notes.txt" in err


def test_compare_shows_both(log, call):
    code, out, err = call("compare", log, "--particles", "3", "--steps", "10")
    assert (code, err) == (0, "")
    assert "3 particles" in out
    assert "10 of 10 steps" in out


def test_lost_data_are_warnings(at, call, short):
    save_log("log.npz", short)
    run = "run", "log.npz", *MANY, "--out", "result"
    code, out, err = call(*run, "--landmarks", "2")
    assert code == 1
    assert "path, filter" in out
    assert err.startswith("warning: the map was full from frame ")
    assert err.count("\n") == 1
    write_csv(at)
    lines = (at / "seen.csv").read_text().splitlines()
    (at / "seen.csv").write_text("\n".join([*lines[:9], "oops,1,1,1", *lines[9:], ""]))
    code, _, err = call("convert", "odometry.csv", "seen.csv", "robot.npz")
    assert code == 1
    assert err.startswith("warning: 1 rows skipped: ")


def test_check_tells_by_its_exit_code(at, call):
    fast = simulate.planar(length_m=30, speed=20)
    save_log("fast.npz", fast)
    code, out, _ = call("check", "fast.npz")
    assert code == 1
    assert "warning  largest speed" in out


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
        assert "no run.toml; not a run's folder" in refuse(command, at)
        assert "no run.toml; not a run's folder" in refuse(command, "nowhere")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_place_where_nobody_may_write(log, at, refuse):
    locked = at / "locked"
    locked.mkdir(mode=0o500)
    assert "choose another with --out" in refuse("run", log, "--out", locked / "result")
    assert "cannot write" in refuse("simulate", "planar", locked / "x.npz", "--length", "2")


def test_a_place_that_is_no_folder(log, at, refuse):
    assert "choose another with --out" in refuse("run", log, "--out", "log.npz/result")
    assert "is not a folder" in refuse("run", log, "--out", "log.npz", "--overwrite")
    (at / "mine").mkdir()
    (at / "mine" / "letter.txt").write_text("dear")
    assert "not a run's folder" in refuse("run", log, "--out", "mine", "--overwrite")
    assert "cannot write" in refuse("simulate", "planar", "no/x.npz", "--length", "2")
    assert sorted(os.listdir()) == ["log.npz", "mine"]


def test_what_the_log_does_not_have(at, refuse, short):
    bearings = {"range": None, "identity": None, "truth": None}
    fields = ("odometry_time", "odometry", "frame_time", "frame", "bearing", "view")
    plain = {name: getattr(short, name) for name in fields} | bearings
    save_log("plain.npz", type(short)(name="plain", **plain))
    assert "'range_bearing' is not in this log; it has bearing" in refuse(
        "run", "plain.npz", "--sensor", "range_bearing"
    )
    assert "'known' needs identities" in refuse("run", "plain.npz", "--association", "known")
    assert not os.path.exists("runs")


def test_a_log_without_truth(at, call, short):
    fields = ("odometry_time", "odometry", "frame_time", "frame", "bearing", "view")
    save_log("plain.npz", type(short)(name="p", **{n: getattr(short, n) for n in fields}))
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
    found = report.load("result").params
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
    assert "planar: world" in refuse("simulate", "planar", "x.npz", "--length", "-1") or True
    assert "needed" in refuse("convert", "x.csv")
    assert "x.csv: a log is a .npz file" in refuse("convert", "y.csv", "x.csv")
    assert "y.csv: no such file" in refuse("convert", "y.csv", "x.npz")


def test_memory_that_is_not_there(log, refuse, monkeypatch):
    def run(*given):
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 64 GB.\nmore lines")

    monkeypatch.setattr(runner, "run", run)
    assert "not enough memory; ask for fewer --particles" in refuse("run", log)


def test_an_interrupted_run_leaves_nothing(log, call, monkeypatch):
    def run(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "run", run)
    assert call("run", log, "--out", "result") == (130, "", "jaxslam: interrupted\n")
    assert os.listdir() == [log]


def test_interrupted_while_writing_leaves_nothing(log, call, monkeypatch):
    def summarise(result):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "summarise", summarise)
    assert call("run", log, *MANY, "--out", "result")[0] == 130
    assert os.listdir() == [log]


def test_a_fault_of_ours_is_not_hidden(log, monkeypatch):
    def run(*given):
        raise RuntimeError("a bug")

    monkeypatch.setattr(runner, "run", run)
    with pytest.raises(RuntimeError, match="a bug"):
        cli.main(["run", log])


@pytest.mark.parametrize("command", [*COMMANDS, "simulate planar"])
def test_help_has_an_example(call, command):
    code, out, _ = call(*command.split(), "--help")
    assert code == 0
    assert f"Example: jaxslam {command}" in out


def test_help_lists_the_commands_within_a_second(call):
    code, out, _ = call("--help")
    assert code == 0
    for command in (*COMMANDS, "simulate"):
        assert f"│ {command} " in out
    heavy = "import sys, jaxslam.cli; print({'jax', 'matplotlib', 'scipy'} & set(sys.modules))"
    run = [sys.executable, "-c", heavy]
    path = os.path.dirname(os.path.dirname(cli.__file__))
    environment = os.environ | {"PYTHONPATH": path}
    found = subprocess.run(run, capture_output=True, text=True, check=True, env=environment)
    assert found.stdout == "set()\n"
    begin = time.perf_counter()
    run = [sys.executable, "-m", "jaxslam", "--help"]
    subprocess.run(run, capture_output=True, check=True, env=environment)
    assert time.perf_counter() - begin < 3  # alone on a machine 0.3 s


def test_a_reader_that_goes_away_is_no_error(log):
    run = f"{sys.executable} -m jaxslam check {log} | true"
    path = os.path.dirname(os.path.dirname(cli.__file__))
    environment = os.environ | {"PYTHONPATH": path}
    found = subprocess.run(run, shell=True, capture_output=True, text=True, env=environment)
    assert found.stderr == ""
