"""Prepare logs for learning: windows of them, and one configuration with room for all."""

import dataclasses
from collections import Counter

from jaxslam.filter.frames import frames_from_log
from jaxslam.logs.slicing import cut, spaced, windows
from jaxslam.runs.run import config_for


def split_log(log, start=0.0, end=None, seconds=60.0, spacing=0.0, known=False):
    """List of `Log`s of `seconds` [s] (0: one log) from `start` to `end` [s after the log's start],
    and how many were left out.

    Frames are at least `spacing` [s] apart. Where identities are believed (`known`) and the log has
    some, windows without any are left out.
    """
    log = cut(log, start, end) if start or end is not None else log
    log = spaced(log, spacing)
    parts = windows(log, seconds) if seconds else [log]
    if not known or log.identity is None or not (log.identity >= 0).any():
        return parts, 0
    kept = [part for part in parts if not len(part.frame) or part.identity.max() >= 0]
    return kept, len(parts) - len(kept)


def config_for_logs(logs, sensor=None, association="sampled", particles=200, landmarks=None):
    """A `Config` large enough for every log, and the number of unused measurements by reason.

    `sensor` None: the first that the log has. `landmarks` None: as `config_for` chooses.
    """
    settings = {"landmarks": landmarks} if landmarks else {}
    configs = [
        config_for(
            log, sensor, association, proposal="informed", particles=particles,
            # Else duplicate landmarks would pay, and noise be learned too small.
            uniform_association_prior=association == "sampled",
            descriptors=0,  # every window would have an appearance space of its own
            **settings,
        )
        for log in logs
    ]  # fmt: skip
    config = dataclasses.replace(
        configs[0],
        measurements=max(each.measurements for each in configs),
        landmarks=max(each.landmarks for each in configs),
    )
    dropped = Counter()
    for log in logs:
        dropped.update(frames_from_log(log, config).dropped)
    return config, dict(dropped)
