"""Central camera models (pixel <-> unit ray), and the pose of the camera on the robot.

Pixels are (u, v): column and row, the centre of the first at (0, 0). The model frame has x along
columns, y along rows and z along the optical axis, as if the camera were a lens: z > 0 at the
centre. `Camera.matrix` maps it to the robot's frame (x forward, y left, z up), where azimuth is
atan2(y, x), counter-clockwise from ahead, and elevation asin(z).

Lengths are normalised by s = half the longer side. `polynomial` is the model of Scaramuzza,
Martinelli and Siegwart (2006): ray ~ (x, y, a0 + a2 rho^2 + a3 rho^3 ...), with a symmetric affine
map of the image and two decentring terms for a misaligned mirror; `unified` is the sphere model of
Mei and Rives (2007) with radial and tangential distortion (OpenCV's omnidir, Kalibr's omni-radtan).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

POLYNOMIAL = ("cx", "cy", "c", "d", "e", "p1", "p2", "a0", "a2", "a3", "a4", "a5", "a6")
UNIFIED = ("cx", "cy", "fx", "fy", "s", "xi", "k1", "k2", "p1", "p2")
MODELS = ("polynomial", "unified")
FARTHEST = 1.6  # normalised radius up to which a polynomial is evaluated: beyond all corners
NEWTON = 6  # steps; four reach double precision from the table's value


def parameter_names(model, count=None):
    """Names of the first `count` parameters of a model (None: all); a polynomial may end early."""
    return {"polynomial": POLYNOMIAL, "unified": UNIFIED}[model][:count]


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera. Raises `ValueError` for invalid values.

    `params` [P], named by `parameter_names(model)`: cx, cy, fx, fy, s in px, others without unit;
    `covariance` [P, P] of them or None. `mirror`: a single mirror, which reverses z. `lens` points
    "up" or "down". `yaw`, `roll`, `pitch` [rad] turn the camera about the robot's z, x and y, in
    this order; `position` (x, y, height) [m] on it. `elevation` (low, high) [rad]: usable view.
    """

    width: int
    height: int
    model: str
    params: np.ndarray
    mirror: bool = False
    lens: str = "up"
    yaw: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    elevation: tuple[float, float] = (-math.pi / 2, math.pi / 2)
    covariance: np.ndarray | None = None

    def __post_init__(self):
        if self.model not in MODELS:
            raise ValueError(f"camera: model {self.model!r} is not one of {', '.join(MODELS)}")
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 1 << 16:
                raise ValueError(f"camera: {name} {value!r} is not a whole number of 1 to 65536")
        _set(self, "params", _numbers("params", self.params, 1))
        least = 10 if self.model == "unified" else 9
        count, most = len(self.params), len(parameter_names(self.model))
        if not least <= count <= most:
            raise ValueError(f"camera: {count} params; {self.model} has {least} to {most}")
        if self.lens not in ("up", "down"):
            raise ValueError(f"camera: lens {self.lens!r} is neither up nor down")
        for name in ("yaw", "roll", "pitch"):
            _set(self, name, float(_numbers(name, getattr(self, name), 0)))
        _set(self, "position", _tuple("position", self.position, 3))
        _set(self, "elevation", _tuple("elevation", self.elevation, 2))
        low, high = self.elevation
        if not -math.pi / 2 <= low < high <= math.pi / 2:
            raise ValueError(f"camera: elevation {low:g}..{high:g} rad; must rise within +-pi/2")
        if self.covariance is not None:
            _set(self, "covariance", _numbers("covariance", self.covariance, 2))
            if self.covariance.shape != (count, count):
                raise ValueError(f"camera: covariance is not {count} x {count}")
        if self.model == "polynomial":
            _check_polynomial(self.params)
        elif self["fx"] <= 0 or self["fy"] <= 0 or self["xi"] < 0:
            raise ValueError("camera: fx and fy must be above 0, and xi at least 0")

    def __getitem__(self, name: str) -> float:
        """A parameter by name."""
        return float(self.params[parameter_names(self.model).index(name)])

    @property
    def names(self) -> tuple[str, ...]:
        return parameter_names(self.model, len(self.params))

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height

    @property
    def matrix(self) -> np.ndarray:
        """Matrix [3, 3] from the model frame to the robot's frame (improper for a mirror)."""
        side, back = 1.0 if self.lens == "up" else -1.0, -1.0 if self.mirror else 1.0
        base = np.diag([1.0, side, side * back])
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return tilt_matrix(self.roll, self.pitch) @ turn @ base

    def ray(self, pixel: ArrayLike) -> np.ndarray:
        """Unit rays [..., 3] in the model frame of pixels [..., 2]; NaN outside the image."""
        pixel = np.asarray(pixel, float)
        ray = pixel_to_ray(self.model, self.params, self.size, pixel)
        return np.where(self._inside(pixel)[..., None], ray, np.nan)

    def pixel(self, ray: ArrayLike) -> np.ndarray:
        """Pixels [..., 2] of rays [..., 3] in the model frame; NaN outside the image."""
        pixel = ray_to_pixel(self.model, self.params, self.size, np.asarray(ray, float))
        return np.where(self._inside(pixel)[..., None], pixel, np.nan)

    def direction(self, pixel: ArrayLike) -> np.ndarray:
        """Unit directions [..., 3] in the robot's frame of pixels [..., 2]."""
        return self.ray(pixel) @ self.matrix.T

    def project(self, direction: ArrayLike) -> np.ndarray:
        """Pixels [..., 2] of directions [..., 3] in the robot's frame; NaN outside the image."""
        return self.pixel(np.asarray(direction, float) @ self.matrix)

    def _inside(self, pixel):
        with np.errstate(invalid="ignore"):
            return ((pixel >= -0.5) & (pixel <= np.array(self.size) - 0.5)).all(-1)


def tilt_matrix(roll, pitch):
    """Rotation [3, 3] Ry(pitch) Rx(roll): about the robot's x (forward), then its y (left)."""
    c, s = np.cos(roll), np.sin(roll)
    rx = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = np.cos(pitch), np.sin(pitch)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ rx


def pixel_to_ray(model, params, size, pixel):
    """Unit rays [..., 3] of pixels [..., 2]; NumPy or JAX arrays, differentiable with JAX."""
    xp, stop = _namespace(params, pixel)
    half = max(size) / 2
    u, v = pixel[..., 0] - params[0], pixel[..., 1] - params[1]
    if model == "polynomial":
        c, d, e, p1, p2 = (params[i] for i in range(2, 7))
        det = c - d * e
        x, y = (c * u - e * v) / det / half, (v - d * u) / det / half
        x, y = _undistort(xp, stop, x, y, (0.0, 0.0, p1, p2))
        rho = xp.sqrt(x * x + y * y + 1e-30)  # the gradient of a bare norm at the centre is NaN
        z = _polynomial(params[7:], rho)
    else:
        fx, fy, s, xi = (params[i] for i in range(2, 6))
        y = v / fy
        x, y = _undistort(xp, stop, (u - s * y) / fx, y, params[6:10])
        square = x * x + y * y
        # Nothing is imaged beyond the sphere's rim: NaN, without a warning or a NaN gradient.
        inside = 1 + (1 - xi * xi) * square
        root = xp.sqrt(xp.where(inside > 0, inside, 1.0))
        eta = xp.where(inside > 0, (xi + root) / (1 + square), xp.nan)
        x, y, z = eta * x, eta * y, eta - xi
    length = xp.sqrt(x * x + y * y + z * z)
    return xp.stack([x / length, y / length, z / length], -1)


def ray_to_pixel(model, params, size, ray):
    """Pixels [..., 2] of rays [..., 3] of any length; NaN outside the domain of the model.

    NumPy or JAX arrays. With JAX, first derivatives are exact (one Newton step from the converged
    root, by the implicit function theorem), higher ones are not.
    """
    xp, stop = _namespace(params, ray)
    half = max(size) / 2
    length = xp.sqrt((ray * ray).sum(-1))
    x, y, z = (ray[..., i] / length for i in range(3))
    if model == "unified":
        fx, fy, s, xi = (params[i] for i in range(2, 6))
        imaged = z * xp.maximum(xi, 1.0) > -xp.minimum(xi, 1.0)  # Mei's domain of definition
        depth = xp.where(imaged, z + xi, 1.0)
        x, y, _ = _distort(x / depth, y / depth, params[6:10])
        u, v = fx * x + s * y + params[0], fy * y + params[1]
    else:
        c, d, e, p1, p2 = (params[i] for i in range(2, 7))
        lateral = xp.sqrt(x * x + y * y + 1e-30)
        rho, imaged = _radius(xp, stop, params[7:], lateral, z)
        x, y, _ = _distort(x / lateral * rho, y / lateral * rho, (0.0, 0.0, p1, p2))
        x, y = half * x, half * y
        u, v = params[0] + x + e * y, params[1] + d * x + c * y
    return xp.where(imaged[..., None], xp.stack([u, v], -1), xp.nan)


def _radius(xp, stop, a, lateral, z):
    """Root rho [...] of f(rho) lateral = rho z, and whether the polynomial is one to one there."""
    grid = np.linspace(0, FARTHEST, 65)
    angle = xp.arctan2(xp.asarray(grid), _polynomial(stop(a), xp.asarray(grid)))  # from the axis
    rising = xp.concatenate([xp.ones(1, bool), angle[1:] > angle[:-1]])
    one_to_one = xp.cumprod(rising) > 0
    last = xp.max(xp.where(one_to_one, angle, 0.0))
    wanted = stop(xp.arctan2(lateral, z))
    rho = xp.interp(wanted, xp.where(one_to_one, angle, last), xp.asarray(grid))
    fixed, side, up = stop(a), stop(lateral), stop(z)
    for _ in range(NEWTON):
        slope = _slope(fixed, rho) * side - up
        rho = rho - (_polynomial(fixed, rho) * side - rho * up) / xp.where(slope == 0, 1.0, slope)
        rho = xp.clip(rho, 0.0, FARTHEST)
    slope = _slope(fixed, rho) * side - up
    rho = rho - (_polynomial(a, rho) * lateral - rho * z) / xp.where(slope == 0, 1.0, slope)
    return rho, wanted <= last


def _polynomial(a, rho):
    """a0 + a2 rho^2 + a3 rho^3 + ..., without a linear term: the mirror is smooth at its tip."""
    total = 0.0 * rho
    for i in range(len(a) - 1, 0, -1):
        total = (total + a[i]) * rho
    return total * rho + a[0]


def _slope(a, rho):
    """Derivative of `_polynomial` by rho."""
    total = 0.0 * rho
    for i in range(len(a) - 1, 0, -1):
        total = total * rho + (i + 1) * a[i]
    return total * rho


def _distort(x, y, k):
    """Distorted (x, y) and the Jacobian's entries (xx, xy, yy); k: two radial, two tangential."""
    k1, k2, p1, p2 = k[0], k[1], k[2], k[3]
    square = x * x + y * y
    radial, slope = 1 + square * (k1 + k2 * square), 2 * (k1 + 2 * k2 * square)
    out_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    out_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return out_x, out_y, (xx, xy, yy)


def _undistort(xp, stop, x, y, k):
    """The inverse of `_distort` by Newton's method; its last step carries the derivative."""
    fixed, goal_x, goal_y = [stop(part) for part in k], stop(x), stop(y)
    px, py = goal_x, goal_y
    for i in range(NEWTON):
        if i == NEWTON - 1:
            fixed, goal_x, goal_y = k, x, y
        at_x, at_y, (xx, xy, yy) = _distort(px, py, fixed)
        dx, dy = goal_x - at_x, goal_y - at_y
        xx, xy, yy = stop(xx), stop(xy), stop(yy)
        det = xx * yy - xy * xy
        det = xp.where(det == 0, 1.0, det)
        px, py = px + (yy * dx - xy * dy) / det, py + (xx * dy - xy * dx) / det
    return px, py


def _namespace(*arrays):
    """NumPy, or jax.numpy if any argument is a JAX array, and its function to stop gradients."""
    if all(isinstance(array, np.ndarray | list | tuple) for array in arrays):
        return np, lambda value: value
    import jax

    return jax.numpy, jax.lax.stop_gradient


def _check_polynomial(params):
    if params[7] <= 0:
        raise ValueError(f"camera: a0 is {params[7]:g}; must be above 0 (z > 0 at the centre)")
    c, d, e = params[2:5]
    if c - d * e <= 0:
        raise ValueError(f"camera: affine c - d e is {c - d * e:g}; must be above 0")


def _numbers(name, value, dimensions):
    try:
        array = np.array(value, float)
    except (TypeError, ValueError):
        raise ValueError(f"camera: {name} does not consist of numbers") from None
    if array.ndim != dimensions or not np.isfinite(array).all():
        raise ValueError(f"camera: {name} must be finite, with {dimensions} dimensions")
    array.setflags(write=False)
    return array


def _tuple(name, value, length):
    array = _numbers(name, value, 1)
    if len(array) != length:
        raise ValueError(f"camera: {name} has {len(array)} numbers; must be {length}")
    return tuple(array.tolist())


def _set(owner, name, value):
    object.__setattr__(owner, name, value)
