"""Camera formats of OCamCalib, Kalibr and OpenCV: text <-> fields of a `Camera`.

OCamCalib's axes are (row, column) and its z points away from the scene, so a = -a_ocam; its
polynomial is in px, lowest power first, as is the inverse one, which takes atan(z / r) to r.
"""

import math

import cv2
import numpy as np
import yaml

from jaxslam.vision.camera import FARTHEST

OCAM = (
    "polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB)."
    " These are used by cam2world",
    "polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB)."
    " These are used by world2cam",
    'center: "row" and "column", starting from 0 (C convention)',
    'affine parameters "c", "d", "e"',
    'image size: "height" and "width"',
)
OCAM_NAMES = ("direct polynomial", "inverse polynomial", "center", "affine", "image size")
OPENCV = {"camera_matrix": 9, "distortion_coefficients": 4, "xi": 1}  # name: count of numbers
OPENCV |= {"image_width": 1, "image_height": 1}
INVERSE_ERROR, INVERSE_DEGREE = 0.01, 25  # largest error [px] and degree


def from_ocamcalib(text):
    """Fields of a `Camera` from a calib_results.txt; the inverse polynomial is not needed."""
    lines = [line.split() for line in text.splitlines()]
    lines = [line for line in lines if line and not line[0].startswith("#")]
    if len(lines) < len(OCAM):
        raise ValueError(f"{OCAM_NAMES[len(lines)]} is missing: the file ends before it")
    values = [_floats(name, line) for name, line in zip(OCAM_NAMES, lines, strict=False)]
    for name, value in zip(OCAM_NAMES[:2], values, strict=False):
        if len(value) < 2 or value[0] != len(value) - 1:
            raise ValueError(f"{name} announces {value[0]:g} coefficients but has {len(value) - 1}")
    for name, value, count in zip(OCAM_NAMES[2:], values[2:], (2, 3, 2), strict=False):
        if len(value) != count:
            raise ValueError(f"{name} has {len(value)} numbers; must be {count}")
    (row, column), (c, d, e), (height, width) = values[2:5]
    direct = values[0][1:]
    if len(direct) > 7 or direct[1:2].any():
        raise ValueError("direct polynomial: must be of order 6 at most, without a linear term")
    width, height = _positive_integer("image size", width), _positive_integer("image size", height)
    powers = np.arange(max(len(direct), 3))
    a = -np.pad(direct, (0, len(powers) - len(direct))) * (max(width, height) / 2) ** (powers - 1.0)
    params = [column, row, c, d, e, 0, 0, a[0], *a[2:]]
    return dict(width=width, height=height, model="polynomial", params=params)


def to_ocamcalib(camera):
    """Text of a calib_results.txt. Raises `ValueError` if the format can't hold the camera."""
    if camera.model != "polynomial" or camera["p1"] or camera["p2"]:
        limit = "without decentring (p1, p2) only; calibrate with simple=True"
        raise ValueError(f"OCamCalib's file holds a polynomial camera {limit}")
    half, a = max(camera.size) / 2, camera.params[7:]
    powers = np.array([0, *range(2, len(a) + 1)])
    direct = np.zeros(powers[-1] + 1)
    direct[powers] = -a * half ** (1.0 - powers)
    inverse = _inverse(direct, FARTHEST * half)
    polynomials = [len(direct), *direct], [len(inverse), *inverse]
    centre, affine = (camera["cy"], camera["cx"]), [camera[name] for name in "cde"]
    numbers = *polynomials, centre, affine, (camera.height, camera.width)
    parts = zip(OCAM, map(_format_numbers, numbers), strict=True)
    return "\n".join(f"#{title}\n\n{text}\n" for title, text in parts)


def _inverse(direct, farthest):
    """Fit r [px] by powers of atan(z / r), lowest first, as far as it is one to one."""
    r = np.linspace(farthest / 2000, farthest, 2000)
    angle = np.arctan(np.polynomial.polynomial.polyval(r, direct) / r)
    falling = np.flatnonzero(np.diff(angle) <= 0)
    r, angle = (x[: falling[0] + 1] if len(falling) else x for x in (r, angle))
    for degree in range(4, INVERSE_DEGREE + 1):
        fit = np.polynomial.Polynomial.fit(angle, r, degree)
        if np.abs(fit(angle) - r).max() < INVERSE_ERROR:
            break
    return fit.convert().coef


def _format_numbers(values):
    return " ".join(str(v) if isinstance(v, int) else f"{v:.16e}" for v in values)


def from_kalibr(text):
    """Fields of a `Camera` from a camchain: its cam0."""
    try:
        chain = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"is not YAML ({str(error).splitlines()[0]})") from None
    camera = chain.get("cam0") if isinstance(chain, dict) else None
    if not isinstance(camera, dict):
        raise ValueError("has no cam0, so it is not a camchain of Kalibr")
    for name, allowed in (("camera_model", "omni"), ("distortion_model", "radtan")):
        if camera.get(name) != allowed:
            raise ValueError(f"cam0.{name} is {camera.get(name)!r}; must be {allowed}")
    found = []
    for name, count in (("intrinsics", 5), ("distortion_coeffs", 4), ("resolution", 2)):
        values = camera.get(name)
        if not isinstance(values, list) or len(values) != count:
            raise ValueError(f"cam0.{name} is {values!r}; must be {count} numbers")
        found.append(_floats(f"cam0.{name}", values))
    (xi, fx, fy, cx, cy), distortion, size = found
    width, height = (_positive_integer("cam0.resolution", n) for n in size)
    params = [cx, cy, fx, fy, 0, xi, *distortion]
    return dict(width=width, height=height, model="unified", params=params)


def to_kalibr(camera):
    """Text of a camchain. Raises `ValueError` if the format can't hold the camera."""
    if camera.model != "unified" or camera["s"]:
        raise ValueError(
            "Kalibr's omni holds a unified camera without skew (s) only; calibrate with simple=True"
        )
    fields = {
        "camera_model": "omni",
        "intrinsics": [camera[name] for name in ("xi", "fx", "fy", "cx", "cy")],
        "distortion_model": "radtan",
        "distortion_coeffs": [camera[name] for name in ("k1", "k2", "p1", "p2")],
        "resolution": [camera.width, camera.height],
    }
    return yaml.safe_dump({"cam0": fields}, sort_keys=False)


def from_opencv(text):
    """Fields of a `Camera` from camera_matrix, distortion_coefficients and xi of cv2.omnidir."""
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        found = {}
        for name, count in OPENCV.items():
            node = storage.getNode(name)
            if node.empty():
                raise ValueError(f"{name} is missing")
            found[name] = _floats(name, np.ravel(node.mat() if node.isMap() else node.real()))
            if len(found[name]) != count:
                raise ValueError(f"{name} has {len(found[name])} numbers; must be {count}")
    except cv2.error as error:
        raise ValueError(f"is not YAML of OpenCV ({error.err.strip()})") from None
    fx, s, cx, _, fy, cy = found["camera_matrix"][:6]
    if not np.array_equal(found["camera_matrix"][[3, 6, 7, 8]], [0, 0, 0, 1]):
        raise ValueError("camera_matrix must be [fx, s, cx; 0, fy, cy; 0, 0, 1]")
    size = ("image_width", "image_height")
    width, height = (_positive_integer(name, found[name][0]) for name in size)
    params = [cx, cy, fx, fy, s, found["xi"][0], *found["distortion_coefficients"]]
    return dict(width=width, height=height, model="unified", params=params)


def to_opencv(camera):
    """Text for cv2.FileStorage. Raises `ValueError` if the format can't hold the camera."""
    if camera.model != "unified":
        raise ValueError("OpenCV's file holds a unified camera only; calibrate with that model")
    fx, fy, s, cx, cy = (camera[name] for name in ("fx", "fy", "s", "cx", "cy"))
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", np.array([[fx, s, cx], [0, fy, cy], [0, 0, 1]]))
    storage.write("distortion_coefficients", camera.params[None, 6:10])
    storage.write("xi", np.array([[camera["xi"]]]))
    return storage.releaseAndGetString()


def _floats(name, values):
    try:
        numbers = np.array([math.nan if isinstance(v, bool) else float(v) for v in values])
    except (TypeError, ValueError):
        numbers = np.array([math.nan])
    if not np.isfinite(numbers).all():
        raise ValueError(f"{name} is {' '.join(map(str, values))}; must be finite numbers")
    return numbers


def _positive_integer(name, value):
    if value != int(value) or value < 1:
        raise ValueError(f"{name} is {value:g}; must be a whole number above 0")
    return int(value)
