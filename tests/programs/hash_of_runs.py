"""Print a digest of what runs find: LOG SETTINGS CHANGES (JSON)."""

import hashlib
import json
import sys

import jax

jax.config.update("jax_num_cpu_devices", 4)
import numpy as np

from jaxslam.logs.log_file import load_log
from jaxslam.parameters import default_params
from jaxslam.results import run_folder
from jaxslam.runs import batch, compiled, run
from jaxslam.runs.run import config_for

log, settings = load_log(sys.argv[1]), json.loads(sys.argv[2])
for change in json.loads(sys.argv[3]):
    compiled.CHUNK = change.pop("chunk", 256)
    runs, folder = change.pop("runs", 0), change.pop("save", None)
    config = config_for(log, **settings | change)
    if runs:  # three of them, shared by so many devices; the first is looked at
        todo = batch.plan_tasks("3,5,6", default_params(config.sensor, log))
        found = batch.run_tasks(log, config, todo, refine=False, devices=runs)[0]
    else:
        found = run.run(log, config, seed=3, refine=False)
    if folder:
        run_folder.save(found, folder, figures=False)
    names = "pose", "cov", "log_evidence", "ess", "match", "landmarks", "ancestral", "lineage"
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves([getattr(found, name) for name in names]):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    print(
        digest.hexdigest(),
        found.resampled.sum(),
        len(found.landmarks.id),
        len(found.pose),
        config.devices,
        f"{found.seconds:.1f} s + {found.compile_seconds:.1f} s",
        flush=True,
    )
