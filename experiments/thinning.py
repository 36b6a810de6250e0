"""Does the odometry's rate change the evidence? `python experiments/thinning.py` (about 7 minutes).

One simulated log (67 Hz odometry, a frame a second, `range_bearing`) is described in several ways:
its odometry thinned to 10 and to 5 Hz, each row the mean velocities of its interval; and the filter
stepping at 67, 10 and 5 Hz between the frames, without looking. Noise whose variance grows linearly
makes these the same model, so the mean log evidence must agree within its spread over the seeds.
To first order, that is: where the robot turns far in one interval (0.6 rad here) on large heading
noise, one step has no shortening of the chord and no spread along it, which many steps do have.
With `err_rot` alone that is 0.3 nats in 30 s (z = 6 over 60 seeds): one spread of a single run.
Writes experiments/results/thinning.json and .md.
tests/experiments/test_thinning.py does a small part of it.
"""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config import Config
from jaxslam.filter import step as fastslam
from jaxslam.filter.frames import frames_from_log
from jaxslam.parameters import Params, default_params
from jaxslam.simulation.planar import planar

RESULTS = Path(__file__).parent / "results"
RATE = 67  # Hz, of the odometry as it comes
ARMS = ((RATE, None), (10, None), (5, None), (RATE, 67), (RATE, 10), (RATE, 5))  # odometry, steps
NOISE = (  # one kind at a time, large, as a small one could hide behind another
    dict(err_tran=0.2),
    dict(err_drift=0.15),
    dict(err_rot=0.2),
    dict(floor_tran=0.1, floor_rot=0.1),
)
CHUNK = 64  # steps per compiled scan, so that one compilation serves all


def simulate(seconds, closed_loop=False, seed=0, **noise):
    """A log of little motion noise but what is given, in which the evidence hangs on that.

    A controller that answers to the noise (`closed_loop`) adds turns to and fro that cancel out in
    the mean of a thinned row, and with them the noise they bring.
    """
    quiet = dict(err_tran=0.02, err_rot=0.02, err_drift=0.02, floor_tran=0.002, floor_rot=0.002)
    return planar(
        "room", seed, length_m=0.5 * seconds, odometry_hz=RATE, rate_hz=1, landmarks=36,
        closed_loop=closed_loop, sigma_range=0.2, sigma_bearing=0.07, max_per_frame=6,
        **quiet | noise,
    )  # fmt: skip


def thin(log, rate):
    """The log with odometry rows of 1/`rate` s: mean velocities of the interval."""
    time = log.odometry_time
    edges = np.append(time, time[-1] + int(np.median(np.diff(time))))
    driven = np.vstack([[0, 0], np.cumsum(log.odometry * np.diff(edges)[:, None] / 1e9, axis=0)])
    count = int(np.ceil((edges[-1] - edges[0]) * 1e-9 * rate - 1e-6))
    cuts = np.minimum(edges[0] + np.rint(np.arange(count + 1) * 1e9 / rate), edges[-1])
    at = np.column_stack([np.interp(cuts, edges, column) for column in driven.T])
    mean = np.diff(at, axis=0) / np.diff(cuts)[:, None] * 1e9
    return dataclasses.replace(log, odometry_time=cuts[:-1].astype(np.int64), odometry=mean)


def steps(log, rate, config, params):
    """Odometry and measurements of all steps: the frames, and more at `rate` that do not look.

    `rate` None: the frames alone.
    """
    time = log.frame_time
    if rate:
        ticks = log.start + np.rint(np.arange(1, time[-1] * 1e-9 * rate) * 1e9 / rate)
        time = np.union1d(time, ticks.astype(np.int64))
    frame = np.searchsorted(time, log.frame_time)[log.frame]
    more = dataclasses.replace(log, frame_time=time, frame=frame, truth=None)
    data = frames_from_log(more, config, params)
    active = np.isin(time, log.frame_time)
    return data.odometry, data.measurements._replace(active=active)


def evidences(log, odometry_rate, step_rate, config, seeds):
    """Log evidence of the log for every seed, its odometry thinned and steps added (`steps`)."""
    params = default_params(config.sensor, log)
    thinned = log if odometry_rate == RATE else thin(log, odometry_rate)
    data = steps(thinned, step_rate, config, params)
    numbers = jax.tree.map(jnp.asarray, Params(*map(float, params)))
    total = -(-len(data[0].dx) // CHUNK) * CHUNK

    def fill(leaf):  # with steps in which nothing happens
        leaf = np.pad(leaf, [(0, total - len(leaf)), *[(0, 0)] * (leaf.ndim - 1)])
        return jnp.asarray(leaf.astype("f") if leaf.dtype.kind == "f" else leaf)

    whole, sums = jax.tree.map(fill, data), []
    for seed in seeds:
        key, log_evidence = jax.random.key(seed), 0.0
        start = log.start_pose - np.array([*log.start_pose[:2], 0])
        state = fastslam.init(config, key, start, log.start_cov)
        for at in range(0, total, CHUNK):
            part = jax.tree.map(lambda leaf, at=at: leaf[at : at + CHUNK], whole)
            state, new = fastslam.run(key, state, *part, numbers, config, log_evidence_of)
            log_evidence += float(np.sum(new, dtype=float))
        sums.append(log_evidence)
    return np.array(sums)


def log_evidence_of(info):
    return info.log_evidence


def z_score(a, b):
    """Difference of two means over its standard error."""
    return (a.mean() - b.mean()) / np.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b))


def compare(log, config, seeds, arms=ARMS):
    """A row per arm: mean and SD of the log evidence, and the z-score to the first arm's mean."""
    rows = []
    for i, (odometry, step) in enumerate(arms):
        # Other seeds for every arm: they would share their draws.
        values = evidences(log, odometry, step, config, np.arange(seeds) + seeds * i)
        first = np.array(rows[0]["values"]) if rows else values
        rows.append(
            dict(odometry_hz=odometry, step_hz=step, mean=values.mean(), sd=values.std(ddof=1),
                 z=z_score(values, first), values=values.tolist())
        )  # fmt: skip
    return rows


def main():
    seconds, seeds, content = 30, 20, []
    cases = [("known", False, noise) for noise in NOISE]
    cases += [("maximum_likelihood", False, NOISE[1]), ("known", True, NOISE[1])]
    names = [f"{o} Hz, steps {f'{s} Hz' if s else 'at frames'}" for o, s in ARMS]
    lines = [
        f"Log evidence of {seconds} s, a frame a second: mean, SD over {seeds} seeds (z to first).",
        "",
        "| identities | driven | noise | "
        + " | ".join(f"odometry {name}" for name in names)
        + " |",
        "|---|---|---|" + "--:|" * len(names),
    ]
    print(*lines, sep="\n")
    for association, closed_loop, noise in cases:
        config = Config(association=association, particles=2000, landmarks=48, measurements=6)
        rows = compare(simulate(seconds, closed_loop, **noise), config, seeds)
        names = (
            "known" if association == "known" else "hidden",
            "steered by truth" if closed_loop else "blindly",
            ", ".join(f"{name} {value}" for name, value in noise.items()),
        )
        cells = ["{mean:.2f}, {sd:.2f} ({z:+.1f})".format(**row) for row in rows]
        lines.append(f"| {' | '.join([*names, *cells])} |")
        print(lines[-1], flush=True)
        content.append(dict(zip(("identities", "driven", "noise"), names, strict=True), rows=rows))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "thinning.md").write_text("\n".join(lines) + "\n")
    (RESULTS / "thinning.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
