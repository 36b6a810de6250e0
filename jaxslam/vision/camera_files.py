"""Camera files: TOML with covariances, and the formats of other tools.

`calib_results.txt` of OCamCalib, camchain YAML of Kalibr (omni + radtan) and YAML of OpenCV
(camera_matrix, distortion_coefficients, xi of omnidir) hold neither covariances nor the pose of the
camera on the robot. Errors are `ValueError` naming file, field and what was found.
"""

import tomllib
from dataclasses import fields
from pathlib import Path

from jaxslam.files import atomic_write
from jaxslam.vision import foreign_camera_formats as foreign
from jaxslam.vision.camera import MODELS, Camera, parameter_names

MAX_BYTES = 1 << 20
FORMATS = ("toml", "ocamcalib", "kalibr", "opencv")
BY_SUFFIX = {".toml": "toml", ".txt": "ocamcalib", ".yaml": "opencv", ".yml": "opencv"}
ENDINGS = f"a camera file ends in one of {', '.join(BY_SUFFIX)}"


def save_camera(path: str | Path, camera: Camera, kind: str | None = None) -> None:
    """Write a camera file atomically. `kind`: one of `FORMATS`, None: by the suffix of `path`.

    Raises `ValueError` if it can't be written, or if the format can't hold the camera.
    """
    path = Path(path)
    kind = kind or BY_SUFFIX.get(path.suffix.lower())
    if kind not in FORMATS:
        raise ValueError(f"{path}: {ENDINGS}")
    writers = _to_toml, foreign.to_ocamcalib, foreign.to_kalibr, foreign.to_opencv
    try:
        text = writers[FORMATS.index(kind)](camera)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    with atomic_write(path) as file:
        file.write(text.encode())


def load_camera(path: str | Path, mirror: bool = False, lens: str = "up") -> Camera:
    """Read a `Camera`: .toml, .txt of OCamCalib, .yaml of Kalibr (its cam0) or OpenCV.

    `mirror` and `lens` as in `Camera`, for formats that lack them. Raises `ValueError`.
    """
    path = Path(path)
    kind = BY_SUFFIX.get(path.suffix.lower())
    if kind is None:
        raise ValueError(f"{path}: {ENDINGS}")
    text = _read_text(path)
    try:
        if kind == "toml":
            return _from_toml(text)
        if kind == "ocamcalib":
            model = foreign.from_ocamcalib(text)
        else:
            model = (foreign.from_opencv if text.startswith("%YAML") else foreign.from_kalibr)(text)
        return Camera(**model, mirror=mirror, lens=lens)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _read_text(path):
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{path}: can't be read ({error.strerror})") from error
    if len(content) > MAX_BYTES:
        raise ValueError(f"{path}: over {MAX_BYTES} bytes, so not a camera file")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not text, so not a camera file") from None


def _to_toml(camera):
    lines = [f"width = {camera.width}", f"height = {camera.height}  # px"]
    lines += [f'model = "{camera.model}"', f"mirror = {str(camera.mirror).lower()}"]
    lines += [f'lens = "{camera.lens}"  # where it points on the robot: up or down']
    for name in ("yaw", "roll", "pitch"):
        lines.append(f"{name} = {getattr(camera, name)!r}  # rad")
    lines.append(f"position = {list(camera.position)}  # m on the robot: forward, left, height")
    lines += [f"elevation = {list(camera.elevation)}  # rad, least and largest", "", "[params]"]
    values = camera.params.tolist()
    lines += [f"{name} = {value!r}" for name, value in zip(camera.names, values, strict=True)]
    if camera.covariance is not None:
        lines += ["", "[covariance]  # of the params, in their order"]
        rows = camera.covariance.tolist()
        lines += [f"{name} = {row}" for name, row in zip(camera.names, rows, strict=True)]
    return "\n".join(lines) + "\n"


def _from_toml(text):
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"is not TOML ({error})") from None
    known = [field.name for field in fields(Camera)]
    for name in table:
        if name not in known:
            raise ValueError(f"{name} is not a field; the fields are {', '.join(known)}")
    for name in ("width", "height", "model", "params"):
        if name not in table:
            raise ValueError(f"{name} is missing")
    if table["model"] not in MODELS:
        raise ValueError(f"model is {table['model']!r}; must be one of {', '.join(MODELS)}")
    if not isinstance(table.get("mirror", False), bool):
        raise ValueError(f"mirror is {table['mirror']!r}; must be true or false")
    names = parameter_names(table["model"], len(table["params"]))
    for part in ("params", "covariance"):
        if part in table:
            table[part] = _sort_values(table[part], part, names)
    return Camera(**table)


def _sort_values(values, part, names):
    """Values of a table in the order of `names`. Raises `ValueError` for missing or other names."""
    if not isinstance(values, dict):
        raise ValueError(f"{part} is {values!r}; must be a table, [{part}]")
    for name in {**dict.fromkeys(names), **values}:
        if name not in values or name not in names:
            fault = "is missing" if name in names else "is not a parameter of the model"
            raise ValueError(f"{part}.{name} {fault}")
    return [values[name] for name in names]
