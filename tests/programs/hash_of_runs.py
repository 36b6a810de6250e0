"""Print a digest of results of runs: LOG SETTINGS CHANGES (JSON)."""

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
    if runs:  # three of them, on so many devices; the digest is of the first
        tasks = batch.plan_tasks("3,5,6", default_params(config.sensor, log))
        result = batch.run_tasks(log, config, tasks, refine=False, devices=runs)[0]
    else:
        result = run.run(log, config, seed=3, refine=False)
    if folder:
        run_folder.save(result, folder, figures=False)
    names = "pose", "cov", "log_evidence", "ess", "match", "landmarks", "ancestral", "lineage"
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves([getattr(result, name) for name in names]):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    print(
        digest.hexdigest(),
        result.resampled.sum(),
        len(result.landmarks.id),
        len(result.pose),
        config.devices,
        f"{result.seconds:.1f} s + {result.compile_seconds:.1f} s",
        flush=True,
    )
