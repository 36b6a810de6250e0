"""Rejuvenation: redraw all particles from the refined path and map of the best one.

Resampling leaves all particles one shared past, whose errors no weight can correct any more, and
whose covariance is meaningless. So, each time the robot has driven some metres, the best particle's
lineage is refined and reassociated (`refine`), and paths with their maps are drawn from the
Gaussian of the result (`posterior_sampling`). This happens after fixed frames of the log, so that
chunks, resuming and devices make no difference.
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

GROWTH = 0.05  # fraction of the path so far, at least, between two rejuvenations of a long run
SURE = 0.5  # probability above which a measurement is an inlier


class SharedPast(NamedTuple):
    """The t frames before the last rejuvenation, common to all particles: refined `pose` [t, 3] and
    `landmark_id` [t, K], in the frame of the filter; `cov` [t, 3, 3], empty before the run's last
    rejuvenation. `event` [E, 4]: frames done, kind (`events.KINDS`), landmark id, and the id that
    it was merged into (-1)."""

    pose: np.ndarray
    cov: np.ndarray
    landmark_id: np.ndarray
    event: np.ndarray


def empty_past(slots):
    """Make the `SharedPast` of no frames, for K = `slots` measurements a frame."""
    return SharedPast(
        np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, slots), np.int64),
        np.zeros((0, 4), np.int64),
    )  # fmt: skip


def due_frames(odometry, every):
    """List after how many frames to rejuvenate: every `every` metres (0: never), and at least
    `GROWTH` of the path so far."""
    path = np.cumsum(np.asarray(odometry.distance, float))
    due, last = [], 0.0
    for done, length in enumerate(path[:-1].tolist() if every else [], 1):
        if length - last >= max(every, GROWTH * last):
            due.append(done)
            last = length
    return due


class Rejuvenator:
    """Rejuvenates the particles of one run; holds its log as a `least_squares.Problem`."""

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
        """Redraw the `State` after `done` frames: the new state, the new `SharedPast`, and how many
        landmarks were lost because no slot was free (None: refinement failed, nothing changed).

        `lineage`: of the particle `best` since the last rejuvenation (None on processes other than
        the leader). Landmarks of the state are up to date (no lazy copies); it is donated.
        """
        best_particle = _take_particle(state, best, self._config)
        joint, lost = (
            posterior_sampling.empty_joint(self._config.landmarks)._replace(used=np.int32(0)),
            0,
        )
        if sharding.is_leader():
            best_particle = jax.tree.map(np.asarray, best_particle)
            try:
                past, joint, lost = self._refine(past, lineage, done, best_particle)
            except np.linalg.LinAlgError:  # a past that can't be refined stays unchanged
                past = empty_past(lineage.landmark_id.shape[1]) if past is None else past
                event = np.vstack([past.event, [[done, FAILED, -1, -1]]])
                past = past._replace(event=event)
        joint = sharding.broadcast(joint)
        if joint.used == 0:
            return state, past, None
        appearances = state.appearances
        for leaf in jax.tree.leaves(state._replace(appearances=None)):  # never two maps in memory
            leaf.delete()
        state = posterior_sampling.draw_state(key, joint, done, self._config, appearances)
        return state, past, lost

    def _refine(self, past, lineage, done, best_particle):
        """Refine past and lineage: `SharedPast`, `Joint`, number of landmarks without a slot."""
        past = empty_past(lineage.landmark_id.shape[1]) if past is None else past
        pose = np.concatenate([past.pose, lineage.pose])
        landmark_id = np.concatenate([past.landmark_id, lineage.landmark_id])
        with jax.enable_x64(True):
            problem, flat_index = least_squares.truncate(self._problem, self._flat_index, done)
            measured = (self._identity if self._known else landmark_id.ravel())[flat_index]
            found = refine.solve_and_reassociate(
                problem, flat_index, pose, measured, self._known, again=True
            )
        joint, lost, held = self._joint(found, problem, best_particle)
        before = _mapped_landmarks(past)
        event = [[done, MERGED, a, b] for a, b in found.merged]
        gone = before - held - {a for a, _ in found.merged}
        event += [[done, DROPPED, a, -1] for a in sorted(gone)]
        event += [[done, FOUND, a, -1] for a in sorted(held - before)]
        event = np.array(event, np.int64).reshape(-1, 4)
        path = found.fit.path[1:].copy()
        path[:, 2] = wrap(path[:, 2])
        # Of the last rejuvenation only: no other is used.
        cov = (
            normal_equations.pose_covariances(found.fit.factor)[1:]
            if done == max(self.due)
            else past.cov
        )
        refined_id = refine.landmark_ids(found, flat_index, landmark_id.shape)
        return SharedPast(path, cov, refined_id, np.concatenate([past.event, event])), joint, lost

    def _joint(self, found, problem, best_particle):
        """`Joint` of a solution, number of landmarks without a slot, and ids of the others."""
        fit, groups = found.fit, found.groups
        mapped, which = reassociation.index_mapped(groups)
        sure = (which >= 0) & (fit.weight > SURE)
        seen = np.bincount(which[sure], minlength=len(mapped))
        slots, lost = self._slots(groups.landmark_id[mapped], seen)
        joint = posterior_sampling.empty_joint(self._config.landmarks)
        cov = posterior_sampling.covariance(fit)
        kept = np.flatnonzero(slots >= 0)
        index = np.concatenate([np.arange(3), *(3 + 2 * i + np.arange(2) for i in kept)])
        target = np.concatenate([np.arange(3), *(3 + 2 * slots[i] + np.arange(2) for i in kept)])
        joint.root[target, : len(index)] = posterior_sampling.factor_of(cov[np.ix_(index, index)])
        joint.pose[:] = fit.path[-1]
        own = np.linalg.cholesky(np.linalg.inv(fit.information))
        sensor = least_squares.sensor_poses(fit.path[problem.frame + 1], problem.params)[:, :2]
        p = problem.params
        odds = reassociation.existence(problem, fit, reassociation.frames_seen(problem, fit, which))
        for i in kept:
            s, viewpoints = slots[i], sensor[sure & (which == i)]
            joint.kind[s], joint.mean[:, s] = posterior_sampling.POINT, fit.points[i]
            joint.factor[:, s] = own[i][[0, 1, 1], [0, 0, 1]]
            joint.anchor[:, s] = _median_viewpoint(viewpoints, fit.points[i])
            joint.log_odds[s] = min(max(odds[i], 0), p.existence_max)
            joint.count[s], joint.landmark_id[s] = seen[i], groups.landmark_id[mapped[i]]
        waiting = np.unique(groups.assignment[(groups.assignment >= 0) & (which < 0)])
        # Only bearings leave a depth unknown.
        waiting = waiting[: len(waiting) if problem.sensor == "bearing" else 0]
        lost += self._copy_unknown_depths(joint, best_particle, groups.landmark_id[waiting])
        held = set(groups.landmark_id[mapped[kept]].tolist())
        return joint._replace(used=np.int32(len(index))), lost, held

    def _slots(self, landmark_id, seen):
        """Assign slots to points, those measured most first (-1: never measured, or no slot free);
        also the number of points without one."""
        slots, measured = np.full(len(landmark_id), -1), np.flatnonzero(seen)
        if self._known:
            slot = self._identity[landmark_id[measured]]
            fits = slot < self._config.landmarks
            slots[measured[fits]] = slot[fits]
            return slots, 0  # the filter counts those without a slot itself
        order = measured[np.argsort(-seen[measured], kind="stable")][: self._config.landmarks]
        slots[np.sort(order)] = np.arange(len(order))
        return slots, len(measured) - len(order)

    def _copy_unknown_depths(self, joint, best_particle, waiting):
        """Copy the landmarks `waiting` (ids) from the best particle; returns how many had none."""
        held = best_particle.landmarks
        wanted = (held.count > 0) & np.isin(held.landmark_id, waiting)
        free = np.flatnonzero(joint.kind == posterior_sampling.NONE)
        source = np.flatnonzero(wanted)
        if self._known:
            source = np.intersect1d(source, free)
            target = source
        else:
            target = free[: len(source)]
        lost, source = len(source) - len(target), source[: len(target)]
        x, y, heading = best_particle.pose.astype(float)
        joint.kind[target] = posterior_sampling.UNKNOWN_DEPTH
        joint.mean[:, target], joint.factor[:, target] = (
            held.mean[:, source],
            held.factor[:, source],
        )
        for name in ("count", "landmark_id", "log_odds"):
            if getattr(held, name) is not None:
                getattr(joint, name)[target] = getattr(held, name)[source]
        if held.anchor is not None:
            joint.mean[0, target] -= heading
            away = held.anchor[:, source] - np.array([[x], [y]])
            c, s = np.cos(heading), np.sin(heading)
            joint.anchor[:, target] = [c * away[0] + s * away[1], c * away[1] - s * away[0]]
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
    """The sensor position, of those [n, 2] that measured a point, at the median distance."""
    distance = np.hypot(*(sensor - point).T)
    return sensor[np.argsort(distance, kind="stable")[len(distance) // 2]]


def _mapped_landmarks(past):
    """Ids of the landmarks in the map after the last rejuvenation."""
    held = set()
    for _, kind, landmark_id, _ in past.event.tolist():
        (held.add if kind == FOUND else held.discard)(landmark_id)
    return held
