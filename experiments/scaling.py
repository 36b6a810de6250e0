"""Time and memory of a step as particles, landmarks and measurements grow, beside its peers.

    python experiments/scaling.py            all sizes, about 25 minutes on two idle cores
    python experiments/scaling.py --quick    a few sizes, under 3 minutes, into runs/scaling
    python experiments/scaling.py --again 2  rows once more that were measured under a higher load
    python experiments/scaling.py --report   table and figure again, from the last run's numbers

Every row is a process of its own on one core (`scaling_one`): the public `jaxslam.step`, jitted
with its state donated, default `Config`, resampling every step, `range_bearing`, a given map of
which the robot sees what is within `view` m and measures the K nearest. Beside it the loop
baseline, vectorised NumPy, the same in numba where that is installed, and the plain C of
../shared/bench where that is. Times are CPU time (two devices: wall time, all cores), memory is the
peak beyond that of an idle process with JAX. Sizes that do not fit are refused beforehand.
Writes scaling.csv, .json and .md into --out (experiments/results), and docs/scaling.png.
"""

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
RESULTS = HERE / "results"
UNKNOWN, KNOWN = "maximum_likelihood", "known"
BASE = dict(
    who="jaxslam", particles=10_000, landmarks=100, measurements=20, association=UNKNOWN,
    lazy=True, devices=1, cores=1, view=6, steps=24, seconds=5.0,
)  # fmt: skip
PEERS = "numpy", "blocks", "numba", "c"  # blocks: NumPy on as many particles as fit the cache
FAR = 100  # m: nearly every landmark is in view, so that a gate cannot help
COUNTS, MAPS = (1_000, 10_000, 100_000, 1_000_000), (25, 100, 400, 1_600)
COLUMNS = (
    *(name for name in BASE if name not in ("steps", "seconds")), "steps", "min_ms", "median_ms",
    "wall_min_ms", "wall_median_ms", "ns", "first_s", "state_bytes", "peak_bytes", "peak_of_state",
    "moved_bytes", "of_bandwidth", "in_view", "held", "error_m", "load", "note",
)  # fmt: skip


def plan(quick):
    """What to measure: one dictionary a row."""
    both = UNKNOWN, KNOWN
    if quick:
        for association in both:
            for who in ("jaxslam", *PEERS):
                yield BASE | dict(who=who, association=association, steps=12)
        yield BASE | dict(particles=1_000)
        yield BASE | dict(who="loop", particles=4, seconds=1.0)
        yield BASE | dict(landmarks=1_600, steps=12)
        for who in ("jaxslam", "numpy", "blocks", "c"):
            yield BASE | dict(who=who, landmarks=400, association=KNOWN, steps=12)
        yield BASE | dict(particles=1_000_000, landmarks=1_600)
        return
    for association in both:
        base = BASE | dict(association=association)
        for n in COUNTS:
            maps = MAPS if n in (10_000, 1_000_000) else MAPS[1::2]
            yield from (base | dict(particles=n, landmarks=m) for m in maps)
        yield from (base | dict(landmarks=m, lazy=False) for m in MAPS[1:])
        yield from (base | dict(landmarks=m, measurements=5) for m in MAPS[1:3])
        yield base | dict(lazy=False, particles=1_000_000)
        for who in PEERS:
            yield from (base | dict(who=who, landmarks=m, seconds=3.0) for m in MAPS[1:3])
            yield base | dict(who=who, particles=1_000, seconds=3.0)
            yield base | dict(who=who, measurements=5, seconds=3.0)
        yield base | dict(who="loop", particles=4, seconds=2.0)
        if association == UNKNOWN:
            yield from (base | dict(landmarks=m, view=FAR) for m in MAPS[1:3])
        for _ in range(2):  # in turns
            for devices in (1, 2):
                yield base | dict(particles=200_000, devices=devices, cores=2)


def measured(given):
    """A row's numbers, from its own process."""
    command = [sys.executable, HERE / "scaling_one.py", json.dumps(given)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return dict(note=f"failed ({done.returncode}): {last[:120]}")
    return json.loads(done.stdout.splitlines()[-1])


def moved(row):
    """Bytes that a step must move at least, for jaxslam's rows.

    A landmark in view is read (mean, factor, times seen; unknown identities also its log-odds,
    which are written), a matched one is written, with the measurement's two matches in `Info`; pose
    and weight are read and written, the ancestor written; eager: the whole map is read and written.
    """
    known, k = row["association"] == KNOWN, row["measurements"]
    looked = k * 24 if known else row["in_view"] * (28 + 4)
    copied = 0 if row["lazy"] else 2 * row["landmarks"] * (28 if known else 32)
    return row["particles"] * (looked + k * (24 + 8) + 36 + copied)


def completed(row, bandwidth, base):
    """The row with what follows from its numbers; `base`: peak bytes of an idle process."""
    if "min_ms" in row:
        each = row["particles"] * row["measurements"]
        time_ms = row["wall_min_ms"] if row["cores"] > 1 else row["min_ms"]
        row["ns"] = 1e6 * time_ms / each
    if row.get("peak_bytes"):
        row["peak_bytes"] = max(0, row["peak_bytes"] - base)
    if row.get("state_bytes"):
        row["peak_of_state"] = row["peak_bytes"] / row["state_bytes"]
        row["moved_bytes"] = moved(row)
        row["of_bandwidth"] = row["moved_bytes"] / (1e6 * time_ms) / bandwidth
    return row


def run(quick, folder):
    """All rows, and what is known of the machine; saved as it goes."""
    begin, rows = time.time(), []
    rates = measured(dict(who="bandwidth"))
    base = measured(dict(who="idle"))["peak_bytes"]
    apart = measured(dict(who="agree"))
    machine = dict(
        bandwidth=rates, best=max(rates.values()), idle_bytes=base, numba=apart, quick=quick,
        cpu=Path("/proc/cpuinfo").read_text().split("model name\t: ")[-1].splitlines()[0],
        cores=len(os.sched_getaffinity(0)), python=platform.python_version(),
    )  # fmt: skip
    for given in plan(quick):
        row = given | measured(given) | dict(load=os.getloadavg()[0])
        rows.append(completed(row, machine["best"], base))
        print(line(row), flush=True)
        saved(rows, machine | dict(seconds=time.time() - begin), folder)
    machine["bandwidth_after"] = measured(dict(who="bandwidth"))
    machine["seconds"] = time.time() - begin
    saved(rows, machine, folder)
    return rows, machine


def again(rows, machine, folder, load):
    """The rows, those measured under a higher load average measured once more."""
    for i, row in enumerate(rows):
        if row["load"] <= load or "min_ms" not in row:
            continue
        given = {name: row[name] for name in BASE}
        new = given | measured(given) | dict(load=os.getloadavg()[0])
        rows[i] = completed(new, machine["best"], machine["idle_bytes"])
        print(line(rows[i]), flush=True)
        saved(rows, machine | dict(again=load), folder)
    return rows, machine | dict(again=load)


def line(row):
    """One row for the terminal."""
    size = "{who} {association} N={particles} M={landmarks} K={measurements}".format(**row)
    how = "{} view {view} m, {devices} device(s)".format("lazy" if row["lazy"] else "eager", **row)
    if "min_ms" not in row:
        return f"{size} {how}: {row.get('note')}"
    memory = f", peak {row['peak_of_state']:.2f} of State" if "peak_of_state" in row else ""
    numbers = "min {min_ms:.2f} median {median_ms:.2f} ms, {ns:.1f} ns".format(**row)
    return f"{size} {how}: {numbers}{memory}, off {row['error_m']:.3f} m, load {row['load']:.1f}"


def saved(rows, machine, folder):
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "scaling.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, restval="", extrasaction="ignore")
        table.writeheader()
        table.writerows({k: rounded(v) for k, v in row.items()} for row in rows)
    (folder / "scaling.json").write_text(json.dumps(dict(machine=machine, rows=rows)) + "\n")


def rounded(value):
    return f"{value:.5g}" if isinstance(value, float) else "" if value is None else value


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few sizes, into runs/scaling")
    parser.add_argument("--report", action="store_true", help="of the numbers that are there")
    parser.add_argument("--again", type=float, help="what was measured under a higher load average")
    parser.add_argument("--out", type=Path, help="folder; default experiments/results")
    given = parser.parse_args()
    folder = given.out or (Path("runs/scaling") if given.quick else RESULTS)
    if given.report or given.again is not None:
        kept = json.loads((folder / "scaling.json").read_text())
        rows, machine = kept["rows"], kept["machine"]
        if given.again is not None:
            rows, machine = again(rows, machine, folder, given.again)
    else:
        rows, machine = run(given.quick, folder)
    import scaling_report  # late: it draws, and this process should stay small

    text = scaling_report.text(rows, machine)
    (folder / "scaling.md").write_text(text)
    figure = (HERE.parent / "docs" if folder == RESULTS else folder) / "scaling.png"
    scaling_report.draw(rows, figure)
    print(f"\n{text}\nwritten: {folder}/scaling.csv, .json, .md, and {figure}")


if __name__ == "__main__":
    main()
