"""The events of a run, frame by frame: what `events.jsonl` holds."""

import numpy as np

from jaxslam.smoother.events import FAILED, KINDS, MERGED

AMBIGUOUS = 0.33  # nats: one particle in ten matches otherwise


def list_events(result):
    """Yield a dict for every frame in which something happened; `t`: seconds since the first frame.

    `rejuvenated`: ids of the landmarks `found`, `dropped` or `merged` (each with the one that is
    left), or that it `failed`. `ambiguous`: ambiguous measurements, as row of the log and entropy
    (nats).
    """
    changed, ambiguous = _map_changes(result), _ambiguous_rows(result)
    happened = result.resampled | (result.new > 0) | (result.overflow > 0) | result.degenerate
    happened = happened | (result.nonfinite > 0) | (result.forgotten >= 0.5)
    happened[[*changed, *ambiguous]] = True
    for step in np.flatnonzero(happened).tolist():
        event = {"step": step, "t": int(result.time[step] - result.time[0]) / 1e9}
        event["ess"] = round(float(result.ess[step]), 1)
        for name in ("resampled", "degenerate"):
            event |= {name: True} if getattr(result, name)[step] else {}
        for name in ("new", "overflow", "nonfinite", "forgotten"):
            count = float(getattr(result, name)[step])
            event |= {name: round(count, 3)} if count else {}
        event |= {"ambiguous": ambiguous[step]} if step in ambiguous else {}
        event |= {"rejuvenated": changed[step]} if step in changed else {}
        yield event


def ambiguous_measurements(result):
    """Return frame and row of the frame [n, 2] of the ambiguous measurements."""
    if result.entropy is None:
        return np.zeros((0, 2), int)
    return np.argwhere(result.entropy > AMBIGUOUS)


def _map_changes(result):
    """Return, by frame, what rejuvenation after it changed in the map."""
    changes = {}
    for done, kind, landmark_id, into in [] if result.events is None else result.events.tolist():
        change = changes.setdefault(done - 1, {})
        if kind == FAILED:
            change["failed"] = True
        else:
            entry = [landmark_id, into] if kind == MERGED else landmark_id
            change.setdefault(KINDS[kind], []).append(entry)
    return changes


def _ambiguous_rows(result):
    """Return, by frame, the log's row and the entropy of each ambiguous measurement."""
    ambiguous = {}
    for step, k in ambiguous_measurements(result).tolist():
        pair = [int(result.row[step, k]), round(float(result.entropy[step, k]), 3)]
        ambiguous.setdefault(step, []).append(pair)
    return ambiguous


def association_entropy(landmark_id, ancestors):
    """Return the entropy [C, K], nats, of the particles' matches of each measurement of C frames.

    `landmark_id` [C, K, N] and `ancestors` [C, N] as in `step.Info`. Particles count as often as
    they are continued after the frame: where they are resampled, by their weight.
    """
    entropy = np.zeros(landmark_id.shape[:2], np.float32)
    differ = (landmark_id != landmark_id[..., :1]).any(-1)
    for c in np.flatnonzero(differ.any(1)):
        copies = np.bincount(ancestors[c], minlength=landmark_id.shape[2])
        for k in np.flatnonzero(differ[c]):
            _, match = np.unique(landmark_id[c, k], return_inverse=True)
            share = np.bincount(match, copies) / len(copies)
            share = share[share > 0]
            entropy[c, k] = max(0.0, -np.sum(share * np.log(share)))
    return entropy
