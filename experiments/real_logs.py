"""Ours beside the batch solution: filtered, refined, GTSAM with known identities, odometry alone.

    python experiments/real_logs.py                       all cases, seeds 0-4
    python experiments/real_logs.py --cases room --seeds 0
    python experiments/real_logs.py --particles 1000

Default configuration and parameters of the sensor, with what the log declares; MRCLAM's robots also
have the gains in experiments/params/, found from odometry against truth. Path errors are root mean
squares after aligning (SE(2), no scale), the landmarks' follow the path's alignment; nothing
aligned is in the .json. Simulated rooms: `worlds`. GTSAM's solution is from bearings and known
identities (`batch`), whatever ours used; without GTSAM its column is left out. MRCLAM may not be
redistributed: read from ../shared/data/mrclam, or left out. Writes experiments/results/real_logs.md
and .json; every seed must hold the limits.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import batch
import numpy as np
import worlds

from jaxslam import Log, config_for, load_log, run
from jaxslam.results.metrics import compute_errors

RESULTS = Path(__file__).parent / "results"
# landmarks by batch with known identities, as measured before this project began [m]
MRCLAM_BATCH = (0.185, 0.103, 0.073, 0.284, 0.066)
FRESH = 20  # worlds of the room before this seed were looked at while the defaults were chosen
COLUMNS = (
    ("ate_filtered_rmse_m", "filtered path"),
    ("landmark_filtered_rmse_m", "landmarks"),
    ("ate_refined_rmse_m", "refined path"),
    ("landmark_refined_rmse_m", "landmarks"),
)
COUNTS = ("matched", "missed", "spurious")


class Case(NamedTuple):
    """A log with its limits: most of a key of `errors`, or (`of_batch`) most times batch's path.

    `seed`: of the simulated world, and then of its one run; None: a run for every seed."""

    name: str
    log: Log
    sensor: str
    association: str
    particles: int
    file: Path | None = None
    limits: dict | None = None
    of_batch: float | None = None
    seed: int | None = None


def cases(seeds):
    """All cases; the room's world is drawn anew for every seed."""
    woods = load_log("lost-in-the-woods")
    known = {"ate_refined_rmse_m": 0.065, "landmark_refined_rmse_m": 0.08}
    known |= {"ate_filtered_rmse_m": 0.20}
    yield Case("Lost in the Woods", woods, "bearing", "known", 1000, limits=known)
    hidden = {"ate_refined_rmse_m": 0.06, "landmark_refined_rmse_m": 0.06}
    hidden |= {"landmarks_refined_missed": 0, "landmarks_refined_spurious": 1}
    both = "range_bearing", "maximum_likelihood"
    yield Case("Lost in the Woods", woods, *both, 1000, limits=hidden)
    for robot, reference in enumerate(MRCLAM_BATCH, 1):
        log, file = batch.mrclam(robot)
        if log is None:
            continue
        limits = {"landmark_refined_rmse_m": 1.2 * reference}
        yield Case(f"MRCLAM D6 robot {robot}", log, "bearing", "known", 1000, file, limits)
    for scale, ratio in ((1.0, 1.1), (3.0, 1.3)):
        limits = {"ate_filtered_rmse_m": 0.03} if scale == 1 else {}
        for seed in seeds:
            log = worlds.room(FRESH + seed, scale)
            name = f"room, {scale:g} deg"
            yield Case(name, log, "bearing", "known", 1000, None, limits, ratio, seed)


def measure(case, seed, reference, particles):
    """Errors of one run, with the limits it broke."""
    count = particles or case.particles
    config = config_for(case.log, case.sensor, case.association, particles=count)
    params = batch.gained(case.log, case.file, case.sensor)
    result = run(case.log, config, params, seed)
    found = compute_errors(result) | {
        "seed": seed,
        "seconds": result.seconds,
        "flags": result.flags,
    }
    found["refine_seconds"] = result.refine_seconds
    limits = dict(case.limits or {})
    if case.of_batch and reference:
        limits["ate_refined_rmse_m"] = case.of_batch * reference["ate_m"]
    found["limits"] = {key: [found.get(key, np.nan), most] for key, most in limits.items()}
    return found


def referenced(case):
    """Errors of the batch solution of a case's log, or None without GTSAM."""
    if not batch.installed():
        return None
    found = batch.solve(case.log, batch.gained(case.log, case.file))
    return batch.errors(found, case.log) | {"settled": found.settled, "seconds": found.seconds}


def spread(values):
    """Mean of some values, and least and most."""
    values = np.array([np.nan if value is None else value for value in values], float)
    low, high = values.min(), values.max()
    return f"{values.mean():.3f}" + (f" ({low:.3f}-{high:.3f})" if high - low >= 5e-4 else "")


def row(key, runs):
    """The table's row of a case's runs."""
    name, sensor, association, particles = key
    identities = "known" if association == "known" else "hidden"
    cells = [name, sensor, identities, f"{particles:,}"]
    cells += [spread([run.get(key) for run in runs]) for key, _ in COLUMNS]
    if batch.installed():
        cells += [spread([run["gtsam"][key] for run in runs]) for key in ("ate_m", "landmark_m")]
    cells.append(spread([run["dead_reckoning_ate_m"] for run in runs]))
    counts = [[run.get(f"landmarks_refined_{how}", np.nan) for how in COUNTS] for run in runs]
    cells.append(" / ".join(f"{mean:.3g}" for mean in np.mean(counts, axis=0)))
    seconds = [[run["seconds"], run["refine_seconds"] or np.nan] for run in runs]
    cells.append(" + ".join(f"{mean:.0f}" for mean in np.mean(seconds, axis=0)))
    return "| " + " | ".join(cells) + " |"


def verdicts(table):
    """One line per limit and case: its worst seed."""
    for key, runs in table.items():
        for name in runs[0]["limits"]:
            worst = max(runs, key=lambda run: _excess(*run["limits"][name]))
            value, most = worst["limits"][name]
            held = "held" if value <= most else "BROKEN"
            yield (f"- {key[0]}, {key[1]}, {key[2]}: {name} {value:.3f}, limit {most:.3f}, "
                   f"worst seed {worst['seed']}: {held}")  # fmt: skip


def _excess(value, most):
    return np.inf if np.isnan(value) else value - most


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    options.add_argument("--cases", nargs="+", help="beginnings of the names of the cases to run")
    options.add_argument("--particles", type=int, help="instead of each case's own number")
    options.add_argument("--name", default="real_logs", help="of the files with the results")
    options = options.parse_args()
    titles = ["log", "sensor", "identities", "particles", *(title for _, title in COLUMNS)]
    titles += ["GTSAM path, known", "landmarks"] if batch.installed() else []
    titles += ["dead reckoning", "matched / missed / spurious", "seconds (filter + refining)"]
    lines = ["| " + " | ".join(titles) + " |", "|---" * len(titles) + "|"]
    table = {}
    for case in cases(options.seeds):
        if options.cases and not case.name.startswith(tuple(options.cases)):
            continue
        key = case.name, case.sensor, case.association, options.particles or case.particles
        reference = referenced(case)
        for seed in options.seeds if case.seed is None else [case.seed]:
            found = measure(case, seed, reference, options.particles)
            table.setdefault(key, []).append(found | {"gtsam": reference})
            print(
                key[:3], seed, {k: round(found.get(k, np.nan), 3) for k, _ in COLUMNS}, flush=True
            )
    lines += [row(key, runs) for key, runs in table.items()]
    notes = ["", f"Seeds {', '.join(map(str, options.seeds))}: mean (least-most); metres."]
    notes += [] if batch.installed() else [batch.MISSING]
    notes += [] if batch.MRCLAM.is_dir() else ["MRCLAM is not here: left out"]
    lines += [*notes, "", *verdicts(table)]
    print(*lines, sep="\n")
    RESULTS.mkdir(exist_ok=True)
    content = {", ".join(map(str, key)): runs for key, runs in table.items()}
    (RESULTS / f"{options.name}.json").write_text(json.dumps(content, indent=1) + "\n")
    (RESULTS / f"{options.name}.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
