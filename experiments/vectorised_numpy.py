"""FastSLAM 1.0 in vectorised NumPy, float32: a contender of step_time.py and scaling.py.

The filter's rules for `range_bearing` with unknown identities, clutter, exclusive matching and
existence, or with known ones and clutter, written from their description over arrays [particles,
landmarks]; gains 1, no mounting, no growth, resampling every step. A state is poses [3, N], the map
[6, N, M] (x, y, xx, xy, yy, log-odds; known: without these) and the times seen [N, M]. Numbers are
Python floats: NumPy's own would make it float64.
"""

import math

import numpy as np


def step(state, odometry, z, p, rng, block, ids=None):
    """One step with measurements z [K, 2], `block` particles at a time: state and mean pose [3].

    `ids` [K]: the landmarks measured, where that is known.
    """
    pose, world, count = state
    pose, n = move(pose, odometry, p, rng), pose.shape[1]
    density = []
    for i in (slice(i, i + block) for i in range(0, n, block)):
        part = pose[:, i], world[:, i], count[i]
        density.append(observe(*part, z, p) if ids is None else named(*part, z, ids, p))
    ancestors, mean = drawn(pose, np.concatenate(density), rng)
    return (pose[:, ancestors], world[:, ancestors], count[ancestors]), mean


def drawn(pose, density, rng):
    """Ancestors [N] by systematic resampling, and the weighted mean pose [3] before it."""
    n = len(density)
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    heading = np.arctan2(weight @ np.sin(pose[2]), weight @ np.cos(pose[2]))
    mean = np.array([weight @ pose[0], weight @ pose[1], heading])
    total = np.cumsum(weight, dtype=float)
    at = (np.arange(n) + rng.random()) / n * total[-1]
    return np.minimum(np.searchsorted(total, at, side="right"), n - 1), mean


def wrap(angle):
    return angle - 2 * math.pi * np.floor((angle + math.pi) * (1 / (2 * math.pi)))


def move(pose, o, p, rng):
    """Poses after an arc (lever 1/2)."""
    n = rng.standard_normal(pose.shape, dtype=np.float32)
    drift = p.err_drift**2 * o.distance + p.floor_rot**2 * o.duration
    spin, floor = p.err_rot**2 * o.turn, p.floor_tran**2 * o.duration
    rest = o.dx**2 * (drift / 12 + o.lever_var * spin) + floor
    along = o.dx + math.sqrt(p.err_tran**2 * o.distance + floor) * n[0]
    error = math.sqrt(drift + spin) * n[1]
    side = o.dx / 2 * error + math.sqrt(rest) * n[2]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = pose[0] + c * along - s * side, pose[1] + s * along + c * side
    return np.stack([x, y, wrap(pose[2] + o.dtheta + error)])


def observe(pose, world, count, z, p):
    """Log densities [n]; the map changes in place."""
    seen = predict(*world[:5], pose[:, :, None], p)
    new = [math.log1p(-p.outlier) + math.log(p.density_new * r) for r in z[:, 0]]
    clutter = math.log(p.outlier / ((p.view_max - p.view_min) * p.view_range))
    slot = associate(score(seen, count > 0, z, p), np.maximum(new, clutter).astype(np.float32))
    before, matched = count > 0, np.zeros(count.shape, bool)
    density = update(pose, world, count, matched, slot, z, p)
    born = (slot < 0) & (np.array(new) >= clutter)
    density += np.where(born, new, np.where(slot < 0, clutter, 0)).sum(1)
    for i, k in np.argwhere(born):  # rare
        create(pose[:, i], world[:, i], count[i], z[k], p)
    r, bearing = seen[:2]
    expected = (bearing >= p.view_min) & (bearing <= p.view_max) & (r < p.view_range) & before
    chance = p.detection * np.maximum(1 - r * (1 / p.view_range), 0)
    lowered = world[5] + p.existence_miss * np.log1p(-chance)
    raised = np.minimum(world[5] + p.existence_seen, p.existence_max)
    world[5] = np.where(matched, raised, np.where(expected, lowered, world[5]))
    count[world[5] < 0] = 0
    return density


def predict(x, y, xx, xy, yy, pose, p):
    """Range, bearing, rows of the Jacobian, innovation covariance; everything broadcasts."""
    dx, dy = x - pose[0], y - pose[1]
    r = np.sqrt(dx * dx + dy * dy)
    a, b = dx / r, dy / r
    c, d = -b / r, a / r
    s00 = a * a * xx + 2 * a * b * xy + b * b * yy + p.sigma_range**2
    s01 = a * c * xx + (a * d + b * c) * xy + b * d * yy
    s11 = c * c * xx + 2 * c * d * xy + d * d * yy + p.sigma_bearing**2
    return r, wrap(np.arctan2(dy, dx) - pose[2]), (a, b, c, d), (s00, s01, s11)


def score(seen, occupied, z, p):
    """Log densities [n, K, M] of every measurement under every landmark, -inf for empty slots."""
    r, bearing, _, (s00, s01, s11) = seen
    det = np.where(occupied, s00 * s11 - s01 * s01, 1)
    inlier = math.log1p(-p.outlier) - math.log(2 * math.pi)
    constant = np.where(occupied, inlier - 0.5 * np.log(det), -np.inf)[:, None]
    q00, q01, q11 = (q[:, None] for q in (-0.5 * s11 / det, s01 / det, -0.5 * s00 / det))
    v0, v1 = z[:, :1] - r[:, None], wrap(z[:, 1:] - bearing[:, None])
    return constant + v0 * (q00 * v0 + q01 * v1) + q11 * v1 * v1


def associate(table, threshold):
    """Slot [n, K] of each measurement or -1, no slot twice: a particle's best pair comes first."""
    slot = table.argmax(2)
    top = np.take_along_axis(table, slot[..., None], 2)[..., 0]
    slot[top <= threshold] = -1
    order = np.sort(slot, 1)
    torn = np.flatnonzero(((order[:, 1:] == order[:, :-1]) & (order[:, 1:] >= 0)).any(1))
    if len(torn) == 0:
        return slot
    rest, lanes = table[torn], np.arange(len(torn))  # few: these one pair after the other
    rest[rest <= threshold[:, None]] = -np.inf
    slot[torn] = -1
    for _ in threshold:
        k, m = np.divmod(rest.reshape(len(torn), -1).argmax(1), rest.shape[2])
        good = rest[lanes, k, m] > -np.inf
        slot[torn[good], k[good]] = m[good]
        rest[lanes, k] = rest[lanes, :, m] = -np.inf
    return slot


def update(pose, world, count, matched, slot, z, p):
    """EKF updates in the measurements' order, on the matched landmarks only: log densities [n]."""
    density = np.zeros(len(slot), np.float32)
    for k in range(len(z)):
        i = np.flatnonzero(slot[:, k] >= 0)
        at = i, slot[i, k]
        new, log_density = corrected([part[at] for part in world[:5]], pose[:, i], z[k], p)
        for part, value in zip(world, new, strict=False):
            part[at] = value
        density[i] += log_density
        count[at] += 1
        matched[at] = True
    return density


def named(pose, world, count, z, ids, p):
    """Log densities [n] with measurement k of landmark ids[k], no two of the same: all at once."""
    old = world[:, :, ids]
    new, density = corrected(old, pose[:, :, None], z.T, p)
    clutter = math.log(p.outlier / ((p.view_max - p.view_min) * p.view_range))
    good = density >= clutter
    world[:, :, ids] = np.where(good, np.stack(new), old)
    count[:, ids] += good
    return np.maximum(density, clutter).sum(1)


def corrected(old, pose, z, p):
    """Landmarks (x, y, xx, xy, yy) after measurements z (range, bearing), and log densities."""
    x, y, vx, vxy, vy = old
    r, bearing, (a, b, c, d), (s00, s01, s11) = predict(*old, pose, p)
    det = s00 * s11 - s01 * s01
    e0, e1 = z[0] - r, wrap(z[1] - bearing)
    square = (s11 * e0 * e0 - 2 * s01 * e0 * e1 + s00 * e1 * e1) / det
    px0, py0, px1, py1 = vx * a + vxy * b, vxy * a + vy * b, vx * c + vxy * d, vxy * c + vy * d
    gx0, gx1 = (px0 * s11 - px1 * s01) / det, (px1 * s00 - px0 * s01) / det
    gy0, gy1 = (py0 * s11 - py1 * s01) / det, (py1 * s00 - py0 * s01) / det
    new = (
        x + gx0 * e0 + gx1 * e1,
        y + gy0 * e0 + gy1 * e1,
        vx - gx0 * px0 - gx1 * px1,
        vxy - gx0 * py0 - gx1 * py1,
        vy - gy0 * py0 - gy1 * py1,
    )
    inlier = math.log1p(-p.outlier) - math.log(2 * math.pi)
    return new, inlier - 0.5 * (square + np.log(det))


def create(pose, world, count, z, p):
    """A landmark in the lowest free slot of one particle, if there is one."""
    free = np.flatnonzero(count == 0)
    if len(free):
        (r, angle), across = z + [0, pose[2]], (z[0] * p.sigma_bearing) ** 2
        c, s, along = math.cos(angle), math.sin(angle), p.sigma_range**2
        xx, yy = c * c * along + s * s * across, s * s * along + c * c * across
        mean = pose[0] + r * c, pose[1] + r * s
        world[:, free[0]] = *mean, xx, c * s * (along - across), yy, p.existence_new
        count[free[0]] = 1
