"""What the pages say runs: their Python, their commands, and the site that is built from them."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from pages import HOW_TO, PAGES, ROOT, TUTORIALS, blocks, commands, text

import jaxslam
from jaxslam.cli import main as cli

QUICK = ("check", "convert", "evaluate", "plot", "simulate planar")
# Smaller, for the tests: what is replaced in the commands of all pages.
SMALLER = (
    ("--particles 20000 ", "--particles 2000 "),
    ("--particles 1000000 ", "--particles 20000 "),
    ("--out runs/bearing", "--end 100 --out runs/bearing"),  # the demo goes through the whole log
    ("--out runs/learned", "--end 100 --out runs/learned"),
)
# Would wait for others, change the shell, or need a process that has not computed yet.
LEFT_OUT = ("--coordinator", "--install-completion", "--devices")


def write_recording(folder):
    """Eight seconds of a robot that drives straight past three posts, as two CSV files."""
    odometry = [f"{t / 10:.1f},0.5,0.0" for t in range(80)]
    rows = []
    for t in np.arange(0.5, 8.1, 0.5):
        for x, y in [(2.0, 2.0), (5.0, -1.5), (7.0, 1.0)]:
            dx = x - 0.5 * t
            rows.append(f"{t},{np.arctan2(y, dx):.6f},{np.hypot(dx, y):.6f}")
    head = "time_s,forward_m_s,yaw_rate_rad_s"
    (folder / "odometry.csv").write_text("\n".join([head, *odometry, ""]))
    head = "time_s,bearing_rad,range_m"
    (folder / "measurements.csv").write_text("\n".join([head, *rows, ""]))


@pytest.fixture
def recording(tmp_path, monkeypatch):
    """The working folder of a reader who has recorded a drive."""
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path)
    jaxslam.save_log("drive.npz", jaxslam.read(["odometry.csv", "measurements.csv"]))
    return tmp_path


LONG_PYTHON = "docs/tutorials/learn-noise.md"  # in a slow test of its own
PYTHON = [p for p in (*TUTORIALS, *HOW_TO) if blocks(p, "python") and p != LONG_PYTHON]


@pytest.mark.parametrize("page", PYTHON)
def test_the_python_of_a_page_runs(page, recording, capsys):
    names = {}
    for code in blocks(page, "python"):
        exec(compile(code, page, "exec"), names)
    assert capsys.readouterr().out


@pytest.mark.slow
def test_the_python_that_learns_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    params = jaxslam.default_params("range_bearing", jaxslam.load_log("lost-in-the-woods"))
    (code,) = blocks(LONG_PYTHON, "python")
    exec(compile(code, LONG_PYTHON, "exec"), {})
    found = jaxslam.load_params("learned.toml", params)
    assert found.sigma_range < params.sigma_range
    # Odometry turns too far: truth says 0.95.
    assert found.gain_rot == pytest.approx(0.95, abs=0.03)


COMMANDS = [(page, command) for page in ("README.md", *PAGES) for command in commands(page)]


def test_every_command_can_be_parsed():
    assert len(COMMANDS) >= 30
    for page, command in COMMANDS:
        if "--install-completion" not in command:
            cli.app.parse_args(command, exit_on_error=False, print_error=False)
            assert cli.main([*command[:2], "--help"]) in (0, None), (page, command)


def test_the_quick_commands_run(recording):
    """Those of the README and of the tutorial on a log of one's own, but for its other runs."""
    for page in ("README.md", "docs/tutorials/own-log.md"):
        for path in recording.glob("*.npz"):
            path.unlink()
        for command in commands(page):
            if " ".join(command).startswith((*QUICK, "run drive.npz")):
                assert cli.main([*smaller(command), *cheap(command)]) == 0, command
        assert (recording / "runs/drive/map.png").is_file()
        os.rename(recording / "runs", recording / f"runs-{page.count('/')}")


def cheap(command):
    return ("--particles", "100") if command[0] == "run" else ()


def smaller(command):
    """The command with fewer particles or frames, which takes less time."""
    line = " ".join(command) + " "
    for many, few in SMALLER:
        line = line.replace(many, few)
    return line.split()


def test_what_is_made_smaller_is_in_the_pages():
    lines = [" ".join(command) + " " for _, command in COMMANDS]
    for many, _ in SMALLER:
        assert any(many in line for line in lines), many


@pytest.mark.slow
def test_the_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path)
    done = []
    for page in ("README.md", *TUTORIALS, *HOW_TO):
        for command in commands(page):
            if command in done or any(option in command for option in LEFT_OUT):
                continue
            assert cli.main(smaller(command)) == 0, (page, command)
            done.append(command)
    assert len(done) >= 20
    said = capsys.readouterr().err.splitlines()
    progress = "note: ", "learning: ", "step "
    assert [line for line in said if not line.startswith(progress)] == []


def nav():
    """The pages that mkdocs.yml lists."""
    listed = re.findall(r"(?:^| )([\w/-]+\.md)$", text("mkdocs.yml"), re.MULTILINE)
    return [f"docs/{page}" for page in listed]


def test_the_navigation_lists_every_page_once():
    assert sorted(nav()) == PAGES


def without_code(page):
    return re.sub(r"^```.*?^```$|`[^`\n]*`", "", text(page), flags=re.DOTALL | re.MULTILINE)


def anchors(page):
    """The ids of a page's headings, as mkdocs makes them."""
    heads = re.findall(r"^#+ (.*)$", text(page), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", head).strip().lower()) for head in heads}


@pytest.mark.parametrize("page", [*PAGES, "CONTRIBUTING.md", "CHANGELOG.md"])
def test_every_link_resolves(page):
    missing = []
    for target in re.findall(r"\]\(([^):]+)\)", without_code(page)):
        file, _, anchor = target.partition("#")
        path = (ROOT / page).parent.joinpath(file).resolve() if file else ROOT / page
        known = path.is_file() and (not anchor or anchor in anchors(path.relative_to(ROOT)))
        missing += [] if known else [target]
    assert missing == []


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    if not all(map(find_spec, ("mkdocs", "material", "mkdocstrings"))):
        pytest.skip('mkdocs is not installed: pip install -e ".[docs]"')
    run = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", tmp_path]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    found = subprocess.run(run, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert (found.returncode, found.stdout + found.stderr) == (0, "")
    page = (tmp_path / "reference/parameters/index.html").read_text(encoding="utf-8")
    assert "extra_bearing_noise" in page
    for path in tmp_path.rglob("*.html"):  # nothing is loaded from other hosts
        loaded = re.findall(r'(?:src|<link[^>]*href)="(https?:[^"]*)', path.read_text("utf-8"))
        assert loaded == [], path
