"""What a run needs of memory: told before it begins, and refused when there is too little."""

import os

import pytest

from jaxslam.logs.log_file import load_log, save_log
from jaxslam.runs import checkpoints, compiled, memory
from jaxslam.runs.run import config_for
from jaxslam.simulation.planar import planar


@pytest.fixture
def there(at):
    """A folder with a log of 24 frames."""
    save_log("log.npz", planar("field", 5, landmarks=25, length_m=6.0, rate_hz=2.0, outlier=0.05))
    return at


def test_too_large_is_refused_before_anything_is_computed(there, refuse, monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 30_000_000_000)
    monkeypatch.setattr(compiled, "compile_loop", None)
    for more in ((), ("--checkpoint-every", "5m")):
        line = refuse(
            "run", "log.npz", "--particles", 10**7, "--landmarks", 300, "--out", "x", *more
        )
        assert "10000000 particles with 300 landmarks need " in line
        assert "GB), and 30 GB are free; --particles " in line
    assert os.listdir() == ["log.npz"]
    most = int(line.split("--particles ")[1].split()[0])
    config = config_for(load_log("log.npz"), particles=most, landmarks=300)
    assert 25e9 < compiled.estimate_memory(config, 24).total < 30e9


def test_the_compilers_own_temporaries_count(there, call, monkeypatch):
    config = config_for(load_log("log.npz"), particles=30, landmarks=30)
    quick, whole = compiled.estimate_memory(config, 24), checkpoints.memory_of_run(config, 24)
    assert whole.state == quick.state == memory.bytes_of(compiled.state_shapes(config))
    assert whole.temporaries > 0 and whole.total > quick.total
    monkeypatch.setattr(memory, "available_bytes", lambda: quick.total + 1)
    code, _, err = call(
        "run", "log.npz", "--particles", 30, "--landmarks", 30, "--out", "new/out",
        "--checkpoint-every", "5m",
    )  # fmt: skip
    told, refused = err.splitlines()
    assert (code, "temporaries" in told) == (2, True)
    assert refused.startswith("jaxslam: 30 particles ") and "temporaries" in refused
    assert os.listdir() == ["log.npz"]


def test_limits_of_control_groups(tmp_path):
    own, first, second = tmp_path / "own", tmp_path / "memory" / "a", tmp_path / "b" / "c"
    own.write_text("4:memory:/a\n3:cpuset:/z\n0::/b/c\n")
    for folder in (first, second):
        folder.mkdir(parents=True)
    for folder, names, stat in (
        (first, ("memory.limit_in_bytes", "memory.usage_in_bytes"), "total_inactive_file 5\n"),
        (second.parent, ("memory.max", "memory.current"), "anon 7\ninactive_file 10\n"),
        (second, ("memory.max", "memory.current"), "inactive_file 1\n"),
    ):
        for name, value in zip(names, ("max" if folder == second else "1000", "300"), strict=True):
            (folder / name).write_text(value + "\n")
        (folder / "memory.stat").write_text(stat)
    found = [size for size in memory._cgroup_bytes(tmp_path, own) if size is not None]
    assert found == [705, 710]
    assert memory.available_bytes() is None or memory.available_bytes() > 0
