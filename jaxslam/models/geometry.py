"""Angles, planar poses and 2 x 2 algebra in closed form.

Components are passed as separate scalars (or as arrays that broadcast): on a CPU this fuses into
plain loops, where batched 2 x 2 matrices do not. A lower-triangular factor is the tuple
`(l11, l21, l22)`, a symmetric matrix `(xx, xy, yy)`.
"""

import jax.numpy as jnp

# arctan(t) / t as a polynomial in t^2 on [0, 1], highest power first: least squares at Chebyshev
# nodes, error 1.2e-8 rad before rounding.
_ARCTAN = (
    0.002834064298827523,
    -0.01600503050313492,
    0.042587607465354546,
    -0.07495445443394587,
    0.1063675409820347,
    -0.14202570511737783,
    0.19992483578509165,
    -0.33333066780692144,
    0.9999999842426363,
)


def wrap(angle):
    """Wrap an angle to [-pi, pi), rad."""
    return angle - 2 * jnp.pi * jnp.floor(angle * (0.5 / jnp.pi) + 0.5)


def norm(x, y, smallest=1e-6):
    """Length of (x, y), at least `smallest`; its gradient is zero, not NaN, at the origin."""
    square = x * x + y * y
    far = square > smallest * smallest
    return jnp.where(far, jnp.sqrt(jnp.where(far, square, 1.0)), smallest)


def direction(y, x):
    """`arctan2(y, x)`, rad, with gradient zero, instead of NaN, at the origin.

    In float32 by reduction to [0, 1] and a polynomial (error below 2e-7 rad): XLA calls the scalar
    library function on a CPU, which took 23 ns a call where this vectorises to about 1 ns, and
    was a third of a whole filter step (`experiments/step_time.py`).
    """
    ax, ay = jnp.abs(x), jnp.abs(y)
    large, small = jnp.maximum(ax, ay), jnp.minimum(ax, ay)
    origin = large == 0
    if jnp.result_type(y, x) != jnp.float32:
        return jnp.where(origin, 0.0, jnp.arctan2(y, jnp.where(origin, 1.0, x)))
    t = small / jnp.where(origin, 1.0, large)
    square, angle = t * t, _ARCTAN[0]
    for coefficient in _ARCTAN[1:]:
        angle = angle * square + coefficient
    angle = angle * t
    angle = jnp.where(ay > ax, jnp.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, jnp.pi - angle, angle)
    return jnp.where(origin, 0.0, jnp.where(y < 0, -angle, angle))


def compose(pose, offset):
    """Compose a pose (x, y, heading) with an offset (x, y, heading) in its frame."""
    x, y, heading = pose
    ox, oy, turn = offset
    c, s = jnp.cos(heading), jnp.sin(heading)
    return x + c * ox - s * oy, y + s * ox + c * oy, heading + turn


def covariance(factor):
    """Covariance (xx, xy, yy) of a lower factor L: L L^T."""
    l11, l21, l22 = factor
    return l11 * l11, l11 * l21, l21 * l21 + l22 * l22


def cholesky(xx, xy, determinant):
    """Lower factor of the matrix with top row (xx, xy) and the given determinant.

    The determinant is an argument because callers know it without cancellation.
    """
    l11 = jnp.sqrt(xx)
    return l11, xy / l11, jnp.sqrt(determinant) / l11


def transpose_times(factor, h):
    """L^T h for a lower factor and a row h = (h1, h2)."""
    l11, l21, l22 = factor
    h1, h2 = h
    return l11 * h1 + l21 * h2, l22 * h2


def scalar_update(mean, factor, h, innovation, variance):
    """Update N(mean, L L^T) by one scalar measurement, with Carlson's square-root Kalman filter.

    `h`: the measurement's row. `innovation`: its value minus its prediction. Returns mean, factor
    and the innovation's variance. Working through the columns from the last to the first keeps the
    factor lower triangular with a positive diagonal (Carlson 1973, doi:10.2514/3.50253); l21 is
    written so that nothing cancels:
    l21 s2 - f1 f2 l22 = l21 r - l11 l22^2 h1 h2.
    """
    l11, l21, l22 = factor
    h1, h2 = h
    f1, f2 = transpose_times(factor, h)
    s2 = variance + f2 * f2
    s1 = s2 + f1 * f1
    inverse1, inverse2 = 1 / jnp.sqrt(s1), 1 / jnp.sqrt(s2)
    gain = innovation * inverse1 * inverse1
    updated_mean = mean[0] + gain * f1 * l11, mean[1] + gain * (f1 * l21 + f2 * l22)
    updated_factor = (
        l11 * s2 * inverse2 * inverse1,
        (l21 * variance - l11 * l22 * l22 * h1 * h2) * inverse1 * inverse2,
        l22 * jnp.sqrt(variance) * inverse2,
    )
    return updated_mean, updated_factor, s1


def pair_update(mean, factor, rows, innovations, variances):
    """Update N(mean, L L^T) by two independent scalars at once, with a Kalman filter: mean, factor,
    and square and logarithm of the predictive density, exp(-(square + logarithm) / 2) / (2 pi).

    `rows` g and h, `innovations` at the mean before, `variances` r. With a = L^T g, b = L^T h and
    A = I + a a^T / r1 + b b^T / r2 the mean moves by L z, A z = a v1 / r1 + b v2 / r2, and the new
    factor is L times the lower factor of A's inverse. Determinants and sums are written so that
    nothing cancels, and the square is |z|^2 plus that of the whitened residuals. Two
    `scalar_update`s give the same; this has half their roots, and what the filter needs more than
    once ends in a division, which XLA does not repeat.
    """
    l11, l21, l22 = factor
    (g1, g2), (h1, h2) = rows
    (a1, a2), (b1, b2) = (transpose_times(factor, row) for row in rows)
    (r1, r2), (p1, p2) = variances, (1 / r for r in variances)
    i1, i2 = (v / r for v, r in zip(innovations, variances, strict=True))
    v1, v2 = i1 * r1, i2 * r2
    across = l11 * l22 * (g1 * h2 - g2 * h1)
    both = p1 * p2 * across
    low = 1 + p1 * a2 * a2 + p2 * b2 * b2
    determinant = low + p1 * a1 * a1 + p2 * b1 * b1 + both * across
    z1 = (i1 * a1 + i2 * b1 + both * (v1 * b2 - v2 * a2)) / determinant
    z2 = (i1 * a2 + i2 * b2 + both * (v2 * a1 - v1 * b1)) / determinant
    scale = 1 / jnp.sqrt(low * determinant)
    updated_factor = (
        l11 * low * scale,
        (l21 - l11 * l22 * l22 * (p1 * g1 * g2 + p2 * h1 * h2)) * scale,
        l22 / jnp.sqrt(low),
    )
    left1, left2 = v1 - a1 * z1 - a2 * z2, v2 - b1 * z1 - b2 * z2
    square = z1 * z1 + z2 * z2 + p1 * left1 * left1 + p2 * left2 * left2
    updated_mean = mean[0] + l11 * z1, mean[1] + (l21 * z1 + l22 * z2)
    return updated_mean, updated_factor, square, jnp.log(determinant * (r1 * r2))
