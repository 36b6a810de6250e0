"""Are the intervals of learnt parameters honest? 100 simulated logs, each learnt on its own.

Truths are drawn from a prior; every log is learnt from a start that is a factor e (for gains: 0.2)
off in every parameter, up or down at random; then the errors are estimated, the statistical and the
Monte-Carlo part. Over all logs and the parameters that each log resolves: the share of 95 %
intervals that cover the truth, and the root mean square of (estimate - truth) / error.

    python experiments/recovery.py --case bearing     # bearings, identities known
    python experiments/recovery.py --case hidden      # ranges and bearings, identities hidden

Nothing stands within 0.5 m of the robot's path: of a landmark driven over bearings lose track.

All logs are worked on in one compiled program, on as many CPU devices as there are cores. Writes
experiments/results/recovery_CASE.csv and .txt; a run that was cut off goes on from its .npz.
"""

import argparse
import csv
import os
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxslam.config import Config
from jaxslam.files import atomic_write
from jaxslam.learning import fit, likelihood, transforms, uncertainty
from jaxslam.parameters import TABLE, Params, default_params
from jaxslam.simulation import planar

RESULTS = Path(__file__).parent / "results"
NOISE = {
    "err_tran": (0.05, 0.4),
    "err_drift": (0.05, 0.4),
    "sigma_bearing": (0.03, 0.4),
    "sigma_range": (0.1, 0.4),
    "gain_rot": (1.0, 0.1),
}  # median of the prior, and its standard deviation in logarithms
CASES = {
    "bearing": ("bearing", "known", ("err_tran", "err_drift", "sigma_bearing", "gain_rot")),
    "hidden": ("range_bearing", "sampled", tuple(NOISE)),
}
STEPS, RATE, SEEDS = 60, 0.2, 3
NEWTON = 5  # steps after Adam's


def world(case, number):
    """A log, and the true values of what is learnt from it."""
    names, rng = CASES[case][2], np.random.default_rng([2026, number])
    truth = {n: NOISE[n][0] * float(np.exp(NOISE[n][1] * rng.standard_normal())) for n in NOISE}
    log = planar.planar(
        "field", 1000 + number, landmarks=20, length_m=30, rate_hz=2.5, odometry_hz=12.5,
        max_per_frame=8, closed_loop=False, clearance=0.5,
        outlier=0.01 if case == "hidden" else 0.0,
        view=(-np.pi, np.pi, 5.0 if case == "hidden" else 8.0), **truth,
    )  # fmt: skip
    return log, np.array([truth[n] for n in names]), rng.choice([-1, 1], len(names))


def problem(case, count):
    """Stacked logs, configuration, parameters, names, true and starting free values [L, P]."""
    sensor, association, names = CASES[case]
    worlds = [world(case, number) for number in range(count)]
    logs = [log for log, _, _ in worlds]
    hidden = association == "sampled"
    config = Config(
        sensor=sensor, association=association, proposal="informed", particles=200, measurements=8,
        landmarks=32 if hidden else 20, uniform_association_prior=hidden,
    )  # fmt: skip
    # Without any clutter one landmark that a filter lost would outweigh all else.
    outlier = 0.01 if hidden else 1e-3
    params = default_params(sensor, logs[0])._replace(density_new=1e-3, outlier=outlier)
    with jax.enable_x64(True):
        true = np.array(
            [[float(transforms.to_free(n, v)) for n, v in zip(names, t, strict=True)]
             for _, t, _ in worlds]
        )  # fmt: skip
    off = np.where([name.startswith("gain") for name in names], 0.2 / TABLE["gain_rot"].step, 1.0)
    return (
        fit.stack_logs(logs, config, params),
        config,
        params,
        names,
        true,
        true + off * np.array([sign for _, _, sign in worlds]),
    )


class Scores:
    """Scores of all logs at once, each at its own free values."""

    def __init__(self, data, config, params, names):
        self.count = len(data.start_pose)
        numbers = Params(*(jnp.asarray(v, data.start_pose.dtype) for v in params))
        self.given, self.model = (numbers, data), (config, names)

    def __call__(self, free, seeds, seed):
        """`Score` with leading axes (logs, seeds), at `free` [L, P]."""
        which = np.repeat(np.arange(self.count), seeds)
        keys = jax.random.split(jax.random.key(seed), len(which))
        found = fit.scores(
            jnp.asarray(free[which], jnp.float32), *self.given, which, keys, *self.model,
            likelihood.DISCOUNT,
        )  # fmt: skip
        return jax.tree.map(
            lambda leaf: np.asarray(leaf, float).reshape(self.count, seeds, *leaf.shape[1:]), found
        )


def climbed(scores, start, saved):
    """Free values [L, P] after Adam, the last iterates' mean. `saved`: a file to go on from."""
    adam = optax.adam(optax.cosine_decay_schedule(RATE, STEPS, fit.LAST_RATE), *fit.MOMENTS)
    free, past, state = start, [], adam.init(jnp.asarray(start, jnp.float32))
    leaves, shape = jax.tree.flatten(state)
    if saved.exists():
        with np.load(saved) as file:
            past = list(file["past"])
            free = file["free"]
            leaves = [jnp.asarray(file[f"leaf{i}"]) for i in range(len(leaves))]
            state = jax.tree.unflatten(shape, leaves)
    begin = time.perf_counter()
    for step in range(len(past), STEPS):
        score = scores(free, 1, 10_000 + step).total[:, 0]
        move, state = adam.update(-jnp.nan_to_num(jnp.asarray(score, jnp.float32)), state)
        past.append(free)
        free = free + np.asarray(move, float)
        with atomic_write(saved) as file:
            leaves = {f"leaf{i}": np.asarray(v) for i, v in enumerate(jax.tree.leaves(state))}
            np.savez(file, past=np.array(past), free=free, **leaves)
        spent = time.perf_counter() - begin
        print(f"step {step + 1}/{STEPS}, {spent:.0f} s", file=sys.stderr, flush=True)
    last = round(fit.TAIL * STEPS)
    return np.mean([*past[-last + 1 :], free], 0)


def assessed(scores, free):
    """Free values after Newton's steps, their errors [L, P] (statistical and Monte Carlo), how
    they were made, scores, and standard errors by other ways."""
    made = []
    for step in range(NEWTON):
        found = scores(free, SEEDS if step < NEWTON - 1 else 2 * SEEDS, 1 + step)
        made.append(outers_of(found))
        outers = np.mean(made, 0)  # those of few seeds are noisy
        if step < NEWTON - 1:
            free = free + stepped(outers, found)
    curves = slopes(scores, free, outers)
    slope = np.array([one[0] for one in curves])
    parts = [
        uncertainty.combine_covariances(outer, *one)
        for outer, one in zip(outers, curves, strict=True)
    ]
    covariance = np.array([part[0] for part in parts])
    used = np.array(
        [o if part[2] == "outer" else (o + s) / 2
         for o, s, part in zip(outers, slope, parts, strict=True)]
    )  # fmt: skip
    noise = [np.cov(totals.T) / len(totals) for totals in found.total]
    inverse = [uncertainty.invert(information) for information in used]
    carlo = np.array([i @ n @ i for i, n in zip(inverse, noise, strict=True)])
    statistical, carlo = (np.sqrt(np.einsum("lpp->lp", m)) for m in (covariance, carlo))
    by = {"outer": outers, "curvature": slope}
    others = {k: np.sqrt([np.diag(uncertainty.invert(m)) for m in v]) for k, v in by.items()}
    others = {k: np.hypot(error, carlo) for k, error in others.items()}
    others["no Monte-Carlo part"] = statistical
    return free + stepped(used, found), np.hypot(statistical, carlo), parts, found, others


def outers_of(found):
    """Information [L, P, P] of every log by outer products."""
    return np.array([uncertainty.outer_products(steps[None]) for steps in found.steps])


def stepped(information, found):
    """Newton's steps [L, P]."""
    means = found.total.mean(1)
    return np.array([uncertainty.newton_step(*one) for one in zip(information, means, strict=True)])


def slopes(scores, free, outers):
    """Minus the slope of every log's score, and its noise, by finite differences."""
    widths = np.array([uncertainty.half_widths(outer) for outer in outers])
    sides = []
    for i in range(free.shape[1]):
        step = np.zeros_like(free)
        step[:, i] = widths[:, i]
        sides.append([scores(free + sign * step, SEEDS, 1).total for sign in (-1, 1)])
        print(f"slope {i + 1}/{free.shape[1]}", file=sys.stderr, flush=True)
    low, high = np.moveaxis(np.array(sides), (1, 2), (0, 1))  # [2, L, P, S, P]
    return [uncertainty.curvature_at(*one) for one in zip(low, high, widths, strict=True)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--case", choices=CASES, required=True)
    parser.add_argument("--logs", type=int, default=100)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", os.cpu_count())
    *given, true, start = problem(args.case, args.logs)
    data, config, params, names = given
    scores = Scores(data, config, params, names)
    free = climbed(scores, start, args.out / f"recovery_{args.case}_{args.logs}.npz")
    estimate, error, parts, found, errors = assessed(scores, free)
    agreement = np.array([part[1] for part in parts])
    resolved = error < uncertainty.OPEN
    z = (estimate - true) / error
    name = args.out / f"recovery_{args.case}.csv"
    with open(name, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["log", "parameter", "true", "start", "estimate", "standard_error",
                         "agreement", "made", "resolved", "z"])  # fmt: skip
        for i, p in np.ndindex(*true.shape):
            row = (true[i, p], start[i, p], estimate[i, p], error[i, p], agreement[i, p])
            writer.writerow([i, names[p], *(f"{v:.4f}" for v in row), parts[i][2],
                             int(resolved[i, p]), f"{z[i, p]:.3f}"])  # fmt: skip
    lines = [*summary(names, (free, estimate, true), error, parts, found, errors)]
    (args.out / f"recovery_{args.case}.txt").write_text("\n".join(lines) + "\n")
    print(*lines, sep="\n")


def summary(names, values, error, parts, found, errors):
    """Lines: coverage and z by parameter, and with standard errors made in other ways."""
    free, estimate, true = values
    resolved = error < uncertainty.OPEN
    z, agreement = (estimate - true) / error, np.array([part[1] for part in parts])
    yield "parameter        resolved  covered   RMS z  mean z  median error  outer/curvature"
    for p, label in [*enumerate(names), (slice(None), "all")]:
        good, score = resolved[:, p], z[:, p][resolved[:, p]]
        yield (
            f"{label:16s} {good.sum():8d} {100 * np.mean(np.abs(score) < 1.96):7.1f}% "
            f"{np.sqrt(np.mean(score**2)):7.2f} {score.mean():7.2f} "
            f"{np.median(error[:, p][good]):13.3f} {np.median(agreement[:, p][good]):16.2f}"
        )
    for kind, other in errors.items():
        score = ((estimate - true) / other)[resolved]
        yield (
            f"with errors by {kind}: covered {100 * np.mean(np.abs(score) < 1.96):.1f}%, "
            f"RMS z {np.sqrt(np.mean(score**2)):.2f}"
        )
    before = ((free - true) / error)[resolved]
    yield f"before the Newton steps: RMS z {np.sqrt(np.mean(before**2)):.2f}"
    spread = np.median(found.log_likelihood.std(1, ddof=1))
    yield f"standard deviation of log Z over seeds, median of the logs: {spread:.2f} nats"
    made = [part[2] for part in parts]
    yield "errors made by " + ", ".join(f"{made.count(k)} {k}" for k in sorted(set(made)))


if __name__ == "__main__":
    main()
