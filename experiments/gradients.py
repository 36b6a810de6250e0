"""Bias and spread of the score's estimators: `python experiments/gradients.py` (about 10 minutes).

Linear SLAM: sensor `position`, heading known, identities known, no clutter. A joint Kalman filter
over the position and all landmarks has the exact log likelihood; its derivative and curvature are
taken by automatic differentiation in double precision. Simulated logs of 200 frames, 20 landmarks,
scored at the true parameters by every estimator with many seeds. Errors in units of the square root
of the exact observed information: 1 moves the estimate of a parameter by one standard error.
- bias: mean error over the seeds of a log, as its root mean square over the logs, less what the
  spread adds to it; and the largest of one log;
- spread: standard deviation over the seeds of one log, as root mean square over the logs.
Writes experiments/results/gradients.csv and .md. `--time`: value and score, side by side, instead
(hidden identities, 1,000 particles, 50 landmarks, 500 frames, 8 parameters), and their memory;
nothing is written.
"""

import argparse
import csv
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import score_estimators

from jaxslam.config import Config
from jaxslam.learning import likelihood
from jaxslam.logs.odometry import Odometry
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params
from jaxslam.simulation.planar import planar

RESULTS = Path(__file__).parent / "results"
NAMES = ("err_tran", "floor_tran", "gain_tran", "position_scale")
ESTIMATORS = (("fisher", 0.97), ("fisher", 0.9), ("fisher", 1.0), ("pathwise", 1.0), ("plain", 1.0))
PARAMS = default_params("position")._replace(
    err_tran=0.1, floor_tran=0.05, gain_tran=1.0, err_rot=0.0, err_drift=0.0, floor_rot=0.0,
    correlation=0.0, extra_bearing_noise=0.0, density_new=0.1,
)  # fmt: skip
STEPS, MARKS, MOST, RADIUS, SIGHT, NOISE = 200, 20, 6, 4.0, 5.0, 0.2  # m
DRIVE = 0.3  # m between frames
TIMED = ("err_tran", "err_rot", "err_drift", "gain_tran")
TIMED += ("sigma_range", "sigma_bearing", "outlier", "density_new")


def simulated(seed, steps=STEPS):
    """`Data` (NumPy) of a drive round and round a circle, as dead reckoning has it."""
    rng, full = np.random.default_rng(seed), np.ones(steps)
    turn = DRIVE / RADIUS
    odometry = Odometry(
        DRIVE * full, 0 * full, turn * full, DRIVE * full, turn * full, full, 0 * full, 0 * full
    )
    angle = rng.uniform(0, 2 * np.pi, MARKS)
    marks = (RADIUS + rng.uniform(-2, 2, MARKS)) * np.array([np.cos(angle), np.sin(angle)])
    place, heading = np.array([0.0, -RADIUS]), 0.0
    along = np.sqrt(PARAMS.err_tran**2 * DRIVE + PARAMS.floor_tran**2)
    value = np.zeros((steps, MOST, 2))
    identity = np.full((steps, MOST), -1, np.int32)
    for t in range(steps):
        ahead, side = DRIVE + along * rng.normal(), PARAMS.floor_tran * rng.normal()
        c, s = np.cos(heading), np.sin(heading)
        place = place + [c * ahead - s * side, s * ahead + c * side]
        heading += turn
        c, s = np.cos(heading), np.sin(heading)
        off = np.array([[c, s], [-s, c]]) @ (marks - place[:, None])
        near = np.flatnonzero(np.hypot(*off) < SIGHT)
        near = rng.permutation(near)[:MOST]
        value[t, : len(near)] = off[:, near].T + NOISE * rng.normal(size=(len(near), 2))
        identity[t, : len(near)] = near
    cov = np.tile(NOISE**2 * np.array([1.0, 0.0, 1.0]), (steps, MOST, 1))
    start = np.array([0.0, -RADIUS, 0.0])
    measurements = Measurements(value, cov, identity, identity >= 0, full > 0)
    return likelihood.Data(start, np.zeros((3, 3)), odometry, measurements)


def kalman(params, data, marks=MARKS):
    """Exact log likelihood, as `likelihood.value` estimates it, by a joint Kalman filter."""
    size = 2 + 2 * marks
    measured = data.measurements
    before = data.start_pose[2] + jnp.cumsum(data.odometry.dtheta) - data.odometry.dtheta

    def step(carry, frame):
        mean, cov, seen, total = carry
        o, m, heading = frame
        chord = heading + jnp.arctan2(o.dy, o.dx)
        ahead = jnp.array([jnp.cos(chord), jnp.sin(chord)])
        side = jnp.array([-ahead[1], ahead[0]])
        floor = params.floor_tran**2 * o.duration
        noise = (params.err_tran**2 * o.distance + floor) * jnp.outer(ahead, ahead)
        mean = mean.at[:2].add(params.gain_tran * jnp.hypot(o.dx, o.dy) * ahead)
        cov = cov.at[:2, :2].add(noise + floor * jnp.outer(side, side))
        c, s = jnp.cos(heading + o.dtheta), jnp.sin(heading + o.dtheta)
        look = jnp.array([[c, s], [-s, c]])  # world to sensor

        def one(carry, row):
            mean, cov, seen, total = carry
            z, (xx, xy, yy), identity, valid = row
            noise = params.position_scale**2 * jnp.array([[xx, xy], [xy, yy]])
            at = 2 + 2 * jnp.maximum(identity, 0) + jnp.arange(2)
            h = jnp.zeros((2, size)).at[:, :2].set(-look).at[:, at].set(look)
            rest, spread = z - h @ mean, h @ cov @ h.T + noise
            gain = cov @ h.T @ jnp.linalg.inv(spread)
            density = -0.5 * (
                rest @ jnp.linalg.solve(spread, rest) + jnp.linalg.slogdet(2 * jnp.pi * spread)[1]
            )
            old = mean + gain @ rest, cov - gain @ h @ cov, density
            begin = jnp.eye(size).at[at].set(jnp.eye(2, size))
            fresh = (begin @ mean).at[at].add(look.T @ z)
            grown = (begin @ cov @ begin.T).at[at[:, None], at].add(look.T @ noise @ look)
            new = fresh, grown, jnp.log(params.density_new)
            again = seen[jnp.maximum(identity, 0)]
            after = [jnp.where(again, a, b) for a, b in zip(old, new, strict=True)]
            after = [jnp.where(valid, a, b) for a, b in zip(after, (mean, cov, 0.0), strict=True)]
            seen = seen.at[jnp.maximum(identity, 0)].max(valid)
            return (after[0], after[1], seen, total + after[2]), None

        rows = m.value, m.cov, m.identity, m.valid
        carry, _ = jax.lax.scan(one, (mean, cov, seen, total), rows)
        return (*carry[:3], carry[3] + likelihood.frame_terms(m, params)), None

    mean = jnp.zeros(size).at[:2].set(data.start_pose[:2])
    cov = jnp.zeros((size, size)).at[:2, :2].set(data.start_cov[:2, :2])
    carry = mean, cov, jnp.zeros(marks, bool), jnp.zeros(())
    return jax.lax.scan(step, carry, (data.odometry, measured, before))[0][3]


@jax.jit
def exact(data):
    """Log likelihood, score [P] and observed information [P, P] at the true parameters."""

    def of(values):
        return kalman(PARAMS._replace(**dict(zip(NAMES, values, strict=True))), data)

    at = jnp.array([getattr(PARAMS, name) for name in NAMES])
    return of(at), jax.grad(of)(at), -jax.hessian(of)(at)


def truths(logs):
    """`Data` and what `exact` says of it, for every log."""
    data = [simulated(seed) for seed in range(logs)]
    with jax.enable_x64(True):
        return [(each, jax.tree.map(np.asarray, exact(jax.tree.map(jnp.asarray, each))))
                for each in data]  # fmt: skip


def config_of(proposal, particles, threshold=0.5):
    return Config(
        sensor="position", association="known", proposal=proposal, particles=particles,
        landmarks=MARKS, measurements=MOST, clutter=False, resample_threshold=threshold,
    )  # fmt: skip


@partial(jax.jit, static_argnames=("config", "estimator"))
def seeds(data, discount, keys, config, estimator):
    """Scores [S, P] and log likelihoods [S]."""
    params = jax.tree.map(jnp.asarray, PARAMS)

    def one(key):
        found = score_estimators.score(params, data, key, config, NAMES, estimator, discount)
        return found.total, found.log_likelihood

    return jax.lax.map(one, keys)


def measure(proposal, particles, truth, runs, threshold=0.5):
    """A row per estimator and parameter."""
    config, rows = config_of(proposal, particles, threshold), []
    keys = jax.random.split(jax.random.key(0), runs)
    for estimator, discount in ESTIMATORS:
        mean, spread, log_spread = [], [], []
        for data, (_, gradient, information) in truth:
            data = jax.tree.map(jnp.asarray, data)
            score, log_zhat = seeds(data, discount, keys, config, estimator)
            error = (np.asarray(score, float) - gradient) / np.sqrt(np.diag(information))
            mean.append(error.mean(0))
            spread.append(error.std(0, ddof=1))
            log_spread.append(np.std(log_zhat, ddof=1))
        square = np.mean(np.square(spread), 0)
        bias = np.sqrt(np.maximum(np.mean(np.square(mean), 0) - square / runs, 0))
        for i, name in enumerate(NAMES):
            rows.append(
                dict(proposal=proposal, particles=particles, estimator=estimator,
                     discount=discount if estimator == "fisher" else "", parameter=name,
                     bias=bias[i], largest_bias=max(np.abs(mean)[:, i]), spread=square[i] ** 0.5,
                     sd_log_z=np.sqrt(np.mean(np.square(log_spread))), logs=len(truth), seeds=runs)
            )  # fmt: skip
    return rows


def table(rows):
    """A line per proposal, number of particles and estimator: bias, spread of every parameter."""
    head = "| proposal | particles | SD(log Zhat) | estimator | "
    lines = [head + " | ".join(NAMES) + " |", "|---|--:|--:|---|" + "--:|" * len(NAMES)]
    for i in range(0, len(rows), len(NAMES)):
        first = rows[i]
        name = first["estimator"] + (f" {first['discount']}" if first["discount"] else "")
        cells = [
            f"{row['bias']:.2f} ({row['largest_bias']:.2f}), {row['spread']:.2f}"
            for row in rows[i : i + len(NAMES)]
        ]
        lines.append(
            f"| {first['proposal']} | {first['particles']} | {first['sd_log_z']:.1f} | {name} | "
            + " | ".join(cells) + " |"
        )  # fmt: skip
    logs, runs = rows[0]["logs"], rows[0]["seeds"]
    told = f"{logs} logs, {runs} seeds each. Bias (largest of one log), spread; in standard errors."
    return "\n".join([told, "", *lines]) + "\n"


def timed(rounds=7):
    """Prints medians of value and score, taking turns, and their temporary memory."""
    log = planar(
        "field", 0, landmarks=50, length_m=50.05, max_per_frame=8, view=(-np.pi, np.pi, 6.0),
        sigma_range=0.1,
    )  # fmt: skip
    config = Config(
        association="sampled", proposal="informed", particles=1000, landmarks=50, measurements=8,
        forgetting=False,
    )  # fmt: skip
    params = jax.tree.map(jnp.asarray, default_params("range_bearing", log))
    data, key = likelihood.data_from_log(log, config), jax.random.key(0)
    programs = {"value": likelihood.value.lower(params, data, key, config).compile()}
    for names in (TIMED[:4], TIMED):
        lowered = likelihood.score_and_value.lower(params, data, key, config, names)
        programs[f"score of {len(names)}"] = lowered.compile()
    seconds = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(program(params, data, key))
            seconds[name].append(time.perf_counter() - begin)
    for name, program in programs.items():
        median = np.median(seconds[name])
        memory = program.memory_analysis().temp_size_in_bytes / 2**20
        print(
            f"{name}: {median:.2f} s, {median / np.median(seconds['value']):.2f}, {memory:.1f} MiB"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--time", action="store_true", help="value and score side by side instead")
    parser.add_argument("--logs", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--particles", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--threshold", type=float, default=0.5, help="of resampling")
    given = parser.parse_args()
    if given.time:
        return timed()
    rows, truth = [], truths(given.logs)
    for particles in given.particles:
        for proposal in ("informed", "prior"):
            found = measure(proposal, particles, truth, given.seeds, given.threshold)
            print(table(found), flush=True)
            rows += found
    if all(getattr(given, name) == parser.get_default(name) for name in vars(given)):
        (RESULTS / "gradients.md").write_text(table(rows))
        with open(RESULTS / "gradients.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    return None


if __name__ == "__main__":
    main()
