"""Whether a run fits into memory: asked before any large array is made."""

import ctypes
import math
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import jax

GROUPS = Path("/sys/fs/cgroup")


class Memory(NamedTuple):
    """Bytes a run needs: its `state`, what a `chunk` of steps hands over, at most the `genealogy`,
    and the compiler's own `temporaries` (0 before it is compiled)."""

    state: int
    chunk: int
    genealogy: int
    temporaries: int

    @property
    def total(self):
        return sum(self)

    def __str__(self):
        parts = (f"{name} {_gb(size)}" for name, size in self._asdict().items() if size)
        return f"{_gb(self.total)} ({', '.join(parts)})"


def bytes_of(tree):
    """Bytes of all arrays, or shapes of arrays, in a tree; where devices share them, what lies in
    the memory that `available` is about."""
    return sum(_size(leaf) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def _size(leaf):
    shared = leaf.sharding
    if shared is None or shared.num_devices == 1:
        return leaf.size
    return math.prod(shared.shard_shape(leaf.shape)) * _together(shared.num_devices)


def _together(devices):
    """How many of a run's devices share the memory that `available` is about."""
    return devices // jax.process_count() if jax.devices()[0].platform == "cpu" else 1


def memory_of_compiled(compiled, memory, config):
    """`memory` with the compiler's own figures of a chunk whose state is donated."""
    told = compiled.memory_analysis()
    if told is None:  # not every backend says
        return memory
    # The figures are of one device; what several hand over is put together on the host.
    times = _together(config.devices)
    handed = times * (told.output_size_in_bytes - told.alias_size_in_bytes)
    inputs = times * told.argument_size_in_bytes - memory.state
    whole = memory.chunk if config.devices > 1 else 0
    temporaries = times * told.temp_size_in_bytes
    return memory._replace(chunk=handed + max(inputs, 0) + whole, temporaries=temporaries)


def check_memory(memory, config):
    """Raise `ValueError` if this does not fit, with the number of particles that would."""
    free = available_bytes()
    if free is None or memory.total <= free:
        return
    n, fixed = config.particles, memory.chunk + memory.genealogy
    # The state and the temporaries grow with the particles, what else there is hardly does.
    share = (free - fixed) / (memory.total - fixed) if free > fixed else free / memory.total
    most = int(0.95 * n * share)
    most -= most % 10 ** max(0, len(str(most)) - 2)
    raise ValueError(
        f"{n} particles with {config.landmarks} landmarks need {memory}, and {_gb(free)} are free; "
        f"--particles {max(1, most)} would fit, or take fewer --landmarks"
    )


def available_bytes():
    """Bytes that can still be had on the first device here; None: not known."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        told = device.memory_stats() or {}
        limit = told.get("bytes_limit")
        return None if limit is None else limit - told.get("bytes_in_use", 0)
    found = [size for size in (_machine_bytes(), *_cgroup_bytes()) if size is not None]
    return min(found, default=None)


def resident_bytes():
    """Bytes of memory this process has now; None: not known."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


def trim_heap():
    """Hand memory that was freed back to the system: after compiling it is hundreds of megabytes,
    which the C library would keep. Only glibc can; elsewhere nothing is done."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def print_memory(memory):
    """One line about the need, on stderr."""
    free = available_bytes()
    said = "" if free is None else f"; {_gb(free)} are free"
    print(f"note: memory needed: {memory}{said}", file=sys.stderr)


def _gb(size):
    return f"{size / 1e9:.3g} GB" if size >= 1e8 else f"{size / 1e6:.3g} MB"


def _machine_bytes():
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    told = next((line.split() for line in lines if line.startswith("MemAvailable:")), None)
    return told and int(told[1]) * 1024


def _cgroup_bytes(groups=GROUPS, own=Path("/proc/self/cgroup")):
    """What is left of the limits of this process's control groups, versions 1 and 2."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, kinds, path = line.split(":", 2)
        if kinds and "memory" not in kinds.split(","):
            continue
        names = ("memory.max", "memory.current", "inactive_file")
        if kinds:
            names = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
        base = groups / "memory" if kinds else groups
        place = base / path.strip("/")
        # In a container the path may be the host's: then the limit is at the base.
        for folder in (place, *place.parents):
            if folder.is_relative_to(base):
                yield _left(folder, *names)


def _left(folder, limit, usage, cache):
    """Bytes left in one group; file pages that can be dropped count as free. None: no limit."""
    try:
        most = (folder / limit).read_text().strip()
        used = int((folder / usage).read_text())
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):
        return None
    return None if most == "max" else max(0, int(most) - used + int(stat.get(cache, 0)))
