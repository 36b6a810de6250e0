"""The command `learn`: parameters from logged runs."""

import os
import re
import sys
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from jaxslam.cli.common import (
    DEMO,
    LogName,
    Sensors,
    at_least,
    check_new,
    note,
    option,
    progress_bar,
    warn,
)
from jaxslam.config import ASSOCIATIONS

FRESH = 8  # seeds that judge
CHECKPOINT = "learn.checkpoint.npz"
EVERY = 10  # steps between two lines of progress without a terminal
PARTS = Group("Which parts of the logs are used", sort_key=1)
EFFORT = Group("Filter and optimization", sort_key=2)


def _in(group, kind):
    """The option, listed under a group of the help."""
    return Annotated[kind, Parameter(group=group)]


def learn(
    *logs: LogName,
    held_out: Annotated[
        list[str],
        Parameter(
            help="Logs that judge the fit and are not learned from.",
            consume_multiple=True, negative=(), show_default=False,
        ),
    ] = (),
    parameters: option(
        str,
        "Parameters to learn, separated by commas (default: those of --params, else a choice that "
        "suits the sensor).",
    ) | None = None,
    sensor: option(Sensors, "Kind of measurements (default: the first that the log has).")
    | None = None,
    association: option(
        Literal[ASSOCIATIONS],
        "Data association: sampled per particle, identities from the log, or the best match, which "
        "is biased.",
    ) = "sampled",
    params: option(
        Path, "TOML file of starting values, and optionally [learn], [bounds] and [prior]."
    ) | None = None,
    out: option(Path, "File of parameters to write (.toml).") = Path("params.toml"),
    overwrite: option(bool, "Overwrite existing files.") = False,
    resume: option(bool, "Continue a fit of the same command that was stopped.") = False,
    seed: at_least("Seed of the random numbers.", 0, 2**32 - 1) = 0,
    start: _in(PARTS, option(float, "Use the logs from this time on [s after their start].")) = 0.0,
    end: _in(PARTS, option(float, "Use the logs up to this time [s] (default: all).")) | None
    = None,
    held_out_start: _in(PARTS, option(float, "The same for the held-out logs [s].")) = 0.0,
    held_out_end: _in(PARTS, option(float, "The same for the held-out logs [s].")) | None = None,
    window: _in(
        PARTS, option(float, "Length of the windows that logs are split into [s] (0: no split).")
    ) = 60.0,
    spacing: _in(
        PARTS,
        option(float, "Least time between the frames used [s]: close ones have correlated errors."),
    ) = 0.0,
    particles: _in(EFFORT, at_least("Number of particles.")) = 200,
    landmarks: _in(
        EFFORT, at_least("Slots of the map (default: 64; known association: one per landmark).")
    ) | None = None,
    seeds: _in(EFFORT, at_least("Filter runs with different seeds per log and step.", 2)) = 4,
    steps: _in(EFFORT, at_least("Largest number of optimization steps.")) = 150,
):  # fmt: skip
    """Learn noise and systematic errors from logs by maximum likelihood.

    Prints start, estimate, standard error and verdict of every parameter. Writes
    the file --out for jaxslam run --params, and beside it learn.csv and learn.png
    with every step. Held-out logs decide when to stop and show what was gained;
    without them, noise particular to one log may be learned. They may be other
    parts of the same log:

    Example: jaxslam learn lost-in-the-woods --end 600 --held-out lost-in-the-woods
    --held-out-start 600 --parameters err_rot,gain_rot --out fit/params.toml
    """
    files = _files(out, overwrite, resume)
    if not logs:
        raise ValueError(f"learn: no log given; for example {DEMO}")
    _check_apart(logs, (start, end), held_out, (held_out_start, held_out_end))
    _use_all_cores()
    from jaxslam.learning.data import config_for_logs

    with progress_bar("reading"):
        known = association == "known"
        train = _windows(logs, start, end, window, spacing, known)
        held_out = _windows(held_out, held_out_start, held_out_end, window, spacing, known)
        config, dropped = config_for_logs(
            train + held_out, sensor, association, particles, landmarks
        )
        task = _task(train, config, params, parameters)
    out.parent.mkdir(parents=True, exist_ok=True)
    fit = _run_fit(train, held_out, config, task, seeds, steps, seed, files, resume)
    fit, errors, judged = _assess(fit, train, held_out, seed)
    _write(fit, errors, task, files)
    warned = _print_fit(fit, errors, judged, dropped, files)
    files["checkpoint"].unlink(missing_ok=True)
    return int(warned)


def _files(out, overwrite, resume):
    """Paths of the output files by name; raises `ValueError` for existing ones."""
    folder = out.parent
    if folder.exists():
        check_new(out, overwrite, "a file of parameters", ".toml")
    elif out.suffix != ".toml":
        raise ValueError(f"{out}: a file of parameters is a .toml file")
    files = {"params": out, "csv": folder / "learn.csv", "figure": folder / "learn.png"}
    for path in files.values():
        if path.exists() and not overwrite:
            raise ValueError(f"{path}: exists; choose another folder or add --overwrite")
    files["checkpoint"] = folder / CHECKPOINT
    if files["checkpoint"].exists() and not (overwrite or resume):
        raise ValueError(
            f"{files['checkpoint']}: a fit was stopped here; --resume continues it, "
            "--overwrite starts anew"
        )
    if resume and not files["checkpoint"].exists():
        raise ValueError(f"{files['checkpoint']}: does not exist; start without --resume")
    return files


def _check_apart(logs, part, held_out, held_part):
    """Raise `ValueError` if a log is learned from and held out at the same times."""
    far = float("inf")
    (a, b), (c, d) = ((s, far if e is None else e) for s, e in (part, held_part))
    both = {str(Path(log).resolve()) for log in logs} & {str(Path(h).resolve()) for h in held_out}
    if both and max(a, c) < min(b, d):
        name = Path(min(both)).name
        raise ValueError(
            f"{name}: both learned from and held out; separate the parts, for example by --end and "
            "--held-out-start"
        )


def _use_all_cores():
    """Make every core a device of JAX, over which logs and seeds are distributed."""
    import jax

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with suppress(RuntimeError):  # JAX is initialized already
        jax.config.update("jax_num_cpu_devices", cores)


def _windows(names, start, end, window, spacing, known):
    """`split_log` of the logs of these names; warns of windows left out."""
    from jaxslam.learning.data import split_log
    from jaxslam.logs.log_file import load_log

    parts = []
    for name in names:
        log = load_log(name)
        kept, blind = split_log(log, start, end, window, spacing, known)
        if blind:
            warn(f"{log.name}: {blind} windows without any identity are left out")
        parts += kept
    return parts


def _task(train, config, path, parameters):
    """`Learning`: starting values, parameters to learn, bounds and priors."""
    from jaxslam.learning import fit, likelihood, transforms
    from jaxslam.parameter_file import Learning, load_learning
    from jaxslam.parameters import TABLE, default_params

    base = default_params(config.sensor, train[0])
    for log in train:
        if default_params(config.sensor, log) != base:
            warn(f"{log.name}: its declared values differ; those of {train[0].name} are used")
            break
    task = load_learning(path, base) if path else Learning(base, None, {}, {})
    start, names = task.params, task.names
    if parameters:
        names = tuple(name.strip() for name in parameters.split(","))
    if names is None:  # a parameter that starts at 0 has no logarithm, so it must be named
        names = fit.default_names(config)
        names = tuple(n for n in names if getattr(start, n) > 0 or TABLE[n].scale == "linear")
    if len(set(names)) < len(names):
        raise ValueError(f"--parameters: {', '.join(names)}; name each once")
    with _without_bias_warning():
        likelihood.check(config, names=names)
    if "sigma_bearing" in names and start.extra_bearing_noise:
        note(
            f"extra_bearing_noise, {start.extra_bearing_noise:g} rad, is included in the learned "
            "sigma_bearing from here on"
        )
        sigma = (start.sigma_bearing**2 + start.extra_bearing_noise**2) ** 0.5
        start = start._replace(sigma_bearing=sigma, extra_bearing_noise=0.0)
    transforms.free_vector(start, names)  # raises for a start at 0
    bounds, priors = (
        {name: pair for name, pair in pairs.items() if name in names}
        for pairs in (task.bounds, task.priors)
    )
    return Learning(start, names, bounds, priors)


def _run_fit(train, held_out, config, task, seeds, steps, seed, files, resume):
    """Run the fit; if stopped, say how to resume it."""
    from jaxslam.learning.fit import fit

    try:
        with _progress_printer("learning") as progress, _without_bias_warning():
            return fit(
                train, config, task.params, task.names, held_out, task.bounds, task.priors,
                seeds=seeds, steps=steps, seed=seed, checkpoint=files["checkpoint"],
                resume=resume, progress=progress,
            )  # fmt: skip
    except KeyboardInterrupt:
        if files["checkpoint"].exists():
            warn("stopped; the same command with --resume continues from here")
        raise


@contextmanager
def _without_bias_warning():
    """Suppress Python's warning of a biased association: a note says so at the end."""
    from jaxslam.learning.likelihood import BIASED

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", re.escape(BIASED))
        yield


@contextmanager
def _progress_printer(what):
    """Give a function that shows the progress of a fit as a bar, or as lines of text."""
    with progress_bar(what, compiles=True) as show:
        if show:
            show(0, None)
        else:
            print(f"{what}: compiling… (once)", file=sys.stderr)

        def print_progress(done, total, record):
            values = ", ".join(f"{name} {value:.3g}" for name, value in record["params"].items())
            text = f"loss {record['loss']:.4f}, gradient {record['gradient_norm']:.2g}, {values}"
            if show:
                show(done, total, text)
            elif done % EVERY == 0 or done in (1, total):
                print(f"step {done}/{total}: {text}", file=sys.stderr)

        yield print_progress


def _assess(fit, train, held_out, seed):
    """The fit after a last Newton step, its `Uncertainty`, and what held-out logs say (or None)."""
    from jaxslam.learning.fit import evidence
    from jaxslam.learning.report import Judged
    from jaxslam.learning.uncertainty import assess, improve

    with progress_bar("standard errors", compiles=True):
        errors = assess(fit, train, seed=seed + 1)
    fit = improve(fit, errors)
    if not held_out:
        return fit, errors, None
    with progress_bar("held-out logs", compiles=True):
        fresh = seed + 7919
        both = (evidence(held_out, fit.config, p, FRESH, fresh) for p in (fit.start, fit.params))
        return fit, errors, Judged(*both)


def _write(fit, errors, task, files):
    """Write the parameters, the table of steps and their figure."""
    from jaxslam.learning import report as learn_report
    from jaxslam.parameter_file import save_params

    standard = learn_report.standard_errors(errors)
    # Rounding of the free scale may move a value beyond its bound.
    at_bound = {n: min(max(getattr(fit.params, n), a), b) for n, (a, b) in task.bounds.items()}
    params = fit.params._replace(**at_bound)
    with progress_bar("writing"):
        save_params(files["params"], params, standard, task._replace(params=params))
        learn_report.save_csv(files["csv"], fit)
        learn_report.save_figure(learn_report.draw_learning(fit, errors), files["figure"])


def _print_fit(fit, errors, judged, dropped, files):
    """Print the results; returns whether there were warnings."""
    from jaxslam.learning import report as learn_report

    print(learn_report.table(fit, errors))
    for line in learn_report.describe(fit, errors, judged):
        print(line)
    print(files["csv"], files["figure"], files["params"], sep="\n")
    print(f"map with it: jaxslam run LOG --sensor {fit.config.sensor} --params {files['params']}")
    for line in learn_report.advice(fit, errors, judged):
        note(line)
    flags = learn_report.flags(fit, errors, judged, dropped)
    for line in flags:
        warn(line)
    return bool(flags)
