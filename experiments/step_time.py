"""Time of one filter step beside NumPy's: `python experiments/step_time.py` (about 3 minutes).

`range_bearing`, identities unknown, resampling every step, default `Config`, a given map, one core.
Contenders take turns, step by step, in one process: the public `jaxslam.filter.step`, plainly
called and with its state donated; a vectorised NumPy filter in float32 (below), on all particles at
once and in blocks that fit the cache; and the loop baseline with a few particles.
Writes experiments/results/step_time.json and .md. `--quick` for a trial, which writes nothing.
"""

import argparse
import json
import os
import time
from pathlib import Path

os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # before JAX and BLAS make their threads
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
os.environ |= {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam import baseline, baseline_ekf
from jaxslam import filter as fastslam
from jaxslam.config import Config, Params, default_params
from jaxslam.motion import Odometry
from jaxslam.sensors import Measurements

RESULTS = Path(__file__).parent / "results"
DRIVE = Odometry(0.1, 0.0, 0.01, 0.1, 0.01, 0.2, 0.5, 1 / 12)  # 0.1 m and 0.01 rad in 0.2 s
KNOWN_TO = 0.05  # m, standard deviation of the given map
PARAMS = default_params("range_bearing")._replace(
    sigma_range=0.1, sigma_bearing=np.deg2rad(1.0), growth=0.0, view_range=12.0
)


def world(landmarks, measurements, steps, seed=0):
    """Given map [M, 2], true poses [T, 3], and each frame's (range, bearing) [T, K, 2]."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(landmarks)))
    nodes = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:landmarks]
    marks = 2.0 * nodes + 1 - side + rng.uniform(-0.4, 0.4, nodes.shape)
    pose, poses, frames = np.zeros(3), [], []
    for _ in range(steps):
        chord = pose[2] + DRIVE.dtheta / 2
        pose = pose + [DRIVE.dx * np.cos(chord), DRIVE.dx * np.sin(chord), DRIVE.dtheta]
        apart = marks - pose[:2]
        apart = apart[rng.permutation(np.argsort(np.hypot(*apart.T))[:measurements])]
        clean = np.column_stack([np.hypot(*apart.T), np.arctan2(*apart.T[::-1]) - pose[2]])
        noise = rng.normal(0, [PARAMS.sigma_range, PARAMS.sigma_bearing], clean.shape)
        poses.append(pose)
        frames.append(clean + noise)
    return marks + rng.normal(0, KNOWN_TO, marks.shape), np.array(poses), np.array(frames)


# --- Vectorised NumPy: the same rules, written from their description --------------------------


def wrap(angle):
    return angle - np.float32(2 * np.pi) * np.floor((angle + np.float32(np.pi)) / (2 * np.pi))


def move(pose, p, rng):
    """Poses [3, N] after `DRIVE` (lever 1/2, gains 1)."""
    o, n = DRIVE, rng.standard_normal(pose.shape, dtype=np.float32)
    drift = p.err_drift**2 * o.distance + p.floor_rot**2 * o.duration
    spin, floor = p.err_rot**2 * o.turn, p.floor_tran**2 * o.duration
    along = o.dx + np.sqrt(p.err_tran**2 * o.distance + floor) * n[0]
    error = np.sqrt(drift + spin) * n[1]
    rest = o.dx**2 * (drift / 3 + (o.lever**2 + o.lever_var) * spin) + floor
    rest -= (o.dx / 2) ** 2 * (drift + spin)
    side = o.dx / 2 * error + np.sqrt(rest) * n[2]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = pose[0] + c * along - s * side, pose[1] + s * along + c * side
    return np.stack([x, y, wrap(pose[2] + o.dtheta + error)]).astype(np.float32)


def predict(x, y, xx, xy, yy, pose, p):
    """Range, bearing, Jacobian rows and innovation covariance; everything broadcasts."""
    dx, dy = x - pose[0], y - pose[1]
    r = np.sqrt(dx * dx + dy * dy)
    a, b = dx / r, dy / r
    c, d = -b / r, a / r
    s00 = a * a * xx + 2 * a * b * xy + b * b * yy + p.sigma_range**2
    s01 = a * c * xx + (a * d + b * c) * xy + b * d * yy
    s11 = c * c * xx + 2 * c * d * xy + d * d * yy + p.sigma_bearing**2
    return r, wrap(np.arctan2(dy, dx) - pose[2]), (a, b, c, d), (s00, s01, s11)


def associate(table, threshold):
    """Slot [n, K] of each measurement or -1, no slot twice: the best pair of a particle first."""
    table = np.where(table > threshold[:, None], table, -np.inf)
    slot = table.argmax(2)
    slot[np.take_along_axis(table, slot[..., None], 2)[..., 0] == -np.inf] = -1
    order = np.sort(slot, 1)
    torn = np.flatnonzero(((order[:, 1:] == order[:, :-1]) & (order[:, 1:] >= 0)).any(1))
    rest, lanes = table[torn], np.arange(len(torn))
    slot[torn] = -1
    while len(torn) and (top := rest.reshape(len(torn), -1).argmax(1)) is not None:
        k, m = np.divmod(top, table.shape[2])
        good = rest[lanes, k, m] > -np.inf
        if not good.any():
            break
        slot[torn[good], k[good]] = m[good]
        rest[lanes, k], rest[lanes, :, m] = -np.inf, -np.inf
    return slot


def observe(pose, marks, count, z, p):
    """Log densities [n]; map [6, n, M] (x, y, xx, xy, yy, log-odds) and `count` change in place."""
    x, y, xx, xy, yy, odds = marks
    lane, inlier = np.arange(len(count)), np.log1p(-p.outlier)
    r, bearing, _, (s00, s01, s11) = predict(*marks[:5], pose[:, :, None], p)
    occupied = count > 0
    det = np.where(occupied, s00 * s11 - s01 * s01, 1)
    constant = np.where(occupied, inlier - np.log(2 * np.pi) - 0.5 * np.log(det), -np.inf)
    q00, q01, q11 = (q[:, None] for q in (-0.5 * s11 / det, s01 / det, -0.5 * s00 / det))
    v0 = z[:, :1] - r[:, None]
    v1 = wrap(z[:, 1:] - bearing[:, None])
    table = constant[:, None].astype(np.float32) + v0 * (q00 * v0 + q01 * v1) + q11 * v1 * v1
    new = inlier + np.log(p.density_new * z[:, 0])
    clutter = np.log(p.outlier / ((p.view_max - p.view_min) * p.view_range))
    slot = associate(table, np.maximum(new, clutter))
    density, matched = np.zeros(len(lane), np.float32), np.zeros_like(occupied)
    for k in range(len(z)):
        i = lane[slot[:, k] >= 0]
        j = slot[i, k]
        old = x[i, j], y[i, j], xx[i, j], xy[i, j], yy[i, j]
        rk, bk, (a, b, c, d), (t00, t01, t11) = predict(*old, pose[:, i], p)
        det = t00 * t11 - t01 * t01
        e0, e1 = z[k, 0] - rk, wrap(z[k, 1] - bk)
        square = (t11 * e0 * e0 - 2 * t01 * e0 * e1 + t00 * e1 * e1) / det
        density[i] += inlier - np.log(2 * np.pi) - 0.5 * (square + np.log(det))
        px0, py0 = old[2] * a + old[3] * b, old[3] * a + old[4] * b
        px1, py1 = old[2] * c + old[3] * d, old[3] * c + old[4] * d
        gx0, gx1 = (px0 * t11 - px1 * t01) / det, (px1 * t00 - px0 * t01) / det
        gy0, gy1 = (py0 * t11 - py1 * t01) / det, (py1 * t00 - py0 * t01) / det
        x[i, j], y[i, j] = old[0] + gx0 * e0 + gx1 * e1, old[1] + gy0 * e0 + gy1 * e1
        xx[i, j] = old[2] - gx0 * px0 - gx1 * px1
        xy[i, j], yy[i, j] = old[3] - gx0 * py0 - gx1 * py1, old[4] - gy0 * py0 - gy1 * py1
        count[i, j] += 1
        matched[i, j] = True
    unmatched = slot < 0
    born = unmatched & (new >= clutter)
    density += np.where(born, new, np.where(unmatched, clutter, 0)).sum(1)
    for i, k in np.argwhere(born):  # rare
        free = np.flatnonzero(count[i] == 0)
        if len(free):
            count[i, free[0]], matched[i, free[0]] = 1, True
            far, angle = z[k, 0], pose[2, i] + z[k, 1]
            c, s, across = np.cos(angle), np.sin(angle), (far * p.sigma_bearing) ** 2
            cov = np.array([[c, -s], [s, c]]) * [p.sigma_range**2, across] @ [[c, s], [-s, c]]
            mean = pose[0, i] + far * c, pose[1, i] + far * s
            marks[:, i, free[0]] = *mean, *cov.ravel()[[0, 1, 3]], p.existence_new
    expected = (bearing >= p.view_min) & (bearing <= p.view_max) & (r < p.view_range) & occupied
    miss = p.existence_miss * np.log1p(-p.detection * np.maximum(0, 1 - r / p.view_range))
    odds += np.where(expected & ~matched, miss, 0)
    raised = np.minimum(odds + p.existence_seen, p.existence_max)
    odds[...] = np.where(matched & occupied, raised, odds)
    count[odds < 0] = 0
    return density


def numpy_step(state, z, p, rng, block):
    """One step of the whole filter, `block` particles at a time: new state and mean pose [3]."""
    pose, marks, count = state
    pose, n = move(pose, p, rng), pose.shape[1]
    parts = [slice(i, i + block) for i in range(0, n, block)]
    density = np.concatenate([observe(pose[:, i], marks[:, i], count[i], z, p) for i in parts])
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    heading = np.arctan2(weight @ np.sin(pose[2]), weight @ np.cos(pose[2]))
    mean = np.array([weight @ pose[0], weight @ pose[1], heading])
    total = np.cumsum(weight, dtype=float)
    at = (np.arange(n) + rng.random()) / n * total[-1]
    ancestors = np.minimum(np.searchsorted(total, at, side="right"), n - 1)
    return (pose[:, ancestors], marks[:, ancestors], count[ancestors]), mean
