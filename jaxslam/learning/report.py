"""Report of a fit: the table, the sentences below it, `learn.csv` and `learn.png`."""

import csv
import io
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from jaxslam.files import atomic_write
from jaxslam.learning.likelihood import BIASED, DISCOUNT
from jaxslam.learning.transforms import from_free
from jaxslam.learning.uncertainty import MANY
from jaxslam.parameters import TABLE
from jaxslam.plotting import FILTER, LANDMARK, RECKONING, REFINED, STYLE, write_figure
from jaxslam.results.tables import format_table

KNOWN = 2.0  # free scale: standard errors from here on (a factor of 7) are meaningless
METHODS = {  # `uncertainty.combine_covariances`
    "both": "outer products and slope of the score agree",
    "outer": "from outer products of the score; its slope is lost in Monte-Carlo noise",
    "sandwich": "outer products and slope of the score disagree, as with an inexact model; "
    "sandwich of both",
}
WIDE = 3.0  # ratio of an axis' ends from which a positive parameter's is logarithmic


class Judged(NamedTuple):
    """Log evidence [seeds] of the held-out logs at the start and at the estimate."""

    before: np.ndarray
    after: np.ndarray


def table(fit, errors):
    """Text with a line per parameter: start, estimate, errors and verdict."""
    rows = [("parameter", "start", "estimate", "std error", "Monte Carlo", "unit", "verdict")]
    known = standard_errors(errors)
    for i, name in enumerate(fit.names):
        cells = [f"{getattr(params, name):.4g}" for params in (fit.start, fit.params)]
        numbers = (errors.standard_error[i], errors.monte_carlo_error[i])
        cells += [f"{number:.2g}" if name in known else "-" for number in numbers]
        rows.append((name, *cells, TABLE[name].unit, errors.verdict[i]))
    return format_table(rows, "<>>>><<")


def standard_errors(errors):
    """Standard errors by name, without those from `KNOWN` on."""
    columns = zip(errors.names, errors.standard_error, errors.free_error, strict=True)
    return {name: float(error) for name, error, free in columns if free < KNOWN}


def describe(fit, errors, judged=None):
    """Lines of text: reason of the end, held-out evidence, Monte-Carlo errors, unresolved."""
    lines = [f"{fit.stopped} ({fit.steps} steps, {fit.seconds:.0f} s)"]
    if judged is not None:
        gain = judged.after - judged.before
        lines.append(
            f"held-out evidence: {_spread(judged.before)} before, {_spread(judged.after)} after, "
            f"difference {_spread(gain, '+')} nats ({len(gain)} fresh seeds)"
        )
    lines.append(f"standard errors: {METHODS[errors.covariance_method]}")
    share = np.max(errors.monte_carlo_error / np.maximum(errors.standard_error, 1e-300))
    lines.append(f"Monte-Carlo error: at most {share:.2g} of a standard error")
    lines.append(f"log Z of one log spreads by {errors.log_z_sd:.2f} nats over seeds")
    for discount in sorted(errors.discounts):
        if discount != DISCOUNT:
            name, far = movement(errors, discount)
            lines.append(
                f"discount {discount:g} instead of {DISCOUNT:g} would move the estimate by "
                f"{far:.2g} standard errors at most ({name})"
            )
    return [*lines, *errors.unresolved]


def movement(errors, discount):
    """Name of the parameter that another discount would move most, and by how many standard errors:
    a Newton step by the difference of the two scores."""
    change = errors.discounts[discount] - errors.discounts[DISCOUNT]
    step = errors.covariance @ change
    far = np.abs(step) / np.maximum(errors.free_error, 1e-300)
    return errors.names[int(np.argmax(far))], float(far.max())


def flags(fit, errors, judged=None, dropped=None):
    """Warnings: measurements not used, numbers not finite."""
    lines = [f"{count} measurements not used: {why}" for why, count in (dropped or {}).items()]
    lost = int((~np.isfinite(fit.history.gradient_norm)).sum())
    if lost:
        lines.append(f"the score was not finite in {lost} of {fit.steps} steps")
    bad = [n for n, e in zip(fit.names, errors.standard_error, strict=True) if not np.isfinite(e)]
    if bad:
        lines.append(f"the standard error is not finite: {', '.join(bad)}")
    if judged is not None and not np.isfinite([*judged.before, *judged.after]).all():
        lines.append("held-out evidence is not finite")
    return lines


def advice(fit, errors, judged=None):
    """Notes on what to distrust."""
    lines = []
    if not errors.log_z_sd <= MANY:
        lines.append(
            f"log Z of one log spreads by {errors.log_z_sd:.2g} nats over seeds, above {MANY:g}: "
            "more --particles or a shorter --window"
        )
    if judged is None:
        lines.append("no --held-out log: whether other logs become more likely is unknown")
    elif not np.mean(judged.after - judged.before) >= 0:
        lines.append("the held-out logs became less likely: keep the parameters you had")
    if fit.config.association == "maximum_likelihood":
        lines.append(BIASED)
    return lines


def _spread(values, sign=""):
    return f"{np.mean(values):{sign}.2f} ± {np.std(values, ddof=1):.2f}"


def save_csv(path, fit):
    """Write a row per step: loss, gradient and parameters before the step, held-out evidence after
    it; `loss` is minus the mean log likelihood per frame."""
    history = fit.history
    held = {int(step): i for i, step in enumerate(history.held_out_step)}
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    head = ("step", "loss", "gradient_norm", "rate", *fit.names, "held_out", "held_out_error")
    rows.writerow(head)
    free = np.reshape(history.free, (-1, len(fit.names)))
    values = np.column_stack([estimates(n, free[:, i]) for i, n in enumerate(fit.names)])
    for s, at in enumerate(values):
        judged = ("", "")
        if s + 1 in held:
            i = held[s + 1]
            judged = repr(float(history.held_out[i])), repr(float(history.held_out_error[i]))
        numbers = (-history.log_likelihood[s], history.gradient_norm[s], history.rate[s], *at)
        rows.writerow([s + 1, *(f"{float(number):.9g}" for number in numbers), *judged])
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def estimates(name, free):
    """Values of a parameter as a NumPy array, from free ones."""
    return np.asarray(from_free(name, np.asarray(free)), float)


def draw_learning(fit, errors):
    """Figure: every parameter, the loss and the held-out evidence by step."""
    names = fit.names
    panels = len(names) + 1 + bool(len(fit.history.held_out))
    columns = min(3, panels)
    rows = -(-panels // columns)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(3.6 * columns, 2.4 * rows + 0.5), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for i, name in enumerate(names):
            _draw_parameter(axes[i], fit, errors, i, name)
        _draw_likelihood(axes[len(names)], fit)
        if len(fit.history.held_out):
            _draw_held_out(axes[len(names) + 1], fit, errors)
        for spare in axes[panels:]:
            spare.remove()
        for shown in axes[:panels]:
            shown.set_xlabel("step")
            shown.set_xlim(-0.02 * fit.steps, 1.02 * fit.steps)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def save_figure(figure, path):
    """Write a figure as PNG, atomically."""
    with matplotlib.rc_context(STYLE):
        write_figure(figure, path)


def _draw_parameter(axes, fit, errors, i, name):
    path = estimates(name, fit.history.free[:, i])
    at, error = fit.free[i], np.fmin(errors.free_error[i], KNOWN)
    low, middle, high = estimates(name, np.array([at - error, at, at + error]))
    axes.plot(np.arange(len(path)), path, color=FILTER, lw=1.2, label="iterates")
    axes.plot(0, path[0], "o", color=RECKONING, ms=5, label="start", clip_on=False, zorder=5)
    axes.axhline(middle, color=LANDMARK, lw=1.2, label="estimate")
    axes.axhspan(low, high, color=LANDMARK, alpha=0.15, lw=0, label="± 1 standard error")
    # The band of a weakly determined parameter must not hide the rest.
    shown = np.array([path.min(), path.max(), middle])
    span = np.ptp(shown)
    near = [max(low, shown.min() - span), min(high, shown.max() + span)]
    fit_axis(axes, "y", name, min(shown.min(), near[0]), max(shown.max(), near[1]))
    axes.set_title(f"{name} [{TABLE[name].unit}]")


def fit_axis(axes, side, name, low, high):
    """Set an axis' limits for a parameter between two values; logarithmic where they are far apart
    and the free scale is a logarithm."""
    axis = getattr(axes, f"{side}axis")
    if TABLE[name].scale == "log" and low > 0 and high / low > WIDE:
        getattr(axes, f"set_{side}scale")("log")
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
        margin = (high / low) ** 0.05
        limits = low / margin, high * margin
    else:
        margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
        least = -np.inf if TABLE[name].scale == "linear" else 0.0
        limits = max(low - margin, least), high + margin
    getattr(axes, f"set_{side}lim")(*limits)


def _draw_likelihood(axes, fit):
    axes.plot(fit.history.log_likelihood, color=FILTER, lw=1.0)
    axes.set_title("log likelihood, nats per frame")


def _draw_held_out(axes, fit, errors):
    history = fit.history
    axes.errorbar(
        history.held_out_step, history.held_out, history.held_out_error,
        fmt="o-", color=REFINED, ms=4, lw=1.2, capsize=2,
    )  # fmt: skip
    # The evaluation from which the last Newton step started.
    chosen = np.flatnonzero((np.asarray(history.tail) == errors.free).all(1))
    if len(chosen):
        step, value = history.held_out_step[chosen[0]], history.held_out[chosen[0]]
        axes.plot(step, value, "o", ms=10, mfc="none", mec=LANDMARK, mew=1.5)
        axes.annotate("taken", (step, value), (-9, -3), textcoords="offset points", ha="right")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.set_title("held-out evidence, nats")
