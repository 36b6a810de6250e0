"""The command `learn`, run in this process on small logs; one compilation serves most of it."""

import csv
import dataclasses
import subprocess
import sys
import tomllib

import jax
import numpy as np
import pytest

from jaxslam.cli import learn as cli_learn
from jaxslam.config import Config
from jaxslam.learning import fit as learn
from jaxslam.learning import uncertainty
from jaxslam.logs.log_file import save_log
from jaxslam.parameter_file import load_learning, load_params
from jaxslam.parameters import default_params
from jaxslam.simulation import planar

jax.devices()  # begun here, so that the command does not ask for more devices for all other tests
SMALL = (
    "--particles",
    "16",
    "--landmarks",
    "12",
    "--window",
    "0",
    "--seeds",
    "8",
    "--association",
    "known",
)
NAMES = "err_rot,sigma_bearing"


@pytest.fixture(scope="session")
def drives():
    """Two logs of 20 frames."""
    return [
        planar.planar(length_m=2.0, landmarks=8, outlier=0.0, seed=seed, max_per_frame=4)
        for seed in (1, 2)
    ]


@pytest.fixture
def logs(at, drives):
    for name, drive in zip("ab", drives, strict=True):
        save_log(f"{name}.npz", drive)
    return "a.npz", "b.npz"


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_from_logs_to_parameters(logs, at, call, refuse):
    (at / "start.toml").write_text(
        'err_rot = 0.1\n[learn]\nparameters = ["err_rot", "sigma_bearing"]\n'
        "[bounds]\nerr_rot = [0.09, 0.11]\n[prior]\nsigma_bearing = [0.02, 0.5]\n"
    )
    told = "learn", "a.npz", "--held-out", "b.npz", "--params", "start.toml", "--steps", "10"
    told += *SMALL, "--out", "fit/params.toml"
    code, out, err = call(*told)
    assert code in (0, 1)
    assert code == ("warning: " in err)
    lines = out.splitlines()
    assert lines[0].split()[:4] == ["parameter", "start", "estimate", "std"]
    assert [line.split()[0] for line in lines[1:3]] == NAMES.split(",")
    for text in (
        "held-out evidence: ",
        "Monte-Carlo error",
        "log Z of one log",
        "discount 0.9 ins",
    ):
        assert text in out
    assert "map with it: jaxslam run LOG --sensor range_bearing --params fit/params.toml" in out
    assert "learning: compiling… (once)" in err
    assert "step 10/10: loss " in err
    assert ", gradient " in err
    folder = at / "fit"
    files = {"params.toml", "learn.csv", "learn.png"}
    assert {path.name for path in folder.iterdir()} == files
    found = load_learning(folder / "params.toml", default_params())
    assert found.names == ("err_rot", "sigma_bearing")
    assert found.bounds == {"err_rot": (0.09, 0.11)}
    assert found.priors == {"sigma_bearing": (0.02, 0.5)}
    assert 0.09 <= found.params.err_rot <= 0.11
    assert float(lines[2].split()[2]) == pytest.approx(found.params.sigma_bearing, rel=1e-3)
    steps = rows(folder / "learn.csv")
    assert len(steps) == 10
    assert float(steps[0]["err_rot"]) == pytest.approx(0.1)
    assert steps[9]["held_out"]
    assert "params.toml: exists; choose another name or add --overwrite" in refuse(*told)
    assert load_params(folder / "params.toml", default_params()) == found.params


@pytest.mark.slow
def test_a_run_with_what_was_learned(logs, at, call):
    told = "learn", "a.npz", "--held-out", "b.npz", "--parameters", NAMES, *SMALL, "--steps", "5"
    code, _, err = call(*told, "--overwrite")
    assert code == ("warning: " in err)
    run = "run", "a.npz", "--params", "params.toml", "--particles", "16", "--no-refine"
    assert call(*run, "--out", "mapped")[0] in (0, 1)
    used = tomllib.loads((at / "mapped" / "run.toml").read_text())["params"]
    found = load_params(at / "params.toml", default_params())
    assert used["sigma_bearing"] == found.sigma_bearing != 0.02


def test_stopped_and_resumed_gives_the_same(logs, at, call, refuse, monkeypatch):
    told = "learn", "a.npz", "--held-out", "b.npz", "--parameters", NAMES, *SMALL
    told += "--steps", "12", "--out"
    code, whole, err = call(*told, "one/params.toml")
    assert code == ("warning: " in err)
    fit = learn.fit

    def stopped(*args, progress, **named):
        def stop(done, total, record):
            progress(done, total, record)
            if done == 11:
                raise KeyboardInterrupt

        return fit(*args, progress=stop, **named)

    monkeypatch.setattr(learn, "fit", stopped)
    code, out, err = call(*told, "two/params.toml")
    assert code == 130
    assert out == ""
    assert "--resume continues from here" in err
    assert [path.name for path in (at / "two").iterdir()] == [cli_learn.CHECKPOINT]
    assert "a fit was stopped here; --resume continues it" in refuse(*told, "two/params.toml")
    monkeypatch.undo()
    monkeypatch.chdir(at)
    code, again, _ = call(*told, "two/params.toml", "--resume")
    assert again.splitlines()[:3] == whole.splitlines()[:3]
    assert rows("one/learn.csv") == rows("two/learn.csv")
    assert not (at / "two" / cli_learn.CHECKPOINT).exists()


def test_what_is_lost_or_worse_is_a_warning(logs, call, drives, monkeypatch):
    """Without the computations: only what is told of them."""
    blind = np.where(np.arange(len(drives[0].frame)) < 3, -1, drives[0].identity)
    save_log("a.npz", dataclasses.replace(drives[0], identity=blind))

    def fit(logs, config, params, names, *_, **__):
        free = np.zeros(len(names))
        assert config.association == "known"
        history = learn.History(
            free[None], np.zeros(1), np.zeros(1), np.zeros(1), *[np.empty(0)] * 4
        )
        return learn.Fit(names, params, params, free, history, "done", config, 0, 1, 0.0)

    def assess(fit, logs, seed):
        one = np.ones(1)
        return uncertainty.Uncertainty(
            fit.names, fit.free, np.eye(1), one, one, one, np.eye(1), np.eye(1), one, "both",
            np.zeros(1), 0.1,
            {0.97: one}, ("resolved",), (),
        )  # fmt: skip

    monkeypatch.setattr(learn, "fit", fit)
    monkeypatch.setattr(uncertainty, "assess", assess)
    known = "learn", "a.npz", "--parameters", "err_rot", "--association", "known"
    code, out, err = call(*known, "--window", "0")
    assert code == 1
    assert "warning: 3 measurements not used: no identity" in err
    assert "note: no --held-out log" in err
    assert "params.toml" in out
    code, _, err = call(*known, "--window", "0", "--overwrite", "--start", "1")
    assert (code, "warning" in err) == (0, False)
    monkeypatch.setattr(
        learn, "evidence", lambda logs, config, params, seeds, seed: np.full(8, np.nan)
    )
    code, _, err = call(*known, "--held-out", "b.npz", "--overwrite", "--start", "1")
    assert code == 1
    assert "warning: held-out evidence is not finite" in err
    assert "note: the held-out logs became less likely" in err


def test_windows_without_identities_are_left_out(logs, drives, capsys):
    early = drives[0].frame < 10  # 2 s
    save_log("a.npz", dataclasses.replace(drives[0], identity=np.where(early, -1, 7)))
    parts = cli_learn._windows(["a.npz"], 0.0, None, 1.0, 0.0, True)
    assert [part.name[-8:] for part in parts] == ["2 to 3 s", "3 to 4 s"]
    assert "2 windows without any identity are left out" in capsys.readouterr().err
    assert len(cli_learn._windows(["a.npz"], 0.0, None, 1.0, 0.0, False)) == 4


def test_caution_becomes_a_part_of_what_is_learned():
    params = default_params("bearing")
    given = Config(sensor="bearing")
    log = planar.planar(length_m=1.0, landmarks=3)
    log = dataclasses.replace(log, noise={})
    task = cli_learn._task([log], given, None, "sigma_bearing")
    assert task.params.extra_bearing_noise == 0
    assert task.params.sigma_bearing == pytest.approx(
        np.hypot(params.sigma_bearing, params.extra_bearing_noise)
    )
    assert (
        cli_learn._task([log], given, None, "err_rot").params.extra_bearing_noise
        == params.extra_bearing_noise
    )


@pytest.mark.parametrize(
    ("told", "found"),
    [
        ((), "learn: no log given; for example lost-in-the-woods"),
        (("none.npz",), "none.npz: no such file"),
        (
            ("a.npz", "--parameters", "err_rt"),
            "'err_rt' can't be learned with sensor range_bearing; these can: err_tran",
        ),
        (("a.npz", "--parameters", "detection"), "'detection' can't be learned"),
        (("a.npz", "--parameters", "err_rot,err_rot"), "name each once"),
        (
            ("a.npz", "--held-out", "a.npz"),
            "a.npz: both learned from and held out; separate the parts",
        ),
        (
            ("a.npz", "--end", "2", "--held-out", "a.npz", "--held-out-start", "1"),
            "held out; separate",
        ),
        (("a.npz", "--end", "99", "--start", "98"), "no frame between 98 and 99 s"),
        (("a.npz", "--window", "-1"), "windows of -1.0 s; must be above 0"),
        (("a.npz", "--out", "fit.csv"), "fit.csv: a file of parameters is a .toml file"),
        (("a.npz", "--out", "new/fit.csv"), "fit.csv: a file of parameters is a .toml file"),
        (("a.npz", "--resume"), "learn.checkpoint.npz: does not exist; start without --resume"),
        (("a.npz", "--parameters", "err_rot,outlier"), "outlier is 0: to be learned it must start"),
        (
            ("a.npz", "--sensor", "position", "--parameters", "landmark_extent"),
            "'landmark_extent' can't be learned",
        ),
        (("a.npz", "--params", "none.toml"), "none.toml: no such file"),
        (("a.npz", "--seeds", "1"), "--seeds"),
    ],
)
def test_what_can_not_be_is_refused_before_computing(logs, refuse, monkeypatch, told, found):
    monkeypatch.setattr(learn, "scores", None)  # what computes
    assert found in refuse("learn", *told)


def test_files_that_are_there_are_kept(logs, at, refuse):
    for name in ("learn.csv", "learn.png"):
        (at / name).touch()
        assert f"{name}: exists" in refuse("learn", "a.npz")
        (at / name).unlink()


def test_the_work_is_shared_out_over_all_cores():
    code = (
        "import os; os.sched_getaffinity = lambda pid: {0, 1, 2}\n"
        "from jaxslam.cli.learn import _use_all_cores; _use_all_cores()\n"
        "import jax; print(len(jax.devices()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "3", done.stderr


def test_help_is_there_at_once(call):
    code, out, _ = call("learn", "--help")
    assert code == 0
    assert "Usage: jaxslam learn [OPTIONS] LOG..." in out
    assert "Example: jaxslam learn lost-in-the-woods" in out
