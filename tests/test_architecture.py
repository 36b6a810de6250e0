"""Imports run one way: the contracts of `[tool.importlinter]` in pyproject.toml."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LINT = "from importlinter.cli import lint_imports_command; lint_imports_command()"


def lint(folder):
    """Exit code and output of `lint-imports --no-cache` in a folder."""
    found = subprocess.run(
        [sys.executable, "-c", LINT, "--no-cache"], cwd=folder, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(folder)},
    )  # fmt: skip
    return found.returncode, found.stdout + found.stderr


def test_imports_run_one_way():
    code, out = lint(ROOT)
    assert code == 0, out


def test_a_wrong_import_is_found(tmp_path):
    for name in ("jaxslam", "calibration"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("data"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    with open(tmp_path / "jaxslam/models/motion.py", "a", encoding="utf-8") as file:
        file.write("\nimport calibration.odometry\nfrom jaxslam.filter import step\n")
    code, out = lint(tmp_path)
    assert code == 1, out
    assert "imports point down BROKEN" in out
    assert "of jaxslam only cli imports calibration BROKEN" in out
    assert "inside the results KEPT" in out
