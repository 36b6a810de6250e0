"""Rebuild the bundled log from the course's file: `python experiments/bundle_log.py dataset2.mat`.

The file is in https://github.com/utiasASRL/aer1513; jaxslam/data/NOTICE says which version. The
same input makes the same bytes.
"""

import dataclasses
import sys
from pathlib import Path

from jaxslam.logs.log_file import save_log
from jaxslam.logs.readers.aer1513 import read_mat

TARGET = Path(__file__).parents[1] / "jaxslam" / "data" / "lost-in-the-woods.npz"
# The course's own convention. What the laser alone says of the motion between two frames fits
# lag 0 and an offset of -0.055 s best (yaw rate residual 0.113 rad/s here, 0.077 at lag 0, 0.069
# with the offset as well).
LAG, TIME_OFFSET = 1, 0.0


def main(source):
    log = read_mat(source, LAG, TIME_OFFSET)
    log = dataclasses.replace(log, name="lost-in-the-woods")
    save_log(TARGET, log)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes, {log}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
