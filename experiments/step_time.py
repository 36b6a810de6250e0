"""Time of one filter step beside NumPy's: `python experiments/step_time.py` (about 1 minute).

`range_bearing`, identities unknown, resampling every step, default `Config`, a given map, one core.
Contenders take turns in one process: the public `jaxslam.filter.step`, plainly called and with its
state donated; a vectorised NumPy filter in float32, on all particles at once and in blocks that fit
the cache; and the loop baseline, on a few particles.
At the default sizes it writes experiments/results/step_time.json and .md. `--quick`: a small trial.
"""

import argparse
import json
import os
import time
from pathlib import Path

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before JAX and BLAS make their threads
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}

import contenders
import jax
import numpy as np

from jaxslam.config import Config

RESULTS = Path(__file__).parent / "results"
SIZES = dict(particles=10000, landmarks=100, measurements=20)
LOOP = "loop baseline"


def measure(given):
    """One row per contender: times, and how far its last mean pose is off the truth."""
    frames = 1 + given.rounds * given.steps
    marks, _, truth, seen, ids = contenders.simulate(given.landmarks, given.measurements, frames)
    sizes = {name: getattr(given, name) for name in SIZES}
    config = Config(**sizes, resample_threshold=1.0)
    rivals = {
        "jaxslam, state donated": contenders.of_jax(marks, config)[:2],
        "jaxslam, plain call": contenders.of_jax(marks, config, donated=False)[:2],
        "vectorised NumPy": contenders.of_numpy(marks, config, block=given.particles),
        "the same, in blocks": contenders.of_numpy(marks, config),
        LOOP: contenders.of_loop(marks, config),
    }
    poses = {name: advance(seen[0], ids[0]) for name, (advance, _) in rivals.items()}  # compiles
    times = {name: [] for name in rivals}
    for round_ in range(given.rounds):
        for name, (advance, _) in rivals.items():
            for t in range(1 + round_ * given.steps, 1 + (round_ + 1) * given.steps):
                begin, begin_cpu = time.perf_counter(), time.process_time()
                poses[name] = advance(seen[t], ids[t])
                now = time.perf_counter(), time.process_time()
                times[name].append((now[0] - begin, now[1] - begin_cpu))
    rows = []
    for name, (_, occupied) in rivals.items():
        wall, cpu = 1e3 * np.array(times[name]).T
        particles = contenders.LOOP_PARTICLES if name == LOOP else given.particles
        apart = np.asarray(poses[name], float) - truth[-1]
        rows.append(
            dict(name=name, particles=particles, steps=len(wall), min_ms=wall.min(),
                 median_ms=np.median(wall), cpu_median_ms=np.median(cpu),
                 ns=1e6 * np.median(wall) / particles / given.measurements,
                 error_m=np.hypot(*apart[:2]), error_rad=abs(apart[2]), landmarks=occupied())
        )  # fmt: skip
    return rows


def report(rows, machine, given):
    """Text; ratios are of medians per particle (of minima in brackets) to jaxslam's, donated."""
    lines = [
        f"One step of {given.particles} particles, {given.landmarks} landmarks,"
        f" {given.measurements} measurements; {machine}",
        "",
        "| | particles | steps | min ms | median ms | CPU ms | ns per particle × measurement"
        " | time / jaxslam's | pose off by | landmarks |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        share = row["particles"] / rows[0]["particles"]
        ratio, least = (row[k] / share / rows[0][k] for k in ("median_ms", "min_ms"))
        lines.append(
            "| {name} | {particles} | {steps} | {min_ms:.1f} | {median_ms:.1f} |"
            " {cpu_median_ms:.1f} | {ns:.0f} |".format(**row)
            + f" {ratio:.3g} ({least:.3g}) |"
            + " {error_m:.3f} m, {error_rad:.4f} rad | {landmarks:.1f} |".format(**row)
        )
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in SIZES.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=3, help="of each contender in a round")
    parser.add_argument("--quick", action="store_true", help="500 particles, 2 rounds")
    given = parser.parse_args()
    if given.quick:
        given.particles, given.rounds = 500, 2
    rows = measure(given)
    cpu = Path("/proc/cpuinfo").read_text().split("model name\t: ")[-1].splitlines()[0]
    machine = f"one core of {cpu}, jax {jax.__version__}, numpy {np.__version__}"
    print(text := report(rows, machine, given))
    if all(getattr(given, name) == size for name, size in SIZES.items()):
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "step_time.md").write_text(text)
        content = json.dumps(dict(machine=machine, given=vars(given), rows=rows), indent=1)
        (RESULTS / "step_time.json").write_text(content + "\n")
    for row in rows:  # a contender that went wrong did other work than the rest
        limit = 0.2 if row["name"] == LOOP else 0.05
        assert row["error_m"] < limit and row["error_rad"] < limit, row


if __name__ == "__main__":
    main()
