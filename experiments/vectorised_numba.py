"""The algorithm of vectorised_numpy.py compiled by numba, particle after particle, in float32.

A contender of scaling.py; numba is no dependency. Motion and ancestors are drawn by the NumPy
version itself, so that the same random numbers give the same particles.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
import vectorised_numpy

F = np.float32
PI, TURN, PER_TURN, HALF, TWO = F(math.pi), F(2 * math.pi), F(0.5 / math.pi), F(0.5), F(2)
LOG_2PI, NEVER = F(math.log(2 * math.pi)), F(-1e30)
# Not `ninf`: the log-odds of a given landmark are infinite.
compiled = nb.njit(fastmath={"contract", "arcp", "nsz", "reassoc", "afn"}, cache=True)


class Numbers(NamedTuple):
    """What the compiled functions take of `Params`, all float32 (a float would make all double)."""

    outlier: F
    sigma_range: F
    sigma_bearing: F
    density_new: F
    detection: F
    view_min: F
    view_max: F
    view_range: F
    existence_new: F
    existence_seen: F
    existence_miss: F
    existence_max: F


def step(state, spare, odometry, z, p, rng, ids=None):
    """As `vectorised_numpy.step`; `spare`: a map and counts to write into; returned: the next."""
    pose, world, count = state
    pose = vectorised_numpy.move(pose, odometry, p, rng)
    numbers = Numbers(*(F(getattr(p, name)) for name in Numbers._fields))
    if ids is None:
        density = observe(pose, world, count, z, numbers)
    else:
        density = named(pose, world, count, z, ids, numbers)
    ancestors, mean = vectorised_numpy.drawn(pose, density, rng)
    copy(world, count, ancestors, *spare)
    return (pose[:, ancestors], *spare), (world, count), mean


@compiled
def copy(world, count, ancestors, to_world, to_count):
    for i in range(len(ancestors)):
        for part in range(len(world)):
            to_world[part, i] = world[part, ancestors[i]]
        to_count[i] = count[ancestors[i]]


@compiled
def wrap(angle):
    return angle - TURN * np.floor((angle + PI) * PER_TURN)


@compiled
def predict(mark, x, y, heading, p):
    """Range, bearing, the Jacobian's first row (a, b), innovation covariance of a landmark [5]."""
    dx, dy = mark[0] - x, mark[1] - y
    r = math.sqrt(dx * dx + dy * dy)
    a, b = dx / r, dy / r
    c, d = -b / r, a / r
    s00 = a * a * mark[2] + TWO * a * b * mark[3] + b * b * mark[4] + p.sigma_range**2
    s01 = a * c * mark[2] + (a * d + b * c) * mark[3] + b * d * mark[4]
    s11 = c * c * mark[2] + TWO * c * d * mark[3] + d * d * mark[4] + p.sigma_bearing**2
    return r, wrap(math.atan2(dy, dx) - heading), a, b, s00, s01, s11


@compiled
def corrected(mark, x, y, heading, z, p):
    """A landmark (x, y, xx, xy, yy) after a measurement, and its log density."""
    r, bearing, a, b, s00, s01, s11 = predict(mark, x, y, heading, p)
    c, d, det = -b / r, a / r, s00 * s11 - s01 * s01
    e0, e1 = z[0] - r, wrap(z[1] - bearing)
    square = (s11 * e0 * e0 - TWO * s01 * e0 * e1 + s00 * e1 * e1) / det
    vx, vxy, vy = mark[2], mark[3], mark[4]
    px0, py0, px1, py1 = vx * a + vxy * b, vxy * a + vy * b, vx * c + vxy * d, vxy * c + vy * d
    gx0, gx1 = (px0 * s11 - px1 * s01) / det, (px1 * s00 - px0 * s01) / det
    gy0, gy1 = (py0 * s11 - py1 * s01) / det, (py1 * s00 - py0 * s01) / det
    mean = mark[0] + gx0 * e0 + gx1 * e1, mark[1] + gy0 * e0 + gy1 * e1
    cov = vx - gx0 * px0 - gx1 * px1, vxy - gx0 * py0 - gx1 * py1, vy - gy0 * py0 - gy1 * py1
    return mean + cov, math.log(F(1) - p.outlier) - LOG_2PI - HALF * (square + math.log(det))


@compiled
def named(pose, world, count, z, ids, p):
    """Log densities [N] with measurement k of landmark ids[k]; the map changes in place."""
    density = np.zeros(pose.shape[1], F)
    clutter = math.log(p.outlier / ((p.view_max - p.view_min) * p.view_range))
    for i in range(pose.shape[1]):
        x, y, heading = pose[0, i], pose[1, i], pose[2, i]
        for k in range(len(ids)):
            new, log_density = corrected(world[:5, i, ids[k]], x, y, heading, z[k], p)
            density[i] += max(log_density, clutter)
            if log_density >= clutter:
                for part in range(5):
                    world[part, i, ids[k]] = new[part]
                count[i, ids[k]] += 1
    return density


@compiled
def observe(pose, world, count, z, p):
    """Log densities [N], identities unknown; the map changes in place."""
    total, slots = len(z), count.shape[1]
    density, table = np.zeros(pose.shape[1], F), np.empty((total, slots), F)
    seen, slot, matched = np.empty((6, slots), F), np.empty(total, np.int32), np.empty(slots, nb.b1)
    expected = np.empty(slots, nb.b1)
    clutter = math.log(p.outlier / ((p.view_max - p.view_min) * p.view_range))
    for i in range(pose.shape[1]):
        x, y, heading = pose[0, i], pose[1, i], pose[2, i]
        look(world[:, i], count[i], x, y, heading, p, seen, expected)
        matched[:] = False
        score(seen, z, table, slot)
        for k in range(total):
            if table[k, slot[k]] <= max(newness(z[k], p), clutter):
                slot[k] = -1
        if torn(slot):
            repair(table, slot, z, clutter, p)
        for k in range(total):
            m = slot[k]
            if m >= 0:
                new, log_density = corrected(world[:5, i, m], x, y, heading, z[k], p)
                for part in range(5):
                    world[part, i, m] = new[part]
                density[i] += log_density
                count[i, m] += 1
                matched[m] = True
        for k in range(total):
            if slot[k] < 0:
                density[i] += max(newness(z[k], p), clutter)
                if newness(z[k], p) >= clutter:
                    create(world[:, i], count[i], x, y, heading, z[k], p)
        existence(world[5, i], count[i], matched, expected, seen[0], p)
    return density


@compiled
def look(world, count, x, y, heading, p, seen, expected):
    """`seen` [6, M]: range, bearing, quadratic form, constant; and whether it should be seen."""
    inlier = math.log(F(1) - p.outlier) - LOG_2PI
    for m in range(len(count)):
        r, bearing, _, _, s00, s01, s11 = predict(world[:5, m], x, y, heading, p)
        det = s00 * s11 - s01 * s01 if count[m] > 0 else F(1)
        seen[0, m], seen[1, m] = r, bearing
        seen[2, m], seen[3, m], seen[4, m] = -HALF * s11 / det, s01 / det, -HALF * s00 / det
        seen[5, m] = inlier - HALF * math.log(det) if count[m] > 0 else NEVER
        inside = bearing >= p.view_min and bearing <= p.view_max and r < p.view_range
        expected[m] = inside and count[m] > 0


@compiled
def score(seen, z, table, slot):
    """Log densities [K, M] into `table`, the best of each row into `slot`."""
    for k in range(len(z)):
        for m in range(seen.shape[1]):  # a loop without branches: vectorised
            v0, v1 = z[k, 0] - seen[0, m], wrap(z[k, 1] - seen[1, m])
            form = v0 * (seen[2, m] * v0 + seen[3, m] * v1) + seen[4, m] * v1 * v1
            table[k, m] = seen[5, m] + form
        slot[k] = 0
        for m in range(seen.shape[1]):
            if table[k, m] > table[k, slot[k]]:
                slot[k] = m


@compiled
def newness(z, p):
    return math.log(p.density_new * z[0])


@compiled
def torn(slot):
    """Whether two measurements want one landmark."""
    for k in range(len(slot)):
        for other in range(k):
            if slot[k] >= 0 and slot[k] == slot[other]:
                return True
    return False


@compiled
def repair(table, slot, z, clutter, p):
    """One pair after the other, the best first."""
    for k in range(len(slot)):
        slot[k] = -1
        for m in range(table.shape[1]):
            if table[k, m] <= max(newness(z[k], p), clutter):
                table[k, m] = NEVER
    for _ in range(len(slot)):
        at = table.argmax()
        k, m = at // table.shape[1], at % table.shape[1]
        if table[k, m] <= NEVER:
            return
        slot[k] = m
        table[k, :] = NEVER
        table[:, m] = NEVER


@compiled
def create(world, count, x, y, heading, z, p):
    """A landmark in the lowest free slot, if there is one."""
    for m in range(len(count)):
        if count[m] == 0:
            angle, along, across = z[1] + heading, p.sigma_range**2, (z[0] * p.sigma_bearing) ** 2
            c, s = math.cos(angle), math.sin(angle)
            world[0, m], world[1, m] = x + z[0] * c, y + z[0] * s
            world[2, m] = c * c * along + s * s * across
            world[3, m] = c * s * (along - across)
            world[4, m] = s * s * along + c * c * across
            world[5, m], count[m] = p.existence_new, 1
            return


@compiled
def existence(odds, count, matched, expected, ranges, p):
    for m in range(len(odds)):
        if matched[m]:
            odds[m] = min(odds[m] + p.existence_seen, p.existence_max)
        elif expected[m]:
            chance = p.detection * max(F(1) - ranges[m] / p.view_range, F(0))
            odds[m] += p.existence_miss * math.log(F(1) - chance)
        if odds[m] < 0:
            count[m] = 0
