"""Rows read through ancestors on several devices: all of them travel, or the borders alone."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.filter import halo_exchange

ROOT = Path(__file__).resolve().parents[2]
N, DEVICES = 160, 4
n, b = N // DEVICES, N // DEVICES // halo_exchange.SHARE

UPDATED = ROOT / "tests" / "programs" / "updated_rows.py"


@pytest.mark.parametrize("precision", ["0", "1"])
def test_rows_are_the_same_whether_all_travel_or_only_borders(precision):
    """Also of numbers of 8 bytes."""
    environment = {"JAX_ENABLE_X64": precision, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, UPDATED, "0", "1", "-3", "9", "-60", "400"],
        capture_output=True, text=True, cwd=ROOT, env=os.environ | environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    near, due = zip(*(line.split() for line in done.stdout.splitlines()), strict=True)
    assert near[:2] == ("True", "True") and near[-2:] == ("False", "False")
    assert min(map(int, due)) > 8  # more than a message


def needed(index):
    """Whether what every device needs of others, and for whom, is within borders: one by one."""
    for i, at in enumerate(index):
        low = i // n * n
        lane = i - low
        if at < low and (at < low - b or lane >= b):
            return False
        if at >= low + n and (at >= low + n + b or lane < n - b):
            return False
    return True


def test_borders_are_enough_where_they_are():
    rng, config = np.random.default_rng(1), Config(particles=N, devices=DEVICES)
    found = []
    for amount in np.repeat(np.arange(-11, 12), 20):
        index = np.arange(N) + amount + rng.integers(-2, 3, N)
        index = np.sort(np.clip(index, 0, N - 1)).astype("i")
        assert bool(halo_exchange.suffices(index, config)) == needed(index)
        found.append(needed(index))
    assert 20 < sum(found) < len(found) - 20


def test_without_devices_or_particles_enough_there_are_no_borders():
    assert halo_exchange.width(Config(particles=N)) == 0
    assert halo_exchange.width(Config(particles=28, devices=4)) == 0
    assert halo_exchange.width(Config(particles=N, devices=DEVICES)) == b
