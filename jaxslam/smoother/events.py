"""Kinds of what rejuvenation did to the map."""

# Kinds of what rejuvenation did (`Result.events`).
KINDS = "merged", "dropped", "found", "failed"

MERGED, DROPPED, FOUND, FAILED = range(len(KINDS))
