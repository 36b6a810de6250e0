"""FastSLAM 1.0 in plain NumPy, one particle at a time: the reference of the JAX filter.

Written directly from the paper (section III): loops over particles, measurements and landmarks,
float64. It imports nothing of the filter, so that an error would have to be made twice, in two
ways, to stay undetected. SI units, radians, counter-clockwise, x forward.
"""

import copy
import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from jaxslam.reference import ekf

NEW, CLUTTER, PADDING = -1, -2, -3
MOST_DULLED = 1e4  # largest factor of a variance, when the robot stands


@dataclass(eq=False)
class Particle:
    """One hypothesis of the path, with the map that follows from it (paper, eq. 6)."""

    pose: np.ndarray  # [3] x, y, theta in the world
    landmarks: list  # one entry per slot: Landmark or None
    log_weight: float


class BaselineResult(NamedTuple):
    """One row per step. Particles are in the order after the step's resampling in `poses` and
    `log_weight`, and before it in `best`, `match`, `slot`, `births`, `freed` and `overflow`."""

    pose_mean: np.ndarray  # [T, 3]
    cov: np.ndarray  # [T, 3, 3]
    best: np.ndarray  # [T] the heaviest particle
    ess: np.ndarray  # [T]
    ancestors: np.ndarray  # [T, N]
    resampled: np.ndarray  # [T]
    log_evidence: np.ndarray  # [T]
    nonfinite: np.ndarray  # [T] particles whose weight was not finite
    degenerate: np.ndarray  # [T] no particle had a finite weight
    match: np.ndarray  # [T, N, K] slot, or -1 new, -2 clutter, -3 padding
    slot: np.ndarray  # [T, N, K] slot matched or created, -1 none
    landmark_id: np.ndarray  # [T, N, K] as match, but the landmark id instead of its slot
    held: np.ndarray  # [T, M] slots that some particle used, before the step's resampling
    births: np.ndarray  # [T, N] new landmarks
    freed: np.ndarray  # [T, N] landmarks forgotten
    overflow: np.ndarray  # [T, N] landmarks lost because no slot was free
    poses: np.ndarray  # [T, 3, N]
    log_weight: np.ndarray  # [T, N]
    particles: list  # of Particle, after the last step


def numbers(record):
    """Convert the fields of a NamedTuple or of a plain object to float64 arrays, by name."""
    fields = record._asdict() if hasattr(record, "_asdict") else vars(record)
    return {name: np.asarray(value, float) for name, value in fields.items()}


def make_model(params, config):
    """Merge `Params` and `Config` into one record; without clutter `outlier` is 0.

    `sigma_bearing` includes `extra_bearing_noise` [rad], an independent error.
    """
    values = {name: float(value) for name, value in numbers(params).items()}
    model = SimpleNamespace(**values | vars(config))
    model.sigma_bearing = math.sqrt(model.sigma_bearing**2 + model.extra_bearing_noise**2)
    if not model.clutter:
        model.outlier = 0.0
    return model


def start(pose, cov, normals, slots):
    """Draw particles around the start pose: pose + L n with L L' = cov [3, 3]; all maps are empty.

    L is the Cholesky factor of a positive definite cov, else V sqrt(max(w, 0)).
    """
    try:
        root = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(cov)
        root = vectors * np.sqrt(np.maximum(values, 0))
    poses = [pose + root @ n for n in normals.T]
    weight = -math.log(len(poses))
    return [Particle(np.append(p[:2], ekf.wrap(p[2])), [None] * slots, weight) for p in poses]


def move(pose, o, normals, model):
    """Draw from p(x_k | x_{k-1}, u_k): the paper's eq. 2 and section III-C (fig. 9).

    `o`: a step of `Odometry`, in the robot's frame at the interval's start.
    """
    length = math.hypot(o.dx, o.dy)
    chord = math.atan2(o.dy, o.dx) if length > 0 else 0.0
    chord += o.lever * (model.gain_rot - 1) * o.dtheta + model.bias_drift * o.distance / 2
    length *= model.gain_tran
    turn = model.gain_rot * o.dtheta + model.bias_drift * o.distance

    var_x = model.err_tran**2 * o.distance + model.floor_tran**2 * o.duration
    var_drift = model.err_drift**2 * o.distance + model.floor_rot**2 * o.duration
    var_rot = model.err_rot**2 * o.turn
    var_theta = var_drift + var_rot
    cov = length * (var_drift / 2 + o.lever * var_rot)  # of heading and lateral error
    var_y = length**2 * (var_drift / 3 + (o.lever**2 + o.lever_var) * var_rot)
    var_y += model.floor_tran**2 * o.duration
    shared = cov / math.sqrt(var_theta) if var_theta > 0 else 0.0
    rest = var_y - (cov**2 / var_theta if var_theta > 0 else 0.0)

    forward = length + math.sqrt(var_x) * normals[0]
    left = shared * normals[1] + math.sqrt(max(rest, 0.0)) * normals[2]
    theta = ekf.wrap(pose[2] + turn + math.sqrt(var_theta) * normals[1])
    return np.append(pose[:2] + ekf.rotation(pose[2] + chord) @ [forward, left], theta)


def alternatives(measurement, model):
    """Log weights of a measurement as a new landmark and as clutter."""
    width, reach = model.view_max - model.view_min, model.view_range
    if model.sensor == "range_bearing":
        area, volume = measurement.value[0], width * reach
    elif model.sensor == "position":
        area, volume = 1.0, width * reach**2 / 2
    else:
        area, volume = reach**2 / 2, width
        if model.association == "maximum_likelihood":
            # A bearing has no position: at most one new landmark per frame is expected.
            area = min(area, 1 / (width * model.density_new))
    new = np.log(1 - model.outlier) + np.log(model.density_new * area)
    return new, np.log(model.outlier) - np.log(volume) if model.clutter else -np.inf


def score_table(particle, frame, s, model):
    """Log weight of each measurement [row] as one of each slot [M], -inf where it is empty."""
    table = np.full((len(frame), len(particle.landmarks)), -np.inf)
    for slot, landmark in enumerate(particle.landmarks):
        if landmark is None:
            continue
        expected = ekf.predict(landmark, s, model)
        for row, measurement in enumerate(frame):
            log_density = ekf.innovation(landmark, measurement, expected, model)[2]
            table[row, slot] = np.log(1 - model.outlier) + log_density
    return table


def associate_likeliest(table, new, clutter, exclusive):
    """Maximum likelihood for every measurement (paper, eq. 6 and section III-D): slot per row.

    Pairs better than both alternatives are taken best first; if `exclusive`, no slot twice.
    """
    choice = [NEW if n >= c else CLUTTER for n, c in zip(new, clutter, strict=True)]
    pairs = [tuple(pair) for pair in np.argwhere(table > np.maximum(new, clutter)[:, None])]
    rows, slots = set(), set()
    for row, slot in sorted(pairs, key=lambda pair: -table[pair]):
        if row not in rows and not (exclusive and slot in slots):
            choice[row] = int(slot)
            rows.add(row)
            slots.add(slot)
    return choice


def associate_known(particle, frame, table, clutter):
    """Match identity i to slot i; only a measurement of a landmark in the map can be clutter."""
    choice = []
    for row, measurement in enumerate(frame):
        i = measurement.identity
        if i >= len(particle.landmarks) or particle.landmarks[i] is None:
            choice.append(NEW)
        else:
            choice.append(CLUTTER if clutter[row] > table[row, i] else i)
    return choice


def free_slot(particle, measurement, free, model):
    """Slot for a new landmark: its identity's, else the next of `free`; -1 if there is none."""
    if model.association == "known":
        return measurement.identity if measurement.identity < len(particle.landmarks) else -1
    return next(free, -1)


def forget(particle, before, matched, s, model):
    """Raise the existence log-odds of measured landmarks, lower those of expected but missed ones,
    and drop landmarks below zero. Returns how many."""
    freed = 0
    for slot in before:
        landmark = particle.landmarks[slot]
        expected = ekf.predict(landmark, s, model)
        ahead = model.view_min <= expected.bearing <= model.view_max
        if slot in matched:
            landmark.log_odds = min(landmark.log_odds + model.existence_seen, model.existence_max)
        elif ahead and expected.range < model.view_range:
            p = model.detection * max(0.0, 1 - expected.range / model.view_range)
            landmark.log_odds += model.existence_miss * np.log1p(-p)
        if landmark.log_odds < 0:
            particle.landmarks[slot] = None
            freed += 1
    return freed


def with_extra_noise(model, o):
    """Increase the noise for errors correlated over `correlation` metres of path; a radian of turn
    counts as 0.1 m.

    An AR(1) process with e-folding path L, sampled every d: the mean of many samples has the
    variance of white noise of (1 + a) / (1 - a) times the variance, with a = exp(-d / L).
    """
    if model.correlation == 0:
        return model
    alike = math.exp(
        -min(max((o.distance + o.turn / 10) / model.correlation, 2 / MOST_DULLED), 20.0)
    )
    ratio = (1 + alike) / (1 - alike)
    noisy = ("sigma_range", "sigma_bearing", "landmark_extent", "position_scale")
    louder = {name: getattr(model, name) * math.sqrt(ratio) for name in noisy}
    return SimpleNamespace(**vars(model) | louder)


def correct(particle, frame, columns, index, model, dull, held):
    """Process all measurements of frame `index`: associate, weigh, update, create, forget.

    Paper, section III-D. Changes the particle in place; returns match [K], slot [K], landmark id
    [K] and how many landmarks were forgotten. `dull`: the model with correlated noise, for
    landmarks measured again. `held` [M]: slots in use by some particle, not for new landmarks.
    """
    free = iter(np.flatnonzero(~held).tolist())
    s = ekf.sensor_pose(particle.pose, model)
    before = [i for i, landmark in enumerate(particle.landmarks) if landmark is not None]
    table = score_table(particle, frame, s, model)
    new, clutter = np.reshape([alternatives(z, model) for z in frame], (-1, 2)).T
    if model.association == "known":
        choice = associate_known(particle, frame, table, clutter)
    else:
        choice = associate_likeliest(table, new, clutter, model.exclusive)

    match, used, landmark_id = [PADDING] * columns, [-1] * columns, [PADDING] * columns
    for row, measurement in enumerate(frame):
        k, slot = measurement.k, choice[row]
        match[k] = slot
        landmark_id[k] = particle.landmarks[slot].landmark_id if slot >= 0 else slot
        if slot == CLUTTER:
            particle.log_weight += clutter[row]
        elif slot == NEW:
            particle.log_weight += new[row]
            used[k] = free_slot(particle, measurement, free, model)
            if used[k] >= 0:
                newborn = ekf.create(measurement, s, index * columns + k, model)
                particle.landmarks[used[k]] = newborn
        else:
            used[k] = slot
            log_density = ekf.update(particle.landmarks[slot], measurement, s, dull)
            particle.log_weight += np.log(1 - model.outlier) + log_density
    freed = forget(particle, before, choice, s, model) if model.forgetting else 0
    return match, used, landmark_id, freed


def in_use(particles):
    """Mask [M] of slots in which some particle has a landmark."""
    return np.array([[m is not None for m in p.landmarks] for p in particles]).any(0)


def normalise(particles):
    """Normalize the weights; their sum is the step's evidence, the denominator of eq. 5."""
    weights = np.array([particle.log_weight for particle in particles])
    lost = ~np.isfinite(weights)
    weights[lost] = -np.inf
    top, evidence = weights.max(), -np.inf
    if lost.all():
        weights[:] = -np.log(len(weights))
    else:
        evidence = top + np.log(np.exp(weights - top).sum())
        weights -= evidence
    for particle, weight in zip(particles, weights, strict=True):
        particle.log_weight = float(weight)
    return {"log_evidence": evidence, "nonfinite": lost.sum(), "degenerate": lost.all()}


def estimate(particles, weights):
    """Weighted mean (circular for headings), covariance, heaviest particle and ESS."""
    weight, pose = weights / weights.sum(), np.array([p.pose for p in particles])
    mean = weight @ pose
    mean[2] = math.atan2(weight @ np.sin(pose[:, 2]), weight @ np.cos(pose[:, 2]))
    error = pose - mean
    error[:, 2] = ekf.wrap(error[:, 2])
    cov = (error * weight[:, None]).T @ error
    return {"pose_mean": mean, "cov": cov, "best": weight.argmax(), "ess": 1 / (weights @ weights)}


def resample(particles, weights, uniform):
    """Resample systematically: child i copies the first particle j with c_j > (i + uniform) / N."""
    count, c = len(weights), np.cumsum(weights) / np.sum(weights)
    last = int(np.flatnonzero(weights)[-1])  # in case rounding takes (i + u) / N up to c's end
    ancestors = [min(int(np.sum(c <= (i + uniform) / count)), last) for i in range(count)]
    children = [copy.deepcopy(particles[j]) for j in ancestors]
    for child in children:
        child.log_weight = -math.log(count)
    return children, ancestors


def map_of(particle, sensor):
    """The particle's map: a list of (slot, mean [2], covariance [2, 2]), world, m."""
    landmarks = [(i, mark) for i, mark in enumerate(particle.landmarks) if mark is not None]
    return [(slot, *ekf.point_of(landmark, sensor)) for slot, landmark in landmarks]


def read_frame(measurements, t, model):
    """Read the valid measurements of frame t, in order, each with k, value [d], cov, identity."""
    frame, scale = [], getattr(measurements, "scale", None)
    for k in np.flatnonzero(np.asarray(measurements.valid[t])):
        value = np.array(measurements.value[t][k], float)[: 1 if model.sensor == "bearing" else 2]
        if scale is not None and scale[t][k]:  # a position triangulated from odometry
            value *= model.gain_tran
        xx, xy, yy = np.array(measurements.cov[t][k], float)
        cov, identity = np.array([[xx, xy], [xy, yy]]), int(measurements.identity[t][k])
        if model.association == "known" and identity < 0:
            raise ValueError(f"frame {t}, measurement {k}: identity {identity}, `known` needs >= 0")
        frame.append(SimpleNamespace(k=int(k), value=value, cov=cov, identity=identity))
    return frame


def step(particles, odometry, frame, columns, index, normals, uniform, model, held=None):
    """Perform one step of FastSLAM (paper, eqs. 4 and 5): new particles, and a row of the result.

    `frame` None: no measurement, the robot only moves. `held` [M]: the slots in use, from the row
    of the step before (None: those of the particles).
    """
    held = in_use(particles) if held is None else held
    for particle, n in zip(particles, normals.T, strict=True):
        particle.pose = move(particle.pose, odometry, n, model)
    nothing = [PADDING] * columns, [-1] * columns, [PADDING] * columns, 0
    outcomes = [nothing] * len(particles)
    row = {"log_evidence": 0.0, "nonfinite": 0, "degenerate": False}
    if frame is not None:
        dull = with_extra_noise(model, odometry)
        outcomes = [correct(p, frame, columns, index, model, dull, held) for p in particles]
        held = in_use(particles)
        row = normalise(particles)
    match, slot, landmark_id, freed = (np.array(part) for part in zip(*outcomes, strict=True))
    row |= {"match": match, "slot": slot, "landmark_id": landmark_id, "freed": freed, "held": held}
    row["births"] = np.sum((match == NEW) & (slot >= 0), axis=1)
    row["overflow"] = np.sum((match == NEW) & (slot < 0), axis=1)

    weights = np.exp([particle.log_weight for particle in particles])
    row |= estimate(particles, weights)
    limit, ancestors = model.resample_threshold, np.arange(len(particles))
    resampled = frame is not None and (row["ess"] < limit * len(particles) or limit >= 1)
    if resampled:
        particles, ancestors = resample(particles, weights, uniform)
    row |= {"resampled": resampled, "ancestors": ancestors}
    row["poses"] = np.array([particle.pose for particle in particles]).T
    row["log_weight"] = [particle.log_weight for particle in particles]
    return particles, row


def run(
    odometry,
    measurements,
    params,
    config,
    start_pose,
    start_cov,
    start_normals,
    normals,
    uniforms,
    first_step=0,
    progress=None,
):
    """Filter a log with the random draws start_normals [3, N], normals [T, 3, N], uniforms [T].

    Inputs are read by attribute: the filter's types or plain objects. `first_step`: number of the
    first frame. `progress(done, total)` is called after every step.
    """
    model, rows, drive = make_model(params, config), [], numbers(odometry)
    given = [np.asarray(part, float) for part in (start_pose, start_cov, start_normals)]
    particles = start(*given, config.landmarks)
    steps, columns = np.shape(measurements.valid)
    with np.errstate(divide="ignore", invalid="ignore"):  # log 0 is a weight like any other
        for t in range(steps):
            u = SimpleNamespace(**{name: float(value[t]) for name, value in drive.items()})
            frame = read_frame(measurements, t, model) if measurements.active[t] else None
            draws = np.asarray(normals[t], float), float(uniforms[t])
            held = rows[-1]["held"] if rows else None
            particles, row = step(particles, u, frame, columns, first_step + t, *draws, model, held)
            rows.append(row)
            if progress is not None:
                progress(t + 1, steps)
    table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return BaselineResult(**table, particles=particles)
