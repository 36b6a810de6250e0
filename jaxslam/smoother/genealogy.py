"""The posterior over the whole path, from the particles' genealogy.

The ancestors of the living particles form a tree whose older levels shrink to one node. It is kept
on the host and pruned as it grows (Jacob, Murray and Rubenthaler, "Path storage in the particle
filter", Statistics and Computing 2015).
"""

from typing import NamedTuple

import numpy as np


class Ancestral(NamedTuple):
    """The smoothed path, T frames: mean `pose` [T, 3] (m, rad), `cov` [T, 3, 3], and the number of
    `distinct` [T] ancestors of the final particles. A single ancestor has no spread, which does not
    mean that it is right."""

    pose: np.ndarray
    cov: np.ndarray
    distinct: np.ndarray


class Lineage(NamedTuple):
    """One particle's path: `pose` [T, 3] and `landmark_id` [T, K] (as in `step.Info`)."""

    pose: np.ndarray
    landmark_id: np.ndarray


class Tree:
    """Every pose that still has a living descendant, one level per frame.

    Level t has n_t nodes: `pose[t]` [n_t, 3] and `landmark_id[t]` [n_t, K]. `origin[t]` [n_(t+1)]:
    the parent, in level t, of every node of the next level; the last is that of the N particles.
    """

    def __init__(self):
        self.pose, self.landmark_id, self.origin = [], [], []

    @property
    def nodes(self):
        return sum(map(len, self.pose))

    def extend(self, pose, landmark_id, ancestors):
        """Add C frames: `pose` [C, 3, N] and `landmark_id` [C, K, N] of all particles before
        resampling, and the `ancestors` [C, N] of the particles after it."""
        first, levels = len(self.pose), []
        follow = ancestors[-1]
        for t in reversed(range(len(ancestors))):
            alive, origin = _compact(follow, ancestors.shape[1])
            levels.append((pose[t].T[alive], landmark_id[t].T[alive], origin))
            follow = ancestors[t - 1][alive]
        if first:
            self.origin[-1] = self.origin[-1][alive]
        for level in reversed(levels):
            for column, part in zip((self.pose, self.landmark_id, self.origin), level, strict=True):
                column.append(part)
        self._prune(first)

    def _prune(self, end):
        """Remove the nodes before level `end` without living descendants."""
        for t in reversed(range(end)):
            alive, self.origin[t] = _compact(self.origin[t], len(self.pose[t]))
            if len(alive) == len(self.pose[t]):  # then nothing older has lost a child either
                break
            self.pose[t], self.landmark_id[t] = self.pose[t][alive], self.landmark_id[t][alive]
            if t:
                self.origin[t - 1] = self.origin[t - 1][alive]


def _compact(index, n):
    """The numbers below n that occur in `index`, in order, and `index` counted among them."""
    used = np.zeros(n, bool)
    used[index] = True
    position = np.cumsum(used, dtype=np.int32) - 1
    return np.flatnonzero(used), position[index]


def smooth_ancestral(tree, log_weight):
    """Compute `Ancestral`: weighted mean and covariance of paths, by the final `log_weight` [N].

    The heading's mean is circular. Particles without weight do not count as descendants.
    """
    log_weight = np.asarray(log_weight, float)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    total = len(tree.pose)
    mean, cov, distinct = np.empty((total, 3)), np.empty((total, 3, 3)), np.empty(total, np.int64)
    for t in reversed(range(total)):
        weight = np.bincount(tree.origin[t], weight, len(tree.pose[t]))
        alive = weight > 0
        mean[t], cov[t] = _moments(tree.pose[t][alive].astype(float), weight[alive])
        distinct[t] = alive.sum()
    return Ancestral(mean, cov, distinct)


def _moments(pose, weight):
    """Mean [3] and covariance [3, 3] of weighted poses [n, 3]."""
    heading = pose[:, 2]
    turn = np.arctan2(weight @ np.sin(heading), weight @ np.cos(heading))
    mean = np.array([weight @ pose[:, 0], weight @ pose[:, 1], turn])
    off = pose - mean
    off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
    return mean, (off * weight[:, None]).T @ off


def trace_lineage(tree, particle):
    """Trace the `Lineage` of one of the living particles."""
    node, nodes = particle, []
    for origin in reversed(tree.origin):
        node = int(origin[node])
        nodes.append(node)
    pose, landmark_id = (
        np.stack([level[node] for level, node in zip(column, reversed(nodes), strict=True)])
        for column in (tree.pose, tree.landmark_id)
    )
    return Lineage(pose.astype(float), landmark_id.astype(np.int64))
