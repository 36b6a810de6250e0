"""Report of a sensor calibration: text, parameters, and the paper's fig. 6."""

from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from calibration.odometry import ODOMETRY
from calibration.points import Model, PointErrors, compare, coverage, identify_lines, point_errors
from calibration.sensor import ErrorModel, fit
from jaxslam.logs.truth import truth_at
from jaxslam.parameters import TABLE, Params
from jaxslam.plotting import FILTER, LANDMARK, STYLE, TRUE, ellipses, write_figure

SHOWN = 250  # largest number of points drawn: more would cover each other


class SensorReport(NamedTuple):
    """Noise of bearings and odometry; errors and models of points (None, empty without points)."""

    bearing: ErrorModel
    errors: PointErrors | None
    models: list[Model]


def calibrate_sensor(log):
    """`SensorReport` of a drive with true poses and surveyed lines.

    Lines without identities get that of the surveyed line at their bearing. Raises `ValueError`
    naming what the log lacks.
    """
    unidentified = log.identity is None and (log.truth is None or log.truth.identity is None)
    identified = identify_lines(log) if unidentified else log
    bearing = fit(identified)
    if not log.has("position") or log.point is None:
        return SensorReport(bearing, None, [])
    errors = point_errors(identified, bearing.values["gain_tran"])
    return SensorReport(bearing, errors, compare(errors))


def values(report):
    """Estimated values of `Params` and their standard errors, two dicts by name.

    The mounting is left out, since it is the camera's.
    """
    found = {k: v for k, v in report.bearing.values.items() if not k.startswith("mount")}
    errors = {k: v for k, v in report.bearing.standard_errors.items() if k in found}
    for model in report.models:
        if model.name == "propagated normal":
            found["position_scale"] = model.values["position_scale"]
    return {k: v for k, v in found.items() if k in Params._fields}, errors


def filter_params(report, base):
    """`Params` for the filter: `base` with the estimated motion and scale of the points' errors.

    `sigma_bearing` stays that of `base`, and the estimated `position_scale` multiplies that of
    `base`: with noise as small as the lines', few particles would take all the weight.
    """
    estimated, _ = values(report)
    motion = {k: estimated[k] for k in ODOMETRY if k in estimated}
    scale = base.position_scale * estimated.get("position_scale", 1.0)
    return base._replace(**motion, position_scale=scale)


def text(report):
    """The tables that `jaxslam calibrate sensor` prints."""
    found, errors = values(report)
    lines = [f"{'parameter':<16}{'value':>11}{'std. error':>12}  unit"]
    for name, value in found.items():
        error = f"{errors[name]:.2g}" if name in errors else ""
        lines.append(f"{name:<16}{value:>11.5g}{error:>12}  {TABLE[name].unit}")
    if report.models:
        lines += ["", _describe_errors(report.errors), ""]
        lines.append(f"{'error model of a point':<24}{'nats/point':>11}{'in 95 %':>9}  parameters")
        for model in report.models:
            shown = ", ".join(f"{k} {v:.4g}" for k, v in model.values.items())
            row = f"{model.name:<24}{model.held_out:>11.3f}{100 * model.coverage:>8.1f}%  {shown}"
            lines.append(row)
        best, second = report.models[:2]
        gap = best.held_out - second.held_out
        lines.append(f"preferred: {best.name}, by {gap:.3f} nats per held-out point")
    return "\n".join(lines)


def _describe_errors(errors):
    """One line on the points' errors."""
    off = np.linalg.norm(errors.point - errors.true, axis=1)
    counts = ", ".join(f"{count} {what}" for what, count in errors.counts.items())
    median, most = np.median(off), np.quantile(off, 0.95)
    quantiles = f"median error {100 * median:.1f} cm, 95 % quantile {100 * most:.1f} cm"
    return f"{counts}; {quantiles}; {100 * coverage(errors):.1f} % within their 95 % ellipse"


def draw(report, log, path):
    """Draw the paper's fig. 6 in the world's frame: surveyed lines, points, 95 % ellipses.

    Raises `ValueError` without points, or if the file can't be written.
    """
    if report.errors is None:
        raise ValueError(f"{log.name}: has no triangulated points to draw")
    chosen = np.unique(np.linspace(0, len(report.errors.row) - 1, SHOWN).astype(int))
    errors = report.errors.part(chosen)
    pose = _sensor_poses(log)[errors.frame]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    point, true = (pose[:, :2] + (turn @ p[..., None])[..., 0] for p in (errors.point, errors.true))
    cov = turn @ errors.cov @ turn.transpose(0, 2, 1)
    outline = ellipses(point, cov[:, [0, 0, 1], [0, 1, 1]], np.sqrt(-2 * np.log(0.05)))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 6), layout="constrained")
        axes = figure.add_subplot()
        axes.plot(*outline.transpose(2, 1, 0), color=FILTER, lw=0.5, alpha=0.5)
        axes.plot(*point.T, "+", ms=5, color=FILTER, label="triangulated, 95 % ellipse")
        axes.plot(*true.T, "o", ms=8, mfc="none", mec=LANDMARK, label="surveyed line")
        axes.plot(*_sensor_poses(log)[:, :2].T, ".", ms=3, color=TRUE, label="image taken")
        axes.set(xlabel="x [m]", ylabel="y [m]", title="Points triangulated on a straight drive")
        x, y = np.stack([np.min(true, axis=0) - 0.6, np.max(true, axis=0) + 0.6], 1)
        axes.set(xlim=x, ylim=y, aspect="equal")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        return write_figure(figure, path)


def _sensor_poses(log):
    """True sensor poses [F, 3] at the frames."""
    pose = truth_at(log.truth, log.frame_time)
    mx, my, yaw = log.mounting
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return pose + np.column_stack([c * mx - s * my, s * mx + c * my, np.full(len(pose), yaw)])
