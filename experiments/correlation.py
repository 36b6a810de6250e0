"""Errors that stay alike: whiten, thin or inflate? `python experiments/correlation.py` (seconds).

A robot on a known path sees one landmark 1.5 m aside, bearings alone, 5 times a second: it stands
for 30 s, drives 4 m past it, and turns once in place. Half of the landmark's bearing error's
variance, or all, is not white:
- `path`: first-order autoregression in the path (what `Params.correlation` says);
- `aspect`: a smooth function of the direction the landmark is seen from, as of a tube's edge;
- `lens`: a smooth function of the bearing in the sensor's frame: it changes with turning too.
The landmark's point is estimated from a prior of 1 m and Jacobians at the truth, so that nothing
but the noise model can be wrong:
- `white`: every frame by itself;
- `inflated`: variance times coth(distance / (2 correlation)), as `sensors.correlated`;
- `inflated, 0.2 m/rad`: of distance + 0.2 m/rad times turn; so with 0.1 and 0.5;
- `thinned`: a frame only after `correlation` m or 0.3 rad;
- `whitened`: the difference from the last frame's residual, by the autoregression.
NEES (should be 2), share of truths in the 95 % ellipse, and RMSE in mm after each leg.
A second table asks what the last leg is worth to the pose: the heading while turning once in place,
with 8 known landmarks around, `err_rot` 0.05 rad per root rad, by levers: NEES (should be 1), RMSE.
Writes experiments/results/correlation.md.
"""

from pathlib import Path

import numpy as np
from scipy.stats import chi2

RESULTS = Path(__file__).parent / "results"
DRAWS, SIGMA, CORRELATION = 4000, np.deg2rad(2), 0.3  # rad, m
LEGS = {"stood 30 s": 150, "drove 0.5 m": 155, "drove 4 m": 190, "turned": 220}  # frames by then
LEVERS, LEAST_TURN = (0.1, 0.2, 0.5), 0.3  # m/rad, rad
MARK, MOST = np.array([2.0, 1.5]), 1e4


def path():
    """Position [T], heading [T], distance and turn since the frame before [T]."""
    distance = np.repeat([0.0, 0.1, 0.0], [150, 40, 30])
    turn = np.repeat([0.0, 0.0, 2 * np.pi / 30], [150, 40, 30])
    return np.cumsum(distance), np.cumsum(turn), distance, turn


def errors(kind, share, rng):
    """Errors [T, D] of variance SIGMA^2, a `share` of it not white."""
    x, heading, distance, _ = path()
    shape = len(x), DRAWS
    white = rng.normal(size=shape)
    alike = np.empty(shape)
    if kind == "path":
        state = rng.normal(size=DRAWS)
        for t, d in enumerate(distance):
            a = np.exp(-d / CORRELATION) if t else 0.0
            state = a * state + np.sqrt(1 - a * a) * rng.normal(size=DRAWS)
            alike[t] = state
    else:
        seen_from = np.arctan2(MARK[1], MARK[0] - x)
        angle = seen_from if kind == "aspect" else seen_from - heading
        alike = smooth(angle, rng)
    return SIGMA * (np.sqrt(share) * alike + np.sqrt(1 - share) * white)


def rows():
    x, *_ = path()
    dx, dy = MARK[0] - x, MARK[1]
    return np.column_stack([-dy / (dx**2 + dy**2), dx / (dx**2 + dy**2)])


def inflation(travel):
    return np.minimum(1 / np.tanh(np.maximum(travel / (2 * CORRELATION), 1 / MOST)), MOST)


def weighted(method, error):
    """Rows [T, 2], residuals [T, D] and variances [T] of independent scalars; inf: not used."""
    _, _, distance, turn = path()
    h, variance = rows(), np.full(len(distance), SIGMA**2)
    if method.startswith("inflated"):
        lever = 0.0 if method == "inflated" else float(method.split()[1])
        travel = distance + lever * turn
        variance[1:] *= inflation(travel[1:])  # the first is new, whatever was driven
    elif method == "thinned":
        moved = turned = np.inf
        for t in range(len(variance)):
            moved, turned = moved + distance[t], turned + turn[t]
            if moved < CORRELATION - 1e-9 and turned < LEAST_TURN:
                variance[t] = np.inf
            else:
                moved = turned = 0.0
    elif method == "whitened":
        a = np.exp(-distance[1:] / CORRELATION)
        keep = 1 - a**2 + 1 / MOST
        h = np.vstack([h[:1], h[1:] - a[:, None] * h[:-1]])
        error = np.vstack([error[:1], error[1:] - a[:, None] * error[:-1]])
        variance[1:] *= keep
    return h, error, variance


def measure(method, error):
    """(NEES, covered, RMSE in mm) after each leg."""
    h, residual, variance = weighted(method, error)
    out = []
    for last in LEGS.values():
        weight = h[:last] / variance[:last, None]
        information = np.eye(2) + weight.T @ h[:last]
        # The prior's mean is drawn too, one metre from the truth: calibrated.
        off = np.random.default_rng(1).normal(size=(2, DRAWS))
        estimate = np.linalg.solve(information, weight.T @ residual[:last] + off)
        nees = np.sum(estimate * (information @ estimate), 0)
        rmse = np.sqrt(np.mean(np.sum(estimate**2, 0)))
        out.append((nees.mean(), np.mean(nees < chi2.ppf(0.95, 2)), 1e3 * rmse))
    return out


def smooth(angle, rng):
    """Normal processes over the circle, alike over about 0.2 rad, variance 1: [*angle, DRAWS]."""
    order = np.arange(1, 40)
    size = np.exp(-0.5 * (0.2 * order) ** 2)
    waves = rng.normal(size=(2, len(order), DRAWS)) * (size / np.sqrt(np.sum(size**2)))[:, None]
    phase = np.asarray(angle)[..., None] * order
    return np.cos(phase) @ waves[0] + np.sin(phase) @ waves[1]


def turning(kind, lever, steps=30, landmarks=8, err_rot=0.05):
    """(NEES, RMSE in degrees) of the heading after a turn in place, by a Kalman filter."""
    rng, turn = np.random.default_rng(0), 2 * np.pi / steps
    place, constant = rng.uniform(-np.pi, np.pi, landmarks), rng.normal(size=(landmarks, DRAWS))
    angle = place - turn * np.arange(steps)[:, None]
    alike = (
        smooth(angle, rng)
        if kind == "lens"
        else np.broadcast_to(constant, (steps, *constant.shape))
    )
    grown = 1.0 if lever is None else inflation(np.array(lever * turn))
    error, variance, noise = np.zeros(DRAWS), 0.0, grown * SIGMA**2 / landmarks
    for t in range(steps):
        error = error + err_rot * np.sqrt(turn) * rng.normal(size=DRAWS)
        variance = variance + err_rot**2 * turn
        gain = variance / (variance + noise)
        error = error - gain * (error + SIGMA * alike[t].mean(0))
        variance = (1 - gain) * variance
    return np.mean(error**2) / variance, np.rad2deg(np.sqrt(np.mean(error**2)))


def main():
    levers = tuple(f"inflated, {lever} m/rad" for lever in LEVERS)
    methods = ("white", "inflated", *levers, "thinned", "whitened")
    lines = [
        f"{DRAWS} draws; {np.rad2deg(SIGMA):.0f}°; correlation {CORRELATION} m."
        " NEES (should be 2), share in the 95 % ellipse, RMSE.",
        "",
        "| errors | method | " + " | ".join(LEGS) + " |",
        "|---|---|" + "--:|" * len(LEGS),
    ]
    cases = (("white", "path", 0.0), ("path", "path", 1.0), ("path, half white", "path", 0.5))
    cases += (("aspect", "aspect", 1.0), ("lens", "lens", 1.0), ("lens, half white", "lens", 0.5))
    for name, kind, share in cases:
        error = errors(kind, share, np.random.default_rng(0))
        for method in methods:
            cells = (f"{n:.3g}, {c:.0%}, {r:.0f} mm" for n, c, r in measure(method, error))
            lines.append(f"| {name} | {method} | " + " | ".join(cells) + " |")
    lines += ["", "| errors | white | inflated | " + " | ".join(levers) + " |"]
    lines.append("|---|" + "--:|" * (2 + len(levers)))
    for name in ("of each landmark, constant", "lens"):
        got = [turning(name, lever) for lever in (None, 0.0, *LEVERS)]
        lines.append(f"| {name} | " + " | ".join(f"{n:.2f}, {r:.1f}°" for n, r in got) + " |")
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "correlation.md").write_text("\n".join(lines) + "\n")
    print(*lines, sep="\n")


if __name__ == "__main__":
    main()
