"""Points over the same road share its error: to thin them or to inflate their covariances?

    python experiments/points.py          (about 10 minutes)

Simulated drives round a room (60 m, a frame every 20 cm, 40 lines, bearings to 0.06 degrees) are
triangulated in several ways and filtered with the sensor `position`, identities hidden; errors are
unaligned. Lines are followed by their true identity, so that only the points differ. A baseline of
0.4 m is two frames, so that of one line's overlapping points two share every stretch of road, and
all lines' points do. Writes experiments/results/points.md.
"""

from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np

from jaxslam import config_for, default_params, run
from jaxslam.simulation.planar import planar
from jaxslam.vision.log_triangulation import PointSettings, triangulate_log

RESULTS = Path(__file__).parent / "results"
ROBOT = dict(err_tran=0.0075, err_rot=0.02, err_drift=0.01, floor_tran=0.0005, floor_rot=0.0005)
WORLDS, SEEDS, PARTICLES = 3, 4, 300
CASES = (  # pairs, baseline [m], inflation
    *(("disjoint", 0.4, inflation) for inflation in (1, 4, 16)),
    *(("consecutive", 0.4, inflation) for inflation in (1, 4, 16)),
    *(("overlapping", 0.2, inflation) for inflation in (16,)),
    *(("overlapping", 0.4, inflation) for inflation in (1, 4, 16, 64)),
    *(("overlapping", 0.8, inflation) for inflation in (4, 16)),
)


def drive(seed):
    """A log of bearings of a drive by commands."""
    log = planar(
        "room", seed, commands=True, stop_m=0.2, sigma_bearing=1e-3, view=(-pi, pi, 12.0),
        max_per_frame=None, outlier=0.0, detection=1.0, **ROBOT,
    )  # fmt: skip
    return replace(log, range=None, noise={**log.noise, "detection": 0.9, "outlier": 0.01})


def scores(log, seed):
    """Path RMSE and maximum [m], share of the landmarks mapped within 15 cm, and the others."""
    config = config_for(log, "position", particles=PARTICLES)
    result = run(log, config, default_params("position", log), seed)
    off = np.hypot(*(result.pose - log.truth.pose)[:, :2].T)
    apart = np.hypot(*(result.landmarks.mean[:, None] - log.truth.landmarks).transpose(2, 0, 1))
    mapped = (apart < 0.15).any(axis=0).mean() if len(apart) else 0.0
    return np.sqrt(np.mean(off**2)), off.max(), mapped, (apart.min(axis=1, initial=9) > 0.15).sum()


def main():
    logs = [drive(seed) for seed in range(WORLDS)]
    lines = [
        "| pairs | baseline [m] | inflation | `position_scale` | bearings with a point [%] "
        "| path RMSE, mean [m] | worst | path, most [m] | mapped [%] | spurious |",
        "|---" * 10 + "|",
    ]
    for pairs, baseline, inflation in CASES:
        settings = PointSettings(pairs=pairs, baseline=baseline, inflation=inflation)
        found = [triangulate_log(log, settings=settings, use_identity=True) for log in logs]
        rmse, most, mapped, other = np.array(
            [scores(log, seed) for log in found for seed in range(SEEDS)]
        ).T
        share = np.mean([np.isfinite(log.point[:, 0]).mean() for log in found])
        scale = found[0].noise["position_scale"]
        lines.append(
            f"| {pairs} | {baseline} | {inflation} | {scale:.2f} | {100 * share:.0f} "
            f"| {rmse.mean():.3f} | {rmse.max():.3f} | {most.max():.2f} "
            f"| {100 * mapped.mean():.0f} | {other.mean():.1f} |"
        )
        print(lines[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "points.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
