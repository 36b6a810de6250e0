"""Whole runs: from a log to a `Result`, over chunks of frames, with checkpoints and processes.

Read `run` first; it calls `compiled` (the loop over a chunk of frames), `assemble` (what is kept
of each step, and the `Result` made of it) and the smoother. `batch` runs one log with many seeds
and parameters. Long runs: `memory` rejects what does not fit, `checkpoints` saves and resumes
(`checkpoint_file`: one such file). Several processes: `cluster` connects them, `supervisor`
reports how one ended.
"""
