"""Is a bearing landmark honest? `python experiments/inverse_depth.py` (5 minutes, one core).

One landmark, known poses: the robot drives 4 m straight on, a bearing every 0.1 m. The landmark is
drawn from the filter's prior given the first bearing (direction N(z, sigma^2), inverse depth
N(inv_depth_mean, inv_depth_sd^2) cut off at `LEAST_INVERSE_DEPTH`), so that the exact posterior,
on a dense grid in float64, is calibrated. Held against it:
- `ekf`: linearised at the mean.
- `second`: second derivatives shift the prediction and widen it (`second, depth`: that alone
  by inverse depth).
- `iterated`: linearised at the posterior's mode (Gauss-Newton, 5 rounds).
- `points`: statistical linear regression over 3 Gauss-Hermite points of inverse depth.
- `split3`, `split5`: the normal as 3 (5) narrower ones along inverse depth, an EKF for each, the
  result's mean and covariance kept; `second`: an EKF of second order for each.
- `shipped`: `jaxslam.landmarks.update` in float32: five, second order.
NEES of (direction, inverse depth), which should be 2; bits of the truth's density lost against the
exact posterior; share of truths within the 95 % ellipse of the world point, once its depth counts
as known; bits that the predictive density of each next bearing loses against the exact one, in sum.
Writes experiments/results/inverse_depth.md. `--draws` for trials.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import numpy as np
from scipy.stats import chi2, truncnorm

from jaxslam.filter import landmarks
from jaxslam.models import sensors
from jaxslam.parameters import default_params

RESULTS = Path(__file__).parent / "results"
STEP, CHECKS = 0.1, (1, 3, 10, 20, 40)  # m; frames at which all is measured
CHUNK = 20  # draws at once: what stays in cache is three times as fast
GRID, KEPT = 64, 16.0  # points a side; log density below the top that still belongs to the grid
PRIOR = default_params("bearing")
# name, first bearing, sigma (degrees), growth (m), depth (m) or None: from the prior
CASES = (
    ("ahead", 0, 4, 0.02, None),
    ("ahead, growth", 0, 4, 0.1, None),
    ("1° off, precise", 1, 0.5, 0.02, None),
    ("3° off", 3, 4, 0.02, None),
    ("3° off, 1°", 3, 1, 0.02, None),
    ("10° off", 10, 4, 0.02, None),
    ("10° off, precise", 10, 0.5, 0.0, None),
    ("30° off", 30, 4, 0.0, None),
    ("30° off, precise", 30, 0.5, 0.0, None),
    ("60° off, growth", 60, 4, 0.1, None),
    ("90° off", 90, 4, 0.0, None),
    ("90° off, precise", 90, 0.5, 0.0, None),
    ("30° off, at 8 m", 30, 2, 0.0, 8.0),
    ("30° off, at 0.6 m", 30, 2, 0.05, 0.6),
)


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def observe(phi, rho, x, sigma, landmark_extent):
    """Bearing, its two derivatives, second derivative by rho, and variance; sensor at (x, 0)."""
    c, s = np.cos(phi), np.sin(phi)
    dx, dy = c - rho * x, s
    square = dx * dx + dy * dy
    w = s * x
    second = 2 * w * x * dx / square**2
    by_phi = (dy * s + dx * c) / square
    return (
        np.arctan2(dy, dx),
        by_phi,
        w / square,
        second,
        sigma**2 + (landmark_extent * rho) ** 2 / square,
    )


def log_normal(nu, variance):
    return -0.5 * (nu**2 / variance + np.log(2 * np.pi * variance))


def kalman(mean, cov, row, nu, variance):
    """One linear update: mean [2, D], cov [3, D] (xx, xy, yy)."""
    (a, b), (xx, xy, yy) = row, cov
    g0, g1 = a * xx + b * xy, a * xy + b * yy
    s = a * g0 + b * g1 + variance
    k0, k1 = g0 / s, g1 / s
    after = np.stack([xx - k0 * g0, xy - k0 * g1, yy - k1 * g1])
    return mean + np.stack([k0 * nu, k1 * nu]), after, log_normal(nu, s)


def ekf(mean, cov, x, z, noise):
    h, a, b, _, variance = observe(*mean, x, *noise)
    return kalman(mean, cov, (a, b), wrap(z - h), variance)


def second(mean, cov, x, z, noise, depth_alone=False):
    """The Hessian is -(u v' + v u'): v the bearing's row, u that of the log distance."""
    h, a, b, bb, variance = observe(*mean, x, *noise)
    if depth_alone:
        shift = 0.5 * bb * cov[2]
        return kalman(mean, cov, (a, b), wrap(z - h - shift), variance + 2 * shift**2)
    dx, dy = np.cos(mean[0]) - mean[1] * x, np.sin(mean[0])
    u = np.stack([np.cos(mean[0]) * dy - np.sin(mean[0]) * dx, -x * dx]) / (dx**2 + dy**2)
    v = np.stack([a, b])

    def between(p, q):
        return p[0] * q[0] * cov[0] + (p[0] * q[1] + p[1] * q[0]) * cov[1] + p[1] * q[1] * cov[2]

    shift, extra = -between(u, v), between(u, u) * between(v, v) + between(u, v) ** 2
    return kalman(mean, cov, (a, b), wrap(z - h - shift), variance + extra)


def iterated(mean, cov, x, z, noise):
    at = mean
    for _ in range(5):
        h, a, b, _, variance = observe(*at, x, *noise)
        nu = wrap(z - h) - a * (mean[0] - at[0]) - b * (mean[1] - at[1])
        at, after, density = kalman(mean, cov, (a, b), nu, variance)
    return at, after, density


def points(mean, cov, x, z, noise):
    sd = np.sqrt(cov[2])
    slope = cov[1] / cov[2]
    nodes, weights = np.array([-np.sqrt(3), 0, np.sqrt(3)])[:, None], np.array([1, 4, 1]) / 6
    h, a, _, _, variance = observe(mean[0] + slope * sd * nodes, mean[1] + sd * nodes, x, *noise)
    off = wrap(h - h[1])
    centre = weights @ off
    along = weights @ (nodes * off) / sd  # total derivative by inverse depth
    rest = weights @ (off - centre - along * sd * nodes) ** 2 + weights @ variance
    by_phi = a[1]
    row = (by_phi, along - by_phi * slope)
    return kalman(mean, cov, row, wrap(z - h[1] - centre), rest)


def split(mean, cov, x, z, noise, part=ekf, nodes=3, share=0.5):
    """`share` of the variance of inverse depth lies between the narrower normals."""
    node, weight = np.polynomial.hermite_e.hermegauss(nodes)
    node, weight = np.sqrt(share) * node, weight / weight.sum()
    sd = np.sqrt(cov[2])
    step = np.stack([cov[1] / sd, sd])
    narrow = cov - share * np.stack([step[0] ** 2, step[0] * step[1], step[1] ** 2])
    parts = [part(mean + n * step, narrow, x, z, noise) for n in node]
    means, covs, densities = (np.stack(part) for part in zip(*parts, strict=True))
    joint = densities + np.log(weight)[:, None]
    top = joint.max(0)
    density = top + np.log(np.exp(joint - top).sum(0))
    w = np.exp(joint - density)
    after = (w[:, None] * means).sum(0)
    d = means - after
    between = np.stack([d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2], 1)
    return after, (w[:, None] * (covs + between)).sum(0), density


def shipped(mean, cov, x, z, noise):
    numbers = PRIOR._replace(sigma_bearing=noise[0], landmark_extent=noise[1])
    l11 = np.sqrt(cov[0])
    factor = l11, cov[1] / l11, np.sqrt(cov[2] - cov[1] ** 2 / cov[0])
    zero = np.zeros_like(z)
    given = (zero + x, zero, zero), tuple(mean), factor, (zero, zero), (z, zero), None
    given = jax.tree.map(np.float32, given)
    after, factor, density = _shipped(*given, jax.tree.map(np.float32, numbers))
    l11, l21, l22 = (np.asarray(part, float) for part in factor)
    cov = np.stack([l11**2, l11 * l21, l21**2 + l22**2])
    return np.stack([np.asarray(part, float) for part in after]), cov, np.asarray(density, float)


_shipped = jax.jit(partial(landmarks.update, "bearing"))


def clamped(update):
    def one(*given):
        mean, cov, density = update(*given)
        return np.stack([mean[0], np.maximum(mean[1], sensors.LEAST_INVERSE_DEPTH)]), cov, density

    return one


METHODS = {
    "ekf": clamped(ekf),
    "second, depth": clamped(partial(second, depth_alone=True)),
    "second": clamped(second),
    "iterated": clamped(iterated),
    "points": clamped(points),
    "split3": clamped(split),
    "split5": clamped(partial(split, nodes=5, share=0.75)),
    "split3, second": clamped(partial(split, part=second)),
    "split4, second": clamped(partial(split, part=second, nodes=4, share=0.7)),
    "shipped": shipped,
}


def draw(case, count, rng):
    """Truth [2, D], and bearings [frames, D] that follow the first."""
    _, first, sigma, landmark_extent, depth = case
    first, sigma = np.deg2rad(first), np.deg2rad(sigma)
    m, sd = PRIOR.inv_depth_mean, PRIOR.inv_depth_sd
    low = (sensors.LEAST_INVERSE_DEPTH - m) / sd
    rho = truncnorm.rvs(low, np.inf, m, sd, size=count, random_state=rng)
    rho = rho if depth is None else np.full(count, 1 / depth)
    phi = first + rng.normal(size=count) * np.hypot(sigma, landmark_extent * rho)
    x = STEP * np.arange(1, CHECKS[-1] + 2)[:, None]
    h, *_, variance = observe(phi, rho, x, sigma, landmark_extent)
    return np.stack([phi, rho]), wrap(h + rng.normal(size=h.shape) * np.sqrt(variance))


def log_posterior(phi, rho, z, first, noise):
    """Unnormalised, on a grid [D, G, G], of the bearings z [frames, D]."""
    total = log_normal(phi - first, noise[0] ** 2 + (noise[1] * rho) ** 2)
    total = total - 0.5 * ((rho - PRIOR.inv_depth_mean) / PRIOR.inv_depth_sd) ** 2
    for i, bearing in enumerate(z):
        h, *_, variance = observe(phi, rho, STEP * (i + 1), *noise)
        total += log_normal(wrap(bearing[:, None, None] - h), variance)
    return total


def exact(case, z, box):
    """Grid (phi [D, G, 1], rho [D, 1, G]), log probability [D, G, G] and cell [D], and the box."""
    first, noise = np.deg2rad(case[1]), (np.deg2rad(case[2]), case[3])
    at = (np.arange(GRID) + 0.5) / GRID
    for _ in range(4):
        low, size = box[0], box[1] - box[0]
        phi = (low[0][:, None] + size[0][:, None] * at)[:, :, None]
        rho = (low[1][:, None] + size[1][:, None] * at)[:, None, :]
        log_p = log_posterior(phi, rho, z, first, noise)
        inside = log_p > log_p.max((1, 2), keepdims=True) - KEPT
        new = np.empty_like(box)
        for axis, other in ((0, 2), (1, 1)):
            some = inside.any(other)
            a, b = some.argmax(1) - 1, GRID - some[:, ::-1].argmax(1) + 1
            new[:, axis] = low[axis] + size[axis] * np.stack([a, b]) / GRID
        new[0, 1] = np.maximum(new[0, 1], sensors.LEAST_INVERSE_DEPTH)
        shrunk = np.prod(new[1] - new[0], 0) / np.prod(size, 0)
        box = new
        if shrunk.min() > 0.5:
            break
    log_p -= log_p.max((1, 2), keepdims=True)
    log_p -= np.log(np.exp(log_p).sum((1, 2), keepdims=True))
    return phi, rho, log_p, np.prod(size / GRID, 0), box


def gaussian(truth, mean, cov):
    """NEES and log density of a truth [2, ...] under N(mean, cov)."""
    e0, e1 = truth[0] - mean[0], truth[1] - mean[1]
    det = cov[0] * cov[2] - cov[1] ** 2
    nees = (e0**2 * cov[2] - 2 * e0 * e1 * cov[1] + e1**2 * cov[0]) / det
    return nees, -0.5 * (nees + np.log(det)) - np.log(2 * np.pi)


def covered(truth, mean, cov):
    """Whether the world point's 95 % ellipse has the truth; NaN where its depth is not known."""
    known = mean[1] > 3 * np.sqrt(cov[2])
    (phi, rho), (xx, xy, yy) = mean, cov
    rho = np.where(known, rho, 1.0)
    c, s = np.cos(phi), np.sin(phi)
    off = np.stack([np.cos(truth[0]), np.sin(truth[0])]) / truth[1] - np.stack([c, s]) / rho
    along, across = c * off[0] + s * off[1], c * off[1] - s * off[0]
    nees, _ = gaussian((across, along), (0, 0), (xx / rho**2, -xy / rho**3, yy / rho**4))
    return np.where(known, nees < chi2.ppf(0.95, 2), np.nan)


def measure(case, count, seed):
    """{(method, frames): measures [5, D]}: NEES, bits of truth lost, KL, covered, evidence lost."""
    rng = np.random.default_rng(seed)
    truth, z = draw(case, count, rng)
    first, noise = np.deg2rad(case[1]), (np.deg2rad(case[2]), case[3])
    m, sd = PRIOR.inv_depth_mean, PRIOR.inv_depth_sd
    at_first = np.hypot(noise[0], noise[1] * m)
    start = np.array([first, m])[:, None] + np.zeros((2, count))
    states = {
        name: (start, np.array([at_first**2, 0, sd**2])[:, None] + np.zeros((3, count)))
        for name in METHODS
    }
    wide = 6 * np.hypot(noise[0], noise[1] * (m + 6 * sd))
    box = np.array([[first - wide, sensors.LEAST_INVERSE_DEPTH], [first + wide, m + 6 * sd]])
    box = box[:, :, None] + np.zeros(count)
    told = dict.fromkeys(METHODS, 0.0)
    out, evidence = {}, _evidence(case, z[:0], box)
    for frame in range(1, CHECKS[-1] + 1):
        for name, update in METHODS.items():
            mean, cov, density = update(*states[name], STEP * frame, z[frame - 1], noise)
            states[name] = mean, cov
            told[name] = told[name] + density
        if frame not in CHECKS:
            if (
                frame % (2 if frame < 20 else 5) == 0
            ):  # so that what is left of the prior is never lost between points
                box = exact(case, z[:frame], box)[-1]
            continue
        phi, rho, log_p, cell, box = exact(case, z[:frame], box)
        p = np.exp(log_p)
        mean = np.stack([(p * phi).sum((1, 2)), (p * rho).sum((1, 2))])
        d0, d1 = phi - mean[0][:, None, None], rho - mean[1][:, None, None]
        cov = np.stack([(p * part).sum((1, 2)) for part in (d0**2, d0 * d1, d1**2)])
        at = _evidence(case, z[:frame], box)
        states_now = {"exact": (mean, cov)} | states
        true_log = _at(case, truth, z[:frame], first, noise) - at
        for name, (m_, c_) in states_now.items():
            nees, log_density = gaussian(truth, m_, c_)
            on_grid = gaussian((phi, rho), m_[..., None, None], c_[..., None, None])[1]
            kl = (p * (log_p - np.log(cell)[:, None, None] - on_grid)).sum((1, 2))
            lost = (at - evidence) - told[name] if name != "exact" else np.zeros(count)
            out[name, frame] = np.stack(
                [nees, (true_log - log_density) / np.log(2), kl / np.log(2),
                 covered(truth, m_, c_), lost / np.log(2)]
            )  # fmt: skip
    return out


def _at(case, truth, z, first, noise):
    return log_posterior(truth[0][:, None, None], truth[1][:, None, None], z, first, noise)[:, 0, 0]


def _evidence(case, z, box):
    """log of the integral of `log_posterior`'s exponential, [D]."""
    noise = np.deg2rad(case[2]), case[3]
    at = (np.arange(GRID) + 0.5) / GRID
    low, size = box[0], box[1] - box[0]
    phi = (low[0][:, None] + size[0][:, None] * at)[:, :, None]
    rho = (low[1][:, None] + size[1][:, None] * at)[:, None, :]
    log_p = log_posterior(phi, rho, z, np.deg2rad(case[1]), noise)
    top = log_p.max((1, 2))
    total = np.exp(log_p - top[:, None, None]).sum((1, 2))
    return top + np.log(total) + np.log(np.prod(size / GRID, 0))


def table(case, out):
    """A row per method: mean NEES at the frames of `CHECKS`, and the rest at the last one."""
    rows = []
    for name in ("exact", *METHODS):
        at = [out[name, frame] for frame in CHECKS]
        last = at[-1]
        share = np.nanmean(last[3]) if np.isfinite(last[3]).any() else np.nan
        rows.append(
            f"| {case[0]} | {name} | "
            + " | ".join(f"{a[0].mean():.3g}" for a in at)
            + f" | {np.mean(at[2][1]):.2f} | {np.mean(last[1]):.2f} | {np.mean(last[2]):.2f}"
            + f" | {share:.0%} | {np.mean(at[2][4]):.2f} | {np.mean(last[4]):.2f} |"
        )
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--cases", type=int, default=len(CASES))
    given = parser.parse_args()
    lines = [
        f"{given.draws} draws a case; columns of NEES by metres driven (should be 2).",
        "",
        "| landmark | method | "
        + " | ".join(f"NEES {STEP * frame:.1f}" for frame in CHECKS)
        + " | bits of truth lost, 1 m | 4 m | KL, 4 m | in 95 % ellipse, 4 m"
        + " | bits of evidence lost to 1 m | to 4 m |",
        "|---|---|" + "--:|" * (len(CHECKS) + 6),
    ]
    print(*lines, sep="\n", flush=True)
    for i, case in enumerate(CASES[: given.cases]):
        chunks = [measure(case, CHUNK, (i, j)) for j in range(given.draws // CHUNK)]
        rows = table(case, {key: np.hstack([c[key] for c in chunks]) for key in chunks[0]})
        print(*rows, sep="\n", flush=True)
        lines += rows
    if given.draws == 200 and given.cases == len(CASES):
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "inverse_depth.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
