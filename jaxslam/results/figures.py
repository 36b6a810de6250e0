"""The figures of a run: its map, its error over time, its particles. Without pyplot's global state.

Estimates are drawn without alignment to the truth, since the start pose is given.
"""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullFormatter

from jaxslam.logs.truth import truth_at, wrap
from jaxslam.plotting import (
    ANCESTRAL,
    FILTER,
    LANDMARK,
    PLAN,
    RECKONING,
    REFINED,
    STYLE,
    TRUE,
    ellipses,
    write_figure,
)
from jaxslam.results.metrics import ate, has_truth, path_estimates

FIGURES = ("map.png", "error.png", "particles.png")


def draw_figures(result, directory):
    """Write map.png, error.png and particles.png into a folder; returns their paths.

    Raises `ValueError` if they can't be written.
    """
    directory = Path(directory)
    paths = []
    for name, draw in zip(FIGURES, (draw_map, draw_error, draw_particles), strict=True):
        with matplotlib.rc_context(STYLE):
            figure = draw(result)
            paths.append(write_figure(figure, directory / name))
    return paths


def draw_map(result):
    """Draw paths and landmarks with 3-sigma ellipses, over the plan or a box about the truth."""
    log, true = result.log, truth_at(result.log.truth, result.time)
    low, high, core = _limits(result, true)
    width, height = high - low
    size = np.array([width, height]) * min(9.5 / width, 7.5 / height)
    figure = Figure(figsize=(max(size[0], 5) + 0.9, size[1] + 1.9), layout="constrained")
    axes = figure.add_subplot()
    _draw_plan(axes, log, core)
    if has_truth(true).any():
        _curve(axes, *true[:, :2].T, TRUE, label="true path")
    reckoning = result.dead_reckoning
    axes.plot(*reckoning[:, :2].T, "--", color=RECKONING, lw=0.7, label="dead reckoning", zorder=1)
    axes.plot(*result.pose[:, :2].T, color=FILTER, lw=0.8, alpha=0.7, label="filter", zorder=3)
    if result.refined is not None:
        path = result.refined.pose
        axes.plot(*path[:, :2].T, color=REFINED, lw=0.9, label="refined", zorder=3.5)
    axes.plot(*log.start_pose[:2], "D", ms=6, mec="white", color=FILTER, label="start", zorder=6)
    if log.truth is not None and log.truth.landmarks is not None:
        style: dict = dict(ms=9, mfc="none", mec=TRUE, label="true landmark", zorder=4)
        axes.plot(*log.truth.landmarks.T, "o", **style)
    for world, sign, colour, label in (
        (result.landmarks, "+", LANDMARK, "filter's"),
        (result.landmarks_refined, "x", REFINED, "refined"),
    ):
        if world is not None:
            _draw_landmarks(axes, world, sign, colour, label)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
    axes.set_title(_title(result, true, low, high))
    columns = 7 if figure.get_figwidth() > 9 else 4
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    return figure


def _draw_landmarks(axes, landmarks, sign, colour, source):
    """Draw the finite landmarks of a map: signs and ellipses."""
    mean, cov = np.reshape(landmarks.mean, (-1, 2)), np.reshape(landmarks.cov, (-1, 3))
    drawable = np.isfinite(mean).all(1) & np.isfinite(cov).all(1)
    mean, cov = mean[drawable], cov[drawable]
    if len(mean) == 0:
        return
    style: dict = dict(ms=6, mew=1.4, color=colour, zorder=5)
    (signs,) = axes.plot(*mean.T, sign, label=f"{source} landmark", **style)
    signs.set_path_effects([withStroke(linewidth=2.8, foreground="white")])
    outlines = LineCollection(
        ellipses(mean, cov), colors=colour, linewidths=0.9, zorder=5, label=rf"{source} 3$\sigma$"
    )
    axes.add_collection(outlines, autolim=False)


def _draw_plan(axes, log, core):
    """Draw the floor plan or, without one, the box about the truth (or the estimate)."""
    plan = log.plan
    if plan is not None and plan.image is not None:
        height, width = plan.image.shape
        (x, y), scale = plan.origin, plan.scale
        extent = (x, x + width * scale, y, y + height * scale)
        axes.imshow(plan.image, cmap="gray", vmin=0, vmax=255, alpha=0.5, extent=extent, zorder=0)
    if plan is not None and plan.segments is not None:
        walls = plan.segments.reshape(-1, 2, 2)
        axes.add_collection(LineCollection(walls, colors=PLAN, linewidths=2.2, zorder=0))
    if plan is None:
        (x, y), (right, top) = core
        axes.fill([x, right, right, x], [y, y, top, top], color="#F4F4F1", zorder=0)


def _limits(result, true):
    """Return corners low, high [2] of the picture, and those of the room (plan and truth).

    The picture shows the room and the filter's path, and of dead reckoning and the estimated
    landmarks, which may be anywhere, what is at most a third of that size outside.
    """
    plan, truth = result.log.plan, result.log.truth
    room = [true[has_truth(true), :2]]
    if plan is not None and plan.segments is not None:
        room.append(plan.segments.reshape(-1, 2))
    if plan is not None and plan.image is not None:
        size = np.array(plan.image.shape[::-1]) * plan.scale
        room.append(np.array([plan.origin, plan.origin + size]))
    if truth is not None and truth.landmarks is not None:
        room.append(truth.landmarks)
    path = np.concatenate([result.pose[:, :2], result.log.start_pose[None, :2]])
    low, high = _corners(np.concatenate([*room, path]))
    core = _corners(np.concatenate(room)) if sum(map(len, room)) else (low, high)
    beyond = max((high - low).max() / 3, 0.5)
    loose = [result.dead_reckoning[:, :2], np.reshape(result.landmarks.mean, (-1, 2))]
    if result.refined is not None:
        loose += [result.refined.pose[:, :2], result.refined.mean]
    loose = np.concatenate(loose)
    loose = loose[((loose >= low - beyond) & (loose <= high + beyond)).all(1)]
    low, high = _corners(np.concatenate([loose, low[None], high[None]]))
    pad = 0.04 * (high - low).max() + 0.1
    return low - pad, high + pad, core


def _corners(points):
    """Return the lower-left and upper-right corner of points [n, 2]."""
    return np.nanmin(points, 0), np.nanmax(points, 0)


def _title(result, true, low, high):
    config = result.config
    about = f"{config.sensor}, {config.association}".replace("_", " ")
    path_error = "no true path"
    if has_truth(true).any():
        errors = [
            f"{ate(path, true, align=False)[0]:.2f} m {name}"
            for name, path in path_estimates(result).items()
            if name in ("filtered", "refined")
        ]
        path_error = f"path error {', '.join(errors)} (RMSE, not aligned)"
    about += f", {config.particles:,} particles"
    return f"{result.log.name}: {about}\n{path_error}; {_count(result, low, high)}"


def _count(result, low, high):
    """Say how many landmarks there are, and how many of them are outside the picture."""
    mean = np.reshape(result.landmarks.mean, (-1, 2))
    outside = int(((mean < low) | (mean > high)).any(1).sum())
    about = [f"{len(result.refined.mean)} refined"] if result.refined is not None else []
    about += [f"{outside} outside the picture"] if outside else []
    return f"{len(mean)} landmarks" + (f" ({', '.join(about)})" if about else "")


LINES = {  # colour, width and label of the paths, in drawing order
    "ancestral": (ANCESTRAL, 2.4, "ancestral"),  # wider: the filter's line covers most of it
    "filtered": (FILTER, 1.0, "filter"),
    "refined": (REFINED, 1.0, "refined"),
}


def draw_error(result):
    """Draw, over time, errors of position and heading with their own 3 sigma, and drift."""
    figure = Figure(figsize=(9.5, 7.5), layout="constrained")
    position, heading, drift = figure.subplots(3, 1, sharex=True, height_ratios=(1.25, 1, 1))
    seconds, true = _seconds(result), truth_at(result.log.truth, result.time)
    known = has_truth(true).any()
    _draw_band(position, heading, seconds, result.cov, FILTER, r"filter's own 3$\sigma$")
    if result.refined is not None:
        cov = result.refined.cov
        _draw_band(position, heading, seconds, cov, REFINED, r"refined path's own 3$\sigma$")
    reference = true if known else result.pose
    found = path_estimates(result)
    for name in [name for name in LINES if name in found]:
        path, (colour, width, label) = found[name], LINES[name]
        turned = np.degrees(wrap(path - true)[:, 2])
        turned[1:][np.abs(np.diff(turned)) > 180] = np.nan  # no line across the whole panel
        error = np.hypot(*(path - true)[:, :2].T)
        _curve(position, seconds, error, colour, label=label, width=width)
        _curve(heading, seconds, turned, colour, width=width)
        if known or name != "filtered":
            away = np.hypot(*(path - reference)[:, :2].T)
            _curve(drift, seconds, away, colour, width=width)
    away = np.hypot(*(result.dead_reckoning - reference)[:, :2].T)
    _curve(drift, seconds, away, RECKONING, "--", "dead reckoning")
    about = "errors, not aligned; gaps: no truth" if known else "the log has no truth"
    position.set(title=f"{result.log.name}: {about}", ylabel="position error [m]", ylim=(0, None))
    heading.set(ylabel="heading error [°]")
    about = "beside dead reckoning" if known else "dead reckoning, measured from the filter"
    measure = "position error" if known else "distance"
    drift.set(title=about, ylabel=f"{measure} [m]", ylim=(0, None))
    _time_axis(drift, seconds)
    figure.align_ylabels()
    figure.legend(loc="outside lower center", ncols=6)
    return figure


def _draw_band(position, heading, seconds, cov, colour, label):
    """Draw 3 sigma of poses [T, 3, 3]: of the position in the worst direction, of the heading."""
    xx, xy, yy = cov[:, (0, 0, 1), (0, 1, 1)].T
    largest = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    for axes, low, band in (
        (position, 0, 3 * np.sqrt(largest.clip(0))),
        (heading, -1, 3 * np.degrees(np.sqrt(cov[:, 2, 2].clip(0)))),
    ):
        fill = axes.fill_between(seconds, low * band, band, color=colour, alpha=0.22, lw=0)
    fill.set_label(label)


def _curve(axes, x, y, colour, style="-", label=None, width=1.1):
    """Draw a line; values without finite neighbours, which a line can't show, as dots."""
    known = np.pad(np.isfinite(y), 1)
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    axes.plot(x, y, style, color=colour, lw=width, label=label)
    axes.plot(x[alone], y[alone], ".", color=colour, ms=4)


def draw_particles(result):
    """Draw, over time, effective sample size and resampling, landmarks begun and lost, clutter."""
    past, seconds = result.ancestral, _seconds(result)
    figure = Figure(figsize=(9.5, 7.0 if past is None else 8.6), layout="constrained")
    heights = (1.5, 1, 1) if past is None else (1.5, 1, 1, 1)
    panels = figure.subplots(len(heights), 1, height_ratios=heights)
    sample, landmarks, clutter = panels[:3]
    for axes in (sample, landmarks):
        axes.sharex(clutter)
        axes.tick_params(labelbottom=False)
    _draw_sample_size(sample, result, seconds)
    if past is not None:
        _draw_ancestors(panels[3], past.distinct, seconds, result.config.particles)
    for name, label, colour in (
        ("new", "created, best particle", FILTER),
        ("forgotten", "forgotten, mean of particles", LANDMARK),
        ("overflow", "lost: map full, mean of particles", TRUE),
    ):
        count = np.cumsum(np.asarray(getattr(result, name), float))
        if name != "overflow" or count[-1:] > 0:
            landmarks.step(seconds, count, where="post", color=colour, lw=1.4, label=label)
    landmarks.set(ylabel="landmarks, in sum", ylim=(0, None))
    seen = (np.asarray(result.row) >= 0).sum(1)
    edges, (measured, rejected) = _binned(seconds, seen, result.outliers)
    clutter.stairs(measured, edges, color=PLAN, fill=True, alpha=0.6, label="measurements")
    clutter.stairs(rejected, edges, color=LANDMARK, fill=True, label="called clutter")
    clutter.set(ylabel="per frame", ylim=(0, None))
    _time_axis(clutter, seconds)
    for axes in panels:  # above the panel, where a legend hides nothing
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.1)
    figure.align_ylabels()
    return figure


def _draw_ancestors(axes, distinct, seconds, particles):
    """Draw how many ancestors the final particles have, over the time before the end."""
    before = (seconds[-1:] - seconds)[:-1]  # a logarithmic axis can't show the end itself
    distinct = distinct[: len(before)]
    axes.step(before, distinct, color=ANCESTRAL, lw=1.6, where="mid", label="distinct ancestors")
    lone = np.flatnonzero(distinct == 1)
    if lone.size:
        span = before[lone[-1]], before[lone[0]]  # earlier frames were redrawn, if any
        axes.axvspan(*span, color=PLAN, alpha=0.25, lw=0, label="all particles share one past")
    axes.set(xscale="log", yscale="log", ylim=(0.8, particles * 1.3), ylabel="ancestors")
    axes.set_xlabel("time before the end [s]")
    if before.size:
        axes.set_xlim(before[0], before[-1] * 0.9)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:,g}")
        axis.set_minor_formatter(NullFormatter())


def _draw_sample_size(axes, result, seconds):
    """Draw span and median of the effective sample size in short stretches; resampling as a rug."""
    config, ess = result.config, np.asarray(result.ess, float)
    stretches = np.array_split(np.arange(ess.size), min(300, ess.size))
    at = [seconds[stretch].mean() for stretch in stretches]
    span = np.array([np.percentile(ess[stretch], (0, 50, 100)) for stretch in stretches]).T
    axes.fill_between(at, span[0], span[2], color=FILTER, alpha=0.25, lw=0, label="least to most")
    axes.plot(at, span[1], color=FILTER, lw=1.1, label="median")
    threshold = config.resample_threshold * config.particles
    if threshold > 0:
        axes.axhline(threshold, color=LANDMARK, lw=1.2, ls="--", label="resampled below")
    ticks = seconds[np.asarray(result.resampled, bool)]
    rug = axes.vlines(ticks, 0, 0.04, colors=TRUE, lw=0.6, transform=axes.get_xaxis_transform())
    rug.set_alpha(min(1.0, 300 / max(ticks.size, 1)))
    least = max(0.8, np.nanmin(ess, initial=config.particles / 10) / 3)
    axes.set(yscale="log", ylim=(least, config.particles * 1.3), ylabel="effective particles")
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    about = f"{config.particles:,} particles, resampled {ticks.size:,} times"
    axes.set_title(f"{result.log.name}: {about}")


def _binned(seconds, *columns, bins=120):
    """Return edges and means of columns [T] over equal spans of time; 0 where one is empty."""
    bins = min(bins, max(len(seconds), 1))
    edges = np.linspace(0, max(seconds[-1:].max(initial=0), 1e-3), bins + 1)
    count = np.histogram(seconds, edges)[0].clip(1)
    return edges, [np.histogram(seconds, edges, weights=column)[0] / count for column in columns]


def _seconds(result):
    """Return frame times [T] in seconds since the first frame."""
    return (result.time - result.time[:1]) / 1e9


def _time_axis(axes, seconds):
    axes.set(xlabel="time [s]", xlim=(0, max(seconds[-1:].max(initial=0), 1e-3)))
