"""Time of one filter step beside NumPy's: `python experiments/step_time.py` (about 1 minute).

`range_bearing`, identities unknown, resampling every step, default `Config`, a given map, one core.
Contenders take turns in one process: the public `jaxslam.filter.step`, plainly called and with its
state donated; a vectorised NumPy filter in float32, on all particles at once and in blocks that fit
the cache; and the loop baseline, on a few particles.
At the default sizes it writes experiments/results/step_time.json and .md. `--quick`: a small trial.
"""

import argparse
import json
import os
import time
from pathlib import Path
from types import SimpleNamespace

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before JAX and BLAS make their threads
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}

import jax
import jax.numpy as jnp
import numpy as np
import vectorised_numpy

from jaxslam import baseline, baseline_ekf
from jaxslam import filter as fastslam
from jaxslam.config import Config, Params, default_params
from jaxslam.motion import Odometry
from jaxslam.sensors import Measurements

RESULTS = Path(__file__).parent / "results"
DRIVE = Odometry(0.1, 0.0, 0.01, 0.1, 0.01, 0.2, 0.5, 1 / 12)  # 0.1 m and 0.01 rad in 0.2 s
KNOWN_TO = 0.05  # m, standard deviation of the given map
PARAMS = default_params("range_bearing")._replace(
    sigma_range=0.1, sigma_bearing=float(np.deg2rad(1)), growth=0.0, view_range=12.0
)
SIZES = dict(particles=10000, landmarks=100, measurements=20)
LOOP_PARTICLES = 4
BLOCK = 500  # particles at once in the blocked NumPy filter: the fastest of 16 to 10,000
LOOP = "loop baseline"


def simulate(landmarks, measurements, steps, seed=0):
    """Given map [M, 2], true poses [T, 3], and each frame's (range, bearing) [T, K, 2]."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(landmarks)))
    nodes = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:landmarks]
    marks = 2.0 * nodes + 1 - side + rng.uniform(-0.4, 0.4, nodes.shape)
    pose, poses, frames = np.zeros(3), [], []
    for _ in range(steps):
        pose = pose + [0.1 * np.cos(pose[2]), 0.1 * np.sin(pose[2]), DRIVE.dtheta]
        apart = marks - pose[:2]
        apart = apart[rng.permutation(np.argsort(np.hypot(*apart.T))[:measurements])]
        clean = np.column_stack([np.hypot(*apart.T), np.arctan2(*apart.T[::-1]) - pose[2]])
        noise = rng.normal(0, [PARAMS.sigma_range, PARAMS.sigma_bearing], clean.shape)
        poses.append(pose)
        frames.append(clean + noise)
    return marks + rng.normal(0, KNOWN_TO, marks.shape), np.array(poses), np.array(frames)


def jax_contender(marks, config, donated):
    """A function of a frame z [K, 2] that does one step and returns the mean pose."""
    factor = np.array([[KNOWN_TO], [0], [KNOWN_TO]]) * np.ones(len(marks))
    key = jax.random.key(0)
    state = fastslam.init(config, key, landmarks_given=(marks.T, factor))
    odometry, params = jax.tree.map(jnp.asarray, (DRIVE, Params(*map(float, PARAMS))))
    step = fastslam.step
    if donated:
        step = jax.jit(step, static_argnames="config", donate_argnames="state")
    k = config.measurements
    rest = np.zeros((k, 3), "f"), np.full(k, -1, "i"), np.ones(k, bool), np.array(True)

    def advance(z):
        nonlocal state
        frame = Measurements(z.astype("f"), *rest)
        state, info = jax.block_until_ready(step(key, state, odometry, frame, params, config))
        return info.estimate.mean

    return advance, lambda: float((fastslam.settled(state).landmarks.count > 0).sum(0).mean())


def numpy_contender(marks, config, block):
    n, rng = config.particles, np.random.default_rng(1)
    world = np.zeros((6, n, len(marks)), np.float32)
    world[:2] = marks.T[:, None]
    world[[2, 4]], world[5] = KNOWN_TO**2, PARAMS.existence_max
    state = np.zeros((3, n), np.float32), world, np.ones((n, len(marks)), np.int32)

    def advance(z):
        nonlocal state
        state, mean = vectorised_numpy.step(state, DRIVE, z.astype("f"), PARAMS, rng, block)
        return mean

    return advance, lambda: float((state[2] > 0).sum(1).mean())


def loop_contender(marks, config):
    n, rng = LOOP_PARTICLES, np.random.default_rng(2)
    model, cov = baseline.make_model(PARAMS, config), KNOWN_TO**2 * np.eye(2)

    def known(i, mark):
        return baseline_ekf.Landmark(mark, cov, np.zeros(2), 1, PARAMS.existence_max, -4 - i)

    maps = [[known(i, mark) for i, mark in enumerate(marks)] for _ in range(n)]
    particles = [baseline.Particle(np.zeros(3), each, -np.log(n)) for each in maps]
    index = 0

    def advance(z):
        nonlocal particles, index
        frame = [SimpleNamespace(k=k, value=value, identity=-1) for k, value in enumerate(z)]
        draws = rng.standard_normal((3, n)), rng.random()
        particles, row = baseline.step(particles, DRIVE, frame, len(z), index, *draws, model)
        index += 1
        return row["pose_mean"]

    return advance, lambda: np.mean([sum(m is not None for m in p.landmarks) for p in particles])


def measure(given):
    """One row per contender: times, and how far its last mean pose is off the truth."""
    frames = 1 + given.rounds * given.steps
    marks, truth, seen = simulate(given.landmarks, given.measurements, frames)
    sizes = {name: getattr(given, name) for name in SIZES}
    config = Config(**sizes, resample_threshold=1.0)
    contenders = {
        "jaxslam, state donated": jax_contender(marks, config, True),
        "jaxslam, plain call": jax_contender(marks, config, False),
        "vectorised NumPy": numpy_contender(marks, config, given.particles),
        "the same, in blocks": numpy_contender(marks, config, BLOCK),
        LOOP: loop_contender(marks, config),
    }
    poses = {name: advance(seen[0]) for name, (advance, _) in contenders.items()}  # compiles
    times = {name: [] for name in contenders}
    for round_ in range(given.rounds):
        for name, (advance, _) in contenders.items():
            for t in range(1 + round_ * given.steps, 1 + (round_ + 1) * given.steps):
                begin, begin_cpu = time.perf_counter(), time.process_time()
                poses[name] = advance(seen[t])
                now = time.perf_counter(), time.process_time()
                times[name].append((now[0] - begin, now[1] - begin_cpu))
    rows = []
    for name, (_, occupied) in contenders.items():
        wall, cpu = 1e3 * np.array(times[name]).T
        particles = LOOP_PARTICLES if name == LOOP else given.particles
        apart = np.asarray(poses[name], float) - truth[-1]
        rows.append(
            dict(name=name, particles=particles, steps=len(wall), min_ms=wall.min(),
                 median_ms=np.median(wall), cpu_median_ms=np.median(cpu),
                 ns=1e6 * np.median(wall) / particles / given.measurements,
                 error_m=np.hypot(*apart[:2]), error_rad=abs(apart[2]), landmarks=occupied())
        )  # fmt: skip
    return rows


def report(rows, machine, given):
    """Text; ratios are of medians per particle (of minima in brackets) to jaxslam's, donated."""
    lines = [
        f"One step of {given.particles} particles, {given.landmarks} landmarks,"
        f" {given.measurements} measurements; {machine}",
        "",
        "| | particles | steps | min ms | median ms | CPU ms | ns per particle × measurement"
        " | time / jaxslam's | pose off by | landmarks |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        share = row["particles"] / rows[0]["particles"]
        ratio, least = (row[k] / share / rows[0][k] for k in ("median_ms", "min_ms"))
        lines.append(
            "| {name} | {particles} | {steps} | {min_ms:.1f} | {median_ms:.1f} |"
            " {cpu_median_ms:.1f} | {ns:.0f} |".format(**row)
            + f" {ratio:.3g} ({least:.3g}) |"
            + " {error_m:.3f} m, {error_rad:.4f} rad | {landmarks:.1f} |".format(**row)
        )
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in SIZES.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=3, help="of each contender in a round")
    parser.add_argument("--quick", action="store_true", help="500 particles, 2 rounds")
    given = parser.parse_args()
    if given.quick:
        given.particles, given.rounds = 500, 2
    rows = measure(given)
    cpu = Path("/proc/cpuinfo").read_text().split("model name\t: ")[-1].splitlines()[0]
    machine = f"one core of {cpu}, jax {jax.__version__}, numpy {np.__version__}"
    print(text := report(rows, machine, given))
    if all(getattr(given, name) == size for name, size in SIZES.items()):
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "step_time.md").write_text(text)
        content = json.dumps(dict(machine=machine, given=vars(given), rows=rows), indent=1)
        (RESULTS / "step_time.json").write_text(content + "\n")
    for row in rows:  # a contender that went wrong did other work than the rest
        limit = 0.2 if row["name"] == LOOP else 0.05
        assert row["error_m"] < limit and row["error_rad"] < limit, row


if __name__ == "__main__":
    main()
