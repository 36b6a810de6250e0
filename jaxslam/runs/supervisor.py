"""Run a process under a supervisor that reports how it ended.

When the leader of a shared run dies, JAX aborts the other processes, at times before they can print
anything.
"""

import os
import signal
import sys
import threading

from jaxslam.runs.cluster import LOST


def run_supervised():
    """Fork, before JAX starts: return in the child; the parent waits, and exits with its code.

    The child's stderr is reduced to its first `jaxslam: ` line, or shown if there is none.
    """
    if not hasattr(os, "fork"):
        return
    read_stderr, write_stderr = os.pipe()
    read_life, write_life = os.pipe()  # the parent holds its end open as long as it lives
    child = os.fork()
    if child:
        os.close(write_stderr)
        os.close(read_life)
        _supervise(child, read_stderr)
    os.close(read_stderr)
    os.close(write_life)
    os.dup2(write_stderr, 2)
    os.close(write_stderr)

    def watch_parent():
        os.read(read_life, 1)  # returns when the parent was killed
        os._exit(128 + signal.SIGKILL)

    threading.Thread(target=watch_parent, daemon=True).start()


def _supervise(child, stderr):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both
    signal.signal(signal.SIGTERM, lambda *_: os.kill(child, signal.SIGTERM))
    with open(stderr, errors="replace") as text:
        lines = list(text)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    message = [line for line in lines if line.startswith("jaxslam: ")][:1]
    if code == -signal.SIGABRT:
        default = "jaxslam: process 0 died, or the connection to it broke\n"
        code, message = LOST, message or [default]
    elif code < 0:
        code, message = 128 - code, [f"jaxslam: killed by signal {-code}\n"]
    if code > 1:
        sys.stderr.writelines(message or lines)
        sys.stderr.flush()
    os._exit(code)
