"""Time to learn five parameters from 1,000 frames: `python experiments/learn_time.py`.

The score climbed by `learn.fit`, against what a user would do instead: Nelder-Mead, told nothing of
derivatives, on our likelihood with a fixed seed, and on the NumPy baseline's. One simulated log,
identities known, 200 particles; every parameter starts a factor e off (the gain: 0.2), up or down.
Judged on another log of the same truth with seeds neither has seen; the judging isn't timed.
Seconds are those of the processor, so that other work on the machine counts little. The baseline is
too slow to climb on: its likelihood is timed on a part of the log. Writes results/learn_time.md.
"""

import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from jaxslam.config import Config
from jaxslam.filter.frames import frames_from_log
from jaxslam.learning import fit as learn
from jaxslam.learning import likelihood, transforms
from jaxslam.parameters import Params, default_params
from jaxslam.reference import compare, fastslam
from jaxslam.simulation import planar

RESULT = Path(__file__).parent / "results" / "learn_time.md"
TRUTH = dict(err_tran=0.05, err_drift=0.05, sigma_range=0.1, sigma_bearing=0.03, gain_rot=1.0)
NAMES = tuple(TRUTH)
OFF = np.array([1.0, -1.0, 1.0, -1.0, 2.0])  # free scale
SIMPLEX = np.array([0.5, 0.5, 0.5, 0.5, 0.1])  # a cautious user's first steps, same scale
FRAMES, PART, JUDGES, NEAR, STEPS, RATE, MOST = 1000, 100, 8, 2.0, 60, 0.15, 300  # NEAR: nats
CONFIG = Config(
    association="known", proposal="informed", particles=200, landmarks=20, measurements=8,
    clutter=False,
)  # fmt: skip


HEAD = "| method | evaluations | CPU s | held-out evidence | CPU s until near | evaluations |"
TOLD = """`python experiments/learn_time.py`: five parameters from {} frames of a simulated log, 200
particles, identities known. CPU seconds, compiled already (compiling: value {:.1f} s, score {:.1f}
s); all of it, with judging: {:.0f} CPU s, {:.0f} s by the clock of a shared machine. Held-out: log
evidence of another log, mean over {} seeds ± s.e. Near: within {:g} nats of learn.fit's last;
looked at every 5 steps, every 20 values. The baseline was not climbed on, its seconds are an
estimate: {:.0f} s per value, scaled from the first {} frames, times the values needed on our
likelihood (its own, with the prior proposal, is noisier)."""


class Point(NamedTuple):
    evaluations: int  # so far
    seconds: float  # of the processor, so far
    free: np.ndarray  # [P] the estimate then


def world(seed):
    return planar.planar(
        "field", seed, landmarks=20, length_m=FRAMES / 10 + 0.05, rate_hz=5.0, odometry_hz=10.0,
        max_per_frame=8, closed_loop=False, outlier=0.0, **TRUTH,
    )  # fmt: skip


def likelihood_of(log, params):
    """Log likelihood of a log as a function of free values and a key."""
    data = likelihood.data_from_log(log, CONFIG, params)

    def value(free, key):
        given = transforms.with_free(params, NAMES, np.asarray(free, np.float32))
        return float(likelihood.value(Params(*map(jnp.float32, given)), data, key, CONFIG))

    return value


def judged(held_out, free):
    """Mean and standard error over seeds of the held-out evidence."""
    keys = jax.random.split(jax.random.key(2026), JUDGES)
    values = np.array([held_out(free, key) for key in keys])
    return values.mean(), values.std(ddof=1) / np.sqrt(JUDGES)


def first_call(call):
    """CPU seconds that a first call takes longer than a second."""
    at = [time.process_time()]
    for _ in range(2):
        call()
        at.append(time.process_time())
    return 2 * at[1] - at[0] - at[2]


def fitted(log, params, seeds):
    """`Point`s of `learn.fit`, every 5 steps: the mean of the last iterates, its estimate."""
    begin, clock = time.process_time(), []
    fit = learn.fit(
        [log], CONFIG, params, NAMES, seeds=seeds, steps=STEPS, rate=RATE,
        progress=lambda *_: clock.append(time.process_time() - begin),
    )  # fmt: skip
    points = []
    for step in range(5, STEPS, 5):
        first = step + 1 - max(1, int(learn.TAIL * step))
        tail = fit.history.free[first : step + 1].mean(0)
        points.append(Point(step * seeds, clock[step - 1], tail))
    return [*points, Point(STEPS * seeds, clock[-1], fit.free)]


def searched(value, start):
    """`Point`s of Nelder-Mead, every 20 evaluations: the best so far."""
    key, begin, tried = jax.random.key(0), time.process_time(), []

    def loss(free):
        found = -value(free, key)
        tried.append((found, free.copy(), time.process_time() - begin))
        return found if np.isfinite(found) else 1e9

    simplex = start + np.vstack([np.zeros(len(start)), np.diag(SIMPLEX)])
    options = dict(initial_simplex=simplex, maxfev=MOST, xatol=0.02, fatol=1.0)
    minimize(loss, start, method="Nelder-Mead", options=options)
    counts = (*range(20, len(tried), 20), len(tried))
    return [Point(c, tried[c - 1][2], min(tried[:c], key=lambda t: t[0])[1]) for c in counts]


def baseline_seconds(log, params):
    """CPU seconds of the baseline's likelihood of the whole log, from its first `PART` frames."""
    log = compare.select_frames(log, np.arange(PART))
    data = frames_from_log(log, CONFIG, params)
    rng, count = np.random.default_rng(0), CONFIG.particles
    draws = rng.normal(size=(3, count)), rng.normal(size=(PART, 3, count)), rng.uniform(size=PART)
    begin = time.process_time()
    start = log.start_pose, log.start_cov
    fastslam.run(data.odometry, data.measurements, params, CONFIG, *start, *draws)
    return (time.process_time() - begin) * FRAMES / PART


def row(name, kind, points, held_out, target):
    """A line of the table; `target`: held-out evidence to come near, None for that of the row."""
    last, (mean, error) = points[-1], judged(held_out, points[-1].free)
    target = mean if target is None else target
    reached = (p for p in points[:-1] if judged(held_out, p.free)[0] >= target - NEAR)
    there = next(reached, last if mean >= target - NEAR else None)
    near = f"{there.seconds:.0f} | {there.evaluations}" if there else "not reached |"
    print(name, dict(zip(NAMES, np.round(np.exp(last.free), 4), strict=True)), flush=True)
    cells = f"{last.evaluations} {kind} | {last.seconds:.0f} | {mean:.1f} ± {error:.1f} | {near} |"
    print(f"| {name} | {cells}", flush=True)
    return f"| {name} | {cells}", mean


def main():
    jax.config.update("jax_enable_compilation_cache", False)  # compiling is to be timed
    began = time.perf_counter(), time.process_time()
    log, other = world(5), world(6)
    truth = default_params(CONFIG.sensor, log)
    true = transforms.free_vector(truth, NAMES)
    start = Params(*map(float, transforms.with_free(truth, NAMES, true + OFF)))
    value, held_out = likelihood_of(log, truth), likelihood_of(other, truth)
    of_value = first_call(lambda: value(true, jax.random.key(1)))
    of_score = first_call(lambda: learn.fit([log], CONFIG, start, NAMES, seeds=1, steps=1))
    mean, error = judged(held_out, true)
    lines = [HEAD, "|---" + "|--:" * 5 + "|", f"| the truth | | | {mean:.1f} ± {error:.1f} | | |"]
    each = baseline_seconds(log, truth)
    print(of_value, of_score, each, *lines, sep="\n", flush=True)
    line, target = row("learn.fit", "scores", fitted(log, start, 1), held_out, None)
    points = searched(value, true + OFF)
    lines += [line, row("Nelder-Mead, our likelihood", "values", points, held_out, target)[0]]
    count = points[-1].evaluations
    cells = f"{count} values | {count * each:.0f} | not run | | |"
    lines.append(f"| Nelder-Mead, NumPy baseline (estimate) | {cells}")
    wall, busy = time.perf_counter() - began[0], time.process_time() - began[1]
    told = TOLD.format(FRAMES, of_value, of_score, busy, wall, JUDGES, NEAR, each, PART)
    print(told, "", *lines, sep="\n")
    RESULT.write_text("\n".join([told, "", *lines]) + "\n")


if __name__ == "__main__":
    main()
