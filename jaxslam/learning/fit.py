"""Maximum-likelihood learning of `Params` from logged runs.

    parts = jaxslam.windows(log, 60)           # pieces of a minute, each with a map of its own
    fit = learn.fit(parts, config, params, ("err_rot", "sigma_bearing"), held_out=others)
    errors = uncertainty.assess(fit, parts)
    fit = uncertainty.improved(fit, errors)

Adam (Kingma and Ba 2015) climbs the score of `likelihood`, averaged over seeds, on the free scale
of `scale`. The rate falls and the estimate is the mean of the last iterates. Held-out logs,
filtered with fresh seeds, say when to stop: the likelihood of what was learnt from goes on rising
after theirs began to fall.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxslam.config import Config
from jaxslam.filter import sharding
from jaxslam.learning import likelihood
from jaxslam.learning.checkpoint import fingerprint_of, load_state, save_state
from jaxslam.learning.transforms import free_vector, from_free, to_free, to_params, with_free
from jaxslam.logs.log import Log
from jaxslam.parameter_file import validate
from jaxslam.parameters import TABLE, Params

TAIL = 0.3  # share of the steps whose mean is the estimate
LAST_RATE = 0.05  # of the first
# Adam's memory. Noise set too small gives scores a hundred times larger than any later one, after
# which a long second moment would keep all steps small.
MOMENTS = 0.9, 0.9


class History(NamedTuple):
    """What happened: S steps' `free` [S, P] (before the step), mean log likelihood per frame,
    gradient norm (free scale, per frame) and rate; E evaluations: after how many steps, held-out
    log likelihood (mean over seeds), its standard error, and the estimate `tail` [E, P] judged."""

    free: np.ndarray
    log_likelihood: np.ndarray
    gradient_norm: np.ndarray
    rate: np.ndarray
    held_out_step: np.ndarray
    held_out: np.ndarray
    held_out_error: np.ndarray
    tail: np.ndarray


class Fit(NamedTuple):
    """Outcome of `fit`: `params` estimated (`free` [P] on the free scale, in the order of `names`)
    from `start`; `stopped` says why it ended after `steps` steps."""

    names: tuple
    start: Params
    params: Params
    free: np.ndarray
    history: History
    stopped: str
    config: object
    seed: int
    steps: int
    seconds: float


def default_names(config):
    """What is learnt if nothing else is said: motion noise, turning gain, sensor noise, yaw.

    Bearings alone leave the scale open, so it is the odometry's: its gain is not learnt.
    """
    names = ("err_tran", "err_rot", "err_drift", "gain_tran", "gain_rot")
    names += ("sigma_range", "sigma_bearing", "position_scale", "mount_yaw", "outlier")
    allowed = likelihood.learnable(config)
    bearing = config.sensor == "bearing"
    return tuple(n for n in names if n in allowed and not (bearing and n == "gain_tran"))


def stack_logs(logs, config, params):
    """`likelihood.Data` of several logs, with a first axis, filled up to the longest."""
    longest = max(len(log.frame_time) for log in logs)
    made = [likelihood.data_from_log(log, config, params, longest) for log in logs]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)


@partial(jax.jit, static_argnames=("config", "names"))
def scores(free, params, data, which, keys, config, names, discount):
    """`likelihood.Score` of items [I]: log `which` [I] of `data` with `keys` [I], at `free` [P] or,
    one for each, [I, P]; derivatives on the free scale. Spread over all devices, one after another
    on each."""
    free = jnp.broadcast_to(free, (len(which), len(names)))

    def one(item):
        at, log, key = item
        given = with_free(params, names, at)
        mine = jax.tree.map(lambda leaf: leaf[log], data)
        if not names:
            value = likelihood.value(given, mine, key, config)
            return likelihood.Score(jnp.zeros(0), value, None, None, None)
        found = likelihood.score_and_value(given, mine, key, config, names, discount)
        by_free = jax.vmap(jnp.multiply, (-1, 0), -1)
        slope = jnp.stack([jax.grad(partial(from_free, n))(at[i]) for i, n in enumerate(names)])
        return found._replace(total=by_free(found.total, slope), steps=by_free(found.steps, slope))

    return sharding.map_over_devices(one, (free, which, keys), len(jax.devices()))


def evidence(logs, config, params, seeds=8, seed=0):
    """Log likelihood [seeds] summed over logs, by seed."""
    data = logs if isinstance(logs, likelihood.Data) else stack_logs(logs, config, params)
    count = len(data.start_pose)
    which = np.repeat(np.arange(count), seeds)
    keys = jax.random.split(jax.random.key(seed), count * seeds)
    numbers = Params(*(jnp.asarray(v, data.start_pose.dtype) for v in params))
    found = scores(jnp.zeros(0), numbers, data, which, keys, config, (), 1.0)
    return np.asarray(found.log_likelihood, float).reshape(count, seeds).sum(0)


class FitSettings(NamedTuple):
    """What `fit` was asked, but for the logs."""

    config: object
    params: Params
    names: tuple
    bounds: dict
    priors: dict
    seeds: int
    held_out_seeds: int
    steps: int
    rate: float
    batch: int
    every: int
    patience: int
    seed: int


def fit(
    logs: Sequence[Log],
    config: Config,
    params: Params,
    names: Sequence[str] | None = None,
    held_out: Sequence[Log] = (),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    seeds: int = 4,
    held_out_seeds: int = 8,
    steps: int = 150,
    rate: float = 0.1,
    batch: int | None = None,
    every: int = 10,
    patience: int = 3,
    seed: int = 0,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> Fit:
    """`Fit` of the parameters `names` (None: `default_names`) to a list of `Log`s.

    Logs are independent runs, or windows of one; `batch` of them (None: all) and `seeds` seeds of
    each make a step. `bounds`: (low, high) by name, in its own unit. `priors`: (value, standard
    deviation) by name, normal on the free scale: the deviation is of the logarithm, the log-odds
    (`outlier`) or the value itself (those of linear scale in `PARAMETERS`). Every `every` steps the last iterates' mean is
    judged on the `held_out` logs with fresh seeds; `patience` times without improvement end the
    fit, and the last estimate that was not clearly worse than the best is taken. `checkpoint`:
    file (.npz) written then; `resume`: go on from it, to the same result. `progress`: called with
    (steps done, steps, dict of loss, gradient_norm, params). Raises `ValueError` for what can't be.
    """
    begin = time.perf_counter()
    names = default_names(config) if names is None else tuple(names)
    params = validate(params, "params")
    told = FitSettings(config, params, names, dict(bounds or {}), dict(priors or {}), seeds,
                 held_out_seeds, steps, rate, min(batch or len(logs), len(logs)), every, patience,
                 seed)  # fmt: skip
    _check(told, logs)
    data = stack_logs(logs, config, params)
    judged = stack_logs(held_out, config, params) if held_out else None
    taught = _Trainer(told, data, judged)
    state = taught.start()
    fingerprint = fingerprint_of(told, (data, judged))
    if resume:
        state = load_state(checkpoint, fingerprint, state)
    while state.step < steps and not state.stopped:
        state, record = taught.advance(state)
        if checkpoint is not None and (state.step % every == 0 or state.step == steps):
            save_state(checkpoint, fingerprint, state)
        if progress:
            progress(state.step, steps, record)
    free, stopped = taught.estimate(state)
    return Fit(names, params, validate(to_params(params, names, free), "the fit"), free,
               state.history(), stopped, config, seed, state.step,
               time.perf_counter() - begin)  # fmt: skip


def _check(told, logs):
    likelihood.check(told.config, names=told.names)
    if not told.names or len(set(told.names)) != len(told.names):
        raise ValueError(f"parameters to learn: {', '.join(told.names) or 'none'}; name each once")
    if not logs:
        raise ValueError("no log to learn from")
    for name in ("seeds", "steps", "every", "patience", "held_out_seeds"):
        if getattr(told, name) < 1:
            raise ValueError(f"{name} is {getattr(told, name)}; must be 1 or more")
    start = dict(zip(told.names, free_vector(told.params, told.names), strict=True))
    for name in {**told.bounds, **told.priors}:
        if name not in start:
            raise ValueError(f"{name} has bounds or a prior, but is not learnt")
    for name, (low, high) in told.bounds.items():
        value = getattr(told.params, name)
        if not low <= value <= high or low == high:
            raise ValueError(f"{name}: starts at {value:g}, outside its bounds {low:g} to {high:g}")


class _State(NamedTuple):
    """Where a fit is: free values, optimiser, and what `History` tells so far (lists)."""

    step: int
    free: np.ndarray
    optimiser: tuple
    rows: tuple
    judgements: tuple
    stopped: str = ""

    def history(self):
        rows = [np.array(column) for column in zip(*self.rows, strict=True)] or [np.empty(0)] * 4
        judged = [np.array(column) for column in zip(*self.judgements, strict=True)]
        return History(*rows, *(judged or [np.empty(0)] * 4))


class _Trainer:
    """The steps of one fit: everything but its state."""

    def __init__(self, told, data, judged):
        self.told, self.data, self.judged = told, data, judged
        self.frames = float(data.measurements.active.sum()) / len(data.start_pose) * told.batch
        schedule = optax.cosine_decay_schedule(told.rate, told.steps, LAST_RATE)
        self.rate, self.adam = schedule, optax.adam(schedule, *MOMENTS)
        dtype = data.start_pose.dtype
        self.numbers = Params(*(jnp.asarray(v, dtype) for v in told.params))
        edges = [told.bounds.get(n, (None, None)) for n in told.names]
        with jax.enable_x64(True):
            self.low, self.high = (
                np.array([
                    fallback if edge[side] is None else float(to_free(n, float(edge[side])))
                    for n, edge in zip(told.names, edges, strict=True)
                ])
                for side, fallback in ((0, -np.inf), (1, np.inf))
            )  # fmt: skip

    def start(self):
        free = free_vector(self.told.params, self.told.names)
        return _State(0, free, self.adam.init(jnp.asarray(free)), (), ())

    def advance(self, state):
        """The state after a step, and what to tell."""
        told = self.told
        found = self.look(state)
        per_frame = np.asarray(found.total, float).reshape(-1, len(told.names)).sum(0)
        gradient = (per_frame / told.seeds + self.prior_score(state.free)) / self.frames
        value = float(np.asarray(found.log_likelihood, float).sum()) / told.seeds / self.frames
        bad = ~np.isfinite(gradient)
        move, optimiser = self.adam.update(
            jnp.asarray(np.where(bad, 0, -gradient)), state.optimiser
        )
        free = np.clip(state.free + np.asarray(move, float), self.low, self.high)
        norm = float(np.linalg.norm(gradient))
        row = (state.free, value, norm, float(self.rate(state.step)))
        state = state._replace(
            step=state.step + 1, free=free, optimiser=optimiser, rows=(*state.rows, row)
        )
        if self.judged is not None and (state.step % told.every == 0 or state.step == told.steps):
            state = self.judge(state)
        named = to_params(told.params, told.names, free)
        record = {"loss": -value, "gradient_norm": norm,
                  "params": {n: getattr(named, n) for n in told.names}}  # fmt: skip
        return state, record

    def look(self, state):
        """Scores of the step's logs and seeds, which depend on the step's number alone."""
        told, total = self.told, len(self.data.start_pose)
        rounds, place = divmod(state.step * told.batch, total)
        order = np.concatenate([
            np.random.default_rng([told.seed, r]).permutation(total) for r in (rounds, rounds + 1)
        ])  # fmt: skip
        which = np.repeat(order[place : place + told.batch], told.seeds)
        keys = jax.random.split(
            jax.random.fold_in(jax.random.key(told.seed), state.step), len(which)
        )
        free = jnp.asarray(state.free, self.data.start_pose.dtype)
        return scores(free, self.numbers, self.data, which, keys, told.config, told.names,
                      likelihood.DISCOUNT)  # fmt: skip

    def prior_score(self, free):
        """Derivatives [P] of the log priors, for the share of the logs that a step sees."""
        told = self.told
        share = told.batch / len(self.data.start_pose)
        gradient = np.zeros(len(free))
        for name, (centre, spread) in told.priors.items():
            i = told.names.index(name)
            spread = spread / TABLE[name].step
            gradient[i] = share * (float(to_free(name, centre)) - free[i]) / spread**2
        return gradient

    def tail(self, state):
        """Mean of the last iterates."""
        last = max(1, int(TAIL * state.step))
        return np.mean([*[row[0] for row in state.rows[-last + 1 :]][: last - 1], state.free], 0)

    def judge(self, state):
        """The state with the tail's mean judged on the held-out logs; `stopped` if that was it."""
        told, free = self.told, self.tail(state)
        found = evidence(self.judged, told.config, to_params(told.params, told.names, free),
                         told.held_out_seeds, (told.seed + 1) * 100_003 + state.step)  # fmt: skip
        error = float(np.std(found) / np.sqrt(len(found)))
        judgements = (*state.judgements, (state.step, float(found.mean()), error, free))
        values = np.array([judgement[1] for judgement in judgements])
        stale = len(values) - 1 - int(values.argmax()) >= told.patience
        return state._replace(
            judgements=judgements,
            stopped="held-out evidence no longer rises" if stale else "",
        )

    def estimate(self, state):
        """The estimate, and why there were no more steps."""
        if not state.judgements:
            return self.tail(state), "all steps done"
        _, values, errors, free = (np.array(c) for c in zip(*state.judgements, strict=True))
        best = int(values.argmax())
        good = values >= values[best] - 2 * np.hypot(errors, errors[best])
        return free[np.flatnonzero(good)[-1]], state.stopped or "all steps done"
