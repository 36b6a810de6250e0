"""Check that a run fits into memory before any large array is made."""

import ctypes
import math
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import jax

CGROUPS = Path("/sys/fs/cgroup")


class Memory(NamedTuple):
    """Bytes that a run needs: for the `state`, the records of a `chunk`, at most the `genealogy`,
    and the compiler's `temporaries` (0 before compiling)."""

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
    """Count the bytes of all arrays, or shapes of arrays, in a tree; of arrays shared by several
    devices, those in the memory of `available_bytes`."""
    return sum(_size(leaf) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def _size(leaf):
    shards = leaf.sharding
    if shards is None or shards.num_devices == 1:
        return leaf.size
    return math.prod(shards.shard_shape(leaf.shape)) * _devices_together(shards.num_devices)


def _devices_together(devices):
    """Count those of a run's devices that share the memory of `available_bytes`."""
    return devices // jax.process_count() if jax.devices()[0].platform == "cpu" else 1


def memory_of_compiled(compiled, memory, config):
    """Complete `memory` with the compiler's figures for a chunk, whose state is donated."""
    figures = compiled.memory_analysis()
    if figures is None:  # not every backend has them
        return memory
    # They are of one device; what several devices return is put together on the host.
    times = _devices_together(config.devices)
    outputs = times * (figures.output_size_in_bytes - figures.alias_size_in_bytes)
    inputs = times * figures.argument_size_in_bytes - memory.state
    on_host = memory.chunk if config.devices > 1 else 0
    temporaries = times * figures.temp_size_in_bytes
    return memory._replace(chunk=outputs + max(inputs, 0) + on_host, temporaries=temporaries)


def check_memory(memory, config):
    """Raise `ValueError`, with the number of particles that would fit, if `memory` is too much."""
    free = available_bytes()
    if free is None or memory.total <= free:
        return
    n, fixed = config.particles, memory.chunk + memory.genealogy
    # State and temporaries grow with the number of particles, the rest hardly does.
    share = (free - fixed) / (memory.total - fixed) if free > fixed else free / memory.total
    most = int(0.95 * n * share)
    most -= most % 10 ** max(0, len(str(most)) - 2)
    raise ValueError(
        f"{n} particles with {config.landmarks} landmarks need {memory}, and {_gb(free)} are free; "
        f"--particles {max(1, most)} would fit, or take fewer --landmarks"
    )


def available_bytes():
    """Return the free bytes of this process's first device; None: unknown."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        limit = stats.get("bytes_limit")
        return None if limit is None else limit - stats.get("bytes_in_use", 0)
    sizes = [size for size in (_machine_bytes(), *_cgroup_bytes()) if size is not None]
    return min(sizes, default=None)


def resident_bytes():
    """Return the resident bytes of this process; None: unknown."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


def trim_heap():
    """Return freed memory, hundreds of megabytes after compiling, to the system; glibc only."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def print_memory(memory):
    """Print needed and free memory on stderr."""
    free = available_bytes()
    text = "" if free is None else f"; {_gb(free)} are free"
    print(f"note: memory needed: {memory}{text}", file=sys.stderr)


def _gb(size):
    return f"{size / 1e9:.3g} GB" if size >= 1e8 else f"{size / 1e6:.3g} MB"


def _machine_bytes():
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    words = next((line.split() for line in lines if line.startswith("MemAvailable:")), None)
    return words and int(words[1]) * 1024


def _cgroup_bytes(groups=CGROUPS, own=Path("/proc/self/cgroup")):
    """Yield the free bytes (None: no limit) of this process's control groups, versions 1 and 2."""
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
        group = base / path.strip("/")
        # In a container the path may be the host's: then the limit is at the base.
        for folder in (group, *group.parents):
            if folder.is_relative_to(base):
                yield _free_bytes(folder, *names)


def _free_bytes(folder, limit, usage, cache):
    """Return the free bytes of one group, with cached file pages; None: no limit."""
    try:
        most = (folder / limit).read_text().strip()
        used = int((folder / usage).read_text())
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):
        return None
    return None if most == "max" else max(0, int(most) - used + int(stat.get(cache, 0)))
