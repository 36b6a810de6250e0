"""What happened in a run and when: frames in which something did, and what became of landmarks."""

import numpy as np

from jaxslam.smoother.events import FAILED, KINDS, MERGED


def list_events(result):
    """A dict for every frame in which something happened; `t` in seconds since the first frame.

    `rejuvenated`: which landmarks (by `id`) it `found`, `dropped` or `merged` (with which), or that
    it `failed`. `ambiguous`: rows of the log about which the particles differed, and by how much
    (nats).
    """
    changed, unsure = _changed(result), _unsure(result)
    happened = result.resampled | (result.new > 0) | (result.overflow > 0) | result.degenerate
    happened = happened | (result.nonfinite > 0) | (result.forgotten >= 0.5)
    happened[[*changed, *unsure]] = True
    for step in np.flatnonzero(happened).tolist():
        event = {"step": step, "t": int(result.time[step] - result.time[0]) / 1e9}
        event["ess"] = round(float(result.ess[step]), 1)
        for name in ("resampled", "degenerate"):
            event |= {name: True} if getattr(result, name)[step] else {}
        for name in ("new", "overflow", "nonfinite", "forgotten"):
            count = float(getattr(result, name)[step])
            event |= {name: round(count, 3)} if count else {}
        event |= {"ambiguous": unsure[step]} if step in unsure else {}
        event |= {"rejuvenated": changed[step]} if step in changed else {}
        yield event


def ambiguous_measurements(result):
    """Frame and slot [n, 2] of the measurements about which the particles differed."""
    if result.entropy is None:
        return np.zeros((0, 2), int)
    return np.argwhere(result.entropy > AMBIGUOUS)


def _changed(result):
    """By frame, what rejuvenation after it did to the map."""
    changed = {}
    for done, kind, label, into in [] if result.events is None else result.events.tolist():
        here = changed.setdefault(done - 1, {})
        if kind == FAILED:
            here["failed"] = True
        else:
            one = [label, into] if kind == MERGED else label
            here.setdefault(KINDS[kind], []).append(one)
    return changed


def _unsure(result):
    """By frame, pairs of a row of the log and its entropy, where that is not small."""
    unsure = {}
    for step, k in ambiguous_measurements(result).tolist():
        pair = [int(result.row[step, k]), round(float(result.entropy[step, k]), 3)]
        unsure.setdefault(step, []).append(pair)
    return unsure


AMBIGUOUS = 0.33  # nats: one particle in ten holds something else


def association_entropy(landmark_id, ancestors):
    """Entropy [C, K], nats, of what each measurement of C frames was taken for.

    `landmark_id` [C, K, N] as `filter.Info`; `ancestors` [C, N]: particles count as often as they go on
    after the frame, which is by their weight wherever they are resampled. Zero where all agree.
    """
    found = np.zeros(landmark_id.shape[:2], np.float32)
    differ = (landmark_id != landmark_id[..., :1]).any(-1)
    for c in np.flatnonzero(differ.any(1)):
        lives = np.bincount(ancestors[c], minlength=landmark_id.shape[2])
        for k in np.flatnonzero(differ[c]):
            _, held = np.unique(landmark_id[c, k], return_inverse=True)
            share = np.bincount(held, lives) / len(lives)
            share = share[share > 0]
            found[c, k] = max(0.0, -np.sum(share * np.log(share)))
    return found
