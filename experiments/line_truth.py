"""Which line is which edge: extracted lines beside the edges that the room's geometry shows."""

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxslam.logs.truth import truth_at, wrap
from jaxslam.simulation.room.geometry import visible_edges

PAIR = np.radians(1.0)  # a line and an edge farther apart are not one another
SURE = np.radians(0.2)  # a line is called by an edge's name if so near to where the edge is seen
FALSE = np.radians(0.5)  # a line farther than that from every visible edge is false
CONTRAST = 0.08  # of 1, between the two sides of an edge, for it to count in the recall
TALL = np.radians(10)  # of an edge in view


def named(bearing, world, pose):
    """Of lines [n]: the edge's id (-1: none), the error [rad], whether it is false; and the ids of
    the edges that ought to be found."""
    seen = visible_edges(world, pose)
    apart = wrap(bearing[:, None] - seen.bearing)
    identity, error = np.full(len(bearing), -1), np.full(len(bearing), np.nan)
    if apart.size:
        rows, columns = linear_sum_assignment(np.minimum(np.abs(apart), PAIR))
        near = np.abs(apart[rows, columns]) < PAIR
        rows, columns = rows[near], columns[near]
        identity[rows], error[rows] = seen.id[columns], apart[rows, columns]
    false = np.abs(apart).min(axis=1, initial=np.inf) > FALSE
    clear = (seen.contrast >= CONTRAST) & (seen.high - seen.low >= TALL)
    return identity, error, false, seen.id[clear & world.edges.landmark[seen.id]]


def identified(log, world):
    """The log with the simulator's identities, measured and true: of every line the id of the edge
    that is to be seen there from the true pose, one line an edge and frame; -1 where there is none.

    The true landmarks are then all edges of the room.
    """
    poses = truth_at(log.truth, log.frame_time)
    identity = np.full(len(log.frame), -1)
    for k, pose in enumerate(poses):
        rows = np.flatnonzero(log.frame == k)
        edge, error, _, _ = named(log.bearing[rows], world, pose)
        identity[rows] = np.where(np.abs(error) < SURE, edge, -1)
    edges = world.edges.point
    truth = replace(
        log.truth, landmarks=edges, landmark_id=np.arange(len(edges)), identity=identity
    )
    return replace(log, identity=identity, truth=truth)
