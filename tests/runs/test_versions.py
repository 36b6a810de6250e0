"""What earlier versions wrote stays readable."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from jaxslam.cli import main as cli
from jaxslam.learning import fit as learn
from jaxslam.logs.log_file import load_log
from jaxslam.parameter_file import load_learning, load_params
from jaxslam.parameters import default_params
from jaxslam.runs.run import config_for
from jaxslam.vision.camera_files import load_camera

FIXTURES = Path(__file__).parents[1] / "fixtures"
RUN = "--sensor bearing --particles 30 --landmarks 24 --params params.toml --seed 3 --rejuvenate 1"


@pytest.fixture
def old(tmp_path, monkeypatch):
    """A copy of what version 0.1.0 wrote, as the working directory."""
    folder = shutil.copytree(FIXTURES / "0.1.0", tmp_path / "old")
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def expected(old):
    return json.loads((old / "expected.json").read_text())


def test_the_fixtures_are_small():
    files = [path for path in FIXTURES.rglob("*") if path.is_file()]
    assert len(files) >= 15
    assert sum(path.stat().st_size for path in files) <= 300_000


def test_a_log(old):
    log = load_log("log.npz")
    assert len(log.frame_time) == 48
    assert len(log.bearing) == len(log.range) == len(log.frame) > 100
    assert log.truth.landmarks.shape == (12, 2)


def test_a_parameter_file(old):
    base = default_params("bearing", load_log("log.npz"))
    params = load_params("params.toml", base)
    assert params.err_rot == 0.03
    learning = load_learning("params.toml", base)
    assert params[10] == 0.04 and params[13] == 0.05  # the third and second last named there
    assert len(learning.names) == 3 and set(learning.priors) < set(learning.names)
    assert list(learning.bounds.values()) == [(0.001, 0.5)]


def test_a_run_folder(old, call):
    before = json.loads((old / "run/summary.json").read_text())
    code, out, err = call("evaluate", "run", "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    same = [key for key, value in found.items() if isinstance(value, float) and key in before]
    assert len(same) >= 10
    for key in same:
        assert found[key] == pytest.approx(before[key], rel=1e-6), key
    code, out, err = call("plot", "run")
    assert (code, err) == (0, "")
    assert (old / "run/map.png").stat().st_size > 10_000


def test_a_checkpoint_of_a_run(old, expected, monkeypatch, capsys):
    from jaxslam.runs import compiled

    monkeypatch.setattr(compiled, "CHUNK", 7)
    words = f"run log.npz {RUN} --no-refine --out interrupted --resume"
    assert cli.main(words.split()) == 0
    assert "resuming after step 22" in capsys.readouterr().err
    steps = np.load("interrupted/steps.npz")
    summary = json.loads(Path("interrupted/summary.json").read_text())
    # Bits are equal where JAX is the one that wrote it; others round otherwise.
    assert steps["pose"][-1] == pytest.approx(expected["resumed"]["pose"], abs=0.05)
    likelihood = expected["resumed"]["log_likelihood"]
    assert summary["log_likelihood"] == pytest.approx(likelihood, abs=3.0)
    ids = np.loadtxt("interrupted/landmarks.csv", delimiter=",", skiprows=1)[:, 0]
    assert set(expected["resumed"]["landmark_ids"][:3]) <= set(ids)


def test_a_checkpoint_of_a_fit(old, expected):
    log = load_log("log.npz")
    params = load_params("params.toml", default_params("bearing", log))
    names = load_learning("params.toml", params).names[:2]
    config = config_for(log, "bearing", "known", particles=16)
    fit = learn.fit(
        [log], config, params, names, held_out=[log], seeds=1, held_out_seeds=1, steps=6, every=2,
        seed=1, bounds={names[1]: (0.001, 0.5)}, priors={"err_rot": (0.05, 0.7)},
        checkpoint="learn.npz", resume=True,
    )  # fmt: skip
    assert fit.steps == 6
    found = [getattr(fit.params, name) for name in fit.names]
    assert found == pytest.approx(list(expected["learnt"].values()), rel=0.01)


def test_a_camera_file(old):
    camera = load_camera("camera.toml")
    assert (camera.width, camera.height, camera.model) == (640, 480, "polynomial")
