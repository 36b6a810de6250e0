"""The command, in chunks of 7 frames: says when it filters, and takes its time if told to.

SLOW: seconds to wait before every chunk. TELL: print `chunk` before it, too.
"""

import os
import sys
import time

from jaxslam.cli import main as cli
from jaxslam.runs import compiled, run

chunk, compiled.CHUNK = run._run_chunk, 7


def slow(*given):
    if "TELL" in os.environ:
        print("chunk", flush=True)
    else:
        open(f"chunk-{os.getppid()}-{os.getpid()}", "w").close()
    time.sleep(float(os.environ.get("SLOW", 0)))
    return chunk(*given)


run._run_chunk = slow
sys.exit(cli.main())
