"""Style shared by all figures."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from jaxslam.files import atomic_write

DPI = 150
# Okabe and Ito's palette, which the colour-blind can distinguish.
TRUE, FILTER, RECKONING, LANDMARK, PLAN = "#222222", "#0072B2", "#E69F00", "#D55E00", "#9A9A9A"
REFINED, ANCESTRAL = "#009E73", "#CC79A7"
STYLE: dict = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "svg.fonttype": "none",
}


def ellipses(mean, cov, sigmas=3.0, corners=49):
    """Return outlines [L, corners, 2] of ellipses: `mean` [L, 2], `cov` [L, 3] (xx, xy, yy)."""
    xx, xy, yy = np.asarray(cov, float).reshape(-1, 3).T
    value, vector = np.linalg.eigh(np.stack([xx, xy, xy, yy], 1).reshape(-1, 2, 2))
    half = vector * np.sqrt(value.clip(0))[:, None, :]
    angle = np.linspace(0, 2 * np.pi, corners)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(mean)[:, None] + sigmas * (half @ circle).transpose(0, 2, 1)


def write_figure(figure, path):
    """Save a figure as PNG, atomically."""
    FigureCanvasAgg(figure)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=DPI, bbox_inches="tight", pad_inches=0.12)
    return path
