"""The simulated room of the comparisons: 10 x 4 m, 40 lines on the walls, the 12 nearest seen.

80 m round and round, 1 m from the walls, a frame every 0.1 m; drawn by `simulate.planar` from the
filter's own motion model, steered by the true pose. The motion noise stands for one that grows in
proportion to the step, as other simulators have it: 5 % of a distance, 5 % of a turn and 0.02 rad/m
a step. Variances that grow with the path give the same at 0.1 m (and, turning, at the corners'
0.125 rad) when err = share * sqrt(step). Noise scaled by `scale` gives the hard room (3).
"""

from dataclasses import replace
from math import radians, sqrt

import numpy as np

from jaxslam.simulation.planar import planar

STEP, CORNER = 0.1, 0.125  # m and rad per frame
NOISE = {
    "err_tran": 0.05 * sqrt(STEP),
    "err_drift": 0.02 * sqrt(STEP),
    "err_rot": 0.05 * sqrt(CORNER),
    "floor_tran": 1e-3,
    "floor_rot": 1e-3,
}
SPEED = 0.5  # m/s
NEAREST = 12
REACH = 8.0  # m: beyond what the twelve nearest can be away
EVERYTHING = 1e6  # m: a range at which detection does not fall within the room


def room(seed, scale=1.0, length_m=80.0):
    """`Log` of bearings with identities; `scale` multiplies 1 degree and the motion noise.

    No clutter, nothing missed; what the log declares of noise is what it was drawn from.
    """
    noise = {name: scale * value for name, value in NOISE.items()}
    log = planar(
        "room", seed, landmarks=40, length_m=length_m, speed=SPEED, rate_hz=SPEED / STEP,
        odometry_hz=SPEED / STEP, sigma_range=1e-6, sigma_bearing=radians(scale),
        landmark_extent=0.0, detection=1.0, outlier=0.0, max_per_frame=None,
        view=(-np.pi, np.pi, EVERYTHING), **noise,
    )  # fmt: skip
    # the measured range is exact here, so this is the true order
    order = np.lexsort((log.range, log.frame))
    rank = np.arange(len(order)) - np.searchsorted(log.frame, log.frame)
    rows = np.sort(order[rank < NEAREST])
    # A filter that never expects clutter can't recover from a bad draw.
    declared = log.noise | {"outlier": 1e-4}
    del declared["sigma_range"]
    return replace(
        log, name=f"room-12-nearest-{seed}-{scale:g}deg", frame=log.frame[rows],
        bearing=log.bearing[rows], range=None, identity=log.identity[rows],
        view=(-np.pi, np.pi, REACH), noise=declared,
        truth=replace(log.truth, identity=log.truth.identity[rows]),
    )  # fmt: skip
