"""experiments/likelihood_surface.py: the grid, the path and the ellipse of its figure."""

import likelihood_surface
import numpy as np
import pytest
from test_fit_report import NAMES, make_errors, make_fit

from jaxslam.learning import report as learn_report


def test_a_surface_with_the_path_and_the_ellipse(tmp_path):
    fit, errors = make_fit(), make_errors()
    first, second = (likelihood_surface._span(fit, errors, name) for name in NAMES[:2])
    assert first[0] == pytest.approx(np.log(0.05) - 0.25)  # 2.5 standard errors
    assert first[-1] == pytest.approx(np.log(0.2))  # where it began
    below = -0.5 * (
        ((first[:, None] - fit.free[0]) / 0.1) ** 2 + ((second - fit.free[1]) / 0.2) ** 2
    )
    found = likelihood_surface.Surface(NAMES[:2], first, second, below, 0.7)
    figure = likelihood_surface.draw_surface(found, fit, errors)
    axes = figure.axes[0]
    assert axes.get_xlabel() == "err_rot [rad/sqrt(rad)]"
    assert "0.7 nats" in axes.get_title(loc="left")
    assert axes.get_xlim() == pytest.approx((np.exp(first[0]), 0.2))
    path, start, estimate, outline = axes.lines
    np.testing.assert_allclose(path.get_xdata()[[0, -1]], [0.2, 0.05], rtol=1e-5)
    np.testing.assert_allclose(start.get_ydata(), [0.05], rtol=1e-5)
    np.testing.assert_allclose(estimate.get_ydata(), [0.02], rtol=1e-5)
    ends = np.log(outline.get_xdata())
    assert np.ptp(ends) == pytest.approx(0.2, rel=1e-4)
    learn_report.save_figure(figure, tmp_path / "surface.png")
    assert (tmp_path / "surface.png").stat().st_size > 10_000


def test_a_surface_without_an_ellipse_where_the_error_is_not_known():
    fit, errors = make_fit(), make_errors((0.1, 0.2, 9.0))
    first, last = (likelihood_surface._span(fit, errors, name) for name in ("err_rot", "mount_yaw"))
    assert np.ptp(last) == pytest.approx(3.0)  # no further than 1.5 to either side
    below = -np.add.outer((first - fit.free[0]) ** 2, np.full(len(last), 0.0))
    below[0, 0] = np.nan
    found = likelihood_surface.Surface(("err_rot", "mount_yaw"), first, last, below, 0.7)
    figure = likelihood_surface.draw_surface(found, fit, errors)
    assert len(figure.axes[0].lines) == 3
