"""Kill long runs (SIGKILL) at random moments, go on with them, and compare with an undisturbed one.

    python experiments/kills.py [--kills 100] [--particles 8000] [--frames 600]

Every run is started anew with --resume until it ends by itself; moments are drawn evenly from the
time an undisturbed run takes. Writes experiments/results/kills.md. About a quarter of an hour.
"""

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from hashlib import sha256
from pathlib import Path

from jaxslam.logs.log_file import save_log
from jaxslam.simulation.planar import planar

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "experiments" / "results"
COMPARED = ("trajectory.tum", "landmarks.csv", "trajectory_refined.tum", "landmarks_refined.csv")
COMPARED += ("steps.npz", "events.jsonl")  # summary.json holds times
ROUNDS = 40  # starts of one run, at most


def start(place, out, particles):
    """Start, or go on with, a run that writes `out` in the folder `place`."""
    told = {"JAX_COMPILATION_CACHE_DIR": str(place / "cache"), "PYTHONPATH": str(ROOT)}
    told |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    words = f"-m jaxslam run log.npz --particles {particles} --out {out} --resume"
    return subprocess.Popen(
        [sys.executable, *words.split(), "--checkpoint-every", "0.1"],
        cwd=place,
        env=os.environ | told,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def fingerprint(folder):
    """SHA-256 of the results, and the names of files that a finished run does not leave."""
    from jaxslam.results.run_folder import FILES

    digest = sha256()
    for name in COMPARED:
        digest.update((folder / name).read_bytes())
    return digest.hexdigest(), sorted({path.name for path in folder.iterdir()} - set(FILES))


def phase(folder, frames):
    """How far a killed run had come, by what it left."""
    steps = [int(path.stem[5:]) for path in (folder / "checkpoints").glob("step-*.npz")]
    if (folder / "summary.json").exists():
        return "finished"
    if not steps:
        return "before the first checkpoint"
    return "refining, writing" if max(steps) == frames else "filtering"


def kill_and_resume(kills, particles=200, frames=400, seed=0, show=print):
    """Undisturbed once, then runs until so many kills have hit; gives rows of counts."""
    draw, rows, phases = random.Random(seed), [], Counter()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        log = planar("room", 1, landmarks=30, length_m=frames / 10, outlier=0.0)
        save_log(place / "log.npz", log)
        for out in ("first", "whole"):  # the first one compiles
            began = time.perf_counter()
            _, said = start(place, out, particles).communicate()
            took = time.perf_counter() - began
        wanted, strays = fingerprint(place / "whole")
        assert not strays and "error" not in said, (strays, said)
        show(f"undisturbed: {took:.1f} s, {len(log.frame_time)} steps", flush=True)
        while (hit := sum(row["kills"] for row in rows)) < kills:
            began = time.perf_counter()
            row = one_run(place, kills - hit, draw, took, particles, phases, len(log.frame_time))
            if not row["kills"]:  # others may have used the machine the first time
                took = min(took, time.perf_counter() - began)
            found, strays = fingerprint(place / "run")
            beside = {path.name for path in place.iterdir()}
            strays += sorted(beside - {"cache", "log.npz", "first", "whole", "run"})
            rows.append(row | {"equal": found == wanted, "strays": len(strays)})
            show(rows[-1], flush=True)
            for path in (place / "run").iterdir():
                path.unlink()
            (place / "run").rmdir()
    return rows, phases


def one_run(place, most, draw, took, particles, phases, frames):
    """One run, killed at most so often: kills, resumes, checkpoints that could not be read."""
    row = dict(kills=0, resumes=-1, unreadable=0)
    for _ in range(ROUNDS + most):
        process = start(place, "run", particles)
        row["resumes"] += 1
        # After many kills a run is left alone, so that it ends.
        patience = draw.uniform(0, took) if row["kills"] < min(most, ROUNDS) else None
        try:
            _, said = process.communicate(timeout=patience)
        except subprocess.TimeoutExpired:
            process.kill()
            _, said = process.communicate()
        row["unreadable"] += said.count("broken checkpoint")
        if process.returncode in (0, 1):
            return row
        assert process.returncode == -9, (process.returncode, said)
        row["kills"] += 1
        phases[phase(place / "run", frames)] += 1
    raise AssertionError(f"no end after {row}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=100)
    # So many that most of the time goes into filtering.
    parser.add_argument("--particles", type=int, default=8000)
    parser.add_argument("--frames", type=int, default=600)
    given = parser.parse_args()
    rows, phases = kill_and_resume(given.kills, given.particles, given.frames)
    total = {name: sum(row[name] for row in rows) for name in rows[0]}
    when = ", ".join(f"{count} {name}" for name, count in phases.most_common())
    lines = [
        "| runs | kills | resumes | results equal | unreadable checkpoints | stray files |",
        "|--:|--:|--:|--:|--:|--:|",
        f"| {len(rows)} | {total['kills']} | {total['resumes']} | {total['equal']} of {len(rows)} "
        f"| {total['unreadable']} | {total['strays']} |",
        "",
        f"Killed while: {when}. {given.particles:,} particles, {given.frames} frames.",
    ]
    print(*lines, sep="\n")
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "kills.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
