"""The command's help, and what it shows on a terminal and to a pipe."""

import os
import re
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


GROUPS = {
    "Arguments": "",
    "Parameters": "sensor association particles params seed out overwrite no-smoothing",
    "Filter": "proposal landmarks paper rejuvenate descriptors start end",
    "Long runs": "checkpoint-every resume",
    "Several runs": "seeds sweep",
    "Parallel": "devices coordinator num-processes process-id",
}


def test_help_of_run_shows_the_everyday_options_first(call, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    panels = call("run", "--help")[1].split("╭─ ")
    options = {panel.split(" ─")[0]: re.findall(r"^│ --(\S+)", panel, re.M) for panel in panels[1:]}
    assert list(options.items()) == [(name, words.split()) for name, words in GROUPS.items()]
    assert 24 <= "".join(panels[:3]).count("\n") <= 40


@pytest.mark.parametrize("command", ["", *COMMANDS, "simulate planar"])
def test_help_fits_a_terminal(call, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "80")
    out = call(*command.split(), "--help")[1]
    assert max(map(len, out.splitlines())) <= 80
    assert "default: ()" not in out


def test_usage_errors_name_the_help_of_the_command(refuse):
    assert refuse("run").endswith("See: jaxslam run --help\n")
    assert refuse("simulate", "planar", "--sed", 1).endswith(
        "See: jaxslam simulate planar --help\n"
    )
    assert refuse("rnu").endswith("See: jaxslam --help\n")


def test_completion_is_installed_and_leaves_startup_files_alone(at, call, monkeypatch):
    monkeypatch.setenv("HOME", str(at))
    code, out, _ = call("--install-completion", "--shell", "bash")
    (script,) = (path for path in at.rglob("*") if path.is_file())
    assert (code, str(script) in out) == (0, True)
    command = (
        f". {script}; COMP_WORDS=(jaxslam run --no-s); COMP_CWORD=2; _jaxslam; echo $COMPREPLY"
    )
    completed = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert completed.stdout == "--no-smoothing\n"


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
