"""Run the filter over a log: compile, filter chunk by chunk, and assemble the result.

Read `run` first. `compiled` has the loop over a chunk of frames, `assemble` makes the `Result` of
its records, `memory` refuses what does not fit. Long runs: `checkpoints` and `checkpoint_file`.
Runs of several processes: `cluster` and `supervisor`. Many small runs in one program: `batch`.
"""
