"""How well a log fixes the parameters learnt from it: standard errors, and what it leaves open.

Two estimates of the information, which agree where the model is right and the particles suffice:
the sum over steps of outer products of the score, each of two different seeds, so that the
particles' own noise does not count as information; and minus the slope of the mean score, by finite
differences with the same seeds on both sides. Where they agree, the covariance of the estimate is
the inverse of their mean. Where they differ by more than noise, the model is wrong, and it is their
sandwich (Huber 1967, White 1982). All of it on the free scale of `scale`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.learning import fit as learn
from jaxslam.learning import likelihood
from jaxslam.learning.transforms import derivative_at, to_params
from jaxslam.logs.log import Log
from jaxslam.parameters import Params

OPEN = 1.0  # free scale: a standard deviation from which on a direction is unresolved
FAINT = 3.0  # free scale: nobody knows less of a parameter than this standard deviation
STRIDE = 0.4  # free scale: a Newton step is no longer; outer products of few seeds may be far off
DIFFER = 0.5  # relative difference of the two informations up to which they agree
SHARE = 0.3  # of a direction's unit vector, from which on a parameter is part of it
MANY = 1.5  # nats: standard deviation of a log's evidence from which on to distrust the score
WHY = {
    frozenset({"err_drift", "err_rot"}): "the log turns too little, or always along with driving",
    frozenset({"err_tran"}): "the log drives too little",
    frozenset({"err_rot"}): "the log turns too little",
    frozenset({"gain_rot"}): "the log turns too little",
    frozenset({"gain_tran"}): "nothing but odometry sets the scale",
    frozenset({"gain_rot", "bias_drift"}): "the log turns along with driving",
    frozenset({"sigma_bearing", "landmark_extent"}): "landmarks are all at about one distance",
    frozenset({"mount_yaw", "gain_rot"}): "the log turns along with driving",
}


class Uncertainty(NamedTuple):
    """Standard errors of P parameters `names`; matrices [P, P] are on the free scale.

    `covariance`: see above. `standard_error` [P] in the parameters' units, `free_error` [P] free.
    `monte_carlo_error` [P]: by what, of that unit, the finite number of particles and seeds moves
    the score's root. `outer`, `curvature`: the two estimates of the information; `agreement` [P]:
    standard errors by the first over those by the second; `made`: which were used (`combined`).
    `step` [P]: Newton's, towards the score's root (free scale). `log_z_sd`: standard deviation of
    one log's evidence over seeds. `discounts`: mean score (free scale) [P] by discount.
    `verdict` [P] and `unresolved`: in words.
    """

    names: tuple
    free: np.ndarray
    covariance: np.ndarray
    free_error: np.ndarray
    standard_error: np.ndarray
    monte_carlo_error: np.ndarray
    outer: np.ndarray
    curvature: np.ndarray
    agreement: np.ndarray
    made: str
    step: np.ndarray
    log_z_sd: float
    discounts: dict
    verdict: tuple
    unresolved: tuple


def assess(
    fit: learn.Fit,
    logs: Sequence[Log],
    seeds: int = 8,
    seed: int = 1,
    discounts: Sequence[float] = (0.9, likelihood.DISCOUNT, 1.0),
) -> Uncertainty:
    """`Uncertainty` of a `learn.Fit` to these logs: 2 P + 3 times `seeds` filter runs of each."""
    names, config = fit.names, fit.config
    data = learn.stack_logs(logs, config, fit.params)
    look = _ScoreAt(fit.params, data, config, names, seeds, seed)
    found = look(fit.free)
    outer = outer_products(found.steps)
    widths = half_widths(outer)
    low, high = (
        np.array([look(fit.free + way).total.sum(0) for way in sign * np.diag(widths)])
        for sign in (-1, 1)
    )
    curvature, noise = curvature_at(low, high, widths)
    by_seed = found.total.sum(0)
    covariance, agreement, made = combine_covariances(outer, curvature, noise)
    inverse = invert(outer if made == "outer" else (outer + curvature) / 2)
    free_error = np.sqrt(np.diag(covariance))
    spread = np.cov(by_seed.T).reshape(outer.shape) / seeds
    slope = np.array([derivative_at(n, f) for n, f in zip(names, fit.free, strict=True)])
    told = {d: (found if d == likelihood.DISCOUNT else look(fit.free, d)).total.sum(0).mean(0)
            for d in discounts}  # fmt: skip
    # Where the slope is lost in noise, that the two differ tells nothing.
    differ = agreement if made == "sandwich" else np.ones(len(names))
    verdict, sentences = judge(names, covariance, differ)
    return Uncertainty(
        names=names,
        free=fit.free,
        covariance=covariance,
        free_error=free_error,
        standard_error=free_error * slope,
        monte_carlo_error=np.sqrt(np.diag(inverse @ spread @ inverse)) * slope,
        outer=outer,
        curvature=curvature,
        agreement=agreement,
        made=made,
        step=newton_step(outer if made == "outer" else (outer + curvature) / 2, by_seed.mean(0)),
        log_z_sd=float(found.log_likelihood.std(1, ddof=1).mean()),
        discounts=told,
        verdict=verdict,
        unresolved=sentences,
    )


def improve(fit: learn.Fit, errors: Uncertainty) -> learn.Fit:
    """The `learn.Fit` after the Newton step that `assess` found: Adam's last iterates still swing
    about the root (experiments/recovery.py, bearings alone: RMS z 1.60 before such steps, 1.10
    after)."""
    free = fit.free + errors.step
    return fit._replace(free=free, params=to_params(fit.params, fit.names, free))


class _ScoreAt:
    """Scores of all logs and seeds, always the same seeds."""

    def __init__(self, params, data, config, names, seeds, seed):
        count = len(data.start_pose)
        self.shape = count, seeds
        self.dtype = data.start_pose.dtype
        numbers = Params(*(jnp.asarray(value, self.dtype) for value in params))
        keys = jax.random.split(jax.random.key(seed), count * seeds)
        self.given = numbers, data, np.repeat(np.arange(count), seeds), keys, config, names

    def __call__(self, free, discount=likelihood.DISCOUNT):
        """`Score` with leading axes (logs, seeds)."""
        found = learn.scores(jnp.asarray(free, self.dtype), *self.given, discount)
        return jax.tree.map(
            lambda leaf: np.asarray(leaf, float).reshape(*self.shape, *leaf.shape[1:]), found
        )


def outer_products(steps):
    """Information [P, P] of scores [logs, seeds, T, P]: products of different seeds' scores."""
    seeds = steps.shape[1]
    whole = steps.sum(1)
    both = np.einsum("ltp,ltq->pq", whole, whole)
    same = np.einsum("lstp,lstq->pq", steps, steps)
    return (both - same) / (seeds * (seeds - 1))


def curvature_at(low, high, widths):
    """Minus the slope of the mean score [P, P], and its standard error, by finite differences.

    `low`, `high` [P, seeds, P]: scores below and above in every parameter, with the same seeds;
    `widths` [P]: half of what lies between.
    """
    slopes = (low - high) / (2 * widths[:, None, None])
    slopes = (slopes + slopes.transpose(2, 1, 0)) / 2
    return slopes.mean(1), slopes.std(1, ddof=1) / np.sqrt(slopes.shape[1])


def half_widths(outer):
    """Half widths [P] of the differences: half a standard error (by the outer products).

    Less would be lost in the scores' noise, more in their curvature.
    """
    return np.clip(0.5 * np.sqrt(np.diag(invert(outer))), 1e-3, 0.25)


def newton_step(information, score):
    """A Newton step [P] towards the score's root; in each parameter it goes two standard errors or
    `STRIDE` at most.

    Adam ends within about one standard error; this takes most of it away.
    """
    inverse = invert(information)
    most = np.minimum(2 * np.sqrt(np.diag(inverse)), STRIDE)
    return np.clip(inverse @ score, -most, most)


def combine_covariances(outer, curvature, noise):
    """Covariance [P, P] of the estimate, the ratio [P] of the two standard errors, and how made.

    `both`; `outer`, where the slope is lost in the noise of few seeds; or `sandwich`, where they
    differ by more than noise.

    `noise` [P, P]: standard errors of `curvature`. All are measured by the outer products: unity in
    every direction is agreement.
    """
    first, second = invert(outer), invert(curvature)
    agreement = np.sqrt(np.diag(first) / np.diag(second))
    root = np.linalg.cholesky(first)
    apart = np.linalg.norm(root.T @ (curvature - outer) @ root)
    scale = np.sqrt(np.diag(first))
    lost = np.linalg.norm(noise * np.outer(scale, scale))
    if apart > 2 * lost + DIFFER:
        return second @ (_positive(outer) + _faint(outer)) @ second, agreement, "sandwich"
    if lost > DIFFER:
        return first, agreement, "outer"
    return invert((outer + curvature) / 2), agreement, "both"


def invert(information):
    """Inverse of an information, with a faint prior for what nothing is known of."""
    return np.linalg.inv(_positive(information) + _faint(information))


def _faint(information):
    return np.eye(len(information)) / FAINT**2


def _positive(matrix):
    """The matrix without its negative eigenvalues, which noise alone makes."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def judge(names, covariance, agreement):
    """Verdict [P] on every parameter, and sentences on the combinations left open."""
    errors = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance)
    sentences, part = [], {}
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < OPEN**2:
            break
        mixed = [n for n, v in zip(names, vector, strict=True) if abs(v) >= SHARE]
        part |= {name: mixed for name in mixed}
        reason = WHY.get(frozenset(mixed), "the log does not tell them apart"
                         if len(mixed) > 1 else "the log does not tell")  # fmt: skip
        sentences.append(f"not resolved: {' with '.join(mixed)} ({reason})")
    verdict = []
    for name, error, ratio in zip(names, errors, agreement, strict=True):
        others = [n for n in part.get(name, ()) if n != name]
        if name in part or error >= OPEN:
            verdict.append("not resolved" + (f" (with {', '.join(others)})" if others else ""))
        elif not 0.5 < ratio < 2:
            verdict.append("the two standard errors disagree")
        else:
            verdict.append("resolved" if error < OPEN / 3 else "weak")
    return tuple(verdict), tuple(sentences)
