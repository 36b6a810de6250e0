"""Learning the noise of real robots: does what was learnt help on logs that were not learnt from?

    python experiments/learn_real.py                          # both, seeds 0-4
    python experiments/learn_real.py --cases woods-first --seeds 0

*Lost in the Woods*: learnt on the first half, judged on the second, and the other way round
(ranges and bearings, identities hidden). MRCLAM dataset 6: learnt on three robots, judged on the
other two (ranges and bearings, identities known). Judged: the held-out log likelihood, and the
errors of `jaxslam.run` with 1,000 particles, with the defaults, with what was published with the
data, and with what was learnt. Learning never sees truth; windows start with an empty map. Writes
experiments/results/learn_real.md and .json, and the parameters to experiments/params/learnt_*.toml.
MRCLAM may not be redistributed: read from ../shared/data/mrclam, or left out.
"""

import argparse
import os
import sys
import time
from pathlib import Path
from typing import NamedTuple

import batch
import jax
import numpy as np

from jaxslam import config_for, default_params, learn, load_log, run, save_params, uncertainty
from jaxslam.cut import cut, spaced, windows
from jaxslam.evaluate import errors

RESULTS = Path(__file__).parent / "results"
PARAMS = Path(__file__).parent / "params"
NAMES = ("err_rot", "err_drift", "floor_tran", "floor_rot", "gain_tran", "gain_rot", "mount_yaw")
NAMES += ("sigma_range", "sigma_bearing", "growth", "outlier")
# The course's standard deviations of speed and yaw rate, every 0.1 s, as noise per time.
WOODS_PUBLISHED = dict(
    sigma_range=0.030, sigma_bearing=0.0259, growth=0.0, floor_tran=0.0665 * 0.1**0.5,
    floor_rot=0.0905 * 0.1**0.5, err_tran=0.0, err_rot=0.0, err_drift=0.0,
)  # fmt: skip
KEYS = ("ate_filtered_rmse_m", "landmark_filtered_rmse_m", "ate_refined_rmse_m")
KEYS += ("landmark_refined_rmse_m",)


class Case(NamedTuple):
    """Logs to learn from and to judge on."""

    name: str
    train: list
    judged: list
    association: str
    published: dict | None
    window: float  # s
    spacing: float  # s between the frames learnt from: errors of close ones are alike


def cases():
    woods = load_log("lost-in-the-woods")
    half = (woods.frame_time[-1] - woods.start) * 1e-9 / 2
    first, second = cut(woods, 0, half), cut(woods, half)
    yield Case("woods-first", [first], [second], "known", WOODS_PUBLISHED, 630.0, 1.0)
    yield Case("woods-second", [second], [first], "known", WOODS_PUBLISHED, 630.0, 1.0)
    robots = [batch.mrclam(robot)[0] for robot in range(1, 6)]
    if robots[0] is not None:
        yield Case("mrclam-123", robots[:3], robots[3:], "known", None, 450.0, 0.0)
        yield Case("mrclam-345", robots[2:], robots[:2], "known", None, 450.0, 0.0)


def model(case, logs, particles=200):
    """The configuration to learn with: one for all logs of a case."""
    most = [config_for(log, "range_bearing", case.association) for log in logs]
    hidden = case.association == "sampled"
    return config_for(
        logs[0], "range_bearing", case.association, particles=particles, proposal="informed",
        measurements=max(c.measurements for c in most),
        landmarks=40 if hidden else max(c.landmarks for c in most), even=hidden,
    )  # fmt: skip


def learnt(case, seed, steps):
    """`Fit` and `Uncertainty` of a case."""
    parts, judged = (
        [spaced(part, case.spacing) for log in logs for part in windows(log, case.window)]
        for logs in (case.train, case.judged)
    )
    config = model(case, [*parts, *judged])
    start = default_params("range_bearing", case.train[0])
    begin = time.perf_counter()

    def tell(done, total, record):
        if done % 5 == 0:
            values = " ".join(f"{n} {v:.4g}" for n, v in record["params"].items())
            print(f"{done}/{total} {time.perf_counter() - begin:.0f} s "
                  f"loss {record['loss']:.3f} {values}", file=sys.stderr, flush=True)  # fmt: skip

    fit = learn.fit(
        parts, config, start, NAMES, held_out=judged, seeds=2, steps=steps, rate=0.15,
        every=15, held_out_seeds=2, seed=seed, progress=tell,
    )  # fmt: skip
    return fit, judged, parts


def judge(case, params, seeds):
    """Errors of runs on the held-out logs: a list for every log."""
    association = "known" if case.association == "known" else "maximum_likelihood"
    rows = []
    for log in case.judged:
        config = config_for(log, "range_bearing", association)
        # What a log declares of its sensor (view) is its own, whatever was learnt elsewhere.
        own = default_params("range_bearing", log)
        given = params._replace(**{n: getattr(own, n) for n in ("view_min", "view_max")})
        found = [errors(run(log, config, given, seed)) for seed in seeds]
        rows.append([{key: one.get(key) for key in (*KEYS, "landmarks_matched")} for one in found])
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--cases", nargs="+", help="names of the cases to run")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--only-learn", action="store_true")
    args = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", os.cpu_count())
    for case in cases():
        if args.cases and case.name not in args.cases:
            continue
        fit, judged, parts = learnt(case, 0, args.steps)
        errs = uncertainty.assess(fit, parts, seeds=4)
        PARAMS.mkdir(exist_ok=True)
        save_params(PARAMS / f"learnt_{case.name}.toml", fit.params,
                    dict(zip(fit.names, errs.standard_error.tolist(), strict=True)))  # fmt: skip
        for i, name in enumerate(fit.names):
            print(f"{case.name} {name:14s} {getattr(fit.start, name):9.4f} "
                  f"{getattr(fit.params, name):9.4f} +- {errs.standard_error[i]:.4f} "
                  f"{errs.verdict[i]}")  # fmt: skip
        print(errs.unresolved, "sd log Z", errs.log_z_sd, "made", errs.made)
        choices = {"default": fit.start, "learnt": fit.params}
        if case.published is not None:
            choices["published"] = fit.start._replace(**case.published)
        for name, params in choices.items():
            held = learn.evidence(judged, fit.config, params, 5, 77)
            print(f"{case.name} {name:10s} held-out evidence", held.round(0), flush=True)
        if args.only_learn:
            continue
        for name, params in choices.items():
            found = judge(case, params, args.seeds)
            for log, rows in zip(case.judged, found, strict=True):
                cells = [f"{key} {np.mean([row[key] for row in rows]):.3f}" for key in KEYS]
                print(f"{case.name} {name} on {log.name}: {', '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
