"""A process that JAX may abort, and one that waits for it and says why.

Where process 0 of a shared run dies, JAX aborts the others, at times before they can say a word.
"""

import os
import signal
import sys
import threading

from jaxslam.runs.cluster import LOST


def run_supervised():
    """Go on in a child, begun before JAX is there; the process that was here ends as it does.

    Of what the child says on stderr only its own lines are shown, unless it fails without one.
    """
    if not hasattr(os, "fork"):
        return
    told, says = os.pipe()
    ends, life = os.pipe()
    child = os.fork()
    if child:
        os.close(says)
        os.close(ends)
        _await(child, told)
    os.close(told)
    os.close(life)
    os.dup2(says, 2)
    os.close(says)

    def watch():
        os.read(ends, 1)  # until the one that waits was killed
        os._exit(128 + signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def _await(child, told):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's is for both
    signal.signal(signal.SIGTERM, lambda *_: os.kill(child, signal.SIGTERM))
    with open(told, errors="replace") as text:
        lines = list(text)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    ours = [line for line in lines if line.startswith("jaxslam: ")][:1]
    if code == -signal.SIGABRT:
        code, ours = LOST, ours or ["jaxslam: process 0 died, or the connection to it broke\n"]
    elif code < 0:
        code, ours = 128 - code, [f"jaxslam: killed by signal {-code}\n"]
    if code > 1:
        sys.stderr.writelines(ours or lines)
        sys.stderr.flush()
    os._exit(code)
