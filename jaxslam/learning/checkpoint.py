"""Checkpoint files of a fit."""

import hashlib
import json
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config import FORMER_FIELDS
from jaxslam.files import atomic_write
from jaxslam.parameters import FORMER_NAMES


def fingerprint_of(settings, data):
    """Digest the settings and logs that a checkpoint belongs to.

    Settings are written as in version 0.1, whose checkpoints can still be resumed.
    """
    text = repr(settings).replace(type(settings).__name__, "_Told", 1)
    for former, name in (FORMER_NAMES | FORMER_FIELDS).items():
        text = text.replace(name, former)
    digest = hashlib.sha256(text.encode())
    for leaf in jax.tree.leaves(data):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def save_state(path, fingerprint, state):
    """Write the state atomically."""
    leaves = jax.tree.leaves(state.optimiser)
    record = {"rows": state.rows, "judgements": state.judgements, "stopped": state.stopped}
    text = json.dumps(record, default=lambda array: array.tolist())
    arrays = {f"optimiser{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    with atomic_write(Path(path)) as file:
        np.savez(
            file, fingerprint=fingerprint, step=state.step, free=state.free, told=text, **arrays
        )


def load_state(path, fingerprint, state):
    """Read the state; raises `ValueError` for no checkpoint, or one of another fit."""
    try:
        with np.load(path, allow_pickle=False) as file:
            entries = dict(file)
    except FileNotFoundError:
        raise ValueError(f"{path}: no checkpoint to resume from") from None
    except (OSError, ValueError, zipfile.BadZipFile) as err:
        raise ValueError(f"{path}: not a checkpoint, or damaged: {err}") from err
    if "fingerprint" not in entries or str(entries["fingerprint"]) != fingerprint:
        raise ValueError(f"{path}: belongs to a fit of other logs or settings; start without it")
    shape = jax.tree.structure(state.optimiser)
    leaves = [jnp.asarray(entries[f"optimiser{i}"]) for i in range(shape.num_leaves)]
    record = json.loads(str(entries["told"]))
    rows, judgements = (
        tuple(tuple(np.array(v) if isinstance(v, list) else v for v in row) for row in record[name])
        for name in ("rows", "judgements")
    )
    return type(state)(
        step=int(entries["step"]),
        free=entries["free"],
        optimiser=jax.tree.unflatten(shape, leaves),
        rows=rows,
        judgements=judgements,
        stopped=record["stopped"],
    )
