"""The log likelihood of a log under the filter's model, and its derivatives by `Params`.

The filter's evidence estimates the marginal likelihood Z of the measurements. As a function of the
parameters it jumps wherever particles are resampled or associations drawn; automatic
differentiation ignores the jumps and is biased, whatever the number of particles. Fisher's identity
gives the score instead: the posterior mean of the derivative of log p(path, associations,
measurements), with path and associations fixed ("frozen"). Every particle carries that derivative s
as it moves, is weighted and resampled; only sensor parameters need derivatives through the landmark
EKFs. Forward mode: memory does not grow with the log.

The inherited s fades by a `discount` per step: it describes ever fewer distinct ancestors, and its
contribution to the current step is mostly noise (Poyiadjis, Doucet and Singh 2011; the discount is
that of MOP, Tan, Hooker and Ionides 2024). See
docs/concepts/score-and-gradients.md for when to distrust which.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxslam.config import Config
from jaxslam.filter import blocks, resampling
from jaxslam.filter import step as fastslam
from jaxslam.filter.association import CLUTTER, NEW
from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.log import Log
from jaxslam.logs.odometry import Odometry
from jaxslam.models import motion
from jaxslam.models.sensors import Measurements
from jaxslam.parameters import ALTERNATIVES, MOTION, Params, learned_by

DISCOUNT = 0.97
BIASED = (
    "association 'maximum_likelihood' biases the score: noise comes out too small where landmarks "
    "are close; learn with 'sampled'"
)


class Data(NamedTuple):
    """A log as arrays: `start_pose` [3], `start_cov` [3, 3], T frames' odometry and measurements,
    and an initial map as for `step.init` (None: empty)."""

    start_pose: jax.Array
    start_cov: jax.Array
    odometry: Odometry
    measurements: Measurements
    landmarks_given: tuple | None = None


class Score(NamedTuple):
    """Derivatives of the log likelihood by P parameters, and the likelihood.

    `total` [P] and `log_likelihood` []: of the whole log. `steps` [T, P] and `log_evidence` [T]:
    the terms of every step (they sum to the total but for discount 1, where it is taken at the
    end). `min_ess` []: least effective sample size.
    """

    total: jax.Array
    log_likelihood: jax.Array
    steps: jax.Array
    log_evidence: jax.Array
    min_ess: jax.Array


def learnable(config):
    """Names of the parameters that have a derivative under this configuration."""
    names = (*learned_by(MOTION), *learned_by(ALTERNATIVES), *learned_by(config.sensor))
    return tuple(name for name in names if config.clutter or name != "outlier")


def data_from_log(log, config, params=None, steps=None):
    """Make `Data` of a `Log`; `steps`: padded to this number of frames (None: not padded).

    Positions are relative to the start, as float32 has 7 digits. Raises `ValueError` when the log
    lacks what the configuration needs, or has more frames than `steps`.
    """
    frames = frames_from_log(log, dataclasses.replace(config, descriptors=0), params)
    total = len(frames.time)
    steps = total if steps is None else steps
    if steps < total:
        raise ValueError(f"{log.name}: has {total} frames, more than the {steps} asked for")
    real = jnp.zeros(()).dtype

    def pad(leaf):
        leaf = np.pad(leaf, [(0, steps - total), *[(0, 0)] * (leaf.ndim - 1)])
        return jnp.asarray(leaf.astype(real) if leaf.dtype.kind == "f" else leaf)

    start = jnp.asarray([0.0, 0.0, log.start_pose[2]], real)
    arrays = jax.tree.map(pad, (frames.odometry, frames.measurements))
    return Data(start, jnp.asarray(log.start_cov, real), *arrays)


def log_likelihood(
    params: Params,
    log: Log | Data,
    key: jax.Array,
    config: Config,
    discount: float | jax.Array = DISCOUNT,
) -> jax.Array:
    """Estimate the log likelihood of a `Log` or `Data`; differentiable by `params`.

    `jax.grad` gives the Fisher score (`score`), not the derivative of the value returned, which
    jumps. Derivatives by parameters that are not `learnable` are zero. Besides the filter's
    evidence the value includes the probability of the number of new landmarks (`frame_terms`).
    """
    check(config)
    data = log if isinstance(log, Data) else data_from_log(log, config)
    numbers = Params(*(jnp.asarray(value, data.start_pose.dtype) for value in params))
    discount = jnp.asarray(discount, data.start_pose.dtype)
    return _differentiable(config, numbers, discount, data, key)


def score(
    params: Params,
    log: Log | Data,
    key: jax.Array,
    config: Config,
    names: Sequence[str],
    discount: float = DISCOUNT,
) -> Score:
    """Compute the `Score` of a `Log` or `Data` by the parameters `names` (`learnable` lists them).

    With `discount` 1 its expectation, weighted with the likelihood estimates, is exactly the
    likelihood's derivative. Raises `ValueError` for names that have no derivative.
    """
    check(config, names)
    data = log if isinstance(log, Data) else data_from_log(log, config)
    numbers = Params(*(jnp.asarray(value, data.start_pose.dtype) for value in params))
    return score_and_value(numbers, data, key, config, tuple(names), discount)


def check(config, names=()):
    """Raise `ValueError` for names without a derivative; warn of an association that biases the
    score."""
    allowed = learnable(config)
    for name in names:
        if name not in allowed:
            raise ValueError(
                f"{name!r} can't be learned with sensor {config.sensor}; these can: "
                f"{', '.join(allowed)}"
            )
    if config.association == "maximum_likelihood":
        warnings.warn(BIASED, stacklevel=3)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(config, params, discount, data, key):
    return value(params, data, key, config)


def _derivative(config, primals, tangents):
    params, discount, data, key = primals
    moved = [
        name
        for name, tangent in zip(Params._fields, tangents[0], strict=True)
        if not isinstance(tangent, jax.custom_derivatives.SymbolicZero)
    ]
    names = tuple(name for name in learnable(config) if name in moved)
    score = score_and_value(params, data, key, config, names, discount)
    along = [getattr(tangents[0], name) * score.total[i] for i, name in enumerate(names)]
    return score.log_likelihood, sum(along, jnp.zeros_like(score.log_likelihood))


_differentiable.defjvp(_derivative, symbolic_zeros=True)


@partial(jax.jit, static_argnames="config")
def value(params, data, key, config):
    """The estimate of the log likelihood alone."""
    config = dataclasses.replace(config, lazy=False)
    start, key = jax.random.split(key)
    state = _initial_state(data, start, config)

    def step(state, frame):
        chance = draw_for_frame(key, state.step, config)
        state, info = fastslam.advance(chance, state, *frame, params, config)
        return state, info.log_evidence + frame_terms(frame[1], params)

    return jax.lax.scan(step, state, (data.odometry, data.measurements))[1].sum()


def _initial_state(data, key, config):
    """`State` before the first frame."""
    return fastslam.init(config, key, data.start_pose, data.start_cov, data.landmarks_given)


def draw_for_frame(key, step, config):
    """Draw the random numbers of a step; with `known` association also uniforms for clutter."""
    chance = fastslam.draw_random_numbers(key, step, config)
    if config.association == "known" and config.clutter:
        shape = config.measurements, config.particles
        own = jax.random.fold_in(key, 2**30 + step)  # different from every step's keys
        chance = chance._replace(picks=jax.random.uniform(own, shape, float))
    return chance


def frame_terms(measurements, params):
    """Terms of a frame's log likelihood that are equal for all particles.

    New landmarks are a Poisson process of `density_new` per m^2 of the view, whose normalization is
    density times area (without it the likelihood would increase with the density for ever).
    Positions derived from odometry were multiplied by its gain: the Jacobian of that scaling.
    """
    area = (params.view_max - params.view_min) * params.view_range**2 / 2
    term = jnp.where(measurements.active, -params.density_new * area, 0.0)
    if measurements.scale is not None:
        scaled = (measurements.scale * measurements.valid).sum()
        term += 2 * scaled * jnp.log(params.gain_tran)
    return term


class _Carry(NamedTuple):
    """State; derivatives by the parameters (first axis) of every particle's landmarks, and of its
    log weight as inherited; sums of the steps' scores and of their part common to all particles;
    least effective sample size."""

    state: fastslam.State
    world: dict
    inherited: jax.Array
    total: jax.Array
    shared: jax.Array
    ess: jax.Array


@partial(jax.jit, static_argnames=("config", "names"))
def score_and_value(params, data, key, config, names, discount=DISCOUNT):
    """`score` of `Data` without checks, for use inside compiled functions."""
    # Derivatives are resampled along with the landmarks, which is not done lazily.
    config = dataclasses.replace(config, lazy=False)
    start, key = jax.random.split(key)
    state = _initial_state(data, start, config)
    through = _filter_through(names, config, data.measurements)
    dtype = state.pose.dtype
    carry = _Carry(
        state,
        {name: jnp.zeros((len(through), *getattr(state.landmarks, name).shape), dtype)
         for name in _parts(through, config)},
        jnp.zeros((len(names), config.particles), dtype),
        jnp.zeros(len(names), dtype),
        jnp.zeros(len(names), dtype),
        jnp.asarray(config.particles, dtype),
    )  # fmt: skip

    def step(carry, frame):
        return _step(carry, frame, params, key, config, names, through, discount)

    frames = data.odometry, data.measurements
    last, (steps, log_evidence) = jax.lax.scan(step, carry, frames)
    weight = jnp.exp(last.state.log_weight)
    at_end = last.inherited @ weight + last.shared
    total = jnp.where(discount == 1, at_end, last.total)
    return Score(total, log_evidence.sum(), steps, log_evidence, last.ess)


def _filter_through(names, config, measurements):
    """The names whose derivatives pass through the landmarks."""
    sensor = learned_by(config.sensor)
    if measurements.scale is not None:
        sensor = (*sensor, "gain_tran")
    return tuple(name for name in names if name in sensor)


def _parts(through, config):
    """Arrays of the map that have derivatives: anchors depend on the mounting only."""
    if not through:
        return ()
    anchored = config.sensor == "bearing" and {"mount_x", "mount_y"} & {*through}
    return ("mean", "factor", "anchor") if anchored else ("mean", "factor")


def _step(carry, frame, params, key, config, names, through, discount):
    """A filter step that propagates the derivatives."""
    state, (odometry, measurements) = carry.state, frame
    chance = draw_for_frame(key, state.step, config)
    seen, world_dot, by_density = _observe(carry, chance, frame, params, config, through)
    gained = dict(zip(through, by_density, strict=True))
    drawn = motion_score(seen.u, odometry, params, [n for n in names if n in learned_by(MOTION)])
    chosen = alternatives_score(seen.match, params)
    for name, more in {**drawn, **{n: chosen[n] for n in names if n in chosen}}.items():
        gained[name] = gained[name] + more if name in gained else more
    after, info = fastslam.weigh_and_resample(chance, state, seen, measurements, config)
    before, weight = jnp.exp(state.log_weight), jnp.exp(info.log_weight)
    inherited = discount * carry.inherited
    own = inherited + jnp.stack([gained[name] for name in names]) if names else inherited
    # A particle without weight must not contribute, not even 0 times NaN.
    own = jnp.where(weight > 0, own, 0.0)
    extra = _frame_score(measurements, params, names)
    gradient = own @ weight - inherited @ before + extra
    world_dot, own = resampling.gather((world_dot, own), info.ancestors, info.resampled, config)
    log_evidence = info.log_evidence + frame_terms(measurements, params)
    sums = carry.total + gradient, carry.shared + extra, jnp.minimum(carry.ess, info.ess)
    return _Carry(after, world_dot, own, *sums), (gradient, log_evidence)


def _observe(carry, chance, frame, params, config, through):
    """`Observed` of the particles, and derivatives of map and density by `through`."""
    state = carry.state
    parts = tuple(carry.world)

    def observe(values, arrays):
        replaced = params._replace(**dict(zip(through, values, strict=True)))
        moved = state._replace(landmarks=state.landmarks._replace(**arrays))
        seen = blocks.observe(moved, chance, *frame, replaced, config, frozen=True)
        return ({name: getattr(seen.landmarks, name) for name in parts}, seen.density), seen

    values = tuple(getattr(params, name) for name in through)
    arrays = {name: getattr(state.landmarks, name) for name in parts}
    if not through:
        return observe(values, arrays)[1], {}, ()

    def push(direction, world_dot):
        tangents = tuple(direction), world_dot
        return jax.jvp(observe, (values, arrays), tangents, has_aux=True)

    basis = jnp.eye(len(through), dtype=state.pose.dtype)
    _, (world_dot, by_density), seen = jax.vmap(push, in_axes=0, out_axes=(None, 0, None))(
        basis, carry.world
    )
    return seen, world_dot, by_density


def motion_score(u, odometry, params, names):
    """Derivatives [N] by name of the log density of the poses drawn, with these fixed."""

    def density(values):
        return motion.log_density_of(u, odometry, params._replace(**values), params)

    return jax.jacfwd(density)({name: getattr(params, name) for name in names}) if names else {}


def alternatives_score(match, params):
    """Derivatives [N] by name of the log probability of the clutter and new landmarks drawn."""
    new = (match == NEW).sum(0)
    clutter = (match == CLUTTER).sum(0)
    real = new + (match >= 0).sum(0)
    return {
        "outlier": clutter / params.outlier - real / (1 - params.outlier),
        "density_new": new / params.density_new,
    }


def _frame_score(measurements, params, names):
    """Derivatives [P] of `frame_terms`."""
    values = jnp.array([getattr(params, name) for name in names])

    def term(values):
        replaced = params._replace(**{name: values[i] for i, name in enumerate(names)})
        return frame_terms(measurements, replaced)

    return jax.jacfwd(term)(values)
