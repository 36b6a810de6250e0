"""What the filter reaches on the bundled log: the accuracy table of the README.

    python experiments/accuracy.py            all cases, seeds 0-4 (about 20 minutes on one core)
    python experiments/accuracy.py --seeds 0  one seed

Writes experiments/results/accuracy.json and accuracy.md. Every case uses the default parameters of
its sensor. Errors are root mean squares, aligned (SE(2), no scale) unless said; the landmarks'
follow the trajectory's alignment. Limits are those the project set itself for this version.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from jaxslam import Config, config_for, default_params, load_log, run
from jaxslam.evaluate import errors

RESULTS = Path(__file__).parent / "results"
COLUMNS = (
    ("ate_filtered_rmse_m", "path [m]"),
    ("ate_filtered_unaligned_rmse_m", "path, not aligned [m]"),
    ("landmark_filtered_rmse_m", "landmarks [m]"),
    ("landmarks_matched", "matched"),
    ("landmarks_spurious", "spurious"),
    ("association_accuracy", "right associations"),
)


def cases(log):
    """Name, configuration and limits (path, landmarks, spurious; of every seed or of the mean)."""
    paper = Config.paper(measurements=config_for(log).measurements)
    strict = {"ate_filtered_rmse_m": 0.15, "landmark_filtered_rmse_m": 0.10}
    strict |= {"landmarks_missed": 0, "landmarks_spurious": 2}
    return [
        ("range_bearing", config_for(log, "range_bearing", particles=1000), strict),
        ("position", config_for(log, "position", particles=1000), strict),
        ("Config.paper()", paper, None),
        (
            "bearing, identities known",
            config_for(log, "bearing", "known", particles=2000),
            {"ate_filtered_rmse_m": 0.50},
        ),
    ]


def measure(log, config, seeds):
    params = default_params(config.sensor, log)
    for seed in seeds:
        result = run(log, config, params, seed)
        found = errors(result)
        found["seed"], found["seconds"] = seed, result.seconds
        found["n_landmarks"], found["flags"] = len(result.landmarks.id), result.flags
        found.setdefault("landmark_filtered_rmse_m", float("nan"))  # nothing matched
        yield found


def row(name, found):
    cells = [name]
    for key, _ in COLUMNS:
        values = [run[key] for run in found]
        digits = 0 if key in ("landmarks_matched", "landmarks_spurious") else 3
        low, high = min(values), max(values)
        spread = f" ({low:.{digits}f}-{high:.{digits}f})" if high > low else ""
        cells.append(f"{np.mean(values):.{max(digits, 0)}f}{spread}")
    return "| " + " | ".join(cells) + " |"


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    options.add_argument("--cases", nargs="+", help="beginnings of the names of the cases to run")
    options = options.parse_args()
    log = load_log("lost-in-the-woods")
    header = ["case, mean over seeds (least-most)", *(title for _, title in COLUMNS)]
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    table, broken = {}, []
    for name, config, limits in cases(log):
        if options.cases and not name.startswith(tuple(options.cases)):
            continue
        found = list(measure(log, config, options.seeds))
        title = f"{name}, {config.particles:,} particles"
        table[title] = found
        lines.append(row(title, found))
        print(lines[-1], flush=True)
        for key, most in (limits or {}).items():
            broken += [
                f"{title}, seed {run['seed']}: {key} {run[key]:.3f} > {most}"
                for run in found
                if not run[key] <= most
            ]
    reckoned = next(iter(table.values()))[0]
    lines.append(
        f"\nDead reckoning: path {reckoned['dead_reckoning_ate_m']:.2f} m, "
        f"{reckoned['dead_reckoning_end_m']:.2f} m off at the end. "
        f"{len(log.frame_time):,} frames, {len(log.frame):,} measurements, seeds "
        f"{', '.join(map(str, options.seeds))}."
    )
    print(
        lines[-1], *(["beyond the limits:", *broken] if broken else ["all limits held"]), sep="\n"
    )
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "accuracy.json").write_text(json.dumps(table, indent=1) + "\n")
    (RESULTS / "accuracy.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
