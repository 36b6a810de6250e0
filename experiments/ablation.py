"""Where the error comes from: one change a row, on *Lost in the Woods*, bearings, identities known.

    python experiments/ablation.py              seeds 0-2 (about 20 minutes on one quiet core)
    python experiments/ablation.py --seeds 0

Every row changes one thing of the row it names; errors are root mean squares of the path (aligned,
SE(2)) and the landmarks, means over the seeds. Refinement starts from each row's own lineage.
Writes experiments/results/ablation.md.
"""

import argparse
from pathlib import Path

import numpy as np

from jaxslam import config_for, default_params, load_log, run
from jaxslam.results.metrics import compute_errors

RESULTS = Path(__file__).parent / "results"
# the motion and the bearing noise of the version before
FORMER_MOTION = dict(err_tran=0.04, err_rot=0.05, err_drift=0.05, floor_tran=0.002)
FORMER_NOISE = dict(sigma_bearing=0.1, landmark_extent=0.02, extra_bearing_noise=0.0, outlier=1e-3)
ROWS = (
    ("the defaults", {}, {}),
    ("the motion noise of the version before", {}, FORMER_MOTION),
    ("the bearing noise of the version before", {}, FORMER_NOISE),
    ("both of the version before", {}, FORMER_MOTION | FORMER_NOISE),
    ("no caution", {}, {"extra_bearing_noise": 0.0}),
    ("no growth at short range", {}, {"landmark_extent": 0.0}),
    ("errors alike over 2 cm of path", {}, {"correlation": 0.02}),
    ("no outliers", {"clutter": False}, {}),
    ("informed proposal", {"proposal": "informed"}, {}),
    ("five times the particles", {"particles": 5}, {}),
    ("a tenth of the particles", {"particles": 0.1}, {}),
    ("wider depth of new landmarks (sd 0.4)", {}, {"inv_depth_sd": 0.4}),
    ("sensor turned by 0.08 rad, as the evidence has it", {}, {"mount_yaw": 0.08}),
)
COLUMNS = ("ate_filtered_rmse_m", "ate_ancestral_rmse_m", "landmark_filtered_rmse_m")
COLUMNS += ("ate_refined_rmse_m", "landmark_refined_rmse_m")


def measure(log, settings, changes, particles, seeds):
    """Mean errors over the seeds, mean log evidence, and the share of steps that resampled."""
    count = round(settings.get("particles", 1) * particles)
    config = config_for(log, "bearing", "known", **(settings | {"particles": count}))
    params = default_params("bearing", log)._replace(**changes)
    rows = []
    for seed in seeds:
        result = run(log, config, params, seed)
        found = compute_errors(result)
        row = [found.get(key, np.nan) for key in COLUMNS]
        rows.append([*row, result.log_likelihood, result.resampled.mean()])
    return np.mean(rows, axis=0)


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options.add_argument("--particles", type=int, default=500)
    options = options.parse_args()
    log = load_log("lost-in-the-woods")
    lines = [
        "| change | filtered path | ancestral | filter's landmarks | refined path | landmarks "
        "| log evidence | resampled |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    print(*lines, sep="\n")
    for name, settings, changes in ROWS:
        *metres, evidence, resampled = measure(
            log, settings, changes, options.particles, options.seeds
        )
        cells = [f"{value:.3f}" for value in metres] + [f"{evidence:,.0f}", f"{resampled:.0%}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    seeds = ", ".join(map(str, options.seeds))
    lines += ["", f"{options.particles:,} particles, means over seeds {seeds}; metres, nats."]
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "ablation.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
