"""The results of a run: as an object, as a folder, as figures and as errors against the truth.

Read `result` first, the `Result` that `runs` assembles; then `metrics`, its errors where the log
has truth, and `events`, what happened frame by frame. `run_folder` writes a result, with
`figures` and under `run_lock`; `load` reads it back. `tables` formats text. Without JAX.
"""
