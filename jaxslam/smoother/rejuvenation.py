"""The filter given a new past now and then: particles redrawn from the refined path and map.

Resampling leaves all particles one common past, whose errors no weight can correct any more, and
whose covariance says nothing. So, each time the robot has driven some metres, the best particle's
past with its associations is refined by least squares (`refine`), its measurements choose their
landmarks anew, landmarks that turn out to be one are merged, and whole paths with their maps are
drawn from the Gaussian of what was refined (`redraw`). It happens after fixed frames of the log, so
that neither chunks, nor resuming, nor devices make a difference.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.filter import sharding
from jaxslam.logs.truth import wrap
from jaxslam.smoother import (
    least_squares,
    normal_equations,
    posterior_sampling,
    reassociation,
    refine,
)
from jaxslam.smoother.events import DROPPED, FAILED, FOUND, MERGED

GROWTH = 0.05  # of the path so far: the least between two rejuvenations of a long run
SURE = 0.5  # probability above which a measurement is an inlier


class SharedPast(NamedTuple):
    """What all particles share of t frames: `pose` [t, 3] and `landmark_id` [t, K] as refined, in the
    frame of the filter; `cov` [t, 3, 3], empty but for the last time. `event` [E, 4]: frames done,
    kind (`events.KINDS`), the landmark's `id`, and what it was merged with (-1)."""

    pose: np.ndarray
    cov: np.ndarray
    landmark_id: np.ndarray
    event: np.ndarray


def empty_past(slots):
    """`Past` of no frames, K measurements wide."""
    return SharedPast(
        np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, slots), np.int64),
        np.zeros((0, 4), np.int64),
    )  # fmt: skip


def due_frames(odometry, every):
    """Numbers of frames done after which it is time: `every` so many metres driven, or a share of
    the path so far; nothing for 0."""
    path = np.cumsum(np.asarray(odometry.distance, float))
    found, last = [], 0.0
    for done, length in enumerate(path[:-1].tolist() if every else [], 1):
        if length - last >= max(every, GROWTH * last):
            found.append(done)
            last = length
    return found


class Rejuvenator:
    """What it takes to give a run's particles a new past: its log, as refinement sees it."""

    def __init__(self, data, log, origin, params, config):
        self.due = frozenset(due_frames(data.odometry, config.rejuvenate))
        self._config, self._known = config, config.association == "known"
        self._identity = np.asarray(data.measurements.identity).ravel()
        params = params if self._known else refine.allow_mistakes(params)
        if self.due and sharding.is_leader():
            with jax.enable_x64(True):
                self._problem, self._flat_index = least_squares.make_problem(
                    data, log.start_pose - origin, log.start_cov, params, config.sensor
                )

    def rejuvenate(self, key, state, past, lineage, done, best):
        """`State` after `done` frames drawn anew, the new `Past`, and landmarks lost for want of a
        slot (None: it failed, and state and past are as they were); `lineage`: of the particle
        `best`, since the last time (None: of another process). The state given is settled
        (`filter.settled`), and is given up."""
        young = _take_particle(state, best, self._config)
        joint, lost = (
            posterior_sampling.empty_joint(self._config.landmarks)._replace(used=np.int32(0)),
            0,
        )
        if sharding.is_leader():
            young = jax.tree.map(np.asarray, young)
            try:
                past, joint, lost = self._looked_back(past, lineage, done, young)
            except np.linalg.LinAlgError:  # a past that can't be refined stays as it is
                past = empty_past(lineage.landmark_id.shape[1]) if past is None else past
                event = np.vstack([past.event, [[done, FAILED, -1, -1]]])
                past = past._replace(event=event)
        joint = sharding.broadcast(joint)
        if joint.used == 0:
            return state, past, None
        appearances = state.appearances
        for leaf in jax.tree.leaves(state._replace(appearances=None)):  # no two maps at once
            leaf.delete()
        return (
            posterior_sampling.draw_state(key, joint, done, self._config, appearances),
            past,
            lost,
        )

    def _looked_back(self, past, lineage, done, young):
        """The new `Past`, `redraw.Joint` and how many landmarks it has no slot for."""
        past = empty_past(lineage.landmark_id.shape[1]) if past is None else past
        pose = np.concatenate([past.pose, lineage.pose])
        landmark_id = np.concatenate([past.landmark_id, lineage.landmark_id])
        with jax.enable_x64(True):
            problem, flat_index = least_squares.truncate(self._problem, self._flat_index, done)
            name = self._identity[flat_index] if self._known else landmark_id.ravel()[flat_index]
            found = refine.solve_and_reassociate(
                problem, flat_index, pose, name, self._known, again=True
            )
        joint, lost, held = self._joint(found, problem, flat_index, young)
        before = _mapped_landmarks(past)
        event = [[done, MERGED, a, b] for a, b in found.merged]
        gone = before - held - {a for a, _ in found.merged}
        event += [[done, DROPPED, a, -1] for a in sorted(gone)]
        event += [[done, FOUND, a, -1] for a in sorted(held - before)]
        event = np.array(event, np.int64).reshape(-1, 4)
        path = found.fit.path[1:].copy()
        path[:, 2] = wrap(path[:, 2])
        # Of the last time alone: no other is looked at.
        cov = (
            normal_equations.pose_covariances(found.fit.factor)[1:]
            if done == max(self.due)
            else past.cov
        )
        match = refine.landmark_ids(found, flat_index, landmark_id.shape)
        return SharedPast(path, cov, match, np.concatenate([past.event, event])), joint, lost

    def _joint(self, found, problem, flat_index, young):
        """`redraw.Joint`, how many landmarks it has no slot for, and labels of those it holds."""
        fit, groups = found.fit, found.groups
        rows, which = reassociation.index_mapped(groups)
        sure = (which >= 0) & (fit.weight > SURE)
        seen = np.bincount(which[sure], minlength=len(rows))
        slots, lost = self._slots(groups.landmark_id[rows], seen, flat_index)
        joint = posterior_sampling.empty_joint(self._config.landmarks)
        cov = posterior_sampling.covariance(fit)
        kept = np.flatnonzero(slots >= 0)
        index = np.concatenate([np.arange(3), *(3 + 2 * i + np.arange(2) for i in kept)])
        to = np.concatenate([np.arange(3), *(3 + 2 * slots[i] + np.arange(2) for i in kept)])
        joint.root[to, : len(index)] = posterior_sampling.factor_of(cov[np.ix_(index, index)])
        joint.pose[:] = fit.path[-1]
        own = np.linalg.cholesky(np.linalg.inv(fit.information))
        sensor = least_squares.sensor_poses(fit.path[problem.frame + 1], problem.params)[:, :2]
        p = problem.params
        odds = reassociation.existence(problem, fit, reassociation.frames_seen(problem, fit, which))
        for i in kept:
            s, mine = slots[i], sensor[sure & (which == i)]
            joint.kind[s], joint.mean[:, s] = posterior_sampling.POINT, fit.points[i]
            joint.factor[:, s] = own[i][[0, 1, 1], [0, 0, 1]]
            joint.anchor[:, s] = _median_viewpoint(mine, fit.points[i])
            joint.log_odds[s] = min(max(odds[i], 0), p.existence_max)
            joint.count[s], joint.landmark_id[s] = seen[i], groups.landmark_id[rows[i]]
        waiting = np.unique(groups.assignment[(groups.assignment >= 0) & (which < 0)])
        # Only bearings leave a depth open.
        waiting = waiting[: len(waiting) if problem.sensor == "bearing" else 0]
        lost += self._carry(joint, young, groups.landmark_id[waiting])
        held = set(groups.landmark_id[rows[kept]].tolist())
        return joint._replace(used=np.int32(len(index))), lost, held

    def _slots(self, label, seen, flat_index):
        """A slot for every point (-1: never measured, or none left; those measured most come
        first), and how many find none."""
        slots, there = np.full(len(label), -1), np.flatnonzero(seen)
        if self._known:
            slot = self._identity[label[there]]
            fits = slot < self._config.landmarks
            slots[there[fits]] = slot[fits]
            return slots, 0  # the filter counts those without a slot whenever they are seen
        order = there[np.argsort(-seen[there], kind="stable")][: self._config.landmarks]
        slots[np.sort(order)] = np.arange(len(order))
        return slots, len(there) - len(order)

    def _carry(self, joint, young, waiting):
        """Take over the best particle's landmarks of unknown depth; how many find no slot."""
        wanted = (young.landmarks.count > 0) & np.isin(young.landmarks.landmark_id, waiting)
        free = np.flatnonzero(joint.kind == posterior_sampling.NONE)
        from_ = np.flatnonzero(wanted)
        if self._known:
            from_ = np.intersect1d(from_, free)
            to = from_
        else:
            to = free[: len(from_)]
        lost, from_ = len(from_) - len(to), from_[: len(to)]
        x, y, heading = young.pose.astype(float)
        held = young.landmarks
        joint.kind[to] = posterior_sampling.UNKNOWN_DEPTH
        joint.mean[:, to], joint.factor[:, to] = held.mean[:, from_], held.factor[:, from_]
        for name in ("count", "landmark_id", "log_odds"):
            if getattr(held, name) is not None:
                getattr(joint, name)[to] = getattr(held, name)[from_]
        if held.anchor is not None:
            joint.mean[0, to] -= heading
            away = held.anchor[:, from_] - np.array([[x], [y]])
            c, s = np.cos(heading), np.sin(heading)
            joint.anchor[:, to] = [c * away[0] + s * away[1], c * away[1] - s * away[0]]
        return lost


class _Particle(NamedTuple):
    pose: jax.Array
    landmarks: tuple


def _take_particle(state, best, config):
    """Pose [3] and landmarks [..., M] of one particle, on every process."""
    return _index_particle(state.pose, state.landmarks, jnp.int32(best), config)


@partial(jax.jit, static_argnames="config")
def _index_particle(pose, world, best, config):
    found = _Particle(pose[:, best], jax.tree.map(lambda leaf: leaf[..., best], world))
    if config.devices == 1:
        return found
    everywhere = sharding.shardings(sharding.replicated(found), config)
    return jax.lax.with_sharding_constraint(found, everywhere)


def _median_viewpoint(sensor, point):
    """Of the places [n, 2] a point was seen from, the one at the median distance."""
    distance = np.hypot(*(sensor - point).T)
    return sensor[np.argsort(distance, kind="stable")[len(distance) // 2]]


def _mapped_landmarks(past):
    """Labels of the landmarks in the map when it was last refined."""
    held = set()
    for _, kind, label, _ in past.event.tolist():
        (held.add if kind == FOUND else held.discard)(label)
    return held
