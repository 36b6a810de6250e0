"""Which error model of the sensor the data prefer: each is learned, and judged on held-out logs.

    python experiments/error_models.py lost-in-the-woods --end 600 --held-out lost-in-the-woods \\
        --held-out-start 600 --association known --spacing 1

The paper models a measurement as a 2-D normal point. Alternatives for ranges and bearings, or
bearings alone: normal; bearing noise that grows towards near landmarks, which have a size
(`landmark_extent`); either with a probability `outlier` of clutter (heavy-tailed). Evidences of one
log are comparable only as densities of the same quantity: that of a point (x, y) is per m^2, that
of (range, bearing) per m rad, and r times as large, since dx dy = r dr dbearing. The sum of log r
over the measurements is added to the former. Of a point's covariance only the scale is learned: it
is made with the noise at the start of the fit.
"""

import argparse
import dataclasses
import sys
from typing import NamedTuple

import numpy as np

from jaxslam.config import ASSOCIATIONS
from jaxslam.filter.frames import frames_from_log
from jaxslam.learning import fit
from jaxslam.learning.data import config_for_logs, split_log
from jaxslam.logs.log_file import load_log
from jaxslam.parameter_file import load_params
from jaxslam.parameters import MOTION, TABLE, default_params

FRESH = 8  # seeds that judge
GROWTH = 0.02  # m: where growth starts if it is 0; its logarithm is learned
OUTLIER = 0.01
SURE = 3.0  # standard errors of a difference, from which on it is a preference
NAMES = ("normal", "range_dependent", "heavy_tailed", "heavy_tailed+range_dependent", "point")


class Judged(NamedTuple):
    """A model: parameters `values` learned, and log `evidence` [seeds] of `count` held-out
    measurements, per m rad (bearings alone: per rad)."""

    model: str
    values: dict
    evidence: np.ndarray
    count: int

    @property
    def finite(self):
        """Whether its evidence is a number."""
        return bool(np.isfinite(self.evidence).all())


def compare(train, held_out, config, params, names=(), seeds=4, steps=150, seed=0, progress=None):
    """A `Judged` per model: lists of `Log`s to learn from and to judge by.

    Of `names` the motion's are learned with each model; `params` are where all start. `progress`:
    called with (models done, models). Raises `ValueError` for sensor `position`, whose points have
    no range and bearing to be compared by.
    """
    if config.sensor not in ("range_bearing", "bearing"):
        raise ValueError(f"error models of sensor {config.sensor}: need ranges or bearings")
    models = NAMES if config.sensor == "range_bearing" else NAMES[:-1]
    rows = []
    for done, model in enumerate(models):
        if progress:
            progress(done, len(models))
        rows.append(_judged(model, train, held_out, config, params, names, seeds, steps, seed))
    return rows


def model_of(model, config, params):
    """`Config`, start `Params` and the sensor's names to learn of a model."""
    heavy, ranged = "heavy_tailed" in model, "range_dependent" in model
    # The noise is all in the model: nothing is added to it.
    sigma = float(np.hypot(params.sigma_bearing, params.extra_bearing_noise))
    params = params._replace(sigma_bearing=sigma, extra_bearing_noise=0.0)
    config = dataclasses.replace(config, clutter=heavy)
    if model == "point":
        return dataclasses.replace(config, sensor="position"), params, ("position_scale",)
    names = ("sigma_range",) if config.sensor == "range_bearing" else ()
    names += ("sigma_bearing",) + ("landmark_extent",) * ranged + ("outlier",) * heavy
    landmark_extent = (params.landmark_extent or GROWTH) if ranged else 0.0
    return (
        config,
        params._replace(landmark_extent=landmark_extent, outlier=params.outlier or OUTLIER),
        names,
    )


def _judged(model, train, held_out, config, params, names, seeds, steps, seed):
    config, start, own = model_of(model, config, params)
    if model == "point":
        train, held_out = ([_without_points(log) for log in logs] for logs in (train, held_out))
    names = (*(name for name in names if MOTION in TABLE[name].learned_by), *own)
    found = fit.fit(train, config, start, names, held_out, seeds=seeds, steps=steps, seed=seed)
    # Positions are made with the noise they were learned with, whose scale is then the fit's.
    evidence = fit.evidence(held_out, config, found.params, FRESH, seed + 7919)
    used = [_ranges(log, config, start) for log in held_out]
    if model == "point":
        evidence = evidence + sum(np.log(ranges).sum() for ranges in used)
    values = {name: getattr(found.params, name) for name in names}
    return Judged(model, values, evidence, sum(map(len, used)))


def _without_points(log):
    """The log with points only as its ranges and bearings make them."""
    return dataclasses.replace(log, point=None, point_cov=None, point_baseline=None)


def _ranges(log, config, params):
    """Ranges [n] of the measurements that find a slot (ones, where none was measured)."""
    row = frames_from_log(log, config, params).row
    ranges = np.ones(len(log.frame)) if log.range is None else log.range
    return ranges[row[row >= 0]]


def table(rows):
    """Text: a line per model, the best first."""
    rows = sorted(rows, key=lambda row: -_mean(row))
    lines = [f"{'error model':30}{'held-out evidence':>24}{'to the best':>16}  learned"]
    for row in rows:
        told = f"{np.mean(row.evidence):.2f} ± {np.std(row.evidence, ddof=1):.2f}"
        behind = f"{_mean(row) - _mean(rows[0]):.2f}"
        values = (f"{name} {value:.3g} {TABLE[name].unit}" for name, value in row.values.items())
        lines.append(f"{row.model:30}{told:>24}{behind:>16}  {', '.join(values)}")
    return "\n".join(lines)


def preferred(rows):
    """A sentence: which model the held-out logs prefer, and by how much."""
    best, second = sorted(rows, key=lambda row: -_mean(row))[:2]
    ahead = _mean(best) - _mean(second)
    error = np.hypot(
        *(np.std(r.evidence, ddof=1) / np.sqrt(len(r.evidence)) for r in (best, second))
    )
    each = f"{ahead:.1f} nats, {ahead / max(best.count, 1):.2g} per measurement"
    if not ahead > SURE * error:
        return (
            f"no preference: {best.model} is ahead of {second.model} by {each}, "
            f"with a standard error of {error:.1f}"
        )
    return f"the held-out logs prefer {best.model}: ahead of {second.model} by {each}"


def _mean(row):
    """Mean evidence; what is not finite comes last."""
    return float(np.mean(row.evidence)) if row.finite else -np.inf


def arguments(description):
    """The arguments of an experiment that learns from logs, as those of `jaxslam learn`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("logs", nargs="+", help="logs to learn from")
    parser.add_argument("--held-out", nargs="+", default=[], help="logs to judge by")
    for option in ("--start", "--held-out-start", "--spacing"):
        parser.add_argument(option, type=float, default=0.0, metavar="SECONDS")
    for option in ("--end", "--held-out-end"):
        parser.add_argument(option, type=float, metavar="SECONDS")
    parser.add_argument("--window", type=float, default=60.0, metavar="SECONDS")
    parser.add_argument("--sensor")
    parser.add_argument("--association", choices=ASSOCIATIONS, default="sampled")
    parser.add_argument("--params", help="TOML file of starting values")
    parser.add_argument("--parameters", help="what to learn, separated by commas")
    for option, default in (("particles", 200), ("seeds", 4), ("steps", 150), ("seed", 0)):
        parser.add_argument(f"--{option}", type=int, default=default)
    return parser


def prepare(given):
    """Windows to learn from and to judge by, `Config`, starting `Params` and names to learn."""
    sides = (given.logs, given.start, given.end), (
        given.held_out, given.held_out_start, given.held_out_end
    )  # fmt: skip
    known = given.association == "known"
    train, held_out = (
        [
            part
            for name in names
            for part in split_log(load_log(name), start, end, given.window, given.spacing, known)[0]
        ]
        for names, start, end in sides
    )
    config, _ = config_for_logs(train + held_out, given.sensor, given.association, given.particles)
    params = default_params(config.sensor, train[0])
    params = load_params(given.params, params) if given.params else params
    if given.parameters:
        return train, held_out, config, params, tuple(given.parameters.split(","))
    names = fit.default_names(config)
    names = (n for n in names if getattr(params, n) > 0 or TABLE[n].scale == "linear")
    return train, held_out, config, params, tuple(names)


def main():
    given = arguments(__doc__.splitlines()[0]).parse_args()
    if not given.held_out:
        sys.exit("error_models.py: add --held-out logs to compare by")
    rows = compare(
        *prepare(given), given.seeds, given.steps, given.seed,
        lambda done, total: print(f"model {done + 1} of {total}", file=sys.stderr),
    )  # fmt: skip
    print(f"{table(rows)}\n{preferred(rows)}")
    return int(any(not row.finite for row in rows))


if __name__ == "__main__":
    sys.exit(main())
