"""Bearings alone, identities hidden: real logs and the simulated room, one set of defaults.

    python experiments/hidden.py                          all cases, seeds 0-4; rooms 7-11
    python experiments/hidden.py --cases woods --seeds 0
    python experiments/hidden.py --particles 4000
    python experiments/hidden.py --cases room "mrclam 3" --seeds 0 --config rejuvenate=0
    python experiments/hidden.py --cases "mrclam 3" --seeds 0 --params caution=0.02

Every run is `jaxslam.run` with the sensor's defaults (informed proposal, rejuvenated every 3 m) and
what the log declares; MRCLAM's robots also have the gains in experiments/params/, as in
experiments/real_logs.py. Path errors are root mean squares after aligning (SE(2), no scale); the
landmarks' follow the path's alignment. Beside each case stand its limits; `--config` and `--params`
try another design. Runs are kept in
experiments/results/hidden.jsonl as they finish, and one that is there is not run again (`--again`:
it is). Writes experiments/results/hidden.md.
"""

import argparse
import json
from pathlib import Path

import batch
import numpy as np
import worlds
from real_logs import MRCLAM_BATCH

from jaxslam import config_for, default_params, load_log, run
from jaxslam.results.events import AMBIGUOUS
from jaxslam.results.metrics import compute_errors

RESULTS = Path(__file__).parent / "results"
KEYS = {
    "ate_filtered_rmse_m": "filtered path",
    "ate_refined_rmse_m": "refined path",
    "landmark_refined_rmse_m": "landmarks",
    "landmarks_refined_matched": "matched",
    "landmarks_refined_missed": "missed",
    "landmarks_refined_spurious": "spurious",
    "dead_reckoning_ate_m": "dead reckoning",
}
ROOMS = 7  # seed of the first room


def cases(seeds):
    """(name, log, params, seed, limits) of every run."""
    woods = load_log("lost-in-the-woods")
    limits = {"ate_refined_rmse_m": 0.10, "landmark_refined_rmse_m": 0.10}
    limits |= {"landmarks_refined_missed": 0, "landmarks_refined_spurious": 1}
    for seed in seeds:
        yield "woods", woods, default_params("bearing", woods), seed, limits
    for seed in seeds:
        log = worlds.room(ROOMS + seed)
        yield (
            "room",
            log,
            default_params("bearing", log),
            ROOMS + seed,
            {"ate_refined_rmse_m": 0.025},
        )
    for robot, reference in enumerate(MRCLAM_BATCH, 1):
        log, file = batch.mrclam(robot)
        if log is None:
            continue
        limits = {"landmark_refined_rmse_m": 1.5 * reference}
        limits |= {"landmarks_refined_missed": 1, "landmarks_refined_spurious": 2}
        for seed in seeds:
            yield f"mrclam {robot}", log, batch.gained(log, file, "bearing"), seed, limits


def changed(words):
    """Names and values of words like `rejuvenate=0` or `proposal=prior`."""
    found = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = value
    return found


def measure(log, params, seed, particles, config, values):
    """Errors of one run and what it took."""
    params = params._replace(**changed(values))
    config = config_for(log, "bearing", particles=particles, **changed(config))
    result = run(log, config, params, seed)
    found = compute_errors(result)
    return {key: found.get(key) for key in KEYS} | {
        "seconds": result.seconds + result.refine_seconds,
        "ambiguous": int((result.entropy > AMBIGUOUS).sum()),
        "flags": result.flags,
    }


def row(name, runs):
    """The table's row of a case: mean (least-most) of each number, and the limits' verdicts."""
    cells = [
        name,
        runs[0].get("design") or "defaults",
        f"{runs[0]['particles']:,}",
        ", ".join(str(run["seed"]) for run in runs),
    ]
    for key in KEYS:
        values = np.array([np.nan if run[key] is None else run[key] for run in runs], float)
        form = "{:.3f}" if key.endswith("_m") else "{:.3g}"
        low, high = form.format(values.min()), form.format(values.max())
        cells.append(low if low == high else f"{form.format(values.mean())} ({low}-{high})")
    broken = [
        key for key, most in runs[0]["limits"].items() if not all(_held(r, key) for r in runs)
    ]
    limits = ", ".join(f"{KEYS[key]} {most:.3g}" for key, most in runs[0]["limits"].items())
    verdict = "held" if not broken else "BROKEN: " + ", ".join(KEYS[key] for key in broken)
    return "| " + " | ".join([*cells, limits, verdict]) + " |"


def _held(run, key):
    return run[key] is not None and run[key] <= run["limits"][key]


def main():
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    options.add_argument("--cases", nargs="+", help="beginnings of names: woods, room, mrclam 2")
    options.add_argument("--particles", type=int, default=1000)
    options.add_argument("--config", nargs="+", default=[], metavar="NAME=VALUE")
    options.add_argument("--params", nargs="+", default=[], metavar="NAME=VALUE")
    options.add_argument("--again", action="store_true", help="also what has been run")
    options = options.parse_args()
    RESULTS.mkdir(exist_ok=True)
    kept = RESULTS / "hidden.jsonl"
    runs = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    for name, log, params, seed, limits in cases(options.seeds):
        about = {"name": name, "seed": seed, "particles": options.particles}
        about["design"] = " ".join([*options.config, *options.params])
        if options.cases and not name.startswith(tuple(options.cases)):
            continue
        there = [run for run in runs if about.items() <= run.items()]
        if there and not options.again:
            continue
        found = (
            about
            | {"limits": limits}
            | measure(log, params, seed, options.particles, options.config, options.params)
        )
        print(found, flush=True)
        runs = [run for run in runs if run not in there] + [found]
        kept.write_text("".join(json.dumps(run) + "\n" for run in runs))
    table = {}
    for each in runs:
        key = each["name"], each["design"], each["particles"]
        table.setdefault(key, []).append(each)
    heads = ["log", "design", "particles", "seeds", *KEYS.values(), "limits", "every seed"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    lines += [row(name, runs) for (name, *_), runs in table.items()]
    lines += ["", "Mean (least-most) over the seeds; lengths in metres."]
    print(*lines, sep="\n")
    (RESULTS / "hidden.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
