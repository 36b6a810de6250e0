"""The log likelihood over a grid of two parameters, with the path that a fit took.

    python experiments/likelihood_surface.py lost-in-the-woods --end 300 --association known \\
        --spacing 1 --over err_rot err_drift --out surface.png
"""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from error_models import arguments, prepare
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from jaxslam.filter import sharding
from jaxslam.learning import fit as learn
from jaxslam.learning import likelihood, transforms, uncertainty
from jaxslam.learning.report import KNOWN, estimates, fit_axis, save_figure
from jaxslam.parameters import TABLE, Params
from jaxslam.plotting import LANDMARK, RECKONING, STYLE, ellipses

CELLS = 9
REACH = 2.5  # standard errors about the estimate, at least
MOST = 1.5  # of the free scale, at most
LEVELS = (-1000, -300, -100, -30, -10, -4.5, -2, -0.5, 0)  # nats below the top


class Surface(NamedTuple):
    """Log likelihood [A, B], mean over seeds, at free values `first` [A] and `second` [B] of the
    two parameters `names`, all others as estimated. `noise`: standard deviation of that mean from
    cell to cell, by how the seeds differ; what differs by less is no slope."""

    names: tuple
    first: np.ndarray
    second: np.ndarray
    log_likelihood: np.ndarray
    noise: float


def surface(logs, fit, errors, pair, seeds=2, seed=0, progress=None):
    """`Surface` of a pair of the learned parameters around the path and the estimate.

    The same random numbers everywhere: neighbours then differ by less than seeds do. `progress`:
    called with (columns done, columns).
    """
    data = learn.stack_logs(logs, fit.config, fit.params)
    dtype = data.start_pose.dtype
    count = len(data.start_pose)
    numbers = Params(*(jnp.asarray(value, dtype) for value in fit.params))
    keys = jax.random.split(jax.random.key(seed), count * seeds)
    which = np.repeat(np.arange(count), seeds)
    first, second = (_span(fit, errors, name) for name in pair)
    columns = []
    for done, x in enumerate(first, 1):
        free = np.column_stack([np.full(CELLS, x), second]).repeat(len(which), 0)
        found = _values(
            jnp.asarray(free, dtype), numbers, data, np.tile(which, CELLS),
            jnp.tile(keys, CELLS), fit.config, tuple(pair),
        )  # fmt: skip
        columns.append(np.asarray(found, float).reshape(CELLS, count, seeds).sum(1))
        if progress:
            progress(done, CELLS)
    by_seed = np.array(columns)
    mean = by_seed.mean(2)
    rest = by_seed - mean[..., None]
    noise = float((rest - rest.mean((0, 1))).std() / np.sqrt(seeds - 1))
    return Surface(tuple(pair), first, second, mean, noise)


def _span(fit, errors, name):
    """Free values [CELLS] that hold the path and the surroundings of the estimate."""
    i = fit.names.index(name)
    reach = min(REACH * float(np.nan_to_num(errors.free_error[i], nan=MOST)), MOST)
    shown = np.append(fit.history.free[:, i], fit.free[i] + reach * np.array([-1, 1]))
    return np.linspace(shown.min(), shown.max(), CELLS)


@partial(jax.jit, static_argnames=("config", "names"))
def _values(free, params, data, which, keys, config, names):
    """Log likelihood [I] of logs `which` with `keys` at `free` [I, P]."""

    def one(item):
        at, log, key = item
        mine = jax.tree.map(lambda leaf: leaf[log], data)
        return likelihood.value(transforms.with_free(params, names, at), mine, key, config)

    return sharding.map_over_devices(one, (free, which, keys), len(jax.devices()))


def draw_surface(found, fit, errors):
    """Figure of a `Surface`: nats below its top, the fit's path, the 1-sigma ellipse."""
    where = [fit.names.index(name) for name in found.names]
    x, y = (estimates(n, f) for n, f in zip(found.names, (found.first, found.second), strict=True))
    below = found.log_likelihood.T - np.nanmax(found.log_likelihood)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 5.2), layout="constrained")
        axes = figure.add_subplot()
        shown = np.ma.masked_invalid(np.maximum(below, LEVELS[0]))
        norm = matplotlib.colors.BoundaryNorm(LEVELS, 256)
        filled = axes.contourf(x, y, shown, LEVELS, cmap="Blues", norm=norm)
        axes.contour(x, y, shown, LEVELS, colors="white", linewidths=0.5)
        told = figure.colorbar(filled, label="log likelihood below its top [nats]", ticks=LEVELS)
        told.ax.set_yticklabels([f"{level:g}" for level in LEVELS])
        axes.set_title(f"noise from cell to cell: ± {found.noise:.2g} nats")
        _draw_path(axes, found, fit, errors, where)
        for side, name, values in (("x", found.names[0], x), ("y", found.names[1], y)):
            fit_axis(axes, side, name, values.min(), values.max())
            getattr(axes, f"set_{side}label")(f"{name} [{TABLE[name].unit}]")
            getattr(axes, f"set_{side}lim")(values.min(), values.max())
        axes.grid(False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _draw_path(axes, found, fit, errors, where):
    """Iterates, start, estimate and ellipse."""

    def own(free):
        return [estimates(n, free[..., k]) for k, n in enumerate(found.names)]

    lined = [withStroke(linewidth=2.6, foreground="white")]
    path, at = fit.history.free[:, where], fit.free[where]
    axes.plot(*own(path), color="#222222", lw=1.2, label="path of the fit", path_effects=lined)
    axes.plot(*own(path[:1]), "o", color=RECKONING, mec="white", ms=8, label="start", zorder=5,
              clip_on=False)  # fmt: skip
    axes.plot(*own(at[None]), "P", color=LANDMARK, mec="white", ms=9, label="estimate", zorder=5)
    cov = errors.covariance[np.ix_(where, where)]
    if not np.diag(cov).max() < KNOWN**2:
        return
    outline = ellipses(at[None], [[cov[0, 0], cov[0, 1], cov[1, 1]]], sigmas=1.0)[0]
    axes.plot(*own(outline), color=LANDMARK, lw=1.5, label=r"1 $\sigma$", path_effects=lined)


def main():
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--over", nargs=2, required=True, metavar="PARAMETER")
    parser.add_argument("--out", type=Path, default=Path("surface.png"))
    given = parser.parse_args()
    train, held_out, config, params, names = prepare(given)
    if len(set(given.over)) != 2 or not set(given.over) <= set(names):
        parser.error(f"--over {' '.join(given.over)}: must be two of {', '.join(names)}")
    fit = learn.fit(
        train, config, params, names, held_out, seeds=given.seeds, steps=given.steps,
        seed=given.seed,
    )  # fmt: skip
    errors = uncertainty.assess(fit, train, seed=given.seed + 1)
    fit = uncertainty.improve(fit, errors)
    found = surface(train, fit, errors, given.over, seed=given.seed + 2)
    save_figure(draw_surface(found, fit, errors), given.out)
    print(given.out)


if __name__ == "__main__":
    main()
