"""One run shared by several processes, on one machine or on several.

Before JAX connects them they meet here, on the coordinator's port: a process that never comes, or
was told another run, ends in one line, where JAX would abort. The connections stay: they show at
once that the process at the other end died, and in the end they carry the exit code.
"""

import json
import os
import re
import socket
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import fields
from typing import NamedTuple

from jaxslam.config import Config

RENDEZVOUS_TIMEOUT = 60.0  # seconds in which all must have come
EXIT_TIMEOUT = 3.0  # seconds in which a process may find by itself why another one ended
LOST = 69  # exit code: a process is missing, or was lost
REPLY_TIMEOUT = 5.0  # seconds for what takes no time
MAX_LINE = 2**16  # bytes of a line


class ClusterAddress(NamedTuple):
    """Where the processes meet, how many there are, and which one this is."""

    host: str
    port: int
    processes: int
    process: int

    @property
    def address(self):
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def find_address(coordinator=None, processes=None, process=None, env=os.environ):
    """`Place` as the three options say, or Slurm or Open MPI where they don't; None: alone, as with
    `processes` 1 whatever a launcher says.

    Raises `ValueError` for options that do not fit together.
    """
    given = (coordinator, processes, process)
    if given == (None, 1, None):
        return None
    given = [a if a is not None else b for a, b in zip(given, _from_launcher(env), strict=True)]
    names = "--coordinator", "--num-processes", "--process-id"
    missing = [name for name, value in zip(names, given, strict=True) if value is None]
    if len(missing) == 3:
        return None
    if missing:
        raise ValueError(f"{' and '.join(missing)} missing; {', '.join(names)} go together")
    address, processes, process = given
    found = re.fullmatch(r"(\[[^\[\]]+\]|[^:\[\]\s]+):(\d{1,5})", address)
    if not found or not 0 < int(found[2]) < 2**16:
        raise ValueError(f"--coordinator is {address!r}; must be HOST:PORT, like 127.0.0.1:4321")
    if not 0 <= process < processes:
        raise ValueError(
            f"--process-id is {process}; of {processes} it must be 0 to {processes - 1}"
        )
    if processes == 1:
        return None
    return ClusterAddress(found[1].strip("[]"), int(found[2]), processes, process)


def _from_launcher(env):
    """Address, processes and process as a launcher tells them; None for what it does not."""
    if int(env.get("SLURM_STEP_NUM_TASKS", 1)) > 1 and "SLURM_PROCID" in env:
        # The first of `node001`, `node001,x2` or `node[001-015,020],x2`.
        first = re.match(r"([^\[,]+)(?:\[(\w+))?", env.get("SLURM_STEP_NODELIST", ""))
        host = first and first[1] + (first[2] or "")
        size, rank, job = "SLURM_STEP_NUM_TASKS", "SLURM_PROCID", int(env.get("SLURM_JOB_ID", 0))
    elif int(env.get("OMPI_COMM_WORLD_SIZE", 1)) > 1:
        # As in 1531576320.0;tcp://10.96.0.1,10.148.0.1:34911; newer versions do not say.
        first = re.match(r"(\d+).*?(?:tcp://([^,:]+)|tcp6://\[([^,\]]+))", env.get(_ORTE, ""))
        host, job = first and (first[2] or first[3]), int(first[1]) // 2**12 if first else 0
        size, rank = "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"
    else:
        return None, None, None
    host = f"[{host}]" if host and ":" in host else host
    # A port of the last 4096, so that jobs on one machine hardly ever share it.
    return host and f"{host}:{61440 + job % 4096}", int(env[size]), int(env[rank])


_ORTE = "OMPI_MCA_orte_hnp_uri"


def rendezvous(place, run, limit=RENDEZVOUS_TIMEOUT):
    """Connections to the other processes (of process 0), or to process 0, by process; when all are
    there and were told the same `run`, a dict for JSON.

    Raises `ConnectionError`, of one line, on every side if that is not so within `limit` seconds.
    """
    return _gather(place, run, limit) if place.process == 0 else {0: _call(place, run, limit)}


def _gather(place, run, limit):
    """Process 0's side of `meet`: waits for the others."""
    family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
    try:
        server = socket.create_server((place.host, place.port), family=family)
    except OSError as error:
        why = (error.strerror or str(error)).split(" (")[0].lower()
        raise ConnectionError(f"can't wait at {place.address}: {why}") from None
    end, found, problem = time.monotonic() + limit, {}, None
    with server:
        while len(found) + 1 < place.processes and not problem:
            server.settimeout(max(1e-3, end - time.monotonic()))
            try:
                link = server.accept()[0]
            except TimeoutError:
                missing = sorted({*range(1, place.processes)} - {*found})
                who = "process " + ", ".join(map(str, missing))
                problem = f"{who} did not come to {place.address} within {limit:g} s"
            else:
                problem = _greet(link, place, run, found)
    # JAX listens at the port from here on.
    for link in found.values():
        _send(link, f"no {problem}" if problem else "go")
        if problem:
            link.close()
    if problem:
        raise ConnectionError(problem)
    return found


def _greet(link, place, run, found):
    """Take in whoever has called; gives what is wrong about it, or None."""
    link.settimeout(REPLY_TIMEOUT)
    try:
        told = json.loads(_line(link))
        process, count, other = told["process"], told["processes"], told["run"]
    except (OSError, ValueError, KeyError, TypeError):  # none of ours
        link.close()
        return None
    problem = None
    if process in (0, *found):
        problem = f"two processes have --process-id {process}"
    elif count != place.processes:
        problem = f"process {process} has --num-processes {count}, process 0 {place.processes}"
    elif differing := find_differences(run, other):
        problem = f"process {process} was told otherwise than process 0: {differing}"
    if problem:
        _send(link, f"no {problem}")
        link.close()
    else:
        found[process] = link
    return problem


def _call(place, run, limit):
    """Another process's side of `meet`: calls process 0."""
    end = time.monotonic() + limit
    while True:
        left = max(0.1, end - time.monotonic())
        try:
            link = socket.create_connection((place.host, place.port), timeout=left)
            # On one machine a socket that looks for a port may be given that very port.
            if link.getsockname() != link.getpeername():
                break
            link.close()
        except OSError as error:
            if time.monotonic() >= end:
                why = (error.strerror or str(error)).lower()
                raise ConnectionError(
                    f"no process 0 at {place.address} within {limit:g} s: {why}"
                ) from None
        time.sleep(0.2)
    _send(link, json.dumps({"process": place.process, "processes": place.processes, "run": run}))
    link.settimeout(limit + REPLY_TIMEOUT)
    try:
        word, _, why = _line(link).partition(" ")
    except OSError:
        word = why = ""
    if word == "go":
        return link
    link.close()
    raise ConnectionError(
        why if word == "no" else f"no process 0 of a run answers at {place.address}"
    )


def find_differences(told, run):
    """What differs between two runs, as one line; empty: nothing. A setting that an earlier version
    did not have counts as its default."""
    usual = {"config": {f.name: f.default for f in fields(Config) if f.default is not None}}
    lines = []
    for name, value in run.items():
        other = told.get(name, value)
        if isinstance(value, dict):
            other = usual.get(name, {}) | other
            lines += [
                f"{key} ({other[key]}, now {now})"
                for key, now in value.items()
                if key in other and other[key] != now
            ]
        elif other != value:
            short = name in ("log", "frames")
            lines.append(name if short else f"{name} ({other}, now {value})")
    return ", ".join(lines)


def connect(place):
    """Let JAX connect processes that have met; its devices are those of all from here on."""
    import jax

    try:
        jax.distributed.initialize(
            place.address, place.processes, place.process,
            coordinator_bind_address=place.address, cluster_detection_method="deactivate",
        )  # fmt: skip
    except RuntimeError as error:
        why = str(error).splitlines()[0]
        raise ConnectionError(
            f"JAX can't connect the processes at {place.address}: {why}"
        ) from None


class ProcessGroup:
    """The processes of a run that have met. Process 0 leads: it alone writes and speaks.

    Threads listen to the others: if one dies, this process says so and ends at once (exit 69), as
    what JAX waits for would never come.
    """

    def __init__(self, place, links):
        self.is_leader, self._links = place.process == 0, links
        self._ending, self._idle, self._once = (
            threading.Event(),
            threading.Event(),
            threading.Lock(),
        )
        self._threads = []
        for who, link in links.items():
            link.settimeout(None)
            _keep_alive(link)
            thread = threading.Thread(target=self._listen, args=(who, link), daemon=True)
            thread.start()
            self._threads.append(thread)

    def _listen(self, who, link):
        """Wait for another process's last words."""
        try:
            word, _, rest = _line(link).partition(" ")
        except OSError:
            word = ""
        if self._ending.is_set() or not self._once.acquire(blocking=False):
            return
        if word != "left":
            lost = rest if word == "lost" else who
            self._tell(f"lost {lost}")
            time.sleep(0.5 if self.is_leader else 0)  # JAX aborts the others when this has gone
            end_now(f"process {lost} died, or the connection to it broke", LOST)
        code = int(rest)
        if not self.is_leader and (code < 2 or self._idle.wait(EXIT_TIMEOUT)):
            os._exit(code)
        if self.is_leader:
            time.sleep(EXIT_TIMEOUT)
            code = max(code, 2)  # 1 is that of a run with warnings
            self._tell(f"left {code}")
            time.sleep(EXIT_TIMEOUT)
        end_now(f"process {who} ended with exit code {code}", code)

    def _tell(self, line):
        for link in self._links.values() if self.is_leader else ():
            _send(link, line)

    def wait_for_leader(self):
        """Wait for process 0 to end, and end with it."""
        self._idle.set()
        threading.Event().wait()

    def exit(self, code):
        """End with this exit code; the others do the same."""
        sys.stdout.flush()
        self._ending.set()
        for link in self._links.values():
            _send(link, f"left {code}")
        # Process 0 goes last: JAX aborts the others when it has gone.
        end = time.monotonic() + REPLY_TIMEOUT
        for thread in self._threads if self.is_leader else ():
            thread.join(max(0, end - time.monotonic()))
        os._exit(code)  # JAX's own leave-taking would wait


def end_now(line, code):
    """Say one line on stderr and end, whatever else goes on."""
    show = "\x1b[?25h" if sys.stderr.isatty() else ""  # a bar may have hidden the cursor
    os.write(2, f"{show}jaxslam: {line}\n".encode())
    os._exit(code)


@contextmanager
def silence_stdout():
    """Within this nothing gets to stdout, where Gloo says whom it reached."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def _line(link):
    """The next line that comes, without its end; empty where the other end has closed."""
    parts = b""
    while len(parts) < MAX_LINE:
        part = link.recv(1)  # what follows the line is left for later
        if part in (b"", b"\n"):
            return parts.decode(errors="replace") if part else ""
        parts += part
    return ""


def _send(link, line):
    with suppress(OSError):  # whoever has gone is noticed by who listens
        link.sendall(f"{line}\n".encode())


def _keep_alive(link):
    """Notice within some 10 s that the other machine has gone."""
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 4), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):
            link.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
