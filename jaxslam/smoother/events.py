"""Kinds of events of rejuvenation in `Result.events`."""

KINDS = "merged", "dropped", "found", "failed"

MERGED, DROPPED, FOUND, FAILED = range(len(KINDS))
