"""What the README says runs."""

import re
import shlex
from pathlib import Path

import pytest

import jaxslam
from jaxslam.cli import main as cli

README = Path(__file__).resolve().parents[2] / "README.md"


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def fewer(text, many, few):
    """The same with fewer particles, which takes less time."""
    assert many in text
    return text.replace(many, few)


def test_the_python_on_one_screen_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = blocks("python")[0]
    exec(compile(code, "README.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[-1]) < 1.0
    assert (tmp_path / "runs/python/map.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_python_that_learns_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    second = blocks("python")[1]
    params = jaxslam.default_params("range_bearing", jaxslam.load_log("lost-in-the-woods"))
    names = {"jaxslam": jaxslam, "params": params}
    exec(compile(second, "README.md", "exec"), names)
    found = jaxslam.load_params("learnt.toml", params)
    assert found.sigma_range < params.sigma_range
    # Odometry turns too far: truth says 0.95.
    assert found.gain_rot == pytest.approx(0.95, abs=0.03)


@pytest.mark.slow
def test_the_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    told = fewer("\n".join(blocks("sh")), "--particles 20000 ", "--particles 2000 ")
    for out in ("runs/bearing", "runs/learnt"):  # the demo goes through the whole log
        told = fewer(told, f"--out {out}", f"--end 100 --out {out}")
    lines = told.splitlines()
    commands = [
        shlex.split(line, comments=True)[1:] for line in lines if line.startswith("jaxslam ")
    ]
    assert len(commands) >= 14
    for command in commands:
        assert cli.main(command) == 0, command
    said = capsys.readouterr().err.splitlines()
    progress = "note: ", "learning: ", "step "
    assert [line for line in said if not line.startswith(progress)] == []


def test_every_command_in_the_readme_exists_and_every_command_is_in_it(capsys):
    text = README.read_text(encoding="utf-8")
    named = set(re.findall(r"jaxslam ([a-z]+)\b", text)) - {"import"}
    known = {"demo", "run", "compare", "convert", "check", "evaluate", "plot", "simulate"}
    known |= {"calibrate", "extract", "triangulate", "learn"}
    assert known <= named
    for name in named:
        assert cli.main([name, "--help"]) in (0, None)
    assert "Example" in capsys.readouterr().out


def test_the_pictures_and_pages_are_there():
    for target in re.findall(r"\]\(([^)]+)\)", README.read_text(encoding="utf-8")):
        assert (README.parent / target).exists(), target
