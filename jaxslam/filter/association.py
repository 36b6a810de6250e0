"""Which landmark each measurement of a frame came from.

`maximum_likelihood`: the slot of greatest density, if that exceeds the alternatives ("new" and
"clutter"). `sampled`: slot or alternative drawn with probability proportional to its density.
`known`: as the log says. For blocks of n particles, with arrays [K, n] of slots and densities.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from jaxslam.filter.landmarks import log_likelihoods
from jaxslam.filter.xla import nonzero_indices, ordered_sum
from jaxslam.models.geometry import wrap

NEW, CLUTTER, PADDING = -1, -2, -3


def associate(config, scorer, measurements, new, clutter, params, picks=None, ratios=None):
    """Match measurements to slots [K, n], or `NEW`, `CLUTTER`, `PADDING`; also returns the log
    probability [n] with which the matches were drawn (0: nothing is drawn).

    `scorer`: `landmarks.Scorer` of every slot, [M, n]. `new` [K] and `clutter` []: log densities of
    the alternatives (`clutter` -inf when the configuration has none). `picks` [K, n]: uniforms
    behind the draws of `sampled`, and of `known` between the identity's slot and clutter (None: the
    one of greater density). `ratios` [K, M]: log-likelihood ratios of appearance, or None. No
    gradient flows through the matches.
    """
    scorer, new, clutter, params = stop_gradient((scorer, new, clutter, params))
    new = jnp.broadcast_to(new, measurements.valid.shape)
    log_choice = jnp.zeros_like(scorer.constant[0])
    if config.association == "sampled":
        slot, log_choice = _sample(
            config, scorer, measurements, new, clutter, params, picks, ratios
        )
    elif config.association == "known":
        slot, log_choice = _take_known(config, scorer, measurements, clutter, params, picks)
    else:
        # Padding beats no threshold, so that it takes no landmark from a measurement.
        threshold = jnp.where(measurements.valid, jnp.maximum(new, clutter), jnp.inf)
        slot = _maximum_likelihood(config, scorer, measurements, threshold, params, ratios)
        other = jnp.where(new >= clutter, NEW, CLUTTER)
        slot = jnp.where(slot < 0, other[:, None], slot)
    return jnp.where(measurements.valid[:, None], slot, PADDING), log_choice


def _sample(config, scorer, measurements, new, clutter, params, picks, ratios):
    """Draw slots [K, n], one measurement after the other; also the log probability [n] of all.

    With `exclusive` slots are drawn without replacement. The particle's weight corrects for the
    order: likelihoods over the probability of the draw are the product of the sums of densities.
    """
    value, cov = jnp.asarray(measurements.value).T, jnp.asarray(measurements.cov).T
    slots, particles = scorer.constant.shape
    kind = scorer.constant.dtype

    def draw(carry, k):
        taken, log_choice = carry
        density = log_likelihoods(
            config.sensor, scorer, tuple(v[k] for v in value), tuple(c[k] for c in cov), params
        )
        if ratios is not None:
            density = density + ratios[k][:, None]
        density = jnp.where(taken, -jnp.inf, density)
        top = jnp.maximum(density.max(0), jnp.maximum(new[k], clutter))
        share, new_share = jnp.exp(density - top), jnp.exp(new[k] - top)
        total = ordered_sum(share) + new_share + jnp.exp(clutter - top)
        draw_at = picks[k] * total

        # The slot at which the cumulative sum passes the uniform; then come "new" and "clutter".
        def accumulate(m, carry):
            below, slot = carry
            slot = jnp.where((slot == CLUTTER) & (draw_at < below + share[m]), m, slot)
            return below + share[m], slot

        none = jnp.full(particles, CLUTTER, jnp.int32)
        below, slot = jax.lax.fori_loop(0, slots, accumulate, (jnp.zeros(particles, kind), none))
        # Rounding may leave the uniform beyond every sum: without clutter that is "new".
        last = (draw_at < below + new_share) | (clutter == -jnp.inf)
        slot = jnp.where((slot == CLUTTER) & last, NEW, slot)
        chosen = jnp.where(jnp.arange(slots)[:, None] == slot, share, 0.0).sum(0)
        chosen = jnp.where(slot == NEW, new_share, chosen)
        chosen = jnp.where(slot == CLUTTER, jnp.exp(clutter - top), chosen)
        log_choice = log_choice + jnp.where(measurements.valid[k], jnp.log(chosen / total), 0.0)
        if config.exclusive:
            drawn = jnp.arange(slots)[:, None] == slot
            taken = taken | (drawn & measurements.valid[k])
        return (taken, log_choice), slot

    start = jnp.zeros((slots, particles), bool), jnp.zeros(particles, kind)
    (_, log_choice), slot = jax.lax.scan(draw, start, jnp.arange(len(new)))
    return slot, log_choice


def _take_known(config, scorer, measurements, clutter, params, picks=None):
    """Match identity i to slot i, unless clutter is likelier; with `picks`, draw between the two.
    Also the log probability [n] of the draws."""
    slots = len(scorer.constant)
    slot = jnp.clip(measurements.identity, 0, slots - 1)
    known = jax.tree.map(lambda leaf: leaf[slot], scorer)
    density = log_likelihoods(config.sensor, known, *measurement_columns(measurements), params)
    there = measurements.valid & (measurements.identity < slots)
    return _decide(slot, there, known.constant > -jnp.inf, density, clutter, picks)


def associate_known_slots(known, occupied, density, measurements, clutter, picks=None):
    """Match measurement k to its slot of `known` (`KnownSlots`), or an alternative: as `associate`.

    `occupied` [K, n]: whether the particle's slot holds a landmark; `density` [K, n]: the
    measurement's log density under it.
    """
    density, clutter = stop_gradient((density, clutter))
    slot, log_choice = _decide(known.slot, known.there, occupied, density, clutter, picks)
    return jnp.where(measurements.valid[:, None], slot, PADDING), log_choice


def _decide(slot, there, occupied, density, clutter, picks):
    """Slots [K] that are `there` [K], or alternatives, by densities [K, n]: matches [K, n], and the
    log probability [n] with which they were drawn."""
    log_choice = jnp.zeros_like(density[0])
    if picks is None:
        # A branch returns arrays: else XLA computes densities again for all that depends on them.
        fits = jax.lax.cond(
            clutter > -jnp.inf, lambda d: d >= clutter, lambda d: ~jnp.isnan(d), density
        )
    else:
        fits = picks < jax.nn.sigmoid(density - clutter)
        chosen = jax.nn.log_sigmoid(jnp.where(fits, density - clutter, clutter - density))
        drawn = occupied & there[:, None] & (clutter > -jnp.inf)
        log_choice = ordered_sum(jnp.where(drawn, chosen, 0.0))
    slot = jnp.where(occupied, jnp.where(fits, slot[:, None], CLUTTER), NEW)
    return jnp.where(there[:, None], slot, NEW), log_choice


def _maximum_likelihood(config, scorer, measurements, threshold, params, ratios):
    """Best slot [K, n] of each measurement, or -1; with `exclusive` the best pair comes first."""
    particles = scorer.constant.shape[1]
    start = (
        jnp.broadcast_to(threshold[:, None], (len(threshold), particles)).astype(
            scorer.constant.dtype
        ),
        jnp.full((len(threshold), particles), -1, jnp.int32),
    )
    possible = _possible(config, scorer, measurements, threshold, ratios)
    pairs, count = nonzero_indices(possible.reshape(-1))

    # A running "is it greater" is plain vector code on a CPU; argmax is not (ten times slower).
    def compare(i, best):
        k, m = jnp.divmod(pairs[i], possible.shape[1])
        density = _density(config, scorer, measurements, params, ratios, k, m)
        held = jax.tree.map(lambda leaf: leaf[k], best)
        better = density > held[0]
        row = jnp.where(better, density, held[0]), jnp.where(better, m, held[1])
        return jax.tree.map(lambda leaf, new: leaf.at[k].set(new), best, row)

    best = jax.lax.fori_loop(0, count, compare, start)
    if not config.exclusive:
        return best[1]
    return _assign_exclusively(
        config, scorer, measurements, threshold, params, ratios, best, possible
    )


def _density(config, scorer, measurements, params, ratios, k, m):
    """Log densities [n] of measurement k under slot m."""
    row = jax.tree.map(lambda leaf: leaf[m], scorer)
    value, cov = tuple(measurements.value[k]), tuple(measurements.cov[k])
    density = log_likelihoods(config.sensor, row, value, cov, params)
    return density if ratios is None else density + ratios[k, m]


def _possible(config, scorer, measurements, threshold, ratios=None):
    """Whether some particle of the block might match a measurement with a slot [K, M].

    A log density is at most the log normaliser minus half the square of one component's innovation
    over its variance. Here the innovation is the smallest and the variance the largest over the
    block, so that no match is missed (NaN counts as possible).
    """
    slots = scorer.constant.shape[0]
    upper = jnp.broadcast_to(scorer.constant.max(-1), (len(threshold), slots))
    if config.sensor == "position":  # the normaliser depends on the measurement
        upper = jnp.where(upper > -jnp.inf, jnp.inf, upper)
    if ratios is not None:
        upper = upper + ratios
    if config.sensor == "bearing":
        parts = [(0, scorer.matrix[0], True)]
    elif config.sensor == "range_bearing":
        a, b, c = scorer.matrix
        parts = [(0, a - b * b / (4 * c), False), (1, c - b * b / (4 * a), True)]
    else:
        parts = []
    away = jnp.zeros_like(upper)
    for i, factor, angle in parts:
        z, predicted = measurements.value[:, i, None], scorer.value[i]
        reference = predicted[:, :1] if angle else 0.0
        off = wrap(predicted - reference) if angle else predicted
        low, high = off.min(-1), off.max(-1)
        at = wrap(z - reference[:, 0]) if angle else z
        turns = (-2 * jnp.pi, 0.0, 2 * jnp.pi) if angle else (0.0,)
        gaps = [jnp.maximum(low - (at + t), (at + t) - high) for t in turns]
        gap = jnp.maximum(jnp.stack(gaps).min(0), 0)
        # Slightly less than exact, against rounding.
        away = jnp.maximum(away, gap**2 * (1e-6 * scorer.matrix[2 * i] - 0.999 * factor).min(-1))
    return ~(upper - jnp.maximum(away, 0) <= threshold[:, None])


def _assign_exclusively(config, scorer, measurements, threshold, params, ratios, best, possible):
    """Resolve conflicts over a slot: the measurement of lower density takes its next best slot.

    Deferred acceptance (Gale and Shapley 1962). Both sides rank a pair by the same density, so the
    outcome is that of taking the best free pair repeatedly, in whatever order. Conflicts are rare:
    each round moves one loser of every particle. Only measurements that share a `possible` slot can
    be in conflict, and only possible pairs are scored.
    """
    total, slots = possible.shape
    index = jnp.arange(total)[:, None]
    share = (possible[:, None] & possible).any(-1) & (index < jnp.arange(total))
    rivals, pairs = nonzero_indices(share.reshape(-1), total * (total - 1) // 2)

    def losers(best):
        density, slot = best

        def compare(i, lost):
            j, k = jnp.divmod(rivals[i], total)
            same = (slot[j] == slot[k]) & (slot[j] >= 0)
            second = density[j] >= density[k]
            lost = lost.at[j].set(lost[j] | (same & ~second))
            return lost.at[k].set(lost[k] | (same & second))

        return jax.lax.fori_loop(0, pairs, compare, jnp.zeros(slot.shape, bool))

    def move(carry):
        (density, slot), lost = carry
        loser = jnp.where(lost, index, total).min(0)
        here = index == loser
        held = jnp.where(here, density, 0).sum(0), jnp.where(here, slot, 0).sum(0)
        moved = here.any(1)
        tried, count = nonzero_indices((possible & moved[:, None]).reshape(-1))

        def find_next(i, best):
            k, m = jnp.divmod(tried[i], slots)
            new = _density(config, scorer, measurements, params, ratios, k, m)
            lower = (new < held[0]) | ((new == held[0]) & (m > held[1]))
            better = here[k] & lower & (new > threshold[k]) & (new > best[0])
            return jnp.where(better, new, best[0]), jnp.where(better, m, best[1])

        none = jnp.full_like(density[0], -jnp.inf), jnp.full_like(slot[0], -1)
        top, next_slot = jax.lax.fori_loop(0, count, find_next, none)
        density = jnp.where(here, top, density)
        slot = jnp.where(here, next_slot, slot)
        return (density, slot), losers((density, slot))

    (_, slot), _ = jax.lax.while_loop(lambda carry: carry[1].any(), move, (best, losers(best)))
    return slot


def measurement_columns(measurements):
    """Values and covariances as tuples of columns [K, 1], which broadcast over particles."""
    value = tuple(measurements.value[:, i, None] for i in range(2))
    cov = tuple(measurements.cov[:, i, None] for i in range(3))
    return value, cov
