"""Camera files: our own readable TOML, with covariances."""

import os
import tomllib
from pathlib import Path

import numpy as np

from jaxslam.vision.camera import Camera, parameter_names

MAX_BYTES = 1 << 20


def save_camera(path, camera):
    """Write a camera as TOML, all or nothing. Raises `ValueError` when it can't be written."""
    path = Path(path)
    lines = [f"width = {camera.width}\n", f"height = {camera.height}\n"]
    lines += [f'model = "{camera.model}"\n', f"mirror = {str(camera.mirror).lower()}\n"]
    lines += [f'lens = "{camera.lens}"\n']
    for name in ("yaw", "roll", "pitch"):
        lines.append(f"{name} = {getattr(camera, name)!r}  # rad\n")
    lines.append(f"position = {list(camera.position)}  # m on the robot: forward, left, height\n")
    lines.append(f"elevation = {list(camera.elevation)}  # rad, least and largest\n\n[params]\n")
    values = camera.params.tolist()
    lines += [f"{name} = {value!r}\n" for name, value in zip(camera.names, values, strict=True)]
    if camera.covariance is not None:
        lines.append("\n[covariance]  # of the params, in their order\n")
        rows = zip(camera.names, camera.covariance.tolist(), strict=True)
        lines += [f"{name} = {row}\n" for name, row in rows]
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "w", encoding="utf-8", newline="\n") as file:
            file.writelines(lines)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise ValueError(f"{path}: can't be written ({error.strerror})") from error
    finally:
        temporary.unlink(missing_ok=True)


def load_camera(path):
    """`Camera` of a TOML file. Raises `ValueError` naming file, field and what is wrong."""
    path = Path(path)
    try:
        with open(path, "rb") as file:
            table = tomllib.loads(file.read(MAX_BYTES).decode("utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: can't be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is not TOML ({error})") from error
    params = table.pop("params", None)
    covariance = table.pop("covariance", None)
    try:
        names = parameter_names(table.get("model"), len(params))
        ordered = [params[name] for name in names]
        matrix = None if covariance is None else np.array([covariance[name] for name in names])
        return Camera(params=ordered, covariance=matrix, **table)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: lacks or misnames {error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
