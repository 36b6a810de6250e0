"""Compare the NumPy baseline, the paper's rules, FastSLAM 1.0, informed proposal and refinement.

    python experiments/variants.py                       the bundled log, identities unknown
    python experiments/variants.py LOG --association known --particles 2000

All filter the same frames with the same parameters; the rows differ in rules and in how many
particles their speed allows.
"""

import argparse
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxslam.config import SENSORS, Config
from jaxslam.logs.log_file import load_log
from jaxslam.logs.slicing import select_frames
from jaxslam.logs.truth import truth_at
from jaxslam.parameters import default_params
from jaxslam.reference.compare import compare, thin
from jaxslam.results.metrics import align_se2, alignable, ate, has_truth, map_error
from jaxslam.runs import run
from jaxslam.runs.run import config_for


class Variant(NamedTuple):
    """One row of the table.

    RMSE [m] of the path, `aligned` and `unaligned`, and of the `landmarks` (aligned with the path),
    NaN without truth; `counts` of landmarks matched, missed and spurious; `seconds` per step,
    without the compilation of the filter but with that of the refinement.
    """

    name: str
    particles: int
    aligned: float
    unaligned: float
    landmarks: float
    counts: tuple[int, ...]
    seconds: float


def variants(log, config, params=None, seed=0, steps=200, every=None, baselines=(), progress=None):
    """Run every variant; a list of `Variant`.

    First the `baselines` (`compare.Comparison` of the same frames), then the compiled filters with
    `config.particles` particles. `progress`: as for `run.run`, for each of them.
    """
    log = select_frames(log, thin(log, steps, every))
    params = default_params(config.sensor, log) if params is None else params
    rows = [_of_baseline(log, row.single) for row in baselines]
    for name, rules in _rules(config).items():
        done = run.run(log, rules, params, seed, progress, refine=name == "informed")
        row = log, rules.particles
        rows.append(_measured(name, *row, done.pose, done.landmarks, done.seconds))
        if (refined := done.refined) is not None:
            spent = done.seconds + done.refine_seconds
            rows.append(_measured("refined", *row, refined.pose, done.landmarks_refined, spent))
    return rows


def _rules(config):
    """`Config` by name; none compares appearances, as the baseline does not."""
    # The paper measures positions; bearings alone do not make one.
    sensor = "bearing" if config.sensor == "bearing" else "position"
    sizes = config.particles, config.landmarks, config.measurements
    return {
        "Config.paper()": Config.paper(*sizes, sensor=sensor, association=config.association),
        "FastSLAM 1.0": replace(config, proposal="prior", rejuvenate=0.0, descriptors=0),
        "informed": replace(config, proposal="informed", rejuvenate=0.0, descriptors=0),
    }


def _of_baseline(log, single):
    world, spent = single.map_baseline, single.seconds_baseline
    return _measured("baseline, NumPy", log, single.particles, single.pose_baseline, world, spent)


def _measured(name, log, particles, pose, world, seconds):
    """`Variant` of a path [T, 3] and a map with `mean` [L, 2] and `identity` [L]."""
    true, truth = truth_at(log.truth, log.frame_time), log.truth
    have, error = has_truth(true), {}
    if truth is not None and truth.landmarks is not None and alignable(true[have, :2]):
        motion = align_se2(pose[have, :2], true[have, :2])
        error = map_error(world.mean, world.identity, truth, motion)
    return Variant(
        name,
        particles,
        ate(pose, true)[0],
        ate(pose, true, align=False)[0],
        error.get("rmse_m", np.nan),
        tuple(error[kind] for kind in ("matched", "missed", "spurious") if error),
        seconds / len(pose),
    )


def table(rows):
    """Text: one line per `Variant`."""
    head = "particles", "path, aligned", "unaligned", "landmarks", "found/missed/extra", "per step"
    lines = [_line("", head)]
    for row in rows:
        metres = [
            "-" if np.isnan(error) else f"{error:.3f} m"
            for error in (row.aligned, row.unaligned, row.landmarks)
        ]
        counts = "/".join(map(str, row.counts)) or "-"
        cells = f"{row.particles:,}", *metres, counts, f"{1e3 * row.seconds:.4g} ms"
        lines.append(_line(row.name, cells))
    return "\n".join(lines)


def _line(name, cells):
    widths = 11, 15, 12, 12, 20, 12
    return f"{name:16}" + "".join(
        f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True)
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log", nargs="?", default="lost-in-the-woods")
    parser.add_argument("--sensor", choices=SENSORS)
    parser.add_argument("--association", default="maximum_likelihood")
    parser.add_argument("--baseline", type=int, nargs="*", default=[20, 100], help="particles")
    parser.add_argument("--particles", type=int, default=1000, help="of the compiled filters")
    parser.add_argument("--steps", type=int, default=200, help="frames to filter")
    parser.add_argument("--every", type=int, help="use each n-th frame (cover a tenth of the log)")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    log = load_log(args.log)

    def sized(particles):
        return config_for(log, args.sensor, args.association, particles=particles)

    rest = None, args.seed, args.steps, args.every
    baselines = [compare(log, sized(count), *rest) for count in args.baseline]
    print(table(variants(log, sized(args.particles), *rest, baselines)))


if __name__ == "__main__":
    main()
