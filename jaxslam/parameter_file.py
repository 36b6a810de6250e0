"""Read and write parameter files: TOML, one line per parameter with its unit and meaning.

`name = value  # unit, meaning`, and standard errors, where known, in a table `[standard_error]`. A
file may hold only some of the names. Three tables may say what is learned, and how:

    [learn]
    parameters = ["err_rot", "sigma_bearing"]
    [bounds]  # lowest and highest, in the parameter's unit
    err_rot = [0.01, 1.0]
    [prior]  # value in its unit; standard deviation of its logarithm (outlier: of its log-odds;
    err_rot = [0.1, 0.5]  # mount_x, mount_y, mount_yaw, bias_drift: in its unit)
"""

import math
import tomllib
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from jaxslam.files import atomic_write
from jaxslam.parameters import FORMER_NAMES, PARAMETERS, TABLE, Params, current_names

ERRORS = "standard_error"
LEARN, BOUNDS, PRIOR = "learn", "bounds", "prior"
PAIRS = {BOUNDS: "[lowest, highest]", PRIOR: "[value, standard deviation]"}
MAX_BYTES = 1 << 20


class Learning(NamedTuple):
    """Settings of learning in a file: the start `params`, `names` to learn (None: not given),
    `bounds` and `priors` as pairs by name."""

    params: Params
    names: tuple | None = None
    bounds: dict | None = None
    priors: dict | None = None


def validate(params, where):
    """Check that each value is a number in its range; returns `Params` of floats.

    `where` begins the message of the `ValueError`: the name of a file, for example.
    """
    values = {name: _number(where, name, value) for name, value in params._asdict().items()}
    for name, (good, allowed) in _ranges(values).items():
        if not good:
            raise ValueError(f"{where}: {name} is {values[name]:g}; must be {allowed}")
    return Params(**values)


def _ranges(values):
    """For each bounded name: whether its value is allowed, and the allowed range in words."""
    ranges = {row.name: _range(row, values[row.name]) for row in PARAMETERS if row.low > -math.inf}
    low, high, pi = values["view_min"], values["view_max"], math.pi + 1e-6  # float32 rounds it up
    most = values["existence_max"]
    new, confirm = values["existence_new"], values["existence_confirm"]
    return ranges | {
        "view_min": (-pi <= low < high, f"from -pi to below view_max, {high:g} rad"),
        "view_max": (low < high <= pi, f"above view_min, {low:g} rad, and at most pi"),
        # Below zero a landmark would be forgotten in its first frame.
        "existence_new": (0 <= new <= most, f"from 0 to existence_max, {most:g}"),
        "existence_confirm": (confirm <= most, f"at most existence_max, {most:g}"),
    }


def _range(row, value):
    """Whether a value is in the range of its row, and the range in words."""
    good = row.low < value if row.above_low else row.low <= value
    if row.high < math.inf:
        below = "below " if row.below_high else ""
        good = good and (value < row.high if row.below_high else value <= row.high)
        return good, f"a {row.unit}, from {row.low:g} to {below}{row.high:g}"
    words = f"above {row.low:g} {row.unit}" if row.above_low else f"{row.low:g} {row.unit} or more"
    return good, words


def load_params(path: str | Path, base: Params) -> Params:
    """Load the `Params` of a file; names not in it keep their value of `base`.

    Raises `ValueError` naming file, parameter, value and what is allowed.
    """
    return _load(path, base).params


def load_learning(path, base):
    """Load the `Learning` of a file: parameters as in `load_params`, and the tables for learning.

    Raises `ValueError` as that does, and for a start outside its bounds.
    """
    learning = _load(path, base)
    for name, (low, high) in learning.bounds.items():
        start = getattr(learning.params, name)
        if not low <= start <= high:
            text = f"{name} starts at {start:g}, outside its bounds {low:g} to {high:g}"
            raise ValueError(f"{path}: {text}")
    return learning


def _load(path, base):
    table = _read(Path(path))
    errors, learn = (_pop_table(path, table, part) for part in (ERRORS, LEARN))
    pairs = {part: _pop_table(path, table, part) for part in PAIRS}
    table, errors = _rename_former(path, table), _rename_former(path, errors)
    pairs = {part: _rename_former(path, names) for part, names in pairs.items()}
    for prefix, names in (("", table), (f"{ERRORS}.", errors)):
        for name, value in names.items():
            _check_name(path, prefix, name)
            if _number(path, prefix + name, value) < 0 and prefix:
                raise ValueError(f"{path}: {prefix}{name} is {value!r}; must be 0 or more")
    params = validate(base._replace(**table), path)
    for part, names in pairs.items():
        for name, value in names.items():
            _check_name(path, f"{part}.", name)
            pairs[part] = pairs[part] | {name: _pair(path, part, name, value, params)}
    return Learning(params, _names(path, learn), pairs[BOUNDS], pairs[PRIOR])


def _rename_former(path, names):
    """Replace names of version 0.1 in a table; `ValueError` if it has both names."""
    for former, name in FORMER_NAMES.items():
        if former in names and name in names:
            raise ValueError(f"{path}: {former} is the former name of {name}; give one of them")
    return current_names(names)


def _pop_table(path, table, part):
    """Remove and return the table of that name; empty if there is none."""
    value = table.pop(part, {})
    if not isinstance(value, dict):
        raise ValueError(f"{path}: {part} is {value!r}; must be a table, [{part}]")
    return value


def _names(path, learn):
    """Names listed in `[learn]`, or None."""
    for key in learn:
        if key != "parameters":
            raise ValueError(f"{path}: {LEARN}.{key} is not known; there is: parameters")
    names = learn.get("parameters")
    if names is None:
        return None
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        wanted = '["err_rot", "err_drift"]'
        raise ValueError(f"{path}: {LEARN}.parameters is {names!r}; must be names, like {wanted}")
    names = [FORMER_NAMES.get(name, name) for name in names]
    for name in names:
        _check_name(path, f"{LEARN}.parameters: ", name)
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: {LEARN}.parameters names one of {', '.join(names)} twice")
    return tuple(names)


def _pair(path, part, name, value, params):
    """Two numbers of `[bounds]` or `[prior]`."""
    where = f"{part}.{name}"
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"{path}: {where} is {value!r}; must be {PAIRS[part]}")
    first, second = (_number(path, where, number) for number in value)
    in_range = (first, second) if part == BOUNDS else (first,)
    for number in in_range:
        good, allowed = _ranges(params._replace(**{name: number})._asdict()).get(name, (True, ""))
        if not good:
            raise ValueError(f"{path}: {where} holds {number:g}; must be {allowed}")
    if part == BOUNDS and not first < second:
        raise ValueError(f"{path}: {where} is {value}; must be {PAIRS[part]}")
    if part == PRIOR and second <= 0:
        raise ValueError(f"{path}: {where}: standard deviation {second:g}; must be above 0")
    if part == PRIOR and first <= 0 and name in _ranges(params._asdict()):
        raise ValueError(
            f"{path}: {where} is about {first:g}, which has no logarithm; must be above 0"
        )
    return first, second


def save_params(
    path: str | Path,
    params: Params,
    standard_errors: Mapping[str, float] | None = None,
    learning: Learning | None = None,
) -> None:
    """Write `params` to a file atomically; `standard_errors`: a dict by name, or None.

    `learning`: a `Learning` whose names, bounds and priors are written, too, so that another fit
    can start from the file.

    Raises `ValueError` if a value is out of range or the file can't be written.
    """
    path = Path(path)
    values = validate(params, path)._asdict()
    lines = [f"{f'{name} = {value!r}':36}  # {TABLE[name].unit}, {TABLE[name].meaning}\n"
             for name, value in values.items()]  # fmt: skip
    if standard_errors:
        lines.append(f"\n[{ERRORS}]\n")
        for name, value in standard_errors.items():
            _check_name(path, f"{ERRORS}.", name)
            lines.append(f"{name} = {_number(path, f'{ERRORS}.{name}', value)!r}\n")
    if learning is not None:
        lines += _learning_lines(path, learning)
    with atomic_write(path) as file:
        file.write("".join(lines).encode())


def _learning_lines(path, learning):
    """Yield the tables of a `Learning`."""
    if learning.names is not None:
        names = ", ".join(f'"{name}"' for name in _names(path, {"parameters": [*learning.names]}))
        yield f"\n[{LEARN}]\nparameters = [{names}]\n"
    for part, pairs in ((BOUNDS, learning.bounds or {}), (PRIOR, learning.priors or {})):
        if pairs:
            yield f"\n[{part}]  # {PAIRS[part]}\n"
        for name, pair in pairs.items():
            _check_name(path, f"{part}.", name)
            yield f"{name} = {list(_pair(path, part, name, [*pair], learning.params))}\n"


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
    except ValueError as err:  # also if not UTF-8
        raise ValueError(f"{path}: not TOML: {err}") from err


def _check_name(path, prefix, name):
    if name not in Params._fields:
        near = get_close_matches(name, Params._fields, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(Params._fields)}"
        raise ValueError(f"{path}: {prefix}{name} is no parameter; {hint}")


def _number(where, name, value):
    """Convert a number or a 0-d array to a finite float, or raise `ValueError`."""
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        found = (repr(value).splitlines() or [""])[0]
        raise ValueError(f"{where}: {name} is {found}; must be a finite number")
    return number
