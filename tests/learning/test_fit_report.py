"""What is told of a fit: table, sentences, warnings, learn.csv and the figures."""

import csv

import numpy as np
import pytest

from jaxslam.config import Config
from jaxslam.learning import report as learn_report
from jaxslam.learning.fit import Fit, History
from jaxslam.learning.report import Judged
from jaxslam.learning.uncertainty import Uncertainty
from jaxslam.parameters import default_params

NAMES = ("err_rot", "sigma_bearing", "mount_yaw")
STEPS = 20


def make_fit(steps=STEPS, held_out=True, **history):
    start = default_params()._replace(err_rot=0.2, sigma_bearing=0.05, mount_yaw=0.0)
    params = start._replace(err_rot=0.05, sigma_bearing=0.02, mount_yaw=0.03)
    ends = [np.array([np.log(p.err_rot), np.log(p.sigma_bearing), p.mount_yaw / 0.1])
            for p in (start, params)]  # fmt: skip
    free = ends[0] + np.linspace(0, 1, steps)[:, None] * (ends[1] - ends[0])
    judged = np.array([10, 20]) if held_out else np.empty(0, int)
    told = History(
        free=free,
        log_likelihood=np.linspace(-3, -2, steps),
        gradient_norm=np.linspace(1, 0.1, steps),
        rate=np.full(steps, 0.1),
        held_out_step=judged,
        held_out=np.array([-100.0, -90.0])[: len(judged)],
        held_out_error=np.array([1.0, 2.0])[: len(judged)],
        tail=np.array([free[9], ends[1]])[: len(judged)],
    )
    told = told._replace(**history)
    return Fit(NAMES, start, params, ends[1], told, "all steps done", Config(association="sampled"),
               0, steps, 12.3)  # fmt: skip


def make_errors(free_error=(0.1, 0.2, 9.0), **changes):
    free_error = np.array(free_error)
    slope = np.array([0.05, 0.02, 0.1])
    made = Uncertainty(
        names=NAMES,
        free=make_fit().free,
        covariance=np.diag(free_error**2),
        free_error=free_error,
        standard_error=free_error * slope,
        monte_carlo_error=0.25 * free_error * slope,
        opg=np.diag(1 / free_error**2),
        curvature=np.diag(1 / free_error**2),
        agreement=np.ones(3),
        covariance_method="both",
        step=np.zeros(3),
        log_z_sd=0.5,
        discounts={0.9: np.array([0.0, 10.0, 0.0]), 0.97: np.zeros(3), 1.0: np.zeros(3)},
        verdict=("resolved", "resolved", "not resolved"),
        unresolved=("not resolved: mount_yaw (the log does not tell)",),
    )
    return made._replace(**changes)


def test_the_table_names_everything_and_no_error_that_means_nothing():
    lines = learn_report.table(make_fit(), make_errors()).splitlines()
    assert lines[0].split() == [
        "parameter", "start", "estimate", "std", "error", "Monte", "Carlo", "unit", "verdict",
    ]  # fmt: skip
    assert lines[1].split() == [
        "err_rot", "0.2", "0.05", "0.005", "0.0013", "rad/sqrt(rad)", "resolved",
    ]  # fmt: skip
    assert lines[3].split() == [
        "mount_yaw", "0", "0.03", "-", "-", "rad", "not", "resolved",
    ]  # fmt: skip
    assert lines[0].index("unit") == lines[1].index("rad/sqrt")
    assert learn_report.standard_errors(make_errors()) == pytest.approx(
        {"err_rot": 0.005, "sigma_bearing": 0.004}
    )


def test_the_sentences():
    judged = Judged(np.array([-10.0, -12.0]), np.array([-5.0, -5.0]))
    text = "\n".join(learn_report.describe(make_fit(), make_errors(), judged))
    assert "all steps done (20 steps, 12 s)" in text
    assert "-11.00 ± 1.41 before, -5.00 ± 0.00 after, difference +6.00 ± 1.41 nats (2 fresh" in text
    assert "standard errors: outer products and slope of the score agree" in text
    assert "Monte-Carlo error: at most 0.25 of a standard error" in text
    assert "log Z of one log spreads by 0.50 nats" in text
    # The score differs by 10, the information is 25: by 0.4, two standard errors.
    assert "discount 0.9 instead of 0.97 would move the estimate by 2 standard errors" in text
    assert "at most (sigma_bearing)" in text
    assert "discount 1 instead of 0.97 would move the estimate by 0 standard errors" in text
    assert text.endswith("not resolved: mount_yaw (the log does not tell)")
    assert "held-out" not in "\n".join(learn_report.describe(make_fit(), make_errors()))


def test_nothing_wrong_no_warning():
    judged = Judged(np.zeros(2), np.ones(2))
    assert learn_report.flags(make_fit(), make_errors(), judged, {}) == []
    assert learn_report.advice(make_fit(), make_errors(), judged) == []


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"dropped": {"no identity": 7}}, "7 measurements not used: no identity"),
        ({"judged": Judged(np.ones(2), np.full(2, np.nan))}, "held-out evidence is not finite"),
        ({"errors": make_errors((0.1, np.nan, 1))}, "error is not finite: sigma_bearing"),
        ({"fit": make_fit(gradient_norm=np.append(np.nan, np.ones(19)))}, "in 1 of 20 steps"),
    ],
)
def test_what_went_wrong_is_a_warning(changes, found):
    given = {"fit": make_fit(), "errors": make_errors()} | changes
    (line,) = learn_report.flags(**given)
    assert found in line


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"judged": None}, "whether other logs become more likely is unknown"),
        ({"judged": Judged(np.ones(2), np.zeros(2))}, "the held-out logs became less likely"),
        (
            {"judged": Judged(np.ones(2), np.full(2, np.nan))},
            "the held-out logs became less likely",
        ),
        ({"errors": make_errors(log_z_sd=2.0)}, "spreads by 2 nats over seeds, above 1.5"),
        ({"errors": make_errors(log_z_sd=np.nan)}, "spreads by nan nats"),
    ],
)
def test_what_to_distrust_is_advice(changes, found):
    given = {"fit": make_fit(), "errors": make_errors(), "judged": Judged(np.zeros(2), np.ones(2))}
    (line,) = learn_report.advice(**given | changes)
    assert found in line


def test_a_row_per_step(tmp_path):
    learn_report.save_csv(tmp_path / "learn.csv", make_fit())
    with open(tmp_path / "learn.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "step", "loss", "gradient_norm", "rate", *NAMES, "held_out", "held_out_error",
    ]  # fmt: skip
    assert [int(row["step"]) for row in rows] == list(range(1, STEPS + 1))
    assert float(rows[0]["err_rot"]) == pytest.approx(0.2)
    assert float(rows[-1]["mount_yaw"]) == pytest.approx(0.03)
    assert float(rows[0]["loss"]) == 3
    held = {row["step"]: (row["held_out"], row["held_out_error"]) for row in rows}
    assert held.pop("10") == ("-100.0", "1.0")
    assert held.pop("20") == ("-90.0", "2.0")
    assert set(held.values()) == {("", "")}


@pytest.mark.parametrize("held_out", [True, False])
def test_a_panel_for_each_parameter_likelihood_and_held_out(tmp_path, held_out):
    fit = make_fit(held_out=held_out)
    figure = learn_report.draw_learning(fit, make_errors((0.1, np.inf, np.nan)))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:3] == ["err_rot [rad/sqrt(rad)]", "sigma_bearing [rad]", "mount_yaw [rad]"]
    assert (
        titles[3:] == ["log likelihood, nats per frame", "held-out evidence, nats"][: 1 + held_out]
    )
    first = figure.axes[0]
    assert first.get_yscale() == "log"  # from 0.2 to 0.05
    np.testing.assert_allclose(first.lines[0].get_ydata()[[0, -1]], [0.2, 0.05], rtol=1e-6)
    assert figure.axes[2].get_yscale() == "linear"
    if held_out:
        assert [text.get_text() for text in figure.axes[4].texts] == ["taken"]
        assert figure.axes[4].lines[-1].get_xdata() == [20]
    learn_report.save_figure(figure, tmp_path / "learn.png")
    assert (tmp_path / "learn.png").stat().st_size > 10_000


def test_the_judgement_that_was_taken_is_marked_though_a_newton_step_followed():
    fit = make_fit()
    figure = learn_report.draw_learning(fit._replace(free=fit.free + 0.01), make_errors())
    assert [text.get_text() for text in figure.axes[4].texts] == ["taken"]
