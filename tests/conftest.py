"""Shared by all tests."""

import gc
import os
import tempfile
from pathlib import Path

import jax
import pytest

from jaxslam.cli import main as cli

LONGEST = "test_the_commands_run", "test_the_python_that_learns_runs"
MOST_MAPS = 25_000
SHARED = Path(__file__).resolve().parents[2] / "shared"


def pytest_configure(config):
    """Each program is compiled once, for all workers and all processes that tests start."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # a worker inherits it
        place = tempfile.TemporaryDirectory(prefix="jaxslam-compiled-", ignore_cleanup_errors=True)
        config.add_cleanup(place.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = place.name
        jax.config.update("jax_compilation_cache_dir", place.name)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def pytest_collection_modifyitems(items):
    """The longest come first: begun last, each would keep one worker busy and the others idle."""
    items.sort(key=lambda item: getattr(item, "originalname", None) not in LONGEST)


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Compiled programs are let go before their memory maps reach the number that Linux allows a
    process (65,530 unless set otherwise), where compiling ends in a segmentation fault."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def x64():
    """Double precision for one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def shared_data():
    """Recorded data that may not be redistributed: `../shared/data`, or a skip."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip("../shared/data is absent: recorded data that may not be redistributed")
    return folder


@pytest.fixture
def at(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


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
