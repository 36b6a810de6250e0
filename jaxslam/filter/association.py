"""Which landmark each measurement of a frame came from.

`maximum_likelihood`: the slot of greatest density, if that beats the alternatives ("new" and
"clutter"). `sampled`: slot or alternative drawn, each with its share of the sum of all densities.
`known`: as the log says. Works on blocks of n particles, on arrays [K, n] of slots and densities.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from jaxslam.filter.landmarks import log_likelihoods
from jaxslam.filter.xla import nonzero_indices, ordered_sum
from jaxslam.models.geometry import wrap

NEW, CLUTTER, PADDING = -1, -2, -3


def associate(config, scorer, measurements, new, clutter, params, picks=None, alike=None):
    """Slots [K, n] matched by the measurements, or `NEW`, `CLUTTER`, `PADDING`; and the log
    probability [n] with which they were drawn (0 where nothing is drawn).

    `scorer`: prediction of every slot, [M, n]. `new` [K] and `clutter` []: log densities of the
    alternatives (`clutter` -inf when the configuration has none). `picks` [K, n]: uniforms behind
    the draws of `sampled`, and of `known` between the identity's slot and clutter (None: the one of
    greater density). `alike` [K, M]: log likelihood ratios of looks, to be added, or None. No
    gradient flows through.
    """
    scorer, new, clutter, params = stop_gradient((scorer, new, clutter, params))
    new = jnp.broadcast_to(new, measurements.valid.shape)
    log_choice = jnp.zeros_like(scorer.constant[0])
    if config.association == "sampled":
        given = measurements, new, clutter, params, picks, alike
        slot, log_choice = _sample(config, scorer, *given)
    elif config.association == "known":
        slot, log_choice = _take_known(config, scorer, measurements, clutter, params, picks)
    else:
        # Padding wants no landmark, so that it takes none from a measurement.
        threshold = jnp.where(measurements.valid, jnp.maximum(new, clutter), jnp.inf)
        slot = _maximum_likelihood(config, scorer, measurements, threshold, params, alike)
        other = jnp.where(new >= clutter, NEW, CLUTTER)
        slot = jnp.where(slot < 0, other[:, None], slot)
    return jnp.where(measurements.valid[:, None], slot, PADDING), log_choice


def _sample(config, scorer, measurements, new, clutter, params, picks, alike):
    """Slots [K, n] drawn one measurement after the other, and the log probability [n] of all.

    With `exclusive` a slot that an earlier measurement took has no share any more: drawn without
    replacement. The weight then makes up for the order: likelihoods over the probability of the
    draw are the product of the sums that were drawn from.
    """
    value, cov = jnp.asarray(measurements.value).T, jnp.asarray(measurements.cov).T
    slots, lanes = scorer.constant.shape
    kind = scorer.constant.dtype

    def draw(carry, k):
        taken, log_choice = carry
        table = log_likelihoods(
            config.sensor, scorer, tuple(v[k] for v in value), tuple(c[k] for c in cov), params
        )
        if alike is not None:
            table = table + alike[k][:, None]
        table = jnp.where(taken, -jnp.inf, table)
        top = jnp.maximum(table.max(0), jnp.maximum(new[k], clutter))
        share, other = jnp.exp(table - top), jnp.exp(new[k] - top)
        total = ordered_sum(share) + other + jnp.exp(clutter - top)
        mark = picks[k] * total

        # The slot in which the running sum passes the mark; "new" and "clutter" come after all.
        def walk(m, found):
            below, slot = found
            slot = jnp.where((slot == CLUTTER) & (mark < below + share[m]), m, slot)
            return below + share[m], slot

        none = jnp.full(lanes, CLUTTER, jnp.int32)
        below, slot = jax.lax.fori_loop(0, slots, walk, (jnp.zeros(lanes, kind), none))
        # Rounding may leave the mark beyond everything: without clutter that is "new".
        last = (mark < below + other) | (clutter == -jnp.inf)
        slot = jnp.where((slot == CLUTTER) & last, NEW, slot)
        chosen = jnp.where(jnp.arange(slots)[:, None] == slot, share, 0.0).sum(0)
        chosen = jnp.where(slot == NEW, other, chosen)
        chosen = jnp.where(slot == CLUTTER, jnp.exp(clutter - top), chosen)
        log_choice = log_choice + jnp.where(measurements.valid[k], jnp.log(chosen / total), 0.0)
        if config.exclusive:
            here = jnp.arange(slots)[:, None] == slot
            taken = taken | (here & measurements.valid[k])
        return (taken, log_choice), slot

    start = jnp.zeros((slots, lanes), bool), jnp.zeros(lanes, kind)
    (_, log_choice), slot = jax.lax.scan(draw, start, jnp.arange(len(new)))
    return slot, log_choice


def _take_known(config, scorer, measurements, clutter, params, picks=None):
    """Identity i is slot i; an occupied slot that fits worse than clutter does is not taken, or,
    with `picks`, taken with its share of the two. Also the log probability [n] of such draws."""
    slots = len(scorer.constant)
    slot = jnp.clip(measurements.identity, 0, slots - 1)
    rows = jax.tree.map(lambda leaf: leaf[slot], scorer)
    density = log_likelihoods(config.sensor, rows, *measurement_columns(measurements), params)
    there = measurements.valid & (measurements.identity < slots)
    return _decide(slot, there, rows.constant > -jnp.inf, density, clutter, picks)


def associate_known_slots(rows, occupied, density, measurements, clutter, picks=None):
    """`associate` where measurement k can be of one slot alone: that of `rows` (`matched.Rows`),
    `occupied` [K, n] or not, under which it has the log density [K, n]."""
    density, clutter = stop_gradient((density, clutter))
    slot, log_choice = _decide(rows.slot, rows.there, occupied, density, clutter, picks)
    return jnp.where(measurements.valid[:, None], slot, PADDING), log_choice


def _decide(slot, there, occupied, density, clutter, picks):
    """What `_known` says, of slots [K] that are `there` [K] and of densities [K, n]."""
    log_choice = jnp.zeros_like(density[0])
    if picks is None:
        # A branch hands on arrays: else XLA works densities out again for all that depends on it.
        taken = jax.lax.cond(
            clutter > -jnp.inf, lambda d: d >= clutter, lambda d: ~jnp.isnan(d), density
        )
    else:
        taken = picks < jax.nn.sigmoid(density - clutter)
        chosen = jax.nn.log_sigmoid(jnp.where(taken, density - clutter, clutter - density))
        drawn = occupied & there[:, None] & (clutter > -jnp.inf)
        log_choice = ordered_sum(jnp.where(drawn, chosen, 0.0))
    slot = jnp.where(occupied, jnp.where(taken, slot[:, None], CLUTTER), NEW)
    return jnp.where(there[:, None], slot, NEW), log_choice


def _maximum_likelihood(config, scorer, measurements, threshold, params, alike):
    """Best slot of each measurement, or -1; exclusive: the best pair first, over the frame."""
    lanes = scorer.constant.shape[1]
    start = (
        jnp.broadcast_to(threshold[:, None], (len(threshold), lanes)).astype(scorer.constant.dtype),
        jnp.full((len(threshold), lanes), -1, jnp.int32),
    )
    possible = _possible(config, scorer, measurements, threshold, alike)
    pairs, count = nonzero_indices(possible.reshape(-1))

    # A running "is it greater" is plain vector code on a CPU; argmax is not (ten times slower).
    def look(i, best):
        k, m = jnp.divmod(pairs[i], possible.shape[1])
        density = _density(config, scorer, measurements, params, alike, k, m)
        held = jax.tree.map(lambda leaf: leaf[k], best)
        better = density > held[0]
        row = jnp.where(better, density, held[0]), jnp.where(better, m, held[1])
        return jax.tree.map(lambda leaf, new: leaf.at[k].set(new), best, row)

    best = jax.lax.fori_loop(0, count, look, start)
    if not config.exclusive:
        return best[1]
    return _assign_exclusively(
        config, scorer, measurements, threshold, params, alike, best, possible
    )


def _density(config, scorer, measurements, params, alike, k, m):
    """Log densities [n] of measurement k under slot m."""
    row = jax.tree.map(lambda leaf: leaf[m], scorer)
    value, cov = tuple(measurements.value[k]), tuple(measurements.cov[k])
    density = log_likelihoods(config.sensor, row, value, cov, params)
    return density if alike is None else density + alike[k, m]


def _possible(config, scorer, measurements, threshold, alike=None):
    """Which slots some particle of the block might match with which measurements [K, M].

    A density is at most its normaliser's, less half the square of one component's innovation over
    that component's variance; here with the innovations' smallest and the variances' largest value
    over the block, so that nothing is missed (a NaN counts as possible).
    """
    slots = scorer.constant.shape[0]
    upper = jnp.broadcast_to(scorer.constant.max(-1), (len(threshold), slots))
    if config.sensor == "position":  # its density has a part per measurement: only empty is sure
        upper = jnp.where(upper > -jnp.inf, jnp.inf, upper)
    if alike is not None:
        upper = upper + alike
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
        # a shade less, for rounding
        away = jnp.maximum(away, gap**2 * (1e-6 * scorer.matrix[2 * i] - 0.999 * factor).min(-1))
    return ~(upper - jnp.maximum(away, 0) <= threshold[:, None])


def _assign_exclusively(config, scorer, measurements, threshold, params, alike, best, possible):
    """Resolve measurements that chose the same slot: the loser goes on to its next best slot.

    Deferred acceptance (Gale and Shapley 1962). Both sides rank a pair by the same density, so the
    outcome is that of taking the best free pair over and over, whatever the order. Conflicts are
    rare: each round moves one loser of every particle. Only measurements that share a `possible`
    slot can be in conflict, and only what is possible is scored.
    """
    total, slots = possible.shape
    index = jnp.arange(total)[:, None]
    share = (possible[:, None] & possible).any(-1) & (index < jnp.arange(total))
    rivals, pairs = nonzero_indices(share.reshape(-1), total * (total - 1) // 2)

    def losers(best):
        density, slot = best

        def beaten(i, lost):
            j, k = jnp.divmod(rivals[i], total)
            same = (slot[j] == slot[k]) & (slot[j] >= 0)
            second = density[j] >= density[k]
            lost = lost.at[j].set(lost[j] | (same & ~second))
            return lost.at[k].set(lost[k] | (same & second))

        return jax.lax.fori_loop(0, pairs, beaten, jnp.zeros(slot.shape, bool))

    def move(carry):
        (density, slot), lost = carry
        loser = jnp.where(lost, index, total).min(0)
        here = index == loser
        held = jnp.where(here, density, 0).sum(0), jnp.where(here, slot, 0).sum(0)
        moved = here.any(1)
        tried, count = nonzero_indices((possible & moved[:, None]).reshape(-1))

        def look(i, found):
            k, m = jnp.divmod(tried[i], slots)
            table = _density(config, scorer, measurements, params, alike, k, m)
            further = (table < held[0]) | ((table == held[0]) & (m > held[1]))
            better = here[k] & further & (table > threshold[k]) & (table > found[0])
            return jnp.where(better, table, found[0]), jnp.where(better, m, found[1])

        none = jnp.full_like(density[0], -jnp.inf), jnp.full_like(slot[0], -1)
        top, next_slot = jax.lax.fori_loop(0, count, look, none)
        density = jnp.where(here, top, density)
        slot = jnp.where(here, next_slot, slot)
        return (density, slot), losers((density, slot))

    settled = jax.lax.while_loop(lambda carry: carry[1].any(), move, (best, losers(best)))
    return settled[0][1]


def measurement_columns(measurements):
    """Value and covariance as tuples of [K, 1] columns, to broadcast over particles."""
    value = tuple(measurements.value[:, i, None] for i in range(2))
    cov = tuple(measurements.cov[:, i, None] for i in range(3))
    return value, cov
