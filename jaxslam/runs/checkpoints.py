"""Checkpoints: write the state of a long run now and then, and resume from it.

A run folder is unfinished while it holds `checkpoints/` or a lock and no `summary.json`. Whenever a
process dies, the run in its folder is finished or can be resumed, to the same bits as undisturbed.
"""

import math
import os
import re
import shutil
import signal
import sys
import threading
import time
import tomllib
from contextlib import contextmanager, suppress
from pathlib import Path
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import sharding
from jaxslam.logs.odometry import Odometry
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import default_params
from jaxslam.results import run_folder, run_lock
from jaxslam.runs import checkpoint_file, compiled, memory
from jaxslam.runs.assemble import RunProgress, Summary
from jaxslam.runs.cluster import end_now, find_differences
from jaxslam.smoother.genealogy import Tree
from jaxslam.smoother.rejuvenation import SharedPast

KEPT = 2  # checkpoints
UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}
AGAIN = "; to resume, repeat the command with --resume"
STOP = 2  # what all processes do after a chunk: 0 continue, 1 write a checkpoint, 2 and stop
SIGNALS = signal.SIGINT, signal.SIGTERM


def parse_interval(text):
    """Parse text like `60`, `60s`, `5m` or `1h` as seconds; raise `ValueError` for other text."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)([smh]?)", text.strip())
    if not found or not float(found[1]):
        raise ValueError(f"--checkpoint-every is {text!r}; must be a time above 0: 60s, 5m, 1h")
    return float(found[1]) * UNITS[found[2]]


def memory_of_run(config, steps=1000):
    """Return the `Memory` that a run of so many steps needs: compile it, but allocate no state."""
    size, k, appearance = compiled.chunk_size(config), config.measurements, {}
    if config.descriptors:
        appearance["descriptor"] = jnp.zeros((size, k, config.descriptors))
        appearance["within"] = jnp.zeros((size, config.descriptors))
    zero = jnp.zeros(size)
    chunk = (
        Odometry(*[zero] * len(Odometry._fields)),
        Measurements(
            value=jnp.zeros((size, k, 2)),
            cov=jnp.zeros((size, k, 3)),
            identity=jnp.zeros((size, k), jnp.int32),
            valid=jnp.zeros((size, k), bool),
            active=jnp.zeros(size, bool),
            **appearance,
        ),
    )
    params = jax.tree.map(jnp.asarray, default_params(config.sensor))
    filter_chunk = compiled.compile_loop(config, chunk, params)
    return memory.memory_of_compiled(filter_chunk, compiled.estimate_memory(config, steps), config)


class Checkpoints:
    """Checkpoints in a run folder, which is locked within `with`.

    `every`: seconds between checkpoints. `resume`: continue from the newest one. `overwrite`:
    replace what is in the folder. `report`: called with each note, warning and line of progress.
    `finished`: the run is complete. Entering raises `BlockingIOError` naming another process that
    writes there, and `ValueError` for a folder that must not be written to.
    """

    def __init__(self, folder, every=60.0, resume=False, overwrite=False, report=None):
        self.folder, self.every, self.resume = Path(folder), every, resume
        self.overwrite, self.report = overwrite, report or _print_to_stderr
        self.finished, self.stopped, self._kept, self._lock = False, False, [], None

    def __enter__(self):
        run_folder.check_target(self.folder, self.overwrite, self.resume)
        self._made = [parent for parent in self.folder.parents if not parent.exists()]
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = run_lock.acquire(self.folder)
        names = {path.name for path in self.folder.iterdir()} - {run_lock.NAME}
        if names and not (self.resume or self.overwrite):  # another run has just begun here
            os.close(self._lock)
            raise ValueError(f"{self.folder}: exists; choose another folder or add --overwrite")
        self.finished = self.resume and run_folder.FINISHED in names
        if self.finished:
            self.clear()
        return self

    def __exit__(self, kind, error, _):
        if not self._files():  # nothing to resume from: leave the folder as it was before
            self.clear()
        # While the lock is still held; a process that waits for it creates another file.
        (self.folder / run_lock.NAME).unlink(missing_ok=True)
        with suppress(OSError):  # not empty
            for folder in (self.folder, *self._made):
                folder.rmdir()
        os.close(self._lock)
        if kind is KeyboardInterrupt and not error.args and self._files():
            raise KeyboardInterrupt(AGAIN) from None

    def check_fingerprint(self, log, config, params, seed):
        """Raise `ValueError` if the checkpoints are those of a run with another fingerprint."""
        self._run = checkpoint_file.run_fingerprint(log, config, params, seed)
        self._run["precision"] = jnp.zeros(()).dtype.name
        self._readable = []
        for path in self._files() if self.resume else ():
            try:
                with checkpoint_file.open_checkpoint(path) as (about, _):
                    before, versions = about["run"], about["versions"]
            except ValueError as error:
                self.report(f"warning: skipping a broken checkpoint: {error}")
                continue
            if differing := find_differences(before, self._run):
                raise ValueError(f"{self.folder}: holds another run; differing: {differing}")
            if not self._readable and versions != run_folder.versions():
                self.report("note: other versions wrote this checkpoint; last digits may differ")
            self._readable.append(path)

    def restore(self, shapes):
        """Read the `RunProgress` of the newest intact checkpoint, or return None if there is none;
        `shapes`: `state_shapes` of the run."""
        for path in self._readable:
            try:
                so_far = _read(path, shapes)
            except ValueError as error:
                self.report(f"warning: skipping a broken checkpoint: {error}")
                continue
            self._kept = [path]
            self.report(f"note: resuming after step {so_far.done}, from {path.name}")
            sharding.broadcast_int(so_far.done)
            return so_far
        if self.resume:
            self.report(f"note: no checkpoint in {self.folder}; starting from the beginning")
        sharding.broadcast_int(0)
        return None

    def take_over_folder(self):
        """Remove what other runs left in the folder; from here on it is this run's."""
        run_folder.clear_results(self.folder)
        if not self.resume:
            shutil.rmtree(self._checkpoints, ignore_errors=True)
        self._checkpoints.mkdir(exist_ok=True)
        self._prune()
        self._last = time.monotonic()

    @contextmanager
    def catch_signals(self):
        """Catch Ctrl-C and SIGTERM: the first asks to stop after the chunk, the second exits.

        By a thread, as Python handles no signals while compiled code runs.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        ends = os.pipe()
        os.set_blocking(ends[1], False)
        watch = threading.Thread(target=self._watch, args=(ends[0],), daemon=True)
        watch.start()
        try:
            with _handle_signals(lambda *_: None):
                wakeup = signal.set_wakeup_fd(ends[1], warn_on_full_buffer=False)
                try:
                    yield
                finally:
                    signal.set_wakeup_fd(wakeup)
        finally:
            os.close(ends[1])
            watch.join()
            os.close(ends[0])
        if self.stopped:  # while the last checkpoint was being written
            raise KeyboardInterrupt(AGAIN)

    def _watch(self, end):
        """Read signal numbers until the other end is closed."""
        while byte := os.read(end, 1):
            if byte[0] not in SIGNALS:
                continue
            if self.stopped:
                end_now("interrupted", 130)
            self.stopped = True

    def save_if_due(self, so_far, total, line):
        """Write a checkpoint of the `RunProgress` if it is time, and report its progress `line`.

        Called after every chunk. Raises `KeyboardInterrupt` if a signal asked to stop.
        """
        due = time.monotonic() - self._last >= self.every or so_far.done == total
        action = sharding.broadcast_int(STOP if self.stopped else int(due))
        if not action:
            return
        path = _path(self._checkpoints, so_far.done)
        about = dict(run=self._run, versions=run_folder.versions(), done=so_far.done)
        about |= dict(seconds=so_far.seconds, genealogy=so_far.tree is not None)
        about |= dict(past=so_far.shared_past is not None)
        checkpoint_file.write_checkpoint(path, about, _columns(so_far))
        self._kept.append(path)
        self._prune()
        self._last = time.monotonic()
        if not sys.stderr.isatty():
            self.report(f"step {so_far.done} of {total}, {line}")
        if action == STOP:
            raise KeyboardInterrupt(f" after step {so_far.done} of {total}{AGAIN}")

    def clear(self):
        """Remove what only an unfinished run needs; the lock is removed on leaving `with`."""
        shutil.rmtree(self.folder / run_folder.PARTIAL, ignore_errors=True)
        shutil.rmtree(self._checkpoints, ignore_errors=True)

    @property
    def _checkpoints(self):
        return self.folder / run_folder.CHECKPOINTS

    def _files(self):
        """List the checkpoint files, the newest first."""
        return sorted(self._checkpoints.glob("step-*.npz"), reverse=True)

    def _prune(self):
        """Remove all but the last checkpoints; nothing until this run has read or written one."""
        self._kept = list(dict.fromkeys(self._kept))[-KEPT:]
        for path in self._checkpoints.iterdir() if self._kept else ():
            if path not in self._kept:
                path.unlink()


class FollowerCheckpoints:
    """`Checkpoints` for the processes other than the leader, which decides and writes.

    `wait_for_leader`: called when the run is stopped; does not return.
    """

    def __init__(self, folder, wait_for_leader):
        self._checkpoints = Path(folder) / run_folder.CHECKPOINTS
        self._wait_for_leader = wait_for_leader

    def check_fingerprint(self, *_):
        """Do nothing: the leader checks."""

    def restore(self, shapes):
        """Read the `RunProgress` of the checkpoint that the leader resumes from, or None."""
        done = sharding.broadcast_int(0)
        if not done:
            return None
        path = _path(self._checkpoints, done)
        try:
            return _read(path, shapes)
        except ValueError as error:
            raise ValueError(f"{path}: every process must be able to read it: {error}") from None

    def take_over_folder(self):
        """Do nothing: the leader does it."""

    def catch_signals(self):
        """Ignore signals: the leader gets them, too."""
        return _handle_signals(signal.SIG_IGN)

    def save_if_due(self, so_far, total, line):
        """Take part in gathering the state if the leader writes a checkpoint."""
        action = sharding.broadcast_int(0)
        if action:
            for _ in _state_columns(so_far.state):
                pass
        if action == STOP:
            self._wait_for_leader()


@contextmanager
def _handle_signals(handler):
    before = [signal.signal(number, handler) for number in SIGNALS]
    try:
        yield
    finally:
        for number, former in zip(SIGNALS, before, strict=True):
            signal.signal(number, former)


def check_finished(folder, log, config, params, seed):
    """Raise `ValueError` if the finished run in a folder is broken, or had other settings."""
    try:
        with open(folder / "steps.npz", "rb") as file, np.load(file) as steps:
            same = np.array_equal(steps["time"], log.frame_time)
    except (BadZipFile, KeyError, ValueError, EOFError) as error:
        raise ValueError(f"{folder}: is finished, but broken ({error}); run it again") from error
    if not same:
        raise ValueError(f"{folder}: is finished, but of another log, or part of it")
    before = tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))
    before = checkpoint_file.current_settings(before)
    if differing := find_differences(before, checkpoint_file.run_settings(config, params, seed)):
        raise ValueError(f"{folder}: is finished, but of another run; differing: {differing}")


def _path(folder, done):
    return folder / f"step-{done:08}.npz"


def _named_leaves(state):
    """List pairs of a name and a leaf."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(state)
    return [("state" + jax.tree_util.keystr(path), leaf) for path, leaf in pairs]


def _state_columns(state):
    """Yield names and arrays; only one at a time is copied to the host."""
    for name, leaf in _named_leaves(state):
        yield name, [sharding.to_host(leaf)]


def _columns(so_far):
    """Yield names and lists of arrays of everything in a checkpoint."""
    yield from _state_columns(so_far.state)
    yield "entropy", so_far.entropy
    for name in Summary._fields:
        yield f"summary.{name}", [getattr(part, name) for part in so_far.summaries]
    if so_far.shared_past is not None:
        for name, column in so_far.shared_past._asdict().items():
            yield f"past.{name}", [column]
    if so_far.tree is not None:
        yield "tree.nodes", [np.array([len(level) for level in so_far.tree.pose])]
        for name in ("pose", "landmark_id", "origin"):
            yield f"tree.{name}", getattr(so_far.tree, name)


def _read(path, shapes):
    """Read the `RunProgress` of a checkpoint; raise `ValueError` if anything in it is broken."""
    with checkpoint_file.open_checkpoint(path) as (about, get):
        summary = Summary(*(get(f"summary.{name}") for name in Summary._fields))
        tree = _read_tree(get) if about["genealogy"] and sharding.is_leader() else None
        past = None
        if about["past"]:
            past = SharedPast(*(get(f"past.{name}") for name in SharedPast._fields))
        state = _read_state(path, get, shapes)
        entropy = [get("entropy")]
    return RunProgress(state, [summary], tree, about["done"], about["seconds"], past, entropy)


def _read_state(path, get, shapes):
    named, leaves = _named_leaves(shapes), {}
    # The largest first: while an array is copied to the device, there are two of it.
    for name, shape in sorted(named, key=lambda pair: -math.prod(pair[1].shape)):
        array = get(name)
        if (array.shape, array.dtype) != (shape.shape, shape.dtype):
            raise ValueError(f"{path.name}: {name} has another shape or type")
        # A copy: JAX can't donate memory of NumPy.
        leaves[name] = sharding.to_devices(array, shape)
    return jax.tree.unflatten(jax.tree.structure(shapes), [leaves[name] for name, _ in named])


def _read_tree(get):
    """Read the genealogy level by level; copies, since levels are freed one by one."""
    tree, nodes = Tree(), get("tree.nodes")
    ends = np.cumsum(nodes)
    for name in ("pose", "landmark_id"):
        setattr(tree, name, [part.copy() for part in np.split(get(f"tree.{name}"), ends[:-1])])
    # A level's nodes are counted by the next level's origins; the last level's by the particles.
    ends = np.cumsum(nodes[1:])
    tree.origin = [part.copy() for part in np.split(get("tree.origin"), ends)]
    return tree


def _print_to_stderr(line):
    print(line, file=sys.stderr, flush=True)
