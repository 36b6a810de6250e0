"""Long runs: what is put aside is gone on with bit for bit, and nothing is lost on the way."""

import dataclasses
import errno
import io
import os
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from test_appearance import coloured

from jaxslam.logs.log_file import save_log
from jaxslam.parameters import default_params
from jaxslam.results import load, run_folder, run_lock
from jaxslam.runs import checkpoint_file, compiled, run
from jaxslam.runs import checkpoints as offline
from jaxslam.runs.run import config_for
from jaxslam.simulation.planar import planar

PARTICLES = 30
RUN = "run", "log.npz", "--landmarks", 30, "--no-refine", "--particles", PARTICLES
LONG = *RUN, "--out", "out", "--checkpoint-every", "0.001"


@pytest.fixture(scope="module")
def log():
    return planar("field", 5, landmarks=25, length_m=6.0, rate_hz=2.0, outlier=0.05)


@pytest.fixture
def there(at, log, monkeypatch):
    """A folder with the log; chunks of 7 frames."""
    save_log("log.npz", log)
    monkeypatch.setattr(compiled, "CHUNK", 7)
    return at


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, two in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, two)


def columns(result):
    """All that a run found, but for times."""
    found = {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.metadata}
    return found | {n: getattr(result, n) for n in ("landmarks", "ancestral", "lineage")}


class Stop(Exception):
    pass


def broken_off(log, config, folder, chunks, **given):
    """A run that dies after so many chunks, without a word."""
    left = [chunks]

    def progress(done, total, more):
        left[0] -= bool(done)
        if left[0] < 0:
            raise Stop

    with pytest.raises(Stop), offline.Checkpoints(folder, 0, **given) as checkpoints:
        run.run(log, config, None, 3, progress, False, checkpoints)


def gone_on(log, config, folder, said=None):
    report = None if said is None else said.append
    with offline.Checkpoints(folder, 0, resume=True, report=report) as checkpoints:
        return run.run(log, config, None, 3, None, False, checkpoints)


@pytest.mark.parametrize(
    "settings",
    [
        dict(),
        dict(association="known", lazy=False, sensor="bearing", proposal="informed"),
        pytest.param(dict(association="sampled", chains=2), marks=pytest.mark.slow),
    ],
    ids=["lazy", "eager", "sampled"],
)
def test_a_resumed_run_is_bit_for_bit_the_undisturbed_one(log, tmp_path, monkeypatch, settings):
    config = config_for(log, particles=30, landmarks=30, **{"sensor": None} | settings)
    whole = columns(run.run(log, config, None, 3, refine=False))
    monkeypatch.setattr(compiled, "CHUNK", 1)
    folder, said = tmp_path / "run", []
    broken_off(log, config, folder, 5)
    assert len(list((folder / "checkpoints").iterdir())) == 2
    broken_off(log, config, folder, 4, resume=True)
    same(columns(gone_on(log, config, folder, said)), whole)
    assert "note: resuming after step 18, from step-00000018.npz" in said
    # The end was put aside as well: nothing is filtered or compiled again.
    monkeypatch.setattr(compiled, "compile_loop", None)
    same(columns(gone_on(log, config, folder)), whole)


@pytest.mark.slow
def test_looks_and_particles_drawn_anew_are_gone_on_with_bit_for_bit(tmp_path, monkeypatch):
    log = coloured(planar("field", 5, landmarks=25, length_m=4.0, rate_hz=8.0, outlier=0.05))
    settings = dict(sensor="bearing", descriptors=1, rejuvenate=1.5)
    config = config_for(log, particles=30, landmarks=30, **settings)
    whole = run.run(log, config, None, 3, refine=False)
    assert whole.events is not None
    monkeypatch.setattr(compiled, "CHUNK", 7)
    broken_off(log, config, tmp_path / "run", 3)
    broken_off(log, config, tmp_path / "run", 3, resume=True)
    same(columns(gone_on(log, config, tmp_path / "run")), columns(whole))


def test_a_genealogy_that_was_given_up_stays_so(log, tmp_path, monkeypatch):
    config = config_for(log, particles=30, landmarks=30)
    monkeypatch.setattr(compiled, "CHUNK", 7)
    monkeypatch.setattr(compiled, "TREE_BYTES", 1000)
    broken_off(log, config, tmp_path / "run", 2)
    monkeypatch.undo()
    assert gone_on(log, config, tmp_path / "run").ancestral is None


def test_a_broken_checkpoint_is_said_and_the_one_before_it_taken(log, tmp_path, monkeypatch):
    monkeypatch.setattr(compiled, "CHUNK", 7)
    config, folder = config_for(log, particles=30, landmarks=30), tmp_path / "run"
    whole = columns(run.run(log, config, None, 3, refine=False))
    broken_off(log, config, folder, 2)
    _, newest = sorted((folder / "checkpoints").iterdir())
    content = newest.read_bytes()
    for damaged in (flipped(content), content[:-900], b""):
        newest.write_bytes(damaged)
        said = []
        with (
            pytest.raises(Stop),
            offline.Checkpoints(folder, 0, True, report=said.append) as places,
        ):
            places.check_fingerprint(log, config, default_params(config.sensor, log), 3)
            assert places.restore(compiled.state_shapes(config)).done == 7
            raise Stop
        assert sum(line.startswith("warning: skipping a broken checkpoint: ") for line in said)
        assert newest.name in said[0]
    said = []
    same(columns(gone_on(log, config, folder, said)), whole)
    assert len(list((folder / "checkpoints").iterdir())) == 2
    for path in (folder / "checkpoints").iterdir():
        path.write_bytes(b"nothing")
    same(columns(gone_on(log, config, folder, said)), whole)
    assert f"note: no checkpoint in {folder}; starting from the beginning" in said


def flipped(content):
    """One bit of the poses is another one, and zipfile's own checksum is right again."""
    with np.load(io.BytesIO(content)) as found:
        arrays = {name: found[name] for name in found.files}
    arrays["state.pose"].view(np.uint32)[0, 0] ^= 1
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def test_another_run_is_not_gone_on_with(there, log, call, refuse, monkeypatch):
    died(call, monkeypatch)
    resume = *LONG, "--resume"
    assert "differing: particles (30, now 41)" in refuse(*RUN[:-1], 41, "--out", "out", "--resume")
    line = refuse(*resume, "--seed", 1, "--proposal", "informed")
    assert "out: holds another run; differing: seed (0, now 1), proposal (prior, now inf" in line
    (there / "p.toml").write_text("sigma_range = 0.25\n")
    assert "differing: sigma_range (" in refuse(*resume, "--params", "p.toml")
    assert refuse(*resume, "--start", 0.5).endswith("; differing: frames, log\n")
    save_log("log.npz", planar("field", 5, landmarks=25, length_m=6.0, rate_hz=2.0, outlier=0.06))
    assert "log" in refuse(*resume)
    save_log("log.npz", log)
    # Nor is it written over by accident.
    assert "out: a run is unfinished; add --resume, or --overwrite" in refuse(*LONG)
    assert "out: a run is unfinished; add --resume, or --overwrite" in refuse(*RUN, "--out", "out")
    assert "choose one" in refuse(*resume, "--overwrite")
    assert call(*resume)[0] == 0


def died(call, monkeypatch, chunks=2):
    """A run in `out` that has died, by a full disk, when it was to write its next checkpoint."""
    write, left = checkpoint_file.write_checkpoint, [chunks]

    def failing(path, about, columns):
        left[0] -= 1
        if left[0] < 0:
            monkeypatch.setattr(os, "fsync", full)
        write(path, about, columns)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    fsync = os.fsync
    monkeypatch.setattr(checkpoint_file, "write_checkpoint", failing)
    found = call(*LONG)
    monkeypatch.setattr(checkpoint_file, "write_checkpoint", write)
    monkeypatch.setattr(os, "fsync", fsync)
    return found


def results(folder):
    """The files that hold no times."""
    times = "summary.json", "run.toml"
    return {p.name: p.read_bytes() for p in Path(folder).iterdir() if p.name not in times}


def test_a_full_disk_leaves_the_old_checkpoint_and_an_exit_code(there, call, monkeypatch):
    code, out, err = died(call, monkeypatch)
    assert (code, out) == (74, "")
    assert err.splitlines()[-1].endswith("step-00000021.npz: No space left on device")
    assert sorted(os.listdir("out/checkpoints")) == ["step-00000007.npz", "step-00000014.npz"]

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:  # while the results are written
        patch.setattr(np, "savez_compressed", full)
        code, _, err = call(*LONG, "--resume")
        assert (code, err.splitlines()[-1]) == (74, "jaxslam: out: No space left on device")
        assert os.listdir("out") == ["checkpoints"]
    code, out, err = call(*LONG, "--resume")
    assert code == 0
    assert "note: resuming after step 24, from step-00000024.npz" in err
    assert set(os.listdir("out")) <= set(run_folder.FILES)
    assert call(*RUN, "--out", "whole")[0] == 0
    assert results("out") == results("whole")


def test_at_most_two_are_kept_and_none_in_the_end(there, call, monkeypatch):
    counts, tell = [], offline._print_to_stderr
    monkeypatch.setattr(
        offline,
        "_print_to_stderr",
        lambda line: (counts.append(len(os.listdir("out/checkpoints"))), tell(line)),
    )
    code, _, err = call(*LONG)
    assert (code, counts) == (0, [1, 2, 2, 2])
    lines = [line for line in err.splitlines() if line.startswith("step ")]
    assert len(lines) == 4
    assert lines[0].startswith("step 7 of 24, ") and " steps/s, ESS " in lines[0]
    assert set(os.listdir("out")) <= set(run_folder.FILES)
    # A finished run is finished, and another one does not take its place.
    code, out, err = call(*LONG, "--resume")
    assert (code, out, err) == (0, "out: is finished already; nothing to do\n", "")
    assert (
        "is finished, but of another run; differing: seed"
        in call(*LONG, "--resume", "--seed", 1)[2]
    )
    assert call(*LONG, "--overwrite", "--seed", 1)[0] == 0
    assert load.load_result("out").seed == 1


def test_with_nothing_there_it_starts_from_the_beginning(there, call, refuse):
    code, _, err = call(*RUN, "--out", "out", "--resume")
    assert code == 0
    assert "note: no checkpoint in out; starting from the beginning" in err
    (there / "mine").mkdir()
    (there / "mine" / "letter.txt").write_text("dear")
    assert "mine: is not a run's folder" in refuse(*RUN, "--out", "mine", "--resume")
    assert (there / "mine" / "letter.txt").read_text() == "dear"
    os.rename("log.npz", "out/log.npz")
    inside = "run", "out/log.npz", *LONG[2:], "--overwrite"
    assert "is in out, where results are replaced" in refuse(*inside)


def test_what_the_dead_left_is_cleared_away(there, call, monkeypatch):
    died(call, monkeypatch)
    for name in ("checkpoints/.step-00000021.npz.123.tmp", "landmarks.csv", "lock"):
        (there / "out" / name).write_text("half")
    (there / "out" / ".results").mkdir()
    (there / "out" / ".results" / "map.png").write_text("half")
    assert call(*LONG, "--resume")[0] == 0
    assert set(os.listdir("out")) <= set(run_folder.FILES)
    assert len((there / "out" / "landmarks.csv").read_text()) > 100
    # Killed after the last of the results was there, before the rest was cleared away.
    (there / "out" / "checkpoints").mkdir()
    (there / "out" / "checkpoints" / "step-00000024.npz").write_text("old")
    (there / "out" / "lock").write_text("process 1")
    assert call(*LONG, "--resume")[1].endswith("nothing to do\n")
    assert set(os.listdir("out")) <= set(run_folder.FILES)


@pytest.mark.parametrize(
    ("text", "value"), [("60s", 60), ("5m", 300), ("1h", 3600), ("90", 90), ("0.5s", 0.5)]
)
def test_times(text, value):
    assert offline.parse_interval(text) == value


@pytest.mark.parametrize("text", ["", "0s", "s", "5 days", "-3", "1e3", "nan"])
def test_no_times(text):
    with pytest.raises(ValueError, match="must be a time above 0"):
        offline.parse_interval(text)


SLOW = Path(__file__).parents[1] / "programs" / "slow_chunks.py"


def child(seconds):
    """The long run as a process of its own, slowed down; it is in its first chunk."""
    words = [sys.executable, SLOW, *map(str, LONG), "--resume"]
    told = {"PYTHONPATH": str(Path(__file__).parents[2]), "SLOW": str(seconds), "TELL": "1"}
    process = subprocess.Popen(
        words, env=os.environ | told, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout.readline() == "chunk\n"
    return process


def test_a_second_writer_is_told_of_the_first_and_ctrl_c_puts_the_run_aside(there, call):
    process = child(0.5)
    holder = f"out: is being written by process {process.pid} on "
    for words in ((*LONG, "--resume"), LONG, (*RUN, "--out", "out", "--overwrite")):
        code, out, err = call(*words)
        assert (code, out) == (75, "")
        assert err.startswith(f"jaxslam: {holder}") and err.count("\n") == 1
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    done = int(err.splitlines()[-1].split("after step ")[1].split()[0])
    again = "of 24; to resume, repeat the command with --resume"
    assert err.splitlines()[-1] == f"jaxslam: interrupted after step {done} {again}"
    assert 0 < done < 24
    assert os.listdir("out") == ["checkpoints"]

    process = child(60)
    for _ in range(2):  # the second one does not wait for the chunk
        process.send_signal(signal.SIGINT)
        time.sleep(0.5)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "jaxslam: interrupted"
    assert call(*LONG, "--resume")[0] == 0
    assert call(*RUN, "--out", "whole")[0] == 0
    assert results("out") == results("whole")


def test_ctrl_c_while_refining_says_how_to_go_on(there, call, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    refining = [word for word in LONG if word != "--no-refine"]
    with monkeypatch.context() as patch:
        patch.setattr(run, "refine_result", interrupted)
        code, _, err = call(*refining)
    assert code == 130
    assert err.splitlines()[-1] == (
        "jaxslam: interrupted; to resume, repeat the command with --resume"
    )
    assert os.listdir("out") == ["checkpoints"]
    assert call(*LONG, "--resume")[0] == 0


def test_a_lock_dies_with_its_process_and_its_file_may_be_removed(tmp_path):
    handle = run_lock.acquire(tmp_path)
    with pytest.raises(BlockingIOError, match=f"process {os.getpid()} on "):
        run_lock.check_unlocked(tmp_path)
    os.close(handle)
    run_lock.check_unlocked(tmp_path)
    assert (tmp_path / "lock").exists()
    os.close(run_lock.acquire(tmp_path))


@pytest.mark.slow
def test_kills_leave_no_trace():
    kills = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "kills.py"))
    rows, _ = kills["kill_and_resume"](12)
    assert sum(row["kills"] for row in rows) >= 12
    assert all(row["equal"] and not row["unreadable"] and not row["strays"] for row in rows)
