"""Logs: what a robot drove and measured. NumPy only; nothing here knows the filter.

Read `log` (the data), then `odometry` (its integration) and `truth`. `log_file` stores logs,
`slicing` cuts them, `readers` makes them of other formats, `validation` checks their fields.
`diagnostics` looks for mistakes (`jaxslam check`), with `clock_offset`; `appearance_space` makes
descriptors comparable.
"""
