"""Parameter files: what is written is read back; what is wrong is named."""

import math
import re

import numpy as np
import pytest

from jaxslam.parameter_file import (
    Learning,
    load_learning,
    load_params,
    save_params,
    validate,
)
from jaxslam.parameters import Params, default_params

BASE = default_params()


def write(tmp_path, text):
    path = tmp_path / "params.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refused(path, base=BASE, load=load_params):
    """The one line of the refusal, which begins with the file."""
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        load(path, base)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_former_names_are_read_and_a_name_given_twice_is_refused(tmp_path):
    path = write(tmp_path, 'growth = 0.3\n[learn]\nparameters = ["caution", "err_rot"]\n')
    found = load_learning(path, BASE)
    assert found.params == BASE._replace(landmark_extent=0.3)
    assert found.names == ("extra_bearing_noise", "err_rot")
    path = write(tmp_path, "growth = 0.3\nlandmark_extent = 0.2\n")
    assert "growth is the former name of landmark_extent; give one of them" in refused(path)


def test_what_is_saved_is_read_back_to_the_last_digit(tmp_path):
    odd = BASE._replace(err_tran=0.1 + 0.2, density_new=1e-300, mount_x=-1 / 3, sigma_range=1e22)
    path = tmp_path / "params.toml"
    save_params(path, odd, {"err_tran": 0.01, "mount_x": 0.0})
    other = Params(*[value / 2 for value in odd])
    assert load_params(path, other) == odd
    lines = path.read_text().splitlines()
    assert f"density_new = {1e-300!r}" in lines[Params._fields.index("density_new")]
    assert lines[0].endswith("# m/sqrt(m), noise along the path, per distance")
    assert lines[len(Params._fields) + 1 :] == [
        "[standard_error]",
        "err_tran = 0.01",
        "mount_x = 0.0",
    ]
    assert list(tmp_path.iterdir()) == [path]


def test_names_left_out_keep_their_value(tmp_path):
    path = write(tmp_path, "sigma_range = 1\nbias_drift = -0.5\n")
    assert load_params(path, BASE) == BASE._replace(sigma_range=1.0, bias_drift=-0.5)


def test_arrays_of_no_dimension_are_numbers(tmp_path):
    arrays = Params(*map(np.float32, BASE))
    assert validate(arrays, "here").err_tran == np.float32(BASE.err_tran)
    save_params(tmp_path / "p.toml", arrays)
    assert load_params(tmp_path / "p.toml", BASE) == Params(*map(float, arrays))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("sigma_rang = 1", "sigma_rang is no parameter; did you mean sigma_range?"),
        ("[config]\nparticles = 3", "config is no parameter; there are: err_tran, "),
        ("sigma_range = '1'", "sigma_range is '1'; must be a finite number"),
        ("sigma_range = true", "sigma_range is True; must be a finite number"),
        ("sigma_range = nan", "sigma_range is nan; must be a finite number"),
        ("mount_x = inf", "mount_x is inf; must be a finite number"),
        ("sigma_range = [1, 2]", "sigma_range is [1, 2]; must be a finite number"),
        ("standard_error = 3", "standard_error is 3; must be a table"),
        ("[standard_error]\nerr_tan = 1", "standard_error.err_tan is no parameter; did you mean"),
        ("[standard_error]\nerr_tran = -1", "standard_error.err_tran is -1; must be 0 or more"),
        ("sigma_range 1", "not TOML: "),
        ("sigma_range = 1\nsigma_range = 2", "not TOML: "),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, found):
    assert found in refused(write(tmp_path, text))


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("err_tran", -0.1, "0 m/sqrt(m) or more"),
        ("floor_rot", -1e-9, "0 rad/sqrt(s) or more"),
        ("gain_tran", 0, "above 0 true / measured"),
        ("gain_rot", -1, "above 0"),
        ("sigma_range", 0, "above 0 m"),
        ("view_range", 0, "above 0 m"),
        ("inv_depth_sd", 0, "above 0 1/m"),
        ("outlier", 1, "a probability, from 0 to below 1"),
        ("outlier", -0.1, "a probability"),
        ("detection", 1.1, "a probability, from 0 to 1"),
        ("view_min", 3.2, "below view_max"),
        ("view_min", -180, "from -pi"),
        ("view_max", 180, "at most pi"),
        ("existence_new", -0.1, "from 0 to existence_max, 20"),
        ("existence_confirm", 21, "at most existence_max, 20"),
        ("existence_max", 0.5, "from 0 to existence_max, 0.5"),
    ],
)
def test_a_value_out_of_range_is_refused(tmp_path, name, value, allowed):
    message = refused(write(tmp_path, f"{name} = {value}"))
    assert allowed in message
    assert name in message
    with pytest.raises(ValueError, match=r"^here: "):
        validate(BASE._replace(**{name: value}), "here")


@pytest.mark.parametrize(
    ("name", "value"), [("outlier", 0), ("detection", 1), ("err_rot", 0), ("view_max", math.pi)]
)
def test_the_ends_of_a_range_are_allowed(name, value):
    assert getattr(validate(BASE._replace(**{name: value}), "here"), name) == value


def test_files_that_are_none(tmp_path):
    assert "no such file" in refused(tmp_path / "missing.toml")
    assert "cannot read" in refused(tmp_path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    assert "not TOML" in refused(binary)
    binary.write_bytes(b"#" * (1 << 21))
    assert "bytes" in refused(binary)


def test_nothing_is_written_in_vain(tmp_path):
    path = tmp_path / "params.toml"
    with pytest.raises(ValueError, match="sigma_range is -1"):
        save_params(path, BASE._replace(sigma_range=-1))
    with pytest.raises(ValueError, match=r"standard_error\.sigma"):
        save_params(path, BASE, {"sigma": 1.0})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match=r"cannot write .*No such file"):
        save_params(tmp_path / "nowhere" / "params.toml", BASE)
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(ValueError, match="cannot write"):
        save_params(folder, BASE)
    assert list(tmp_path.iterdir()) == [folder]


LEARNING = """err_rot = 0.2
[standard_error]
err_rot = 0.03
[learn]
parameters = ["err_rot", "mount_yaw"]
[bounds]
err_rot = [0, 1]
mount_yaw = [-0.2, 0.2]
[prior]
err_rot = [0.1, 0.5]
mount_yaw = [0, 1]
outlier = [0.01, 2]
"""


def test_what_is_to_be_learnt_is_read_and_a_run_does_without(tmp_path):
    path = write(tmp_path, LEARNING)
    found = load_learning(path, BASE)
    assert found == Learning(
        BASE._replace(err_rot=0.2),
        ("err_rot", "mount_yaw"),
        {"err_rot": (0.0, 1.0), "mount_yaw": (-0.2, 0.2)},
        {"err_rot": (0.1, 0.5), "mount_yaw": (0.0, 1.0), "outlier": (0.01, 2.0)},
    )
    assert load_params(path, BASE) == BASE._replace(err_rot=0.2)
    again = tmp_path / "again.toml"
    save_params(again, found.params, {"err_rot": 0.03}, found)
    assert load_learning(again, BASE._replace(err_rot=0.9)) == found
    assert "[standard_error]\nerr_rot = 0.03\n" in again.read_text()


def test_without_tables_nothing_is_said_of_learning(tmp_path):
    assert load_learning(write(tmp_path, "err_rot = 1"), BASE) == Learning(
        BASE._replace(err_rot=1.0), None, {}, {}
    )


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("learn = 3", "learn is 3; must be a table, [learn]"),
        ("[learn]\nparameter = ['err_rot']", "learn.parameter is not known; there is: parameters"),
        ("[learn]\nparameters = 'err_rot'", "learn.parameters is 'err_rot'; must be names"),
        ("[learn]\nparameters = []", "learn.parameters is []; must be names"),
        ("[learn]\nparameters = [1]", "learn.parameters is [1]; must be names"),
        ("[learn]\nparameters = ['err_rt']", "learn.parameters: err_rt is no parameter; did you"),
        ("[learn]\nparameters = ['err_rot', 'err_rot']", "names one of err_rot, err_rot twice"),
        ("bounds = [1, 2]", "bounds is [1, 2]; must be a table"),
        ("[bounds]\nerr_rt = [1, 2]", "bounds.err_rt is no parameter; did you mean err_rot?"),
        ("[bounds]\nerr_rot = 1", "bounds.err_rot is 1; must be [lowest, highest]"),
        ("[bounds]\nerr_rot = [1, 2, 3]", "must be [lowest, highest]"),
        ("[bounds]\nerr_rot = [2, 1]", "bounds.err_rot is [2, 1]; must be [lowest, highest]"),
        ("[bounds]\nerr_rot = [1, 1]", "must be [lowest, highest]"),
        ("[bounds]\nerr_rot = [-1, 1]", "bounds.err_rot holds -1; must be 0 rad/sqrt(rad) or more"),
        ("[bounds]\nerr_rot = [0, '1']", "bounds.err_rot is '1'; must be a finite number"),
        ("[bounds]\noutlier = [0.1, 1]", "bounds.outlier holds 1; must be a probability"),
        ("[prior]\nerr_rot = [0.1]", "prior.err_rot is [0.1]; must be [value, standard deviation]"),
        ("[prior]\nerr_rot = [0.1, 0]", "prior.err_rot: standard deviation 0; must be above 0"),
        ("[prior]\nerr_rot = [-0.1, 1]", "prior.err_rot holds -0.1; must be 0 rad/sqrt(rad) or"),
        ("[prior]\nerr_rot = [0, 1]", "prior.err_rot is about 0, which has no logarithm"),
    ],
)
def test_bad_tables_are_refused_by_a_run_as_well(tmp_path, text, found):
    assert found in refused(write(tmp_path, text))
    assert found in refused(write(tmp_path, text), load=load_learning)


def test_a_start_outside_its_bounds_concerns_learning_only(tmp_path):
    path = write(tmp_path, "err_rot = 0.5\n[bounds]\nerr_rot = [0.1, 0.4]")
    assert load_params(path, BASE).err_rot == 0.5
    message = refused(path, load=load_learning)
    assert "err_rot starts at 0.5, outside its bounds 0.1 to 0.4" in message


def test_tables_that_are_wrong_are_not_written(tmp_path):
    path = tmp_path / "params.toml"
    for learning in (
        Learning(BASE, ("err_rt",)),
        Learning(BASE, bounds={"err_rot": (2, 1)}),
        Learning(BASE, priors={"err_rot": (0.1, -1)}),
    ):
        with pytest.raises(ValueError, match=r"params\.toml: "):
            save_params(path, BASE, None, learning)
    assert not path.exists()
