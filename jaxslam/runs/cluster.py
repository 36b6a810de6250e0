"""Connect the processes of a run, on one machine or on several.

Before JAX connects them, all processes connect to process 0 at the coordinator's address (the
rendezvous): a missing process or different settings end in one line, where JAX would abort. The
connections stay: they show at once that a process has died, and carry the exit code at the end.
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

RENDEZVOUS_TIMEOUT = 60.0  # seconds until all processes must be connected
REPLY_TIMEOUT = 5.0  # seconds for a message that is due at once
EXIT_TIMEOUT = 3.0  # seconds for a process to report its own error when another one has ended
LOST = 69  # exit code: a process is missing or has died
MAX_LINE = 2**16  # bytes


class ClusterAddress(NamedTuple):
    """Address of process 0, the number of processes, and this process's number."""

    host: str
    port: int
    processes: int
    process: int

    @property
    def address(self):
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def find_address(coordinator=None, processes=None, process=None, env=os.environ):
    """Find the `ClusterAddress` from the three options, or from Slurm or Open MPI; None: a single
    process, as with `processes` 1 under any launcher.

    Raises `ValueError` for options that do not fit together.
    """
    options = (coordinator, processes, process)
    if options == (None, 1, None):
        return None
    options = [a if a is not None else b for a, b in zip(options, _from_launcher(env), strict=True)]
    names = "--coordinator", "--num-processes", "--process-id"
    missing = [name for name, value in zip(names, options, strict=True) if value is None]
    if len(missing) == 3:
        return None
    if missing:
        raise ValueError(f"{' and '.join(missing)} missing; {', '.join(names)} go together")
    address, processes, process = options
    parts = re.fullmatch(r"(\[[^\[\]]+\]|[^:\[\]\s]+):(\d{1,5})", address)
    if not parts or not 0 < int(parts[2]) < 2**16:
        raise ValueError(f"--coordinator is {address!r}; must be HOST:PORT, like 127.0.0.1:4321")
    if not 0 <= process < processes:
        raise ValueError(f"--process-id is {process}; must be 0 to {processes - 1}")
    if processes == 1:
        return None
    return ClusterAddress(parts[1].strip("[]"), int(parts[2]), processes, process)


def _from_launcher(env):
    """Read address, number of processes and process from a launcher's variables, or None each."""
    if int(env.get("SLURM_STEP_NUM_TASKS", 1)) > 1 and "SLURM_PROCID" in env:
        # The first of `node001`, `node001,x2` or `node[001-015,020],x2`.
        first = re.match(r"([^\[,]+)(?:\[(\w+))?", env.get("SLURM_STEP_NODELIST", ""))
        host = first and first[1] + (first[2] or "")
        size, rank, job = "SLURM_STEP_NUM_TASKS", "SLURM_PROCID", int(env.get("SLURM_JOB_ID", 0))
    elif int(env.get("OMPI_COMM_WORLD_SIZE", 1)) > 1:
        # As in 1531576320.0;tcp://10.96.0.1,10.148.0.1:34911; newer versions do not set it.
        uri = env.get("OMPI_MCA_orte_hnp_uri", "")
        first = re.match(r"(\d+).*?(?:tcp://([^,:]+)|tcp6://\[([^,\]]+))", uri)
        host, job = first and (first[2] or first[3]), int(first[1]) // 2**12 if first else 0
        size, rank = "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"
    else:
        return None, None, None
    host = f"[{host}]" if host and ":" in host else host
    # One of the last 4096 ports by job, so that jobs on one machine hardly ever share it.
    return host and f"{host}:{61440 + job % 4096}", int(env[size]), int(env[rank])


def rendezvous(address, run, timeout=RENDEZVOUS_TIMEOUT):
    """Connect all processes to process 0, and check that they have the same `run` (for JSON).

    Returns the connections by process: on process 0 to all others, on the others to process 0.
    Raises `ConnectionError` on all of them if that fails within `timeout` seconds.
    """
    if address.process == 0:
        return _accept_all(address, run, timeout)
    return {0: _connect_to_leader(address, run, timeout)}


def _accept_all(address, run, timeout):
    """Wait for the connections of all other processes, then answer all of them."""
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    try:
        server = socket.create_server((address.host, address.port), family=family)
    except OSError as error:
        cause = (error.strerror or str(error)).split(" (")[0].lower()
        raise ConnectionError(
            f"can't listen at {address.address}: {cause}; choose another --coordinator"
        ) from None
    end, connections, problem = time.monotonic() + timeout, {}, None
    with server:
        while len(connections) + 1 < address.processes and not problem:
            server.settimeout(max(1e-3, end - time.monotonic()))
            try:
                connection = server.accept()[0]
            except TimeoutError:
                missing = sorted({*range(1, address.processes)} - {*connections})
                problem = (
                    f"process {', '.join(map(str, missing))} did not connect to {address.address} "
                    f"within {timeout:g} s; start all processes together"
                )
            else:
                problem = _check_process(connection, address, run, connections)
    # From here on the port is free for JAX.
    for connection in connections.values():
        _send(connection, f"refuse {problem}" if problem else "accept")
        if problem:
            connection.close()
    if problem:
        raise ConnectionError(problem)
    return connections


def _check_process(connection, address, run, connections):
    """Add a process that has connected to the `connections`; return what is wrong, or None."""
    connection.settimeout(REPLY_TIMEOUT)
    try:
        message = json.loads(_receive(connection))
        process, count, other = message["process"], message["processes"], message["run"]
    except (OSError, ValueError, KeyError, TypeError):  # another program
        connection.close()
        return None
    problem = None
    if process in (0, *connections):
        problem = f"two processes have --process-id {process}"
    elif count != address.processes:
        problem = f"process {process} has --num-processes {count}, process 0 {address.processes}"
    elif differing := find_differences(run, other):
        problem = f"process {process} has other settings than process 0: {differing}"
    if problem:
        _send(connection, f"refuse {problem}")
        connection.close()
    else:
        connections[process] = connection
    return problem


def _connect_to_leader(address, run, timeout):
    """Connect to process 0, send it this process's `run`, and wait for its answer."""
    end = time.monotonic() + timeout
    while True:
        left = max(0.1, end - time.monotonic())
        try:
            connection = socket.create_connection((address.host, address.port), timeout=left)
            # On one machine a socket may be given the very port that it connects to.
            if connection.getsockname() != connection.getpeername():
                break
            connection.close()
        except OSError as error:
            if time.monotonic() >= end:
                cause = (error.strerror or str(error)).lower()
                raise ConnectionError(
                    f"can't reach process 0 at {address.address} within {timeout:g} s: {cause}; "
                    "start it, or check --coordinator"
                ) from None
        time.sleep(0.2)
    message = {"process": address.process, "processes": address.processes, "run": run}
    _send(connection, json.dumps(message))
    connection.settimeout(timeout + REPLY_TIMEOUT)
    try:
        word, _, problem = _receive(connection).partition(" ")
    except OSError:
        word = ""
    if word == "accept":
        return connection
    connection.close()
    if word != "refuse":
        problem = f"no answer from process 0 at {address.address}; check --coordinator"
    raise ConnectionError(problem)


def find_differences(before, run):
    """Describe in one line what differs between two runs; empty: nothing. A setting missing in
    `before`, of an earlier version, counts as its default."""
    defaults = {"config": {f.name: f.default for f in fields(Config) if f.default is not None}}
    lines = []
    for name, value in run.items():
        other = before.get(name, value)
        if isinstance(value, dict):
            other = defaults.get(name, {}) | other
            lines += [
                f"{key} ({other[key]}, now {now})"
                for key, now in value.items()
                if key in other and other[key] != now
            ]
        elif other != value:
            lines.append(name if name in ("log", "frames") else f"{name} ({other}, now {value})")
    return ", ".join(lines)


def connect(address):
    """Let JAX connect the processes after their rendezvous; it then has the devices of all."""
    import jax

    try:
        jax.distributed.initialize(
            address.address, address.processes, address.process,
            coordinator_bind_address=address.address, cluster_detection_method="deactivate",
        )  # fmt: skip
    except RuntimeError as error:
        cause = str(error).splitlines()[0]
        raise ConnectionError(f"JAX can't connect at {address.address}: {cause}") from None


class ProcessGroup:
    """The connected processes of a run. Process 0 is the leader: it alone writes and prints.

    A thread listens to each connection. If another process dies, this one prints that and exits
    with code 69, as JAX would wait for it forever.
    """

    def __init__(self, address, connections):
        self.is_leader, self._connections = address.process == 0, connections
        self._exiting, self._waiting = threading.Event(), threading.Event()
        self._ended, self._threads = threading.Lock(), []
        for process, connection in connections.items():
            connection.settimeout(None)
            _keep_alive(connection)
            thread = threading.Thread(target=self._listen, args=(process, connection), daemon=True)
            thread.start()
            self._threads.append(thread)

    def _listen(self, process, connection):
        """Wait until another process ends, then end this one as well."""
        try:
            word, _, rest = _receive(connection).partition(" ")
        except OSError:
            word = ""
        if self._exiting.is_set() or not self._ended.acquire(blocking=False):
            return
        if word != "exit":
            lost = rest if word == "lost" else process
            self._tell_followers(f"lost {lost}")
            time.sleep(0.5 if self.is_leader else 0)  # JAX aborts the others when the leader ends
            end_now(f"process {lost} died, or the connection to it broke", LOST)
        code = int(rest)
        if not self.is_leader and (code < 2 or self._waiting.wait(EXIT_TIMEOUT)):
            os._exit(code)
        if self.is_leader:
            time.sleep(EXIT_TIMEOUT)
            code = max(code, 2)  # 1 is that of a run with warnings
            self._tell_followers(f"exit {code}")
            time.sleep(EXIT_TIMEOUT)
        end_now(f"process {process} ended with exit code {code}", code)

    def _tell_followers(self, line):
        for connection in self._connections.values() if self.is_leader else ():
            _send(connection, line)

    def wait_for_leader(self):
        """Wait until the leader ends, and end with its exit code."""
        self._waiting.set()
        threading.Event().wait()

    def exit(self, code):
        """End all processes with this exit code."""
        sys.stdout.flush()
        self._exiting.set()
        for connection in self._connections.values():
            _send(connection, f"exit {code}")
        # The leader ends last: JAX aborts the others when it has ended.
        end = time.monotonic() + REPLY_TIMEOUT
        for thread in self._threads if self.is_leader else ():
            thread.join(max(0, end - time.monotonic()))
        os._exit(code)  # without JAX's own shutdown, which would wait


def end_now(line, code):
    """Print a line on stderr and end the process, whatever else is running."""
    show = "\x1b[?25h" if sys.stderr.isatty() else ""  # a progress bar may have hidden the cursor
    os.write(2, f"{show}jaxslam: {line}\n".encode())
    os._exit(code)


@contextmanager
def silence_stdout():
    """Discard what is written to stdout, where Gloo prints its connections."""
    sys.stdout.flush()
    stdout, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    try:
        yield
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)
        os.close(null)


def _receive(connection):
    """Receive a line, without its end; empty if the other end has closed."""
    line = b""
    while len(line) < MAX_LINE:
        byte = connection.recv(1)  # nothing beyond the line
        if byte in (b"", b"\n"):
            return line.decode(errors="replace") if byte else ""
        line += byte
    return ""


def _send(connection, line):
    with suppress(OSError):  # the listening thread notices a process that has ended
        connection.sendall(f"{line}\n".encode())


def _keep_alive(connection):
    """Detect within about 10 s that the other machine has gone."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 4), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
