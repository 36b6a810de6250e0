"""The rooms of experiments/spacing.py: lines on the walls in groups, a given distance apart.

`simulate.planar`'s room (10 x 4 m) and drive (a rounded rectangle 1 m from the walls, 0.1 m a
frame), with its motion noise, its sensor's reach (detection falls linearly from 0.9 to 0 at 5 m)
and its clutter (2 %). Only the lines are others: 8 groups of 3, three on a long wall, one on a
short one, so that there are 24 whatever the spacing, and none of two groups are nearer than 1 m.
A seed means the same drive, odometry and places of the groups at every spacing and noise.
"""

from dataclasses import replace
from math import radians

import numpy as np

from jaxslam.simulation.planar import ROOM, planar

GROUP = 3  # lines
GROUPS = (3, 1)  # on a long wall, on a short one
LINES = GROUP * 2 * sum(GROUPS)
JITTER = 0.1  # m that a group's middle is off the middle of its part of the wall, at most
SPACINGS = (0.1, 0.3, 1.0)  # m
DEGREES = (1, 3)  # bearing noise
MOST = 16  # bearings in a frame
UNTOLD = ("sigma_range", "density_new")
DETECTION, REACH, OUTLIER = 0.9, 5.0, 0.02  # `planar`'s own


def lines(seed, spacing):
    """Points [LINES, 2] m; the three of a group are neighbours in it."""
    rng = np.random.default_rng((seed, 1))
    width, height = ROOM
    walls = [((0, 0), (1, 0), width, GROUPS[0]), ((width, 0), (0, 1), height, GROUPS[1])]
    walls += [
        ((width, height), (-1, 0), width, GROUPS[0]),
        ((0, height), (0, -1), height, GROUPS[1]),
    ]
    found = []
    for corner, along, length, groups in walls:
        middle = (np.arange(groups) + 0.5) * length / groups
        middle = middle + rng.uniform(-JITTER, JITTER, groups)
        place = middle[:, None] + spacing * (np.arange(GROUP) - (GROUP - 1) / 2)
        found.append(np.array(corner) + place.reshape(-1, 1) * along)
    return np.vstack(found)


def room(seed, spacing, degrees, length_m=40.0):
    """`Log` of bearings, with identities and truth; the noise that it declares is the true one."""
    drive = planar("room", seed, landmarks=1, length_m=length_m, view=(-np.pi, np.pi, REACH))
    marks, pose = lines(seed, spacing), drive.truth.pose
    rng = np.random.default_rng((seed, 2))
    sigma = radians(degrees)
    looks = [look(rng, at, marks, sigma) for at in pose]
    bearing, identity = (np.concatenate(part) for part in zip(*looks, strict=True))
    # `planar` also declares how dense all its landmarks are, as the density of new ones. With every
    # bearing as likely to be a new one, 3 degrees are too much for any to be matched; no sensor
    # knows it either: the default of the filter stands.
    declared = {key: drive.noise[key] for key in drive.noise if key not in UNTOLD}
    declared |= dict(sigma_bearing=sigma)
    truth = replace(drive.truth, landmarks=marks, landmark_id=np.arange(LINES), identity=identity)
    return replace(
        drive, name=f"lines-{spacing:g}m-{degrees:g}deg-{seed}", noise=declared, range=None,
        frame=np.repeat(np.arange(len(pose)), [len(part) for part, _ in looks]),
        bearing=bearing, identity=identity, truth=truth,
    )  # fmt: skip


def look(rng, pose, marks, sigma):
    """Bearings [k] and identities [k] (-1: clutter) of one frame, in random order."""
    apart = marks - pose[:2]
    chance = DETECTION * np.maximum(0, 1 - np.hypot(*apart.T) / REACH)
    seen = np.flatnonzero(rng.random(len(marks)) < chance)
    bearing = np.arctan2(apart[seen, 1], apart[seen, 0]) - pose[2]
    bearing = bearing + sigma * rng.standard_normal(len(seen))
    # as in `planar`: every measurement is clutter with that probability
    clutter = rng.negative_binomial(len(seen), 1 - OUTLIER) if len(seen) else 0
    bearing = np.append(bearing, rng.uniform(-np.pi, np.pi, clutter))
    identity = np.append(seen, np.full(clutter, -1))
    kept = rng.permutation(len(bearing))[:MOST]
    return (bearing[kept] + np.pi) % (2 * np.pi) - np.pi, identity[kept]
