"""Is the filter's pose as sure as it is right, over a long run, with rejuvenation and without?

    python experiments/nees_rejuvenation.py                    100 worlds of 600 frames, both ways
    python experiments/nees_rejuvenation.py --runs 10 --cases bearing
    python experiments/nees_rejuvenation.py --woods            over Lost in the Woods, reported

Worlds of `simulate.planar`, 60 m round a room with 20 lines, a frame every 0.1 m, drawn from the
filter's own models with what the filter is told; a new world for every run. NEES of the filtered
pose (x, y, heading) with the particles' covariance, averaged over the worlds, over 3: 1 if the
filter is honest, with the 99.9 % band of chi-square for so many worlds. Finished runs are kept in
experiments/results/nees_rejuvenation.jsonl and not run again. Writes nees_rejuvenation.md beside.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from jaxslam import config_for, default_params, load_log, run
from jaxslam.logs.truth import truth_at, wrap
from jaxslam.simulation.planar import planar

RESULTS = Path(__file__).parent / "results"
CASES = {
    "range_bearing": dict(sensor="range_bearing", association="known", proposal="informed"),
    "bearing": dict(sensor="bearing", association="known", proposal="informed"),
    "bearing, hidden": dict(sensor="bearing"),
}
EVERY = (3.0, 0.0)  # m between rejuvenations
AT = (50, 100, 200, 300, 400, 500, 600)


def world(seed):
    """A room of its own for every seed."""
    return planar(
        "room", 5000 + seed, landmarks=20, length_m=60.0, speed=0.5, rate_hz=5, odometry_hz=5,
        sigma_range=0.1, sigma_bearing=0.0175, landmark_extent=0.0, outlier=0.0, detection=1.0,
        view=(-np.pi, np.pi, 6.0),
    )  # fmt: skip


def measure(case, seed, every, particles):
    """NEES / 3 of one run's filtered pose at the steps `AT`, and its path's error."""
    log = world(seed)
    settings = CASES[case] | dict(particles=particles, rejuvenate=every)
    params = default_params(CASES[case]["sensor"], log)
    result = run(log, config_for(log, **settings), params, seed, refine=False)
    nees, error = _nees(result, log)
    at = [min(step, len(nees)) - 1 for step in AT]
    return {
        "nees": nees[at].tolist(),
        "rmse": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, 1)))),
    }


def _nees(result, log):
    """NEES / 3 [T] where the truth is known, NaN elsewhere, and the errors there."""
    truth = truth_at(log.truth, result.time)
    there = np.isfinite(truth).all(1)
    error = result.pose - truth
    error[:, 2] = wrap(error[:, 2])
    nees = np.full(len(error), np.nan)
    cov = result.cov[there] + 1e-12 * np.eye(3)
    solved = np.linalg.solve(cov, error[there][..., None])[..., 0]
    nees[there] = np.sum(error[there] * solved, 1) / 3
    return nees, error[there]


def table(rows):
    """Markdown: the average NEES / 3 by steps of every case, with the band."""
    yield (
        "| sensor, identities | rejuvenated | worlds | path RMSE [m] | "
        + " | ".join(f"step {step}" for step in AT)
        + " | 99.9 % band |"
    )
    yield "|---" * (len(AT) + 5) + "|"
    groups = {}
    for each in rows:
        groups.setdefault((each["case"], each["every"]), []).append(each)
    for (case, every), runs in groups.items():
        low, high = chi2.ppf([0.0005, 0.9995], 3 * len(runs)) / (3 * len(runs))
        mean = np.mean([each["nees"] for each in runs], axis=0)
        cells = [f"**{value:.2f}**" if low < value < high else f"{value:.2f}" for value in mean]
        rmse = np.mean([each["rmse"] for each in runs])
        name = case if "hidden" in case else f"{case}, known"
        how = f"every {every:g} m" if every else "never"
        yield (
            f"| {name} | {how} | {len(runs)} | {rmse:.3f} | "
            + " | ".join(cells)
            + (f" | {low:.2f}-{high:.2f} |")
        )


def woods(particles):
    """Lines on the NEES over Lost in the Woods, whose errors are not those of any model."""
    log = load_log("lost-in-the-woods")
    for every in EVERY:
        config = config_for(log, "bearing", particles=particles, rejuvenate=every)
        result = run(log, config, seed=0, refine=False)
        nees, error = _nees(result, log)
        rmse = np.sqrt(np.mean(np.sum(error[:, :2] ** 2, 1)))
        yield (
            f"- Lost in the Woods, bearings, identities hidden, {particles:,} particles, "
            f"rejuvenated {f'every {every:g} m' if every else 'never'}: median NEES / 3 "
            f"{np.nanmedian(nees):.2f}, within its 99 % region "
            f"{np.mean(nees[np.isfinite(nees)] * 3 < chi2.ppf(0.99, 3)):.0%} of the frames, "
            f"path RMSE {rmse:.3f} m (not aligned)"
        )


def main():
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--runs", type=int, default=100)
    options.add_argument("--particles", type=int, default=1000)
    options.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES)
    options.add_argument("--woods", action="store_true")
    options = options.parse_args()
    RESULTS.mkdir(exist_ok=True)
    if options.woods:
        lines = list(woods(options.particles))
        (RESULTS / "nees_woods.md").write_text("\n".join(lines) + "\n")
        print(*lines, sep="\n")
        return
    kept = RESULTS / "nees_rejuvenation.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    for case in options.cases:
        for every in EVERY:
            for seed in range(options.runs):
                about = dict(case=case, every=every, seed=seed, particles=options.particles)
                if any(about.items() <= row.items() for row in rows):
                    continue
                rows.append(about | measure(case, seed, every, options.particles))
                with kept.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
            print(case, every, "done", flush=True)
    lines = list(table(rows))
    (RESULTS / "nees_rejuvenation.md").write_text("\n".join(lines) + "\n")
    print(*lines, sep="\n")


if __name__ == "__main__":
    main()
