"""Does the odometry's rate change the evidence? `python experiments/thinning.py` (about 3 minutes).

One simulated log (67 Hz odometry, a frame a second, `range_bearing`) is described in several ways:
its odometry thinned to 10 and to 5 Hz, each row the mean velocities of its interval; and the filter
stepping at 67, 10 and 5 Hz between the frames, without looking. Noise whose variance grows linearly
makes these the same model, so the mean log evidence must agree within its spread over the seeds.
Writes experiments/results/thinning.json and .md. tests/test_thinning.py does a small part of it.
"""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import filter as fastslam
from jaxslam.config import Config, Params, default_params
from jaxslam.frames import frames
from jaxslam.simulate import planar

RESULTS = Path(__file__).parent / "results"
RATES = (67, 10, 5)  # Hz, of odometry rows and of steps
CHUNK = 64  # steps per compiled scan, so that one compilation serves all


def simulate(seconds, closed_loop=False, seed=0):
    """A log in which the evidence hangs on the motion noise, which is large.

    A controller that answers to the noise (`closed_loop`) adds turns to and fro that cancel out in
    the mean of a thinned row, and with them the noise they bring.
    """
    return planar(
        "room", seed, length_m=0.5 * seconds, odometry_hz=67, rate_hz=1, landmarks=36,
        closed_loop=closed_loop, err_tran=0.1, err_rot=0.3, err_drift=0.1, floor_tran=0.05,
        floor_rot=0.05, sigma_range=0.2, sigma_bearing=0.06, max_per_frame=6,
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
    data = frames(more, config.sensor, config.measurements, params, config.association == "known")
    active = np.isin(time, log.frame_time)
    return data.odometry, data.measurements._replace(active=active)


def evidences(log, odometry_rate, step_rate, config, seeds):
    """Log evidence of the log for every seed; rates None: as it is, and frames alone."""
    params = default_params(config.sensor, log)
    thinned = thin(log, odometry_rate) if odometry_rate else log
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


def arms():
    """(odometry Hz, step Hz); the first is the reference."""
    return [(None, None), *[(r, None) for r in RATES[1:]], *[(None, r) for r in RATES], (5, 10)]


def compare(log, config, seeds):
    rows = []
    for i, (odometry, step) in enumerate(arms()):
        # Fresh seeds for every arm: the same ones would share their draws.
        values = evidences(log, odometry, step, config, np.arange(seeds) + 1000 * i)
        rows.append(dict(odometry_hz=odometry or RATES[0], step_hz=step, values=values.tolist()))
        rows[-1] |= dict(mean=values.mean(), sd=values.std(ddof=1))
        rows[-1] |= dict(z=z_score(values, np.array(rows[0]["values"])) if i else 0.0)
    return rows


def main():
    seconds, seeds, lines, content = 40, 20, [], []
    lines = [f"Log evidence, {seconds} s, a frame a second, {seeds} seeds each.", ""]
    lines += ["| identities | driven | odometry Hz | steps Hz | mean | SD | z to the first |"]
    lines += ["|---|---|--:|--:|--:|--:|--:|"]
    for association, closed_loop in (
        ("known", False),
        ("maximum_likelihood", False),
        ("known", True),
    ):
        config = Config(association=association, particles=2000, landmarks=48, measurements=6)
        rows = compare(simulate(seconds, closed_loop), config, seeds)
        names = association.replace("maximum_likelihood", "hidden"), closed_loop
        content.append(dict(identities=names[0], closed_loop=closed_loop, rows=rows))
        for row in rows:
            lines.append(
                "| {} | {} | {odometry_hz} | {} | {mean:.2f} | {sd:.2f} | {z:+.1f} |".format(
                    names[0],
                    "by truth" if closed_loop else "blindly",
                    row["step_hz"] or "frames",
                    **row,
                )
            )
            print(lines[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "thinning.md").write_text("\n".join(lines) + "\n")
    (RESULTS / "thinning.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
