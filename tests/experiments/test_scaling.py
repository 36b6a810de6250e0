"""The pieces of experiments/scaling.py at tiny sizes; its times are not tested."""

import contenders
import numpy as np
import pytest
import scaling
import scaling_one
import scaling_report

from jaxslam.config import Config


@pytest.mark.parametrize("association", ["maximum_likelihood", "known"])
def test_the_contenders_follow_the_same_drive_with_the_same_map(association):
    """A contender that did other work than ours would be no measure of it."""
    marks, _, truth, seen, ids = contenders.simulate(36, 8, 6)
    sizes = dict(particles=300, landmarks=36, measurements=8, resample_threshold=1.0)
    config = Config(association=association, **sizes)
    rivals = [contenders.of_jax(marks, config)[:2], contenders.of_numpy(marks, config, block=100)]
    rivals.append(contenders.of_loop(marks, config))
    for frame in zip(seen, ids, strict=True):
        poses = [np.asarray(advance(*frame), float) for advance, _ in rivals]
    for pose, (_, occupied), limit in zip(poses, rivals, (0.05, 0.05, 0.2), strict=True):
        assert np.hypot(*(pose - truth[-1])[:2]) < limit
        assert occupied() == pytest.approx(36, abs=0.1)


def test_numpys_two_ways_agree_where_every_match_is_right():
    marks, _, _, seen, ids = contenders.simulate(36, 8, 4)
    sizes = dict(particles=50, landmarks=36, measurements=8)
    ways = [contenders.of_numpy(marks, Config(association=name, **sizes))[0]
            for name in ("maximum_likelihood", "known")]  # fmt: skip
    for frame in zip(seen, ids, strict=True):
        hidden, known = (advance(*frame) for advance in ways)
        np.testing.assert_allclose(hidden, known, atol=1e-6)


def test_numba_does_what_numpy_does():
    pytest.importorskip("numba")
    assert scaling_one.agree({})["apart"] < 1e-5


def test_maps_are_nested_and_show_the_same():
    small, large = (contenders.simulate(m, 10, 3) for m in (100, 400))
    np.testing.assert_array_equal(small[0], large[0][:100])
    for one, other in zip(small[2:], large[2:], strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_size_that_does_not_fit_is_refused_before_it_is_made(monkeypatch):
    given = scaling.BASE | dict(particles=10**6, landmarks=1600)
    monkeypatch.setattr(scaling_one, "available_bytes", lambda: 20 * 10**9)
    size, need = scaling_one.needed(scaling_one.config_of(given))
    assert need > size > 4 * 8 * 10**6 * 1600
    assert "does not fit" in scaling_one.refusal(given)
    assert scaling_one.refusal(given | dict(particles=1000)) is None


def test_what_a_step_must_move_grows_with_what_is_in_view_and_eager_with_the_map():
    row = scaling.BASE | dict(in_view=50.0)
    lazy, larger = scaling.moved(row), scaling.moved(row | dict(landmarks=1600))
    assert lazy == larger == 10_000 * (50 * 32 + 20 * 32 + 36)
    assert scaling.moved(row | dict(lazy=False)) - lazy == 10_000 * 2 * 100 * 32


def row(**changed):
    numbers = dict(min_ms=2.0, median_ms=2.5, in_view=50.0, peak_bytes=3e8, error_m=0.01)
    numbers |= dict(wall_min_ms=2.0, wall_median_ms=2.5, load=0.1)
    return scaling.completed(scaling.BASE | numbers | changed, 40.0, 1e8)


def test_tables_checks_and_figure(tmp_path):
    rows = [
        row(state_bytes=1e8), row(who="numpy", min_ms=50.0),
        row(landmarks=1600, state_bytes=1e9, min_ms=2.4),
        scaling.BASE | dict(particles=10**6, note="does not fit: needs 67.2 GB, 20 GB are free",
                            load=0.1),
        scaling.BASE | dict(who="numba", note="skipped: No module named 'numba'", load=0.1),
    ]  # fmt: skip
    machine = dict(bandwidth={"copy": 30.0}, best=40.0, idle_bytes=1e8, quick=True, seconds=60.0,
                   numba={"note": "skipped"}, cpu="a processor")  # fmt: skip
    text = scaling_report.text(rows, machine)
    assert "| unknown | jaxslam | 10,000 | 2 (2.5) | 2.4 (2.5) |" in text
    assert "| unknown | jaxslam | 1,000,000 | refused: 67.2 GB |  |" in text
    assert "times faster than NumPy: 25.00, limit >= 30" in text and "BROKEN" in text
    assert "held: unknown: time at M = 1,600 / at M = 100, same in view: 1.20" in text
    assert "not measured: known" in text and "Skipped: numba" in text
    scaling_report.draw(rows, tmp_path / "scaling.png")
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
