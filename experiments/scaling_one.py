"""One measurement of scaling.py, in a process of its own so that its peak memory is its own.

    python experiments/scaling_one.py '{"who": "jaxslam", "particles": 1000, "landmarks": 100, ...}'

Prints one line of JSON. Cores and threads are limited before the first import of JAX or NumPy.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

GIVEN = json.loads(sys.argv[1]) if __name__ == "__main__" else {"cores": 1}
CORES = sorted(os.sched_getaffinity(0))
if __name__ == "__main__":
    os.sched_setaffinity(0, CORES[-GIVEN.get("cores", 1) :])
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}

import contenders
import jax
import numpy as np

from jaxslam.config import Config
from jaxslam.filter import step as fastslam
from jaxslam.runs import memory
from jaxslam.runs.memory import available_bytes

C_FOLDER = Path(__file__).resolve().parents[2] / "shared" / "bench"
C_FLAGS = "-Ofast -march=native -mprefer-vector-width=512 -fopenmp-simd"
WARM, LEAST = 2, 3  # steps before timing, and at least timed
MARGIN, OTHERS = 1.3, 2**29  # estimated peak over State, and bytes left to everything else
STREAM = 2**26  # float32 numbers of an array whose bandwidth is measured


def peak(who="jaxslam"):
    """Bytes: the largest resident set so far, or what was most in use on an accelerator."""
    if who == "jaxslam" and device():
        return device()["peak_bytes_in_use"]
    status = Path("/proc/self/status").read_text()
    return 1024 * int(re.search(r"VmHWM:\s+(\d+)", status)[1])


def device():
    """Figures of an accelerator's memory; None on a CPU, where memory is the process's."""
    return None if jax.default_backend() == "cpu" else jax.devices()[0].memory_stats()


def config_of(given):
    """`Config` of what is asked."""
    names = "particles", "landmarks", "measurements", "association", "lazy", "devices"
    return Config(**{name: given[name] for name in names}, resample_threshold=1.0)


def needed(config, who="jaxslam"):
    """Bytes of `State`, and at most needed for a run."""
    state = jax.eval_shape(lambda: fastslam.init(config, jax.random.key(0)))
    size = memory.bytes_of(state)
    if who != "jaxslam":  # a second map while resampling; NumPy all at once: tables
        n, m, k = config.particles, config.landmarks, config.measurements
        tables = 6 * 4 * n * m * k if who == "numpy" and config.association != "known" else 0
        return size, 2 * size + tables + OTHERS
    return size, MARGIN * size + OTHERS


def refusal(given):
    """Why a size cannot be measured here, or None."""
    if given["who"] == "loop":
        return None
    _, need = needed(config_of(given | {"devices": 1}), given["who"])
    if need > available_bytes():
        return f"does not fit: needs {need / 1e9:.1f} GB, {available_bytes() / 1e9:.1f} GB are free"
    return None


def timed(given):
    """Times of a contender's steps, its peak memory, and how far its last pose is off."""
    config = config_of(given)
    params = contenders.PARAMS._replace(view_range=float(given["view"]))
    steps = given["steps"] + WARM
    marks, true, poses, seen, ids = contenders.simulate(
        config.landmarks, config.measurements, steps
    )
    size, who = None, given["who"]
    if who == "jaxslam":
        advance, occupied, size = contenders.of_jax(marks, config, params)
    else:
        make = dict(
            numpy=lambda *args: contenders.of_numpy(*args, block=config.particles),
            blocks=contenders.of_numpy, numba=contenders.of_numba, loop=contenders.of_loop,
        )  # fmt: skip
        advance, occupied = make[who](marks, config, params)
    wall, cpu, begin = [], [], time.perf_counter()
    for t in range(steps):
        at = time.perf_counter(), time.process_time()
        pose = advance(seen[t], ids[t])
        wall.append(time.perf_counter() - at[0])
        cpu.append(time.process_time() - at[1])
        if t == WARM - 1:
            begin = time.perf_counter()
        if t >= WARM + LEAST - 1 and time.perf_counter() - begin > given["seconds"]:
            break
    in_view = [(np.hypot(*(true - p[:2]).T) < params.view_range).sum() for p in poses[: t + 1]]
    if who == "jaxslam" and device():
        cpu = wall
    found = {f"{how}_ms": 1e3 * getattr(np, how)(cpu[WARM:]) for how in ("min", "median")}
    found |= {f"wall_{how}_ms": 1e3 * getattr(np, how)(wall[WARM:]) for how in ("min", "median")}
    found |= dict(
        steps=len(cpu) - WARM, first_s=wall[0], state_bytes=size, peak_bytes=peak(who),
        in_view=float(np.mean(in_view)),
        error_m=float(np.hypot(*(np.asarray(pose, float) - poses[t])[:2])),
    )  # fmt: skip
    return found | dict(held=occupied() if config.particles <= 100_000 else None)


def idle(given):
    """Memory of a process that did what all do."""
    jax.block_until_ready(jax.jit(lambda x: x + 1)(np.zeros(3, "f")))
    return dict(peak_bytes=peak())


def bandwidth(given):
    """GB/s, the best of several: a copy, and an in-place sum (each reads and writes)."""
    if device():
        add = jax.jit(lambda x: x + 1, donate_argnums=0)
        held = [jax.numpy.zeros(STREAM, np.float32)]
        return dict(update=_best(lambda: held.append(add(held.pop()).block_until_ready())))
    a, b = np.zeros(STREAM, np.float32), np.ones(STREAM, np.float32)
    found = dict(copy=_best(lambda: np.copyto(a, b)), update=_best(lambda: np.add(a, 1, out=a)))
    try:
        import numba
    except ImportError:
        return found

    @numba.njit
    def add(a):
        for i in range(len(a)):
            a[i] += np.float32(1)

    add(a)
    return found | dict(update_numba=_best(lambda: add(a)))


def _best(call):
    times = []
    for _ in range(8):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return 2 * 4 * STREAM / min(times) / 1e9


def agree(given):
    """Largest difference of mean poses [m, rad] between NumPy and numba from the same draws."""
    marks, _, _, seen, ids = contenders.simulate(100, 20, 6)
    apart = 0.0
    for association in ("maximum_likelihood", "known"):
        config = Config(particles=300, landmarks=100, association=association, measurements=20)
        both = [make(marks, config)[0] for make in (contenders.of_numpy, contenders.of_numba)]
        for frame in zip(seen, ids, strict=True):
            one, other = (advance(*frame) for advance in both)
            apart = max(apart, float(np.abs(one - other).max()))
    return dict(apart=apart)


def plain_c(given):
    """The reference in C, on its own log of the same sizes; CPU ms. Nothing of it is kept."""
    if not (C_FOLDER / "cref.c").is_file():
        raise ImportError("../shared/bench is absent")
    compiler = shutil.which("gcc")
    if compiler is None:
        raise ImportError("there is no gcc")
    sys.path.insert(0, str(C_FOLDER))
    sys.dont_write_bytecode = True
    from workload import make_log, save

    with tempfile.TemporaryDirectory() as folder:
        source = [C_FOLDER / "cref.c", "-o", "cref", "-lmvec", "-lm"]
        subprocess.run([compiler, *C_FLAGS.split(), *source], cwd=folder, check=True)
        m, k = given["landmarks"], given["measurements"]
        save(make_log(m, k, T=60, seed=m + k), f"{folder}/log")
        known = given["association"] == "known"
        layout = "lazy" if known and given["lazy"] else "soa"
        rules = [layout, given["particles"], "log.bin", "known" if known else "ml", "always"]
        command = ["./cref", *map(str, rules)]
        said = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    least, median = re.search(r"cpu\(min\) ([\d.]+) us cpu\(med\) ([\d.]+)", said.stdout).groups()
    wall = re.search(r" min ([\d.]+) us", said.stdout)[1]
    steps, error = re.search(r"err ([\d.]+) .*steps (\d+)", said.stdout).groups()[::-1]
    return dict(
        min_ms=float(least) / 1e3, median_ms=float(median) / 1e3, wall_min_ms=float(wall) / 1e3,
        steps=int(steps), error_m=float(error),
    )  # fmt: skip


def main():
    if GIVEN.get("devices", 1) > 1:
        jax.config.update("jax_num_cpu_devices", GIVEN["devices"])
    other = dict(idle=idle, bandwidth=bandwidth, agree=agree, c=plain_c)
    try:
        reason = None if GIVEN["who"] in other else refusal(GIVEN)
        found = dict(note=reason) if reason else other.get(GIVEN["who"], timed)(GIVEN)
    except ImportError as missing:
        found = dict(note=f"skipped: {missing}")
    except ValueError as refused:
        found = dict(note=str(refused))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
