"""Learning the noise of real robots: does what was learnt help on logs that were not learnt from?

    python experiments/learn_real.py                          # both, seeds 0-4
    python experiments/learn_real.py --cases woods-first --seeds 0

*Lost in the Woods*: learnt on the first half, judged on the second, and the other way round; the
maps that judge are made with identities hidden. MRCLAM dataset 6: learnt on three robots, judged on
the other two. Ranges and bearings; learnt with identities known. Frames learnt from are 1 s apart,
MRCLAM's 3 s: its robots follow commands late, so that from frame to frame they turn less than they
do in the end. Judged: the held-out evidence, and the errors of `jaxslam.run` with 1,000 particles
and the informed proposal, with the defaults, with what was published with the data, and with what
was learnt. Learning never sees truth; windows start with an empty map.
Writes experiments/results/learn_real.md and .json, and experiments/params/learnt_*.toml.
MRCLAM may not be redistributed: read from ../shared/data/mrclam, or left out.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import NamedTuple

import batch
import jax
import numpy as np

from calibration.odometry import fit_odometry
from jaxslam import config_for, default_params, load_log, run, save_params
from jaxslam.learning import fit as learn
from jaxslam.learning import uncertainty
from jaxslam.logs.slicing import cut, spaced, windows
from jaxslam.results.metrics import compute_errors

RESULTS = Path(__file__).parent / "results"
PARAMS = Path(__file__).parent / "params"
NAMES = ("err_tran", "err_rot", "err_drift", "floor_tran", "floor_rot", "gain_tran", "gain_rot")
NAMES += ("mount_yaw", "sigma_range", "sigma_bearing", "landmark_extent", "outlier")
# Commanded drives bend to one side; where the camera looks is each robot's own; and what a glimpse
# of one or two landmarks every 3 s leaves open is not asked.
LEFT = ("mount_yaw", "floor_tran", "floor_rot")
CURVED = (*(name for name in NAMES if name not in LEFT), "bias_drift")
# The course's standard deviations of speed and yaw rate, every 0.1 s, as noise per time.
WOODS_PUBLISHED = dict(
    sigma_range=0.030, sigma_bearing=0.0259, landmark_extent=0.0, floor_tran=0.0665 * 0.1**0.5,
    floor_rot=0.0905 * 0.1**0.5, err_tran=0.0, err_rot=0.0, err_drift=0.0,
)  # fmt: skip
KEYS = ("ate_filtered_rmse_m", "landmark_filtered_rmse_m", "ate_refined_rmse_m")
KEYS += ("landmark_refined_rmse_m",)


class Case(NamedTuple):
    """Logs to learn from and to judge on."""

    name: str
    train: list
    judged: list
    hidden: str | None  # association of the runs that judge; None: identities known there, too
    published: dict | None
    window: float  # s
    spacing: float  # s between the frames learnt from: errors of close ones are alike
    names: tuple = NAMES
    particles: int = 200


def cases():
    woods = load_log("lost-in-the-woods")
    half = (woods.frame_time[-1] - woods.start) * 1e-9 / 2
    first, second = cut(woods, 0, half), cut(woods, half)
    yield Case("woods-first", [first], [second], "maximum_likelihood", WOODS_PUBLISHED, 630.0, 1.0)
    yield Case("woods-second", [second], [first], "maximum_likelihood", WOODS_PUBLISHED, 630.0, 1.0)
    robots = [batch.mrclam(robot)[0] for robot in range(1, 6)]
    if robots[0] is not None:
        yield Case("mrclam-123", robots[:3], robots[3:], None, None, 450.0, 3.0, CURVED, 400)
        yield Case("mrclam-345", robots[2:], robots[:2], None, None, 450.0, 3.0, CURVED, 400)


def model(logs, particles):
    """The configuration to learn with: one for all logs of a case."""
    made = [config_for(log, "range_bearing", "known") for log in logs]
    return config_for(
        logs[0], "range_bearing", "known", particles=particles, proposal="informed",
        measurements=max(one.measurements for one in made),
        landmarks=max(one.landmarks for one in made),
    )  # fmt: skip


def learnt(case, seed, steps):
    """`Fit` and `Uncertainty` of a case."""
    parts, judged = (
        [spaced(part, case.spacing) for log in logs for part in windows(log, case.window)]
        for logs in (case.train, case.judged)
    )
    config = model([*parts, *judged], case.particles)
    start = default_params("range_bearing", case.train[0])
    begin = time.perf_counter()

    def tell(done, total, record):
        if done % 5 == 0:
            values = " ".join(f"{n} {v:.4g}" for n, v in record["params"].items())
            print(f"{done}/{total} {time.perf_counter() - begin:.0f} s "
                  f"loss {record['loss']:.3f} {values}", file=sys.stderr, flush=True)  # fmt: skip

    fit = learn.fit(
        parts, config, start, case.names, held_out=judged, seeds=2 if len(parts) < 3 else 1,
        steps=steps, rate=0.15, every=15, held_out_seeds=2, seed=seed, progress=tell,
    )  # fmt: skip
    return fit, judged, parts


def judge(case, params, seeds):
    """Errors of runs on the held-out logs, by log and seed."""
    association = "known" if case.hidden is None else case.hidden
    found = {}
    for log in case.judged:
        config = config_for(log, "range_bearing", association, proposal="informed")
        # What a log declares of its view is its own, whatever was learnt elsewhere.
        own = default_params("range_bearing", log)
        view = {n: getattr(own, n) for n in ("view_min", "view_max", "view_range")}
        runs = [compute_errors(run(log, config, params._replace(**view), seed)) for seed in seeds]
        found[log.name] = [{key: one.get(key) for key in KEYS} for one in runs]
        means = [f"{key} {np.mean([one[key] for one in runs]):.3f}" for key in KEYS]
        print(f"{case.name} on {log.name}: {', '.join(means)}", flush=True)
    return found


def assessed(case, steps, seeds):
    """What is written of a case: values, errors, evidence and map errors."""
    fit, judged, parts = learnt(case, 0, steps)
    found = uncertainty.assess(fit, parts, seeds=2)
    known = {n: float(e) for n, e, f in zip(fit.names, found.standard_error, found.free_error,
                                            strict=True) if f < uncertainty.OPEN}  # fmt: skip
    PARAMS.mkdir(exist_ok=True)
    save_params(PARAMS / f"learnt_{case.name}.toml", fit.params, known)
    choices = {"default": fit.start, "learnt": fit.params}
    if case.published is not None:
        choices["published"] = fit.start._replace(**case.published)
    return {
        "values": {
            n: [getattr(fit.start, n), getattr(fit.params, n), known.get(n), verdict]
            for n, verdict in zip(fit.names, found.verdict, strict=True)
        },
        "true_gain_rot": [
            fit_odometry(log, case.spacing)[0].get("gain_rot") for log in case.train
        ],
        "made": found.covariance_method, "log_z_sd": found.log_z_sd, "seconds": fit.seconds,
        "steps": fit.steps, "unresolved": list(found.unresolved),
        "evidence": {
            name: learn.evidence(judged, fit.config, params, len(seeds), 77).tolist()
            for name, params in choices.items()
        },
        "runs": {name: judge(case, params, seeds) for name, params in choices.items()},
    }  # fmt: skip


def table(results):
    """Markdown of everything."""
    for name, found in results.items():
        evidence = found["evidence"]
        better = {
            other: sum(a > b for a, b in zip(evidence["learnt"], evidence[other], strict=True))
            for other in evidence if other != "learnt"
        }  # fmt: skip
        yield f"## {name}\n"
        yield (
            f"{found['steps']} steps in {found['seconds']:.0f} s; log Z spreads by "
            f"{found['log_z_sd']:.1f} nats; standard errors: {found['made']}\n"
        )
        yield "| parameter | start | learnt | standard error | verdict |\n|---|--:|--:|--:|---|"
        for n, (start, value, error, verdict) in found["values"].items():
            error = "-" if error is None else f"{error:.2g}"
            yield f"| {n} | {start:.4g} | {value:.4g} | {error} | {verdict} |"
        gains = ", ".join("?" if gain is None else f"{gain:.3f}" for gain in found["true_gain_rot"])
        yield from [
            "",
            f"True poses as far apart as the frames learnt from give gain_rot {gains}.\n",
        ]
        yield from [*found["unresolved"], ""]
        yield (
            "Held-out evidence [nats], mean over seeds: "
            + ", ".join(f"{n} {np.mean(v):.0f}" for n, v in evidence.items())
            + "; learnt is better in "
            + ", ".join(
                f"{count} of {len(evidence['learnt'])} seeds ({other})"
                for other, count in better.items()
            )
            + "\n"
        )
        yield "| held-out log | parameters | " + " | ".join(KEYS) + " |"
        yield "|---|---|" + "--:|" * len(KEYS)
        for choice, logs in found["runs"].items():
            for log, runs in logs.items():
                cells = (np.array([run[key] for run in runs], float) for key in KEYS)
                texts = (f"{c.mean():.3f} ({c.min():.3f}-{c.max():.3f})" for c in cells)
                yield f"| {log} | {choice} | " + " | ".join(texts) + " |"
        yield ""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--cases", nargs="+", help="names of the cases to run")
    parser.add_argument("--steps", type=int, default=60)
    args = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", os.cpu_count())
    file = RESULTS / "learn_real.json"
    results = json.loads(file.read_text()) if file.exists() else {}
    for case in cases():
        if args.cases and case.name not in args.cases:
            continue
        results[case.name] = assessed(case, args.steps, args.seeds)
        file.write_text(json.dumps(results, indent=1) + "\n")
        (RESULTS / "learn_real.md").write_text("\n".join(table(results)))
    print(*table(results), sep="\n")


if __name__ == "__main__":
    main()
