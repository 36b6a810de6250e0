"""Parameter files: TOML, one line per parameter with its unit and meaning.

`name = value  # unit, meaning`, and standard errors, where known, in a table `[standard_error]`. A
file may hold only some of the names.
"""

import math
import tomllib
from difflib import get_close_matches
from pathlib import Path

from jaxslam.atomic import replacing
from jaxslam.config import UNITS, Params

MEANING = {
    "err_tran": "noise along the path, per distance",
    "err_rot": "noise of the heading, per turn",
    "err_drift": "noise of the heading, per distance",
    "floor_tran": "noise of the position, per time",
    "floor_rot": "noise of the heading, per time",
    "gain_tran": "true over measured distance",
    "gain_rot": "true over measured turn",
    "bias_drift": "systematic turn, per distance",
    "sigma_range": "noise of a range",
    "sigma_bearing": "noise of a bearing, far away",
    "growth": "sideways noise of what is seen: it has a size",
    "position_scale": "multiplies the standard deviations of positions",
    "correlation": "path over which errors stay alike",
    "caution": "bearing noise that the filter adds",
    "mount_x": "sensor on the robot, forward",
    "mount_y": "sensor on the robot, left",
    "mount_yaw": "sensor on the robot, counter-clockwise",
    "outlier": "that a measurement comes from nothing",
    "density_new": "landmarks to be expected",
    "detection": "that a landmark at range 0 is seen",
    "view_min": "least bearing the sensor sees",
    "view_max": "largest bearing the sensor sees",
    "view_range": "largest range the sensor sees",
    "inv_depth_mean": "inverse depth of a new landmark (bearing only)",
    "inv_depth_sd": "its standard deviation",
    "existence_new": "existence of a new landmark",
    "existence_seen": "added when it is seen",
    "existence_miss": "weight of not seeing what was expected",
    "existence_max": "existence at most",
    "existence_confirm": "from here on it is in the map",
}
ABOVE_ZERO = ("gain_tran", "gain_rot", "sigma_range", "sigma_bearing", "position_scale")
ABOVE_ZERO += ("density_new", "view_range", "inv_depth_mean", "inv_depth_sd", "existence_max")
AT_LEAST_ZERO = ("err_tran", "err_rot", "err_drift", "floor_tran", "floor_rot", "growth")
AT_LEAST_ZERO += ("correlation", "caution", "existence_seen", "existence_miss")
ERRORS = "standard_error"
MAX_BYTES = 1 << 20


def validate(params, where):
    """`params` as floats, once each value is a number in its range.

    `where` begins the message of the `ValueError`: a file's name, for example.
    """
    values = {name: _number(where, name, value) for name, value in params._asdict().items()}
    for name, (good, allowed) in _ranges(values).items():
        if not good:
            raise ValueError(f"{where}: {name} is {values[name]:g}; must be {allowed}")
    return Params(**values)


def _ranges(v):
    """For each bounded name: whether its value is allowed, and what is."""
    ranges = {name: (v[name] > 0, f"above 0 {UNITS[name]}") for name in ABOVE_ZERO}
    ranges |= {name: (v[name] >= 0, f"0 {UNITS[name]} or more") for name in AT_LEAST_ZERO}
    low, high, pi = v["view_min"], v["view_max"], math.pi + 1e-6  # float32 rounds it up
    most = v["existence_max"]
    return ranges | {
        "outlier": (0 <= v["outlier"] < 1, "a probability, from 0 to below 1"),
        "detection": (0 <= v["detection"] <= 1, "a probability, from 0 to 1"),
        "view_min": (-pi <= low < high, f"from -pi to below view_max, {high:g} rad"),
        "view_max": (low < high <= pi, f"above view_min, {low:g} rad, and at most pi"),
        # Below zero a landmark would be forgotten in the frame it was born in.
        "existence_new": (0 <= v["existence_new"] <= most, f"from 0 to existence_max, {most:g}"),
        "existence_confirm": (v["existence_confirm"] <= most, f"at most existence_max, {most:g}"),
    }


def load_params(path, base):
    """`Params` of a file; names it does not hold keep their value of `base`.

    Raises `ValueError` naming file, name, what was found and what is allowed.
    """
    table = _read(Path(path))
    errors = table.pop(ERRORS, {})
    if not isinstance(errors, dict):
        raise ValueError(f"{path}: {ERRORS} is {errors!r}; must be a table, [{ERRORS}]")
    for place, names in (("", table), (f"{ERRORS}.", errors)):
        for name, value in names.items():
            _check_name(path, place, name)
            if _number(path, place + name, value) < 0 and place:
                raise ValueError(f"{path}: {place}{name} is {value!r}; must be 0 or more")
    return validate(base._replace(**table), path)


def save_params(path, params, standard_errors=None):
    """Write `params` to a file, all or nothing; `standard_errors`: a dict by name, or None.

    Raises `ValueError` when a value is out of range or the place can't be written.
    """
    path = Path(path)
    values = validate(params, path)._asdict()
    lines = [f"{f'{name} = {value!r}':36}  # {UNITS[name]}, {MEANING[name]}\n"
             for name, value in values.items()]  # fmt: skip
    if standard_errors:
        lines.append(f"\n[{ERRORS}]\n")
        for name, value in standard_errors.items():
            _check_name(path, f"{ERRORS}.", name)
            lines.append(f"{name} = {_number(path, f'{ERRORS}.{name}', value)!r}\n")
    with replacing(path) as file:
        file.write("".join(lines).encode())


def _read(path):
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file of parameters") from None
    except OSError as err:
        raise ValueError(f"{path}: cannot read ({err.strerror})") from err
    if len(content) > MAX_BYTES:
        raise ValueError(f"{path}: over {MAX_BYTES} bytes, so it is no file of parameters")
    try:
        return tomllib.loads(content.decode("utf-8"))
    except ValueError as err:  # also what can't be decoded
        raise ValueError(f"{path}: not TOML: {err}") from err


def _check_name(path, place, name):
    if name not in Params._fields:
        near = get_close_matches(name, Params._fields, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(Params._fields)}"
        raise ValueError(f"{path}: {place}{name} is no parameter; {hint}")


def _number(where, name, value):
    """A finite float of a number or a 0-d array."""
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        found = (repr(value).splitlines() or [""])[0]
        raise ValueError(f"{where}: {name} is {found}; must be a finite number")
    return number
