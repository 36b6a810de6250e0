"""Simulated logs with known truth.

`planar` draws logs from the filter's own model. `room` renders images of a furnished room.
"""
