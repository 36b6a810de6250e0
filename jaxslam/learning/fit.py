"""Maximum-likelihood learning of `Params` from logged runs.

    parts = jaxslam.windows(log, 60)           # pieces of one minute, each with its own map
    fit = learn.fit(parts, config, params, ("err_rot", "sigma_bearing"), held_out=others)
    errors = uncertainty.assess(fit, parts)
    fit = uncertainty.improve(fit, errors)

Adam (Kingma and Ba 2015) climbs the score of `likelihood`, averaged over seeds, on the free scale
of `transforms`. The rate falls, and the estimate is the mean of the last iterates. Held-out logs,
filtered with fresh seeds, decide when to stop: the likelihood of the logs learned from continues to
rise after theirs has begun to fall.
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

TAIL = 0.3  # fraction of the steps, the last, whose mean is the estimate
LAST_RATE = 0.05  # learning rate of the last step, as a fraction of the first
# Adam's decay rates. Noise that starts too small gives scores a hundred times larger than any later
# one, after which a second moment of long memory would keep all steps small.
MOMENTS = 0.9, 0.9


class History(NamedTuple):
    """Course of a fit. S steps: `free` [S, P] (before the step), mean log likelihood per frame,
    gradient norm (free scale, per frame) and rate. E evaluations: number of steps done, held-out
    log likelihood (mean over seeds), its standard error, and the estimate evaluated, `tail` [E, P].
    """

    free: np.ndarray
    log_likelihood: np.ndarray
    gradient_norm: np.ndarray
    rate: np.ndarray
    held_out_step: np.ndarray
    held_out: np.ndarray
    held_out_error: np.ndarray
    tail: np.ndarray


class Fit(NamedTuple):
    """Outcome of `fit`: the estimate `params` (on the free scale `free` [P], in the order of
    `names`) from `start`; `stopped` is the reason why it ended after `steps` steps."""

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
    """Parameters learned by default: motion noise, gains, sensor noise, mounting yaw.

    Bearings alone do not determine the scale, so it is the odometry's: `gain_tran` is left out.
    """
    names = ("err_tran", "err_rot", "err_drift", "gain_tran", "gain_rot")
    names += ("sigma_range", "sigma_bearing", "position_scale", "mount_yaw", "outlier")
    allowed = likelihood.learnable(config)
    bearing = config.sensor == "bearing"
    return tuple(n for n in names if n in allowed and not (bearing and n == "gain_tran"))


def stack_logs(logs, config, params):
    """Stack the `likelihood.Data` of logs along a new first axis, padded to the longest."""
    longest = max(len(log.frame_time) for log in logs)
    data = [likelihood.data_from_log(log, config, params, longest) for log in logs]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *data)


@partial(jax.jit, static_argnames=("config", "names"))
def scores(free, params, data, which, keys, config, names, discount):
    """Compute the `likelihood.Score` of I items: log `which` [I] of `data` with `keys` [I], at
    `free` [P] or [I, P]; derivatives on the free scale.

    Items are distributed over all devices and computed one after another on each.
    """
    free = jnp.broadcast_to(free, (len(which), len(names)))

    def score_item(item):
        at, log, key = item
        item_params = with_free(params, names, at)
        item_data = jax.tree.map(lambda leaf: leaf[log], data)
        if not names:
            value = likelihood.value(item_params, item_data, key, config)
            return likelihood.Score(jnp.zeros(0), value, None, None, None)
        score = likelihood.score_and_value(item_params, item_data, key, config, names, discount)
        by_free = jax.vmap(jnp.multiply, (-1, 0), -1)
        slope = jnp.stack([jax.grad(partial(from_free, n))(at[i]) for i, n in enumerate(names)])
        return score._replace(total=by_free(score.total, slope), steps=by_free(score.steps, slope))

    return sharding.map_over_devices(score_item, (free, which, keys), len(jax.devices()))


def evidence(logs, config, params, seeds=8, seed=0):
    """Compute the log likelihood [seeds], summed over the logs, by seed."""
    data = logs if isinstance(logs, likelihood.Data) else stack_logs(logs, config, params)
    count = len(data.start_pose)
    which = np.repeat(np.arange(count), seeds)
    keys = jax.random.split(jax.random.key(seed), count * seeds)
    numbers = Params(*(jnp.asarray(v, data.start_pose.dtype) for v in params))
    score = scores(jnp.zeros(0), numbers, data, which, keys, config, (), 1.0)
    return np.asarray(score.log_likelihood, float).reshape(count, seeds).sum(0)


class FitSettings(NamedTuple):
    """The arguments of `fit` without the logs. Checkpoints depend on the names and their order."""

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
    """Fit the parameters `names` (None: `default_names`) to a list of `Log`s: `Fit`.

    Logs are independent runs, or windows of one; each step uses `batch` of them (None: all) and
    `seeds` seeds of each. `bounds`: (low, high) by name, in the parameter's unit. `priors`: (value,
    standard deviation) by name, normal on the parameter's scale in `PARAMETERS`: of its logarithm,
    its log-odds (`outlier`), or the value itself. Every `every` steps the mean of the last iterates
    is evaluated on the `held_out` logs with fresh seeds; the fit ends after `patience` evaluations
    without improvement, and takes the last estimate that was not clearly worse than the best.
    `checkpoint`: file (.npz) written then; `resume`: continue from it, with the same result.
    `progress`: called with (steps done, steps, dict of loss, gradient_norm, params). Raises
    `ValueError` for invalid settings, or a checkpoint of another fit.
    """
    begin = time.perf_counter()
    names = default_names(config) if names is None else tuple(names)
    params = validate(params, "params")
    settings = FitSettings(
        config, params, names, dict(bounds or {}), dict(priors or {}), seeds, held_out_seeds, steps,
        rate, min(batch or len(logs), len(logs)), every, patience, seed,
    )  # fmt: skip
    _check(settings, logs)
    data = stack_logs(logs, config, params)
    held_out_data = stack_logs(held_out, config, params) if held_out else None
    trainer = _Trainer(settings, data, held_out_data)
    state = trainer.start()
    fingerprint = fingerprint_of(settings, (data, held_out_data))
    if resume:
        state = load_state(checkpoint, fingerprint, state)
    while state.step < steps and not state.stopped:
        state, record = trainer.advance(state)
        if checkpoint is not None and (state.step % every == 0 or state.step == steps):
            save_state(checkpoint, fingerprint, state)
        if progress:
            progress(state.step, steps, record)
    free, stopped = trainer.estimate(state)
    return Fit(names, params, validate(to_params(params, names, free), "the fit"), free,
               state.history(), stopped, config, seed, state.step,
               time.perf_counter() - begin)  # fmt: skip


def _check(settings, logs):
    likelihood.check(settings.config, names=settings.names)
    if not settings.names or len(set(settings.names)) != len(settings.names):
        raise ValueError(
            f"parameters to learn: {', '.join(settings.names) or 'none'}; name each once"
        )
    if not logs:
        raise ValueError("no log to learn from")
    for name in ("seeds", "steps", "every", "patience", "held_out_seeds"):
        if getattr(settings, name) < 1:
            raise ValueError(f"{name} is {getattr(settings, name)}; must be 1 or more")
    start = dict(zip(settings.names, free_vector(settings.params, settings.names), strict=True))
    for name in {**settings.bounds, **settings.priors}:
        if name not in start:
            raise ValueError(f"{name} has bounds or a prior, but is not learned")
    for name, (low, high) in settings.bounds.items():
        value = getattr(settings.params, name)
        if not low <= value <= high or low == high:
            raise ValueError(f"{name}: starts at {value:g}, outside its bounds {low:g} to {high:g}")


class _State(NamedTuple):
    """State of a fit: free values, optimiser, and the rows of `History` so far."""

    step: int
    free: np.ndarray
    optimiser: tuple
    rows: tuple
    judgements: tuple
    stopped: str = ""

    def history(self):
        rows = [np.array(column) for column in zip(*self.rows, strict=True)] or [np.empty(0)] * 4
        evaluations = [np.array(column) for column in zip(*self.judgements, strict=True)]
        return History(*rows, *(evaluations or [np.empty(0)] * 4))


class _Trainer:
    """Steps and evaluations of one fit, without its state."""

    def __init__(self, settings, data, held_out):
        self.settings, self.data, self.held_out = settings, data, held_out
        self.frames = float(data.measurements.active.sum()) / len(data.start_pose) * settings.batch
        schedule = optax.cosine_decay_schedule(settings.rate, settings.steps, LAST_RATE)
        self.rate, self.adam = schedule, optax.adam(schedule, *MOMENTS)
        dtype = data.start_pose.dtype
        self.numbers = Params(*(jnp.asarray(v, dtype) for v in settings.params))
        edges = [settings.bounds.get(n, (None, None)) for n in settings.names]
        with jax.enable_x64(True):
            self.low, self.high = (
                np.array([
                    fallback if edge[side] is None else float(to_free(n, float(edge[side])))
                    for n, edge in zip(settings.names, edges, strict=True)
                ])
                for side, fallback in ((0, -np.inf), (1, np.inf))
            )  # fmt: skip

    def start(self):
        free = free_vector(self.settings.params, self.settings.names)
        return _State(0, free, self.adam.init(jnp.asarray(free)), (), ())

    def advance(self, state):
        """Take a step: the next state, and a record for `progress`."""
        settings = self.settings
        score = self.score(state)
        per_frame = np.asarray(score.total, float).reshape(-1, len(settings.names)).sum(0)
        gradient = (per_frame / settings.seeds + self.prior_score(state.free)) / self.frames
        value = float(np.asarray(score.log_likelihood, float).sum()) / settings.seeds / self.frames
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
        if self.held_out is not None and (
            state.step % settings.every == 0 or state.step == settings.steps
        ):
            state = self.evaluate(state)
        named = to_params(settings.params, settings.names, free)
        record = {"loss": -value, "gradient_norm": norm,
                  "params": {n: getattr(named, n) for n in settings.names}}  # fmt: skip
        return state, record

    def score(self, state):
        """Scores of the step's logs and seeds, which depend on the step's number only."""
        settings, total = self.settings, len(self.data.start_pose)
        epoch, first = divmod(state.step * settings.batch, total)
        order = np.concatenate([
            np.random.default_rng([settings.seed, e]).permutation(total) for e in (epoch, epoch + 1)
        ])  # fmt: skip
        which = np.repeat(order[first : first + settings.batch], settings.seeds)
        keys = jax.random.split(
            jax.random.fold_in(jax.random.key(settings.seed), state.step), len(which)
        )
        free = jnp.asarray(state.free, self.data.start_pose.dtype)
        return scores(
            free, self.numbers, self.data, which, keys, settings.config, settings.names,
            likelihood.DISCOUNT,
        )  # fmt: skip

    def prior_score(self, free):
        """Derivatives [P] of the log priors, scaled by the fraction of the logs in a step."""
        settings = self.settings
        fraction = settings.batch / len(self.data.start_pose)
        gradient = np.zeros(len(free))
        for name, (centre, spread) in settings.priors.items():
            i = settings.names.index(name)
            spread = spread / TABLE[name].step
            gradient[i] = fraction * (float(to_free(name, centre)) - free[i]) / spread**2
        return gradient

    def tail(self, state):
        """Mean of the last iterates."""
        last = max(1, int(TAIL * state.step))
        return np.mean([*[row[0] for row in state.rows[-last + 1 :]][: last - 1], state.free], 0)

    def evaluate(self, state):
        """Evaluate the tail's mean on the held-out logs; sets `stopped` at the end."""
        settings, free = self.settings, self.tail(state)
        params = to_params(settings.params, settings.names, free)
        seed = (settings.seed + 1) * 100_003 + state.step
        params = to_params(settings.params, settings.names, free)
        seed = (settings.seed + 1) * 100_003 + state.step
        by_seed = evidence(self.held_out, settings.config, params, settings.held_out_seeds, seed)
        error = float(np.std(by_seed) / np.sqrt(len(by_seed)))
        judgements = (*state.judgements, (state.step, float(by_seed.mean()), error, free))
        values = np.array([judgement[1] for judgement in judgements])
        stale = len(values) - 1 - int(values.argmax()) >= settings.patience
        return state._replace(
            judgements=judgements,
            stopped="held-out evidence no longer rises" if stale else "",
        )

    def estimate(self, state):
        """The estimate, and the reason why the fit ended."""
        if not state.judgements:
            return self.tail(state), "all steps done"
        _, values, errors, free = (np.array(c) for c in zip(*state.judgements, strict=True))
        best = int(values.argmax())
        good = values >= values[best] - 2 * np.hypot(errors, errors[best])
        return free[np.flatnonzero(good)[-1]], state.stopped or "all steps done"
