import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
from small_run import make_log, make_refined, make_result

from jaxslam import plotting
from jaxslam.logs.log import FloorPlan
from jaxslam.results import figures, load, run_folder
from jaxslam.results.result import MapEstimate


def pictures(result, folder):
    folder.mkdir(exist_ok=True)
    return {path.name: imread(path) for path in figures.draw_figures(result, folder)}


def pixels(draw, result):
    """What a figure looks like, without a file."""
    canvas = FigureCanvasAgg(draw(result))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba()).astype(int)


def differs(draw, a, b):
    first, other = pixels(draw, a), pixels(draw, b)
    return first.shape != other.shape or np.abs(first - other).max() > 25


def test_figures_are_decodable_pictures_of_a_fair_size_and_nothing_else_is_left(tmp_path):
    found = pictures(make_result(), tmp_path / "a")
    assert set(found) == {path.name for path in (tmp_path / "a").iterdir()} == set(figures.FIGURES)
    for picture in found.values():
        height, width, _ = picture.shape
        assert 700 < width < 2500
        assert 700 < height < 2500
        assert 0.005 < (picture[..., :3].min(-1) < 0.9).mean() < 0.6  # drawn on, not full


def test_the_same_result_draws_the_same_and_another_differs():
    result, other = make_result(), make_result(shift=0.6)
    fewer = dataclasses.replace(result, ess=result.ess / 4)
    assert not differs(figures.draw_map, result, make_result())
    assert differs(figures.draw_map, result, other)
    assert differs(figures.draw_error, result, other)
    assert differs(figures.draw_particles, result, fewer)


def test_ellipses_hold_what_three_sigma_should():
    rng = np.random.default_rng(0)
    cov = np.array([[0.5, 0.3, 0.4], [2.0, -1.0, 1.0]])
    mean = np.array([[1.0, 2.0], [-5.0, 0.0]])
    for outline, centre, (xx, xy, yy) in zip(plotting.ellipses(mean, cov), mean, cov, strict=True):
        matrix = np.array([[xx, xy], [xy, yy]])
        offset = outline - centre
        distance = np.einsum("ci,ij,cj->c", offset, np.linalg.inv(matrix), offset)
        np.testing.assert_allclose(distance, 9)
        inside = rng.multivariate_normal(centre, matrix, 20000) - centre
        within = np.einsum("ci,ij,cj->c", inside, np.linalg.inv(matrix), inside) < 9
        assert within.mean() == pytest.approx(1 - np.exp(-4.5), abs=0.003)


def texts(figure):
    legends = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return legends, " ".join(
        axes.get_title(loc) for axes in figure.axes for loc in ("left", "center")
    )


def test_map_says_what_it_shows():
    legend, title = texts(figures.draw_map(make_result()))
    for entry in ("true path", "filter", "dead reckoning", "filter's landmark", "true landmark"):
        assert entry in legend
    for words in (
        "circle",
        "range bearing",
        "100 particles",
        "0.10 m filtered (RMSE, not aligned)",
    ):
        assert words in title
    assert "5 landmarks (1 outside the picture)" in title
    legend, title = texts(figures.draw_map(make_refined()))
    assert {"refined", "refined landmark", r"refined 3$\sigma$"} < set(legend)
    assert "path error 0.10 m filtered, 0.05 m refined (RMSE, not aligned)" in title
    assert "5 landmarks (4 refined, 1 outside the picture)" in title
    legend, title = texts(figures.draw_map(make_result(truth=False)))
    assert "true path" not in legend
    assert "no true path" in title


def test_a_stray_landmark_or_reckoning_does_not_shrink_the_map():
    result = make_result()
    lost = dataclasses.replace(result, dead_reckoning=result.dead_reckoning * 1000)
    axes = figures.draw_map(lost).axes[0]
    assert axes.get_aspect() == 1
    assert axes.get_xlim()[1] < 8
    assert axes.get_xlim()[0] < -4  # the wall is in


def test_error_is_drawn_only_where_truth_is():
    result = make_result()
    truth = result.log.truth
    some = np.r_[0:10, 30:40]
    holed = dataclasses.replace(truth, time=truth.time[some], pose=truth.pose[some])
    result = dataclasses.replace(result, log=dataclasses.replace(result.log, truth=holed))
    position = figures.draw_error(result).axes[0].lines[0].get_ydata()
    np.testing.assert_array_equal(np.isfinite(position), np.isin(np.arange(40), some))
    np.testing.assert_allclose(position[some], 0.1)


def test_the_band_is_three_sigma_of_the_worst_direction():
    band = figures.draw_error(make_result()).axes[0].collections[0]
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(3 * np.sqrt(0.02))


def test_every_path_has_its_error_over_time():
    figure = figures.draw_error(make_refined())
    told = texts(figure)[0]
    assert {"filter", "ancestral", "refined", "dead reckoning"} < set(told)
    assert {r"filter's own 3$\sigma$", r"refined path's own 3$\sigma$"} < set(told)
    position = figure.axes[0]
    curves = {line.get_label(): line.get_ydata() for line in position.lines}
    for label, off in (("filter", 0.1), ("ancestral", 0.08), ("refined", 0.05)):
        np.testing.assert_allclose(curves[label], off)
    bands = [band.get_paths()[0].vertices[:, 1].max() for band in position.collections]
    np.testing.assert_allclose(bands, 3 * np.sqrt([0.02, 0.005]))


def test_the_past_that_hangs_on_one_is_marked():
    axes = figures.draw_particles(make_refined()).axes
    assert len(axes) == len(figures.draw_particles(make_result()).axes) + 1
    curve = axes[-1].lines[0]
    np.testing.assert_allclose(curve.get_xdata(), 0.2 * np.arange(39, 0, -1))  # before the end
    np.testing.assert_array_equal(curve.get_ydata(), np.arange(39) // 10 + 1)
    marked = axes[-1].patches[0]
    np.testing.assert_allclose([marked.get_x(), marked.get_width()], [6.0, 1.8])


def shown_readings(log):
    """The log with truth at every tenth frame only, too far apart to interpolate."""
    truth = log.truth
    every = slice(None, None, 10)
    return dataclasses.replace(
        log, truth=dataclasses.replace(truth, time=truth.time[every], pose=truth.pose[every])
    )


def test_single_readings_are_drawn_as_dots():
    result = make_result()
    result = dataclasses.replace(result, log=shown_readings(result.log))
    dots = figures.draw_error(result).axes[0].lines[1]
    assert dots.get_marker() == "."
    np.testing.assert_allclose(dots.get_xdata(), [0, 2, 4, 6])


ODD = {
    "no truth": lambda r: dataclasses.replace(r, log=make_log(truth=False)),
    "no plan": lambda r: dataclasses.replace(r, log=dataclasses.replace(r.log, plan=None)),
    "plan as image": lambda r: dataclasses.replace(
        r,
        log=dataclasses.replace(
            r.log, plan=FloorPlan(image=np.eye(50, dtype=np.uint8) * 255, scale=0.2)
        ),
    ),
    "no landmarks": lambda r: dataclasses.replace(
        r, landmarks=MapEstimate(*(np.asarray(column)[:0] for column in r.landmarks))
    ),
    "nothing finite": lambda r: dataclasses.replace(
        r, pose=r.pose * np.nan, cov=r.cov * np.nan, ess=r.ess * np.nan
    ),
    "never resampled": lambda r: dataclasses.replace(
        r,
        config=dataclasses.replace(r.config, resample_threshold=0),
        resampled=np.zeros(40, bool),
    ),
    "map full": lambda r: dataclasses.replace(r, overflow=np.full(40, 0.5)),
}


@pytest.mark.parametrize("oddity", ODD)
def test_odd_results_are_drawn_too(tmp_path, oddity):
    assert len(pictures(ODD[oddity](make_refined()), tmp_path / "a")) == 3


def test_one_frame_is_drawn_too(tmp_path):
    assert len(pictures(make_refined(frames=1), tmp_path / "a")) == 3


def test_saved_runs_are_drawn_anew(tmp_path):
    run_folder.save(make_result(), tmp_path / "run")
    before = imread(tmp_path / "run" / "map.png")
    (tmp_path / "run" / "map.png").unlink()
    load.plot_folder(tmp_path / "run")
    np.testing.assert_array_equal(imread(tmp_path / "run" / "map.png"), before)


def test_an_unwritable_place_is_a_one_line_error(tmp_path):
    with pytest.raises(ValueError, match=r"map\.png: cannot write"):
        figures.draw_figures(make_result(), tmp_path / "missing")


def test_pyplot_is_never_touched():
    # In a process of its own: the experiments, which other tests import, draw with it.
    code = (
        "import sys, jaxslam.results.figures, jaxslam.results.run_folder;"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
