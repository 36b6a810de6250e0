"""The particle filter: FastSLAM on arrays, from odometry and measurements to a weighted map.

Read `step` first: a step in four paragraphs, and the states it goes between. `block_update` does
the work of one frame: associate, draw the pose, update, weigh, forget; `association`, `proposal`,
`landmarks`, `weights` and `resampling` are its parts, `appearance` and `map_estimate` what is
added to them, and `frames` converts a log to the filter's input.

The rest makes it fast, with the same result: `blocks`, `candidate_slots`, `landmark_updates`,
`new_landmarks`, `lazy_resampling` and `xla` on a CPU, `sharding` and `halo_exchange` on several
devices.
"""
