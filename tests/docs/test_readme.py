"""The README is short, and holds the commands that set up and test."""

import re

from pages import ROOT, blocks, text

from jaxslam.cli import main as cli

SET_UP = "python3 -m venv .venv && .venv/bin/pip install -q . && .venv/bin/jaxslam demo"
TEST = (
    'python3 -m venv .venv && .venv/bin/pip install -q -e ".[test]" '
    "&& .venv/bin/python -m pytest -q -n 2"
)


def test_it_is_short():
    assert len(text("README.md").splitlines()) <= 150


def test_the_commands_that_set_up_and_test_are_there_word_for_word():
    assert text("README.md").splitlines().count(SET_UP) == 1
    assert text("README.md").splitlines().count(TEST) == 1
    first = re.search(r"^python3 -m venv .*pytest.*$", text("README.md"), re.MULTILINE)
    assert first[0] == TEST  # .ci/run takes it by this pattern


def test_the_python_on_one_screen_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = blocks("README.md", "python")[0]
    exec(compile(code, "README.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[-1]) < 1.0
    assert (tmp_path / "runs/python/map.png").stat().st_size > 10_000


def test_every_command_in_the_readme_exists_and_every_command_is_in_it(capsys):
    named = set(re.findall(r"(?:^|`)jaxslam ([a-z]+)\b", text("README.md"), re.MULTILINE))
    known = {"demo", "run", "compare", "convert", "check", "evaluate", "plot", "simulate"}
    known |= {"calibrate", "extract", "triangulate", "learn"}
    assert known <= named
    for name in named:
        assert cli.main([name, "--help"]) in (0, None)
    assert "Example" in capsys.readouterr().out


def test_the_pictures_and_pages_are_there():
    for target in re.findall(r"\]\(([^)]+)\)", text("README.md")):
        assert (ROOT / target).exists(), target
