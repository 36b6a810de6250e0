"""What ten thousand, a hundred thousand and a million particles buy on real logs.

    python experiments/particles.py                            everything, two processes at a time
    python experiments/particles.py --sizes 1000,10000         only these numbers of particles
    python experiments/particles.py --report                   table and figure again

Filtered errors against truth and the log evidence of the same frames, over seeds, with the filter
alone (`refine=False`), default `Config` and parameters of the sensor. *Lost in the Woods* with
ranges and bearings, identities known and hidden, a frame a second (of ten) so that a million go
far enough; MRCLAM dataset 6, robot 1, bearings with known identities, from ../shared/data where
present. Writes experiments/results/particles.md and .json, and docs/particles.png.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
RESULTS = HERE / "results"
SEEDS = {1_000: 10, 10_000: 10, 100_000: 3, 1_000_000: 2}
SECONDS, SPACING = 200.0, 1.0  # of Lost in the Woods
MRCLAM_SECONDS = 200.0
CASES = {
    "woods known": "Lost in the Woods, known",
    "woods hidden": "Lost in the Woods, hidden",
    "mrclam": "MRCLAM robot 1, bearings, known",
}
KEYS = dict(
    ate_filtered_rmse_m="filtered path, RMS [m]", landmark_filtered_rmse_m="landmarks, RMS [m]",
    log_evidence="log evidence [nats]",
)  # fmt: skip


def log_of(case):
    """Log, `Config` settings and `Params` of a case; `None` where the log is absent."""
    import batch

    import jaxslam

    if case == "mrclam":
        log, gains = batch.mrclam(1)
        if log is None:
            return None
        params = batch.gained(log, gains, "bearing")
        log = jaxslam.cut(log, 0, MRCLAM_SECONDS)
        return log, dict(sensor="bearing", association="known"), params
    log = jaxslam.load_log("lost-in-the-woods")
    log = jaxslam.cut(jaxslam.spaced(log, SPACING), 0, SECONDS)
    rule = "known" if case == "woods known" else "maximum_likelihood"
    params = jaxslam.default_params("range_bearing", log)
    return log, dict(sensor="range_bearing", association=rule), params


def measure(case, particles, seeds):
    """Prints one line of JSON per seed."""
    import jaxslam

    found = log_of(case)
    if found is None:
        return
    log, settings, params = found
    config = jaxslam.config_for(log, **settings, particles=particles)
    for seed in range(seeds):
        result = jaxslam.run(log, config, params, seed, refine=False)
        row = {k: v for k, v in jaxslam.errors(result).items() if k in KEYS}
        row |= dict(case=case, particles=particles, seed=seed, frames=len(result.time),
                    log_evidence=float(np.sum(result.log_evidence, dtype=float)),
                    seconds=result.seconds, ancestral=result.ancestral is not None)  # fmt: skip
        print(json.dumps(row), flush=True)


def run(sizes):
    """Rows of all cases and sizes, the largest first, two processes at a time on a core each."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    jobs = [(case, n) for n in sorted(sizes, reverse=True) for case in CASES]
    free = list(cores)
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(JAX_COMPILATION_CACHE_DIR=cache) | os.environ  # one compilation a size

        def one(job):
            case, n = job
            core = free.pop()
            try:
                command = [sys.executable, __file__, "--one", case, str(n), str(SEEDS.get(n, 3))]
                done = subprocess.run(
                    command, stdout=subprocess.PIPE, text=True, env=environment, check=True,
                    preexec_fn=lambda: os.sched_setaffinity(0, {core}),
                )  # fmt: skip
            finally:
                free.append(core)
            rows = [json.loads(line) for line in done.stdout.splitlines()]
            spent = sum(row["seconds"] for row in rows)
            print(f"{case}, {n:,} particles: {len(rows)} runs, {spent:.0f} s", flush=True)
            return rows

        with ThreadPoolExecutor(len(cores)) as pool:
            return [row for rows in pool.map(one, jobs) for row in rows]


def groups(rows):
    """{case: {particles: rows}}, in order."""
    found = {}
    for case in CASES:
        for n in sorted({row["particles"] for row in rows if row["case"] == case}):
            some = [row for row in rows if (row["case"], row["particles"]) == (case, n)]
            found.setdefault(case, {})[n] = some
    return found


def values(rows, key):
    return np.array([row.get(key, np.nan) for row in rows], float)


def spread(found):
    text = f"{found.mean():.3f}"
    return text + (f" ({found.min():.3f}-{found.max():.3f})" if len(found) > 1 else "")


def bought(fewer, more, key):
    """What more particles did to a number: means, and whether beyond two standard errors."""
    a, b = values(fewer, key), values(more, key)
    if len(a) < 2 or len(b) < 2:
        return "too few seeds to tell"
    error = np.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b))
    change = b.mean() - a.mean()
    if abs(change) <= 2 * error:
        return f"nothing seen ({change:+.3g} ± {error:.1g})"
    better = (change > 0) == (key == "log_evidence")
    return f"{'better' if better else 'worse'} ({change:+.3g} ± {error:.1g})"


def text(rows):
    lines = [
        "| log, identities | particles | seeds | frames | filtered path [m] | landmarks [m] |"
        " log evidence, mean | SD | s a frame |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    said = ["", "What ten times the particles bought (difference of means ± standard error):", ""]
    for case, sizes in groups(rows).items():
        for n, some in sizes.items():
            evidence = values(some, "log_evidence")
            sd = f"{evidence.std(ddof=1):.2f}" if len(some) > 1 else ""
            path, marks = (spread(values(some, key)) for key in list(KEYS)[:2])
            frames = some[0]["frames"]
            each = np.median(values(some, "seconds")) / frames
            lines.append(
                f"| {CASES[case]} | {n:,} | {len(some)} | {frames} | {path} | {marks} |"
                f" {evidence.mean():.1f} | {sd} | {each:.2g} |"
            )
        counts = list(sizes)
        for few, many in pairwise(counts):
            told = "; ".join(
                f"{name.split(',')[0].split(' [')[0]} {bought(sizes[few], sizes[many], key)}"
                for key, name in KEYS.items()
            )
            said.append(f"- {CASES[case]}, {few:,} to {many:,}: {told}")
    about = (
        f"`python experiments/particles.py`: mean (least-most) over seeds, filter alone; *Lost in"
        f" the Woods*: {SECONDS:.0f} s, a frame every {SPACING:g} s; MRCLAM:"
        f" {MRCLAM_SECONDS:.0f} s."
    )
    return "\n".join([about, "", *lines, *said]) + "\n"


def draw(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
    for case, colour in zip(CASES, ("tab:blue", "tab:orange", "tab:green"), strict=True):
        sizes = groups(rows).get(case, {})
        for axis, key in zip(axes[:2], list(KEYS)[:2], strict=True):
            for n, some in sizes.items():
                axis.plot([n] * len(some), values(some, key), ".", color=colour, alpha=0.5)
            means = [values(some, key).mean() for some in sizes.values()]
            axis.plot(list(sizes), means, "-", color=colour, label=CASES[case])
        spreads = {n: values(some, "log_evidence").std(ddof=1) for n, some in sizes.items()
                   if len(some) > 1}  # fmt: skip
        axes[2].plot(list(spreads), list(spreads.values()), "o-", color=colour, label=CASES[case])
    labels = [*list(KEYS.values())[:2], "SD of the log evidence over seeds [nats]"]
    for axis, label in zip(axes, labels, strict=True):
        axis.set(xscale="log", yscale="log", xlabel="particles", ylabel=label)
        axis.grid(alpha=0.3)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default=",".join(map(str, SEEDS)))
    parser.add_argument("--report", action="store_true", help="of the numbers that are there")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        case, *numbers = given.one
        return measure(case, *map(int, numbers))
    file = given.out / "particles.json"
    rows = json.loads(file.read_text()) if given.report else run(map(int, given.sizes.split(",")))
    given.out.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(rows, indent=1) + "\n")
    (given.out / "particles.md").write_text(text(rows))
    draw(rows, (HERE.parent / "docs" if given.out == RESULTS else given.out) / "particles.png")
    print(text(rows))


if __name__ == "__main__":
    main()
