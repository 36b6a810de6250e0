"""The loop over `init` and `step` in docs/how-to/step-by-step.md runs; helpers pad and convert."""

import re
from pathlib import Path

import numpy as np
import pytest

import jaxslam

PAGE = Path(__file__).resolve().parents[2] / "docs/how-to/step-by-step.md"
POSTS = np.array([[2.0, 1.5], [4.0, -1.0], [6.0, 2.0]])


def test_the_program_of_the_page_maps_the_posts(capsys):
    (program,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    exec(compile(program, PAGE.name, "exec"), names)
    assert capsys.readouterr().out.count("heading") == 8
    assert float(names["x"]) == pytest.approx(4.0, abs=0.05)
    landmarks = np.asarray(names["landmarks"])
    assert landmarks[landmarks[:, 0].argsort()] == pytest.approx(POSTS, abs=0.1)


def test_displacement_along_an_arc():
    arc = jaxslam.Odometry.from_displacement(2.0, 2.0, np.pi / 2, 3.0)  # radius 2 m
    assert arc.distance == pytest.approx(np.pi)
    assert (arc.turn, arc.duration) == (np.pi / 2, 3.0)
    turn = jaxslam.Odometry.from_displacement(0.0, 0.0, -0.5, 1.0)
    assert (turn.distance, turn.turn) == (0.0, 0.5)


def test_values_are_padded_and_checked():
    config = jaxslam.Config("bearing", "known", measurements=3)
    found = jaxslam.Measurements.from_values([0.1, 0.2], config, identity=[4, 2])
    assert found.value.tolist() == [[0.1, 0.0], [0.2, 0.0], [0.0, 0.0]]
    assert found.identity.tolist() == [4, 2, -1]
    assert found.valid.tolist() == [True, True, False]
    none = jaxslam.Measurements.from_values([], config)
    assert not none.valid.any() and none.value.shape == (3, 2)
    with pytest.raises(ValueError, match=r"4 are more than Config\.measurements, 3"):
        jaxslam.Measurements.from_values([0.1] * 4, config)
    with pytest.raises(ValueError):
        jaxslam.Measurements.from_values([1.0, 2.0, 3.0], jaxslam.Config("position"))
