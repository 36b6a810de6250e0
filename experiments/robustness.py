"""How wrong may the noise be? Every noise parameter at a third and at three times its value.

    python experiments/robustness.py                seed 0, 1,000 particles
    python experiments/robustness.py --seeds 0 1 2

Bearings with known identities, on *Lost in the Woods* and in the simulated room (`worlds`), whose
true noise the log declares; informed proposal. Path errors are aligned (SE(2), no scale), root mean
square, of the worst seed. Writes experiments/results/robustness.md and .json.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import worlds

from jaxslam import config_for, default_params, load_log, run
from jaxslam.results.metrics import compute_errors

RESULTS = Path(__file__).parent / "results"
NOISES = (
    "sigma_bearing",
    "landmark_extent",
    "correlation",
    "outlier",
    "err_tran",
    "err_rot",
    "err_drift",
)
NOISES += ("floor_tran", "floor_rot")
COLUMNS = ("ate_filtered_rmse_m", "ate_refined_rmse_m", "landmark_refined_rmse_m")


def variants(params):
    """Name, factor and `Params`; a noise that is zero stays zero and is left out."""
    yield "all as they are", 1.0, params
    for name in NOISES:
        for factor in (1 / 3, 3.0):
            value = factor * getattr(params, name)
            if value:
                yield name, factor, params._replace(**{name: value})
    for factor in (1 / 3, 3.0):
        every = {name: factor * getattr(params, name) for name in NOISES if name != "outlier"}
        yield "all but outlier", factor, params._replace(**every)


def worst(log, params, particles, seeds):
    """The largest error of each kind over the seeds [m]; infinite where a run found none."""
    config = config_for(log, "bearing", "known", particles=particles, proposal="informed")
    found = [compute_errors(run(log, config, params, seed)) for seed in seeds]
    return {key: max(each.get(key, np.inf) for each in found) for key in COLUMNS}


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seeds", type=int, nargs="+", default=[0])
    options.add_argument("--particles", type=int, default=1000)
    options = options.parse_args()
    lines = ["| log | parameter | times | filtered path | refined path | refined landmarks |"]
    lines += ["|---|---|--:|--:|--:|--:|"]
    print(*lines, sep="\n")
    content = []
    for log in (load_log("lost-in-the-woods"), worlds.room(0)):
        for name, factor, params in variants(default_params("bearing", log)):
            found = worst(log, params, options.particles, options.seeds)
            content.append({"log": log.name, "parameter": name, "factor": factor, **found})
            cells = [f"{found[key]:.3f}" for key in COLUMNS]
            lines.append(f"| {log.name} | {name} | {factor:.2g} | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    seeds = ", ".join(map(str, options.seeds))
    lines += ["", f"{options.particles:,} particles, worst of seeds {seeds}; metres."]
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "robustness.json").write_text(json.dumps(content, indent=1) + "\n")
    (RESULTS / "robustness.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
