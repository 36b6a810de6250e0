"""The command's help, and what it shows on a terminal and to a pipe."""

import os
import subprocess
import sys

import pytest

from jaxslam.cli import common
from jaxslam.cli import main as cli

COMMANDS = ("demo", "run", "compare", "convert", "check", "evaluate", "plot", "learn")


@pytest.mark.parametrize("command", [*COMMANDS, "simulate planar"])
def test_help_has_an_example(call, command):
    code, out, _ = call(*command.split(), "--help")
    assert code == 0
    assert f"Example: jaxslam {command}" in out


def test_help_lists_the_commands(call):
    code, out, _ = call("--help")
    assert code == 0
    for command in (*COMMANDS, "simulate"):
        assert f"│ {command} " in out


def outside(command):
    """What a command of the shell prints, this package importable."""
    path = os.path.dirname(os.path.dirname(cli.__file__))
    found = subprocess.run(
        command, shell=True, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}
    )
    return found.returncode, found.stdout, found.stderr


def test_help_imports_nothing_heavy():
    program = (
        "import sys; from jaxslam.cli.main import main; main(['--help']); "
        "heavy = {'jax', 'matplotlib', 'scipy'} & set(sys.modules); "
        "sys.exit(bool(heavy))"
    )
    assert outside(f'{sys.executable} -c "{program}"')[0] == 0


def test_a_reader_that_goes_away_is_no_error():
    assert outside(f"{sys.executable} -m jaxslam check lost-in-the-woods | true")[1:] == ("", "")


def test_a_terminal_gets_a_bar_and_a_file_does_not(capsys, monkeypatch):
    with common.progress_bar("filtering", compiles=True) as show:
        assert show is None
    assert capsys.readouterr() == ("", "")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with common.progress_bar("filtering", compiles=True) as show:
        show(0, 8)
        show(4, 8)
    with common.progress_bar("refining") as show:
        show(3, None)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.index("filtering: compiling… (once)") < err.index("50%") < err.index("refining")
