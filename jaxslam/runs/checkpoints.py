"""Long runs: put aside now and then, interrupted, gone on with, and refused if they do not fit.

A run's folder is unfinished while it holds `checkpoints/` or a lock and no `summary.json`. Whatever
moment a process dies at, the folder it leaves can be gone on with, or is finished. A run that goes
on gives bit for bit what it would have given undisturbed.
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

from jaxslam.config import FORMER_FIELDS
from jaxslam.filter import sharding
from jaxslam.logs.odometry import Odometry
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import current_names, default_params
from jaxslam.results import run_folder, run_lock
from jaxslam.runs import checkpoint_file, compiled
from jaxslam.runs import memory as capacity
from jaxslam.runs.assemble import RunProgress, Summary
from jaxslam.runs.cluster import end_now, find_differences
from jaxslam.smoother.genealogy import Tree
from jaxslam.smoother.rejuvenation import SharedPast

KEPT = 2  # checkpoints
UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}
AGAIN = "; go on with the same command and --resume"
STOP = 2  # what the processes of a run agree on after a chunk: 0 go on, 1 put aside, 2 and end
NO_MATTER = ("devices",)  # settings that do not change the result


def parse_interval(text):
    """Seconds of `60`, `60s`, `5m` or `1h`."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)([smh]?)", text.strip())
    if not found or not float(found[1]):
        raise ValueError(f"--checkpoint-every is {text!r}; must be a time above 0: 60s, 5m, 1h")
    return float(found[1]) * UNITS[found[2]]


def memory_of_run(config, steps=1000):
    """`capacity.Memory` that a run of so many steps needs: compiled for it, nothing large made."""
    size, k, looks = compiled.chunk_size(config), config.measurements, {}
    if config.descriptors:
        looks["descriptor"] = jnp.zeros((size, k, config.descriptors))
        looks["within"] = jnp.zeros((size, config.descriptors))
    zero = jnp.zeros(size)
    chunk = (
        Odometry(*[zero] * len(Odometry._fields)),
        Measurements(
            value=jnp.zeros((size, k, 2)),
            cov=jnp.zeros((size, k, 3)),
            identity=jnp.zeros((size, k), jnp.int32),
            valid=jnp.zeros((size, k), bool),
            active=jnp.zeros(size, bool),
            **looks,
        ),
    )
    params = jax.tree.map(jnp.asarray, default_params(config.sensor))
    steps_compiled = compiled.compile_loop(config, chunk, params)
    return capacity.memory_of_compiled(
        steps_compiled, compiled.estimate_memory(config, steps), config
    )


class Checkpoints:
    """The folder of a long run, locked while this is entered (`with`).

    `every`: seconds between checkpoints. `resume`: go on with what is there. `overwrite`: replace
    it. `say`: gets lines worth knowing. `finished`: nothing is left to do. Entering raises
    `BlockingIOError` naming the process that is writing there, `ValueError` for a folder that is
    not to be written to.
    """

    def __init__(self, folder, every=60.0, resume=False, overwrite=False, say=None):
        self.folder, self.every, self.resume = Path(folder), every, resume
        self.overwrite, self.say = overwrite, say or _print_to_stderr
        self.finished, self.stopped, self._kept, self._lock = False, False, [], None

    def __enter__(self):
        run_folder.check_target(self.folder, self.overwrite, self.resume)
        self._above = [place for place in self.folder.parents if not place.exists()]
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = run_lock.acquire(self.folder)
        names = {path.name for path in self.folder.iterdir()} - {run_lock.NAME}
        if names and not (self.resume or self.overwrite):  # another run came in between
            os.close(self._lock)
            raise ValueError(f"{self.folder}: exists; choose another folder or add --overwrite")
        self.finished = self.resume and run_folder.FINISHED in names
        if self.finished:
            self.clear()
        return self

    def __exit__(self, kind, error, _):
        if not self._files():  # nothing to go on with: the folder as it was before
            self.clear()
        # While the lock is still held; whoever waits for it makes a file of its own.
        (self.folder / run_lock.NAME).unlink(missing_ok=True)
        with suppress(OSError):  # not empty
            for place in (self.folder, *self._above):
                place.rmdir()
        os.close(self._lock)
        if kind is KeyboardInterrupt and not error.args and self._files():
            raise KeyboardInterrupt(AGAIN) from None

    def check_fingerprint(self, log, config, params, seed):
        """Raise `ValueError` if what there is to go on with is of another run."""
        self._run = {
            **run_fingerprint(log, config, params, seed),
            "precision": jnp.zeros(()).dtype.name,
        }
        self._readable = []
        for path in self._files() if self.resume else ():
            try:
                with checkpoint_file.open_checkpoint(path) as (about, _):
                    before, versions = _current(about["run"]), about["versions"]
            except ValueError as error:
                self.say(f"warning: a broken checkpoint is left aside: {error}")
                continue
            if differing := find_differences(before, self._run):
                raise ValueError(f"{self.folder}: is of another run; differing: {differing}")
            if not self._readable and versions != run_folder.versions():
                self.say("note: other versions wrote this checkpoint: last digits may differ")
            self._readable.append(path)

    def restore(self, shapes):
        """`Filtered` of the newest checkpoint that is sound; None: from the beginning.

        `shapes`: of `filter.State`.
        """
        for path in self._readable:
            try:
                found = _read(path, shapes)
            except ValueError as error:
                self.say(f"warning: a broken checkpoint is left aside: {error}")
                continue
            self._kept = [path]
            self.say(f"note: goes on after step {found.done}, from {path.name}")
            sharding.broadcast_int(found.done)
            return found
        if self.resume:
            self.say(f"note: {self.folder} has nothing to go on with; starts from the beginning")
        sharding.broadcast_int(0)
        return None

    def take_over_folder(self):
        """From here on the folder is this run's: what others left in it is removed."""
        run_folder.clear_results(self.folder)
        if not self.resume:
            shutil.rmtree(self._place, ignore_errors=True)
        self._place.mkdir(exist_ok=True)
        self._prune()
        self._last = time.monotonic()

    @contextmanager
    def catch_signals(self):
        """Within this, the first Ctrl-C (or SIGTERM) only asks to stop; the second ends at once.

        By a thread, since Python itself sees no signal while the compiled code runs.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        ends = os.pipe()
        os.set_blocking(ends[1], False)
        watch = threading.Thread(target=self._watch, args=(ends[0],), daemon=True)
        watch.start()
        signals = signal.SIGINT, signal.SIGTERM
        before = [signal.signal(which, lambda *_: None) for which in signals]
        wakeup = signal.set_wakeup_fd(ends[1], warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(wakeup)
            for which, handler in zip(signals, before, strict=True):
                signal.signal(which, handler)
            os.close(ends[1])
            watch.join()
            os.close(ends[0])
        if self.stopped:  # while the last checkpoint was being written
            raise KeyboardInterrupt(AGAIN)

    def _watch(self, end):
        """Read signals until the other end is closed."""
        while signs := os.read(end, 1):
            if signs[0] not in (signal.SIGINT, signal.SIGTERM):
                continue
            if self.stopped:
                end_now("interrupted", 130)
            self.stopped = True

    def save_if_due(self, at, total, line):
        """Called after every chunk with `Filtered`: a checkpoint if it is time for one.

        `line`: how it goes. Raises `KeyboardInterrupt` if it was asked to stop.
        """
        due = time.monotonic() - self._last >= self.every or at.done == total
        wanted = sharding.broadcast_int(STOP if self.stopped else int(due))
        if not wanted:
            return
        path = _path(self._place, at.done)
        about = {"run": self._run, "versions": run_folder.versions(), "done": at.done}
        about |= {"seconds": at.seconds, "genealogy": at.tree is not None}
        about |= {"past": at.shared_past is not None}
        checkpoint_file.write_checkpoint(path, about, _columns(at))
        self._kept.append(path)
        self._prune()
        self._last = time.monotonic()
        if not sys.stderr.isatty():
            self.say(f"step {at.done} of {total}, {line}")
        if wanted == STOP:
            raise KeyboardInterrupt(f" after step {at.done} of {total}{AGAIN}")

    def clear(self):
        """Remove what only an unfinished run needs; the lock goes when this is left."""
        shutil.rmtree(self.folder / run_folder.PARTIAL, ignore_errors=True)
        shutil.rmtree(self._place, ignore_errors=True)

    @property
    def _place(self):
        return self.folder / run_folder.CHECKPOINTS

    def _files(self):
        """Checkpoints that are there, the newest first."""
        return sorted(self._place.glob("step-*.npz"), reverse=True)

    def _prune(self):
        """Keep the last good ones, and nothing else; until there is one, whatever is there."""
        self._kept = list(dict.fromkeys(self._kept))[-KEPT:]
        for path in self._place.iterdir() if self._kept else ():
            if path not in self._kept:
                path.unlink()


class FollowerCheckpoints:
    """What `Checkpoints` are to the other processes of a run: process 0 decides and writes.

    `wait`: called when the run is stopped, and does not return.
    """

    def __init__(self, folder, wait):
        self._place, self._wait = Path(folder) / run_folder.CHECKPOINTS, wait

    def check_fingerprint(self, *_):
        """Process 0 has looked."""

    def restore(self, shapes):
        """`Filtered` of the checkpoint that process 0 goes on from, or None."""
        done = sharding.broadcast_int(0)
        if not done:
            return None
        path = _path(self._place, done)
        try:
            return _read(path, shapes)
        except ValueError as error:
            raise ValueError(f"{path}: every process of a run has to read it: {error}") from None

    def take_over_folder(self):
        """Process 0 has it."""

    @contextmanager
    def catch_signals(self):
        """Within this, signals are left to process 0, which gets them, too."""
        signals = signal.SIGINT, signal.SIGTERM
        before = [signal.signal(which, signal.SIG_IGN) for which in signals]
        try:
            yield
        finally:
            for which, handler in zip(signals, before, strict=True):
                signal.signal(which, handler)

    def save_if_due(self, at, total, line):
        """Give process 0 what it puts aside."""
        wanted = sharding.broadcast_int(0)
        if wanted:
            for _ in _state_columns(at.state):
                pass
        if wanted == STOP:
            self._wait()


def check_finished(folder, log, config, params, seed):
    """Raise `ValueError` if the run that is finished there was told otherwise."""
    try:
        with open(folder / "steps.npz", "rb") as file, np.load(file) as steps:
            same = np.array_equal(steps["time"], log.frame_time)
    except (BadZipFile, KeyError, ValueError, EOFError) as error:
        raise ValueError(f"{folder}: is finished, but broken ({error}); run it again") from error
    if not same:
        raise ValueError(f"{folder}: is finished, but of another log, or part of it")
    before = tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))
    if differing := find_differences(_current(before), _settings(config, params, seed)):
        raise ValueError(f"{folder}: is finished, but of another run; differing: {differing}")


def run_fingerprint(log, config, params, seed):
    """What a run was told that decides its result, for JSON."""
    return {
        "frames": [len(log.frame_time), *map(int, log.frame_time[[0, -1]])],
        **_settings(config, params, seed),
        "log": checkpoint_file.digest_of_log(log),
    }


def _settings(config, params, seed):
    """`told` but for the log."""
    return {
        "seed": int(seed),
        "config": {k: v for k, v in vars(config).items() if k not in NO_MATTER},
        "params": {k: float(v) for k, v in params._asdict().items()},
    }


def _current(told):
    """Settings as a file holds them, with names of version 0.1 replaced."""
    config = {FORMER_FIELDS.get(name, name): value for name, value in told["config"].items()}
    return told | {"config": config, "params": current_names(told["params"])}


def _current_entries(get, stored):
    """`get`, a function of an entry's name, that also finds entries by their names of version 0.1;
    `stored`: the names that are there."""

    def get_by_either(name):
        former = name.replace("summary.landmark_id", "summary.match")
        former = former.replace("landmark_id", "birth").replace(".appearances", ".looks")
        return get(name if name in stored else former)

    return get_by_either


def _path(place, done):
    return place / f"step-{done:08}.npz"


def _names(state):
    """Pairs of a name and a leaf."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(state)
    return [("state" + jax.tree_util.keystr(path), leaf) for path, leaf in pairs]


def _state_columns(state):
    """Names and arrays, of which only one at a time is fetched."""
    for name, leaf in _names(state):
        yield name, [sharding.to_host(leaf)]


def _columns(at):
    """What a checkpoint holds."""
    yield from _state_columns(at.state)
    yield "entropy", at.entropy
    for name in at.summaries[0]._fields:
        yield f"summary.{name}", [getattr(part, name) for part in at.summaries]
    if at.shared_past is not None:
        for name, column in at.shared_past._asdict().items():
            yield f"past.{name}", [column]
    if at.tree is not None:
        yield "tree.nodes", [np.array([len(level) for level in at.tree.pose])]
        for name in ("pose", "landmark_id", "origin"):
            yield f"tree.{name}", getattr(at.tree, name)


def _read(path, shapes):
    """`Filtered` of a checkpoint. Raises `ValueError` if anything in it is not sound."""
    with checkpoint_file.open_checkpoint(path) as (about, get):
        get = _current_entries(get, about["arrays"])
        summary = Summary(*(get(f"summary.{name}") for name in Summary._fields))
        tree = _tree(get) if about["genealogy"] and sharding.is_leader() else None
        past = (
            SharedPast(*(get(f"past.{name}") for name in SharedPast._fields))
            if about["past"]
            else None
        )
        named, leaves = _names(shapes), {}
        # The largest first: while an array is copied to the device, it is there twice.
        for name, shape in sorted(named, key=lambda pair: -math.prod(pair[1].shape)):
            array = get(name)
            if (array.shape, array.dtype) != (shape.shape, shape.dtype):
                raise ValueError(f"{path.name}: {name} has another shape or type")
            # A copy: memory of NumPy's can't be given up.
            leaves[name] = sharding.to_devices(array, shape)
        state = jax.tree.unflatten(jax.tree.structure(shapes), [leaves[name] for name, _ in named])
        return RunProgress(
            state, [summary], tree, about["done"], about["seconds"], past, [get("entropy")]
        )


def _tree(get):
    """The genealogy, level by level; copies, since the levels die one by one."""
    tree, nodes = Tree(), get("tree.nodes")
    ends = np.cumsum(nodes)
    for name in ("pose", "landmark_id"):
        setattr(tree, name, [part.copy() for part in np.split(get(f"tree.{name}"), ends[:-1])])
    # The nodes of a level point to the level before; the last ones' children are the particles.
    ends = np.cumsum(nodes[1:])
    tree.origin = [part.copy() for part in np.split(get("tree.origin"), ends)]
    return tree


def _print_to_stderr(line):
    print(line, file=sys.stderr, flush=True)
