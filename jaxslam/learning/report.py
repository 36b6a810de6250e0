"""What was learnt, for people: the table, the sentences below it, `learn.csv` and `learn.png`."""

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

KNOWN = 2.0  # free scale: from here on (a factor of 7) a standard error is without meaning
MADE = {  # `uncertainty.combined`
    "both": "products of the scores and their slope agree",
    "outer": "from products of the scores; their slope is lost in the particles' noise",
    "sandwich": "products of the scores and their slope disagree, as with a model that is not "
    "quite right; they are the sandwich of both",
}
WIDE = 3.0  # an axis from x to this many times x is drawn logarithmic, where that is the free scale


class Judged(NamedTuple):
    """Log evidence [seeds] of the held-out logs at the start and at the estimate, by seed."""

    before: np.ndarray
    after: np.ndarray


def table(fit, errors):
    """Text: a line per parameter, with its start, estimate, errors and verdict."""
    rows = [("parameter", "start", "estimate", "std error", "Monte Carlo", "unit", "verdict")]
    known = standard_errors(errors)
    for i, name in enumerate(fit.names):
        told = [f"{getattr(params, name):.4g}" for params in (fit.start, fit.params)]
        numbers = (errors.standard_error[i], errors.monte_carlo_error[i])
        told += [f"{number:.2g}" if name in known else "-" for number in numbers]
        rows.append((name, *told, TABLE[name].unit, errors.verdict[i]))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    align = "<>>>><<"
    return "\n".join(
        "  ".join(f"{cell:{a}{w}}" for cell, a, w in zip(row, align, widths, strict=True)).rstrip()
        for row in rows
    )


def standard_errors(errors):
    """Standard errors by name, of those parameters that the log says anything about."""
    told = zip(errors.names, errors.standard_error, errors.free_error, strict=True)
    return {name: float(error) for name, error, free in told if free < KNOWN}


def describe(fit, errors, judged=None):
    """Lines of text: why it ended, held-out evidence, how far the particles are to be trusted."""
    lines = [f"{fit.stopped} ({fit.steps} steps, {fit.seconds:.0f} s)"]
    if judged is not None:
        gain = judged.after - judged.before
        lines.append(
            f"held-out evidence: {_spread(judged.before)} before, {_spread(judged.after)} after, "
            f"difference {_spread(gain, '+')} nats ({len(gain)} fresh seeds)"
        )
    lines.append(f"standard errors: {MADE[errors.made]}")
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
    """Which parameter the score with another discount would move most, and by how many standard
    errors: a Newton step from where the two scores differ."""
    change = errors.discounts[discount] - errors.discounts[DISCOUNT]
    step = errors.covariance @ change
    far = np.abs(step) / np.maximum(errors.free_error, 1e-300)
    return errors.names[int(np.argmax(far))], float(far.max())


def flags(fit, errors, judged=None, dropped=None):
    """Lines on what went wrong: rows lost, numbers not finite."""
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
    """Lines on what to distrust, though nothing was lost."""
    lines = []
    if not errors.log_z_sd <= MANY:
        lines.append(
            f"log Z of one log spreads by {errors.log_z_sd:.2g} nats over seeds, above {MANY:g}: "
            "more --particles or a shorter --window"
        )
    if judged is None:
        lines.append("no --held-out log: nothing says whether other logs get more likely, too")
    elif not np.mean(judged.after - judged.before) >= 0:
        lines.append("the held-out logs got less likely: keep what you had")
    if fit.config.association == "maximum_likelihood":
        lines.append(BIASED)
    return lines


def _spread(values, sign=""):
    return f"{np.mean(values):{sign}.2f} ± {np.std(values, ddof=1):.2f}"


def save_csv(path, fit):
    """Write a row per step: what was found before the step moved, and what the held-out logs said
    after it; `loss` is minus the mean log likelihood per frame."""
    told = fit.history
    held = {int(step): i for i, step in enumerate(told.held_out_step)}
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    head = ("step", "loss", "gradient_norm", "rate", *fit.names, "held_out", "held_out_error")
    rows.writerow(head)
    free = np.reshape(told.free, (-1, len(fit.names)))
    values = np.column_stack([estimates(n, free[:, i]) for i, n in enumerate(fit.names)])
    for s, at in enumerate(values):
        judged = ("", "")
        if s + 1 in held:
            i = held[s + 1]
            judged = repr(float(told.held_out[i])), repr(float(told.held_out_error[i]))
        numbers = (-told.log_likelihood[s], told.gradient_norm[s], told.rate[s], *at)
        rows.writerow([s + 1, *(f"{float(number):.9g}" for number in numbers), *judged])
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def estimates(name, free):
    """A parameter's values for free ones, as NumPy has them."""
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
    """Write a figure as PNG, whole or not at all."""
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
    # What is hardly known has an error that would hide the rest.
    shown = np.array([path.min(), path.max(), middle])
    span = np.ptp(shown)
    near = [max(low, shown.min() - span), min(high, shown.max() + span)]
    fit_axis(axes, "y", name, min(shown.min(), near[0]), max(shown.max(), near[1]))
    axes.set_title(f"{name} [{TABLE[name].unit}]")


def fit_axis(axes, side, name, low, high):
    """Limits of an axis for a parameter between two values; logarithmic where they are far apart
    and the parameter is learnt as a logarithm."""
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
    told = fit.history
    axes.errorbar(
        told.held_out_step, told.held_out, told.held_out_error,
        fmt="o-", color=REFINED, ms=4, lw=1.2, capsize=2,
    )  # fmt: skip
    # The one that the last Newton step went from.
    chosen = np.flatnonzero((np.asarray(told.tail) == errors.free).all(1))
    if len(chosen):
        step, value = told.held_out_step[chosen[0]], told.held_out[chosen[0]]
        axes.plot(step, value, "o", ms=10, mfc="none", mec=LANDMARK, mew=1.5)
        axes.annotate("taken", (step, value), (-9, -3), textcoords="offset points", ha="right")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.set_title("held-out evidence, nats")
