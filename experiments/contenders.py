"""What step_time.py and scaling.py let run beside one another: a log, and the filters.

A contender is a function of a frame (z [K, 2], identities [K]) that does one step and returns the
mean pose, and one that counts the landmarks of a particle's map. The threads and cores to be used
are set by the importing script, before.
"""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import vectorised_numpy

from jaxslam.filter import step as fastslam
from jaxslam.models.motion import Odometry
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import Params, default_params
from jaxslam.reference import ekf
from jaxslam.reference import fastslam as baseline
from jaxslam.runs import memory

DRIVE = Odometry(0.1, 0.0, 0.01, 0.1, 0.01, 0.2, 0.5, 1 / 12)  # 0.1 m and 0.01 rad in 0.2 s
KNOWN_TO = 0.05  # m, standard deviation of the given map
PARAMS = default_params("range_bearing")._replace(
    sigma_range=0.1, sigma_bearing=float(np.deg2rad(1)), landmark_extent=0.0, view_range=12.0
)
SIDE = 40  # of the largest map, in landmarks
LOOP_PARTICLES = 4
BLOCK = 500  # particles at once in the blocked NumPy filter: the fastest of 16 to 10,000


def simulate(landmarks, measurements, steps, seed=0):
    """Given map [M, 2], true map [M, 2], true poses [T, 3], and of each frame, (range, bearing)
    [T, K, 2] and identities [T, K].

    A small map is the middle of a large one, and what is seen of it, the nearest, is the same.
    """
    rng = np.random.default_rng(seed)
    nodes = 2.0 * np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), -1).reshape(-1, 2)
    nodes += 1 - SIDE
    ring = np.argsort(np.abs(nodes).max(1), kind="stable")[:landmarks]
    true = (nodes + rng.uniform(-0.4, 0.4, nodes.shape))[ring]
    given = true + rng.normal(0, KNOWN_TO, nodes.shape)[ring]
    pose, poses, frames, named = np.zeros(3), [], [], []
    for _ in range(steps):
        pose = pose + [0.1 * np.cos(pose[2]), 0.1 * np.sin(pose[2]), DRIVE.dtheta]
        apart = true - pose[:2]
        ids = rng.permutation(np.argsort(np.hypot(*apart.T))[:measurements])
        apart = apart[ids]
        clean = np.column_stack([np.hypot(*apart.T), np.arctan2(*apart.T[::-1]) - pose[2]])
        noise = rng.normal(0, [PARAMS.sigma_range, PARAMS.sigma_bearing], clean.shape)
        poses.append(pose)
        frames.append(clean + noise)
        named.append(ids)
    return given, true, np.array(poses), np.array(frames, np.float32), np.array(named, np.int32)


def of_jax(marks, config, params=PARAMS, donated=True):
    """The public `jaxslam.step`, its state donated or not; also the bytes of its `State`."""
    key, k, known = jax.random.key(0), config.measurements, config.association == "known"
    odometry, params = jax.tree.map(jnp.asarray, (DRIVE, Params(*map(float, params))))
    hidden = np.full(k, -1, "i")

    def frame(z, ids):
        ids = np.asarray(ids, "i") if known else hidden
        z, cov = np.asarray(z, "f"), np.zeros((k, 3), "f")
        return Measurements(z, cov, ids, np.ones(k, bool), np.array(True))

    factor = np.array([[KNOWN_TO], [0], [KNOWN_TO]]) * np.ones(len(marks))
    init = partial(fastslam.init, config, landmarks_given=(marks.T, factor))
    shapes = jax.eval_shape(init, key)
    size = memory.bytes_of(shapes)
    step = jax.jit(
        fastslam.step, static_argnames="config", donate_argnames="state" if donated else ()
    )
    step = partial(step, config=config)
    if config.devices == 1:  # before the state is there, as a run does: compiling takes memory, too
        given = key, shapes, odometry, frame(np.zeros((k, 2)), hidden), params
        step = step.func.lower(*given, config).compile()
        memory.trim_heap()
    state = init(key)

    def advance(z, ids):
        nonlocal state
        state, info = jax.block_until_ready(step(key, state, odometry, frame(z, ids), params))
        return info.estimate.mean

    def held():
        return float((fastslam.settle(state, config).landmarks.count > 0).sum(0).mean())

    return advance, held, size


def _arrays(marks, config):
    """Poses, map and counts as the vectorised filters have them."""
    n, known = config.particles, config.association == "known"
    world = np.zeros((5 if known else 6, n, len(marks)), np.float32)
    world[:2] = marks.T[:, None]
    world[[2, 4]] = KNOWN_TO**2
    if not known:
        world[5] = np.inf
    return np.zeros((3, n), np.float32), world, np.ones((n, len(marks)), np.int32)


def of_numpy(marks, config, params=PARAMS, block=BLOCK):
    state, rng = _arrays(marks, config), np.random.default_rng(1)
    known = config.association == "known"

    def advance(z, ids):
        nonlocal state
        ids = ids if known else None
        state, mean = vectorised_numpy.step(state, DRIVE, z, params, rng, block, ids)
        return mean

    return advance, lambda: float((state[2] > 0).sum(1).mean())


def of_numba(marks, config, params=PARAMS):
    """Raises `ImportError` where numba is not installed."""
    import vectorised_numba

    state, rng = _arrays(marks, config), np.random.default_rng(1)
    spare, known = tuple(map(np.zeros_like, state[1:])), config.association == "known"

    def advance(z, ids):
        nonlocal state, spare
        ids = ids if known else None
        state, spare, mean = vectorised_numba.step(state, spare, DRIVE, z, params, rng, ids)
        return mean

    return advance, lambda: float((state[2] > 0).sum(1).mean())


def of_loop(marks, config, params=PARAMS):
    """The baseline, on `LOOP_PARTICLES`."""
    n, rng = LOOP_PARTICLES, np.random.default_rng(2)
    model, cov = baseline.make_model(params, config), KNOWN_TO**2 * np.eye(2)
    known = config.association == "known"

    def given(i, mark):
        return ekf.Landmark(mark, cov, np.zeros(2), 1, params.existence_max, -4 - i)

    maps = [[given(i, mark) for i, mark in enumerate(marks)] for _ in range(n)]
    particles = [baseline.Particle(np.zeros(3), each, -np.log(n)) for each in maps]
    index = 0

    def advance(z, ids):
        nonlocal particles, index
        ids = ids if known else np.full(len(z), -1)
        rows = enumerate(zip(z.astype(float), ids, strict=True))
        frame = [SimpleNamespace(k=k, value=value, identity=i) for k, (value, i) in rows]
        draws = rng.standard_normal((3, n)), rng.random()
        particles, row = baseline.step(particles, DRIVE, frame, len(z), index, *draws, model)
        index += 1
        return row["pose_mean"]

    return advance, lambda: np.mean([sum(m is not None for m in p.landmarks) for p in particles])
