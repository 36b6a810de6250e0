"""Particles shared by devices and by processes: the same bits, and one line when one is missing."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import pytest
from test_appearance import coloured

from jaxslam.cli import main as cli
from jaxslam.config import Config
from jaxslam.logs.log_file import save_log
from jaxslam.parameters import default_params
from jaxslam.runs import checkpoint_file, cluster
from jaxslam.runs.cluster import ClusterAddress
from jaxslam.simulation.planar import planar

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ROOT / "tests" / "programs"

BITS = PROGRAMS / "hash_of_runs.py"


def bits(path, settings, changes):
    """A line for every change: a digest of what was found, and how much that was."""
    # A compiled program that another process is just writing can't be read, and is compiled again.
    warnings = "-W", "error", "-W", "ignore:Error reading persistent"
    words = [sys.executable, *warnings, BITS, path]
    found = subprocess.run(
        [*map(str, words), json.dumps(settings), json.dumps(changes)],
        capture_output=True, text=True, cwd=ROOT,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    print(found.stdout)
    return [line.split() for line in found.stdout.splitlines()]


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    path = tmp_path_factory.mktemp("short") / "log.npz"
    save_log(path, planar("field", 5, landmarks=25, length_m=6.0, rate_hz=2.0, outlier=0.05))
    return path


def test_devices_make_no_difference(short):
    settings = dict(particles=1004, block=100, landmarks=30)
    changes = [dict(), dict(devices=2), dict(devices=4), dict(devices=2, lazy=False, chunk=7)]
    lines = bits(short, settings, [*changes, dict(runs=2)])
    assert [int(line[4]) for line in lines] == [1, 2, 4, 2, 1]
    assert len({line[0] for line in lines}) == 1
    assert int(lines[0][1]) > 0 and int(lines[0][2]) > 5


@pytest.mark.slow
def test_rejuvenation_and_looks_are_the_same_on_devices(tmp_path):
    log = planar("field", 5, landmarks=25, length_m=4.0, rate_hz=8.0, outlier=0.05)
    save_log(tmp_path / "log.npz", coloured(log))
    settings = dict(sensor="bearing", particles=504, block=100, landmarks=40, rejuvenate=1.5)
    settings["descriptors"] = 1
    lines = bits(tmp_path / "log.npz", settings, [dict(), dict(devices=2, chunk=7)])
    assert len({line[0] for line in lines}) == 1
    assert int(lines[0][2]) >= 3


@pytest.mark.slow
def test_devices_make_no_difference_at_length(tmp_path):
    log = planar("room", 1, length_m=52.0, landmarks=20, max_per_frame=3)
    assert len(log.frame_time) >= 500
    save_log(tmp_path / "log.npz", log)
    settings = dict(sensor="range_bearing", particles=10_004, landmarks=100)
    changes = [
        dict(save=str(tmp_path / "one")),
        dict(devices=2, chunk=31),
        dict(devices=4, lazy=False, chunk=100),
    ]
    lines = bits(tmp_path / "log.npz", settings, changes)
    assert len({line[0] for line in lines}) == 1, lines
    assert int(lines[0][1]) > 0 and int(lines[0][2]) > 10, lines
    options = "--seed", 3, "--sensor", "range_bearing", "--particles", 10_004, "--landmarks", 100
    both = together(tmp_path, *COMMAND, *options, "--out", "two")
    assert [code for code, *_ in both] == [0, 0], both
    assert results(tmp_path / "two") == results(tmp_path / "one")


COMMAND = "run", "log.npz", "--no-refine"
SMALL = *COMMAND, "--particles", 1004, "--landmarks", 30


def start(folder, *words, slow=0):
    told = {"PYTHONPATH": str(ROOT), "SLOW": str(slow)}
    return subprocess.Popen(
        [sys.executable, PROGRAMS / "slow_chunks.py", *map(str, words)],
        env=os.environ | told, cwd=folder,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(process):
    out, err = process.communicate(timeout=240)
    return process.returncode, out, err


def run(folder, *words):
    return ended(start(folder, *words))


def start_two(folder, *words, **given):
    address = f"127.0.0.1:{free_port()}"
    shared = *words, "--coordinator", address, "--num-processes", 2, "--process-id"
    return [start(folder, *shared, i, **given) for i in range(2)]


def together(folder, *words):
    return [ended(process) for process in start_two(folder, *words)]


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def results(folder):
    names = "trajectory.tum", "landmarks.csv", "events.jsonl"
    return [(folder / name).read_bytes() for name in names]


@pytest.fixture(scope="module")
def there(tmp_path_factory, short):
    """A folder with the log and one process's run."""
    folder = tmp_path_factory.mktemp("there")
    (folder / "log.npz").write_bytes(short.read_bytes())
    code, _, err = run(folder, *SMALL, "--out", "one")
    assert code in (0, 1), err
    return folder


def test_two_processes_give_what_one_gives(there):
    lead, other = together(there, *SMALL, "--out", "two", "--devices", 2)
    assert lead[0] == other[0] < 2, (lead, other)
    assert "the map is two/map.png" in lead[1] and "Gloo" not in lead[1]
    assert other[1:] == ("", "")
    assert results(there / "two") == results(there / "one")


@pytest.mark.slow
def test_a_run_of_two_that_was_killed_goes_on_alone_or_with_another(there):
    long = *SMALL, "--out", "long", "--checkpoint-every", "0.001"
    processes = start_two(there, *long, slow=0.3)
    wait_for(lambda: list(there.glob("long/checkpoints/step-*14.npz")), processes)
    for process in processes:
        process.kill()
        process.communicate()
    (there / "again").mkdir()
    for path in (there / "long").iterdir():
        path.rename(there / "again" / path.name)
    (there / "long").rmdir()
    copy = there / "long" / "checkpoints"
    copy.mkdir(parents=True)
    for path in (there / "again" / "checkpoints").iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    code, _, err = run(there, *long, "--resume", "--devices", 4)
    assert code < 2 and "note: resuming after step " in err, err
    lead, other = together(there, *SMALL, "--out", "again", "--resume")
    assert lead[0] == other[0] < 2 and "note: resuming after step " in lead[2], (lead, other)
    for name in ("long", "again"):
        assert results(there / name) == results(there / "one")
        assert not (there / name / "checkpoints").exists()


def wait_for(done, processes):
    while not done():
        assert all(process.poll() is None for process in processes), ended(processes[0])
        time.sleep(0.05)


@pytest.mark.parametrize("victim", [0, 1])
def test_a_process_that_dies_ends_the_run_in_one_line(there, victim):
    processes = start_two(there, *SMALL, "--out", f"dead-{victim}", slow=60)
    lead = processes[0].pid
    wait_for(lambda: list(there.glob(f"chunk-*-{lead}")), processes)
    processes[victim].kill()
    code, out, err = ended(processes[1 - victim])
    assert (code, out) == (69, ""), err
    assert err == f"jaxslam: process {victim} died, or the connection to it broke\n"
    processes[victim].communicate()


def meeting(*parties, limit=20.0):
    """What `rendezvous` returns or raises for each (place, run); all at once."""
    found = {}

    def one(index, place, run):
        try:
            found[index] = cluster.rendezvous(place, run, limit)
        except ConnectionError as error:
            found[index] = str(error)

    threads = [threading.Thread(target=one, args=(i, *party)) for i, party in enumerate(parties)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    links = [link for value in found.values() if isinstance(value, dict) for link in value.values()]
    for link in links:
        link.close()
    return [found[i] for i in range(len(parties))]


def test_all_meet_and_whoever_does_not_fit_is_named_on_every_side():
    port, run = free_port(), {"seed": 1, "config": {"particles": 10}, "log": "a"}
    places = [ClusterAddress("127.0.0.1", port, 3, i) for i in range(3)]
    first, second, third = meeting(*((place, run) for place in places))
    assert (sorted(first), sorted(second), sorted(third)) == ([1, 2], [0], [0])

    pair = [ClusterAddress("127.0.0.1", port, 2, i) for i in range(2)]
    other = {"seed": 2, "config": {"particles": 20}, "log": "b"}
    said = meeting((pair[0], run), (pair[1], other))
    differing = "seed (1, now 2), particles (10, now 20), log"
    assert said == [f"process 1 has other settings than process 0: {differing}"] * 2

    said = meeting((places[0], run), (places[1], run), (places[1], run))
    assert said == ["two processes have --process-id 1"] * 3
    said = meeting((pair[0], run), (places[1], run))
    assert said == ["process 1 has --num-processes 3, process 0 2"] * 2


def test_whoever_is_missing_is_named(monkeypatch):
    port = free_port()
    lead, other = (ClusterAddress("127.0.0.1", port, 2, i) for i in range(2))
    told = f"process 1 did not connect to 127.0.0.1:{port} within 0.5 s"
    assert meeting((lead, {}), limit=0.5) == [f"{told}; start all processes together"]
    (said,) = meeting((other, {}), limit=0.5)
    assert said.startswith(f"can't reach process 0 at 127.0.0.1:{port} within 0.5 s: ")
    with socket.create_server(("127.0.0.1", port)):
        said = meeting((lead, {}))
    assert said == [
        f"can't listen at 127.0.0.1:{port}: address already in use; choose another --coordinator"
    ]


def test_a_missing_process_ends_the_command_with_69(at, short, call, monkeypatch):
    monkeypatch.setattr(cluster.rendezvous, "__defaults__", (0.5,))
    words = "run", short, "--num-processes", 2, "--coordinator", f"127.0.0.1:{free_port()}"
    code, out, err = call(*words, "--process-id", 0)
    assert (code, out, err.count("\n")) == (69, "", 1)
    assert err.startswith("jaxslam: process 1 did not connect to 127.0.0.1:")
    assert os.listdir() == []


def test_options_that_do_not_fit_are_refused(at, short, refuse):
    jax.devices()  # begun, so that no command gives all other tests more devices
    run = "run", short
    three = *run, "--coordinator", "127.0.0.1:4321", "--num-processes", 2
    assert "--process-id missing; --coordinator, --num-processes, --process-id go" in refuse(*three)
    assert "--process-id is 2; must be 0 to 1" in refuse(*three, "--process-id", 2)
    line = "which 3 devices can't share evenly; take 999 or 1002"
    assert line in refuse(*run, "--devices", 3)
    assert "which 4 devices can't share evenly; take 4" in refuse(
        *run, "--devices", 4, "--particles", 3
    )
    assert "take 999 or 1002" in refuse(
        *run, "--coordinator", "h:1", "--num-processes", 3, "--process-id", 0
    )
    assert "but JAX has" in refuse(*run, "--devices", 500)
    assert cli.main([*map(str, run), "--devices", "0"]) == 2
    for address in ("localhost", ":80", "a b:1", "h:0", "h:65536", "h:x", "::1:80"):
        with pytest.raises(ValueError, match="must be HOST:PORT, like 127"):
            cluster.find_address(address, 2, 1, {})
    assert os.listdir() == []


SLURM = {"SLURM_JOB_ID": "5000", "SLURM_PROCID": "1", "SLURM_STEP_NUM_TASKS": "4"}
MPI = {"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "1"}


@pytest.mark.parametrize(
    ("env", "found"),
    [
        ({}, None),
        (SLURM | {"SLURM_STEP_NODELIST": "node[001,007-015],x2"}, ("node001", 62344, 4, 1)),
        (SLURM | {"SLURM_STEP_NODELIST": "n7,x2"}, ("n7", 62344, 4, 1)),
        (SLURM | {"SLURM_STEP_NUM_TASKS": "1"}, None),
        (
            MPI | {"OMPI_MCA_orte_hnp_uri": "8192.0;tcp://10.0.0.1,10.1.0.1:34911"},
            ("10.0.0.1", 61442, 2, 1),
        ),
    ],
)
def test_launchers_say_where_all_meet(env, found):
    assert cluster.find_address(env=env) == (found and ClusterAddress(*found))


def test_options_go_before_the_launcher():
    place = cluster.find_address("[::1]:80", env=MPI)
    assert place == ClusterAddress("::1", 80, 2, 1) and place.address == "[::1]:80"
    with pytest.raises(ValueError, match="--coordinator missing; "):
        cluster.find_address(env=MPI)
    # A launcher's processes with a run each.
    assert (
        cluster.find_address(processes=1, env=MPI)
        is cluster.find_address(processes=1, env=SLURM)
        is None
    )


def test_a_run_is_the_same_whoever_shares_it():
    settings = checkpoint_file.run_settings
    one, two = (settings(Config(devices=d), default_params(), 0) for d in (1, 2))
    assert one == two


def test_a_setting_that_an_earlier_version_did_not_have_counts_as_its_default():
    """A checkpoint of that version is of a run without descriptors, and is resumed so."""
    before = {"config": {"particles": 20}}
    with_looks, without = ({"config": {"particles": 20, "descriptors": n}} for n in (6, 0))
    assert cluster.find_differences(before, with_looks) == "descriptors (0, now 6)"
    assert cluster.find_differences(before, without) == ""
