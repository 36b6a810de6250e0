"""The free scale, on which parameters are learned and every real number is allowed.

Logarithms of positive values, log-odds of probabilities, in units of which one is a large change:
a factor e of a noise, a tenth of a gain, 0.1 m or rad of the mounting.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.parameters import TABLE


def to_free(name, value):
    """Transform a parameter's value to the free scale."""
    row = TABLE[name]
    if row.scale == "logit":
        return jnp.log(value) - jnp.log1p(-value)
    return (jnp.log(value) if row.scale == "log" else value) / row.step


def from_free(name, free):
    """Transform a value on the free scale to the parameter's."""
    row = TABLE[name]
    if row.scale == "logit":
        return jax.nn.sigmoid(free)
    free = free * row.step
    return jnp.exp(free) if row.scale == "log" else free


def with_free(params, names, free):
    """Replace the parameters `names` by those of `free` [P]."""
    return params._replace(**{n: from_free(n, free[i]) for i, n in enumerate(names)})


def to_params(params, names, free):
    """`with_free` with floats, computed in double precision."""
    with jax.enable_x64(True):
        values = {n: float(from_free(n, float(free[i]))) for i, n in enumerate(names)}
    return params._replace(**values)


def free_vector(params, names):
    """Compute the free values [P] (float64) of the parameters `names`.

    Raises `ValueError` for a value without one, such as a noise of zero.
    """
    for name in names:
        value = float(getattr(params, name))
        if TABLE[name].scale != "linear" and value <= 0:
            raise ValueError(f"{name} is {value:g}: to be learned it must start above 0")
    with jax.enable_x64(True):
        return np.array([float(to_free(n, float(getattr(params, n)))) for n in names])


def derivative_at(name, free):
    """Derivative of a parameter by its free value, at `free`."""
    with jax.enable_x64(True):
        return float(jax.grad(lambda f: from_free(name, f))(float(free)))
