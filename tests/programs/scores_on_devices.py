"""Print the scores of three logs, worked out on so many devices: COUNT."""

import sys
from pathlib import Path

import jax

jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "learning"))
from test_fit import CONFIG, NAMES, drive

from jaxslam.learning import fit, transforms
from jaxslam.parameters import Params, default_params

logs = [drive(1), drive(2), drive(3)]
params = default_params("range_bearing", logs[0])
data = fit.stack_logs(logs, CONFIG, params)
numbers = Params(*(jnp.float32(v) for v in params))
free = jnp.asarray(transforms.free_vector(params, NAMES), jnp.float32)
keys = jax.random.split(jax.random.key(0), 3)
found = fit.scores(free, numbers, data, np.arange(3), keys, CONFIG, NAMES, 0.97)
assert len(jax.devices()) == int(sys.argv[1])
print(*np.asarray(found.total, float).ravel(), *np.asarray(found.log_likelihood, float))
