"""The command `learn`: parameters from logged runs."""

import os
import re
import sys
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from jaxslam.cli.common import (
    DEMO,
    End,
    LogName,
    Overwrite,
    Seed,
    Sensor,
    Start,
    at_least,
    check_new,
    note,
    option,
    progress_bar,
    warn,
)
from jaxslam.config import ASSOCIATIONS

HeldOut = Annotated[
    list[str],
    Parameter(help="logs to judge by, not to learn from", consume_multiple=True, negative=()),
]
FRESH = 8  # seeds that judge
CHECKPOINT = "learn.checkpoint.npz"
EVERY = 10  # steps between two lines of progress, where there is no terminal


def learn(
    *logs: LogName,
    held_out: HeldOut = (),
    parameters: option(str, "what to learn, by commas (as --params says, or a usual choice)")
    | None = None,
    sensor: Sensor = None,
    association: option(
        Literal[ASSOCIATIONS], "drawn by particle, believe the log, or the best match (biased)"
    ) = "sampled",
    params: option(Path, "TOML file: starting values, and [learn], [bounds], [prior]")
    | None = None,
    particles: at_least("how many hypotheses of the path") = 200,
    landmarks: at_least("slots of the map (64; known: one each)") | None = None,
    window: option(float, "logs are learnt in pieces so long [s] (0: whole)") = 60.0,
    spacing: option(
        float, "use frames at least so far apart [s]: errors of close ones are alike"
    ) = 0.0,
    start: Start = 0.0,
    end: End = None,
    held_out_start: Start = 0.0,
    held_out_end: End = None,
    seeds: at_least("per log and step", 2) = 4,
    steps: at_least("at most") = 150,
    seed: Seed = 0,
    out: option(Path, "the file of parameters to write") = Path("params.toml"),
    overwrite: Overwrite = False,
    resume: option(bool, "go on where the same command was stopped") = False,
):
    """Learn noise and systematic errors from logged runs, by maximum likelihood.

    Prints start, estimate, standard error and verdict of every parameter; --out is
    for jaxslam run --params. learn.csv and learn.png beside it tell of every step.
    Held-out logs say when to stop and what was won; without them it may learn the
    noise of this log. The same log may be held out in another part:

    Example: jaxslam learn lost-in-the-woods --end 600 --held-out lost-in-the-woods
    --held-out-start 600 --parameters err_rot,err_drift,gain_rot --out fit/params.toml
    """
    files = _files(out, overwrite, resume)
    if not logs:
        raise ValueError(f"learn: which log? There is {DEMO}, for one")
    _check_apart(logs, (start, end), held_out, (held_out_start, held_out_end))
    _use_all_cores()
    from jaxslam.learning.data import config_for_logs

    with progress_bar("reading"):
        known = association == "known"
        train = _windows(logs, start, end, window, spacing, known)
        judges = _windows(held_out, held_out_start, held_out_end, window, spacing, known)
        config, dropped = config_for_logs(train + judges, sensor, association, particles, landmarks)
        task = _task(train, config, params, parameters)
    out.parent.mkdir(parents=True, exist_ok=True)
    fit = _run_fit(train, judges, config, task, seeds, steps, seed, files, resume)
    fit, errors, judged = _assess(fit, train, judges, seed)
    _write(fit, errors, task, files)
    found = _print_fit(fit, errors, judged, dropped, files)
    files["checkpoint"].unlink(missing_ok=True)
    return int(found)


def _files(out, overwrite, resume):
    """Paths of what is written, by name; refuses those that are there."""
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
            f"{files['checkpoint']}: a fit was stopped here; --resume goes on, "
            "--overwrite begins anew"
        )
    if resume and not files["checkpoint"].exists():
        raise ValueError(f"{files['checkpoint']}: is not there; begin without --resume")
    return files


def _check_apart(logs, part, held_out, held_part):
    """Refuse to judge by what was learnt from."""
    far = float("inf")
    (a, b), (c, d) = ((s, far if e is None else e) for s, e in (part, held_part))
    both = {str(Path(log).resolve()) for log in logs} & {str(Path(h).resolve()) for h in held_out}
    if both and max(a, c) < min(b, d):
        name = Path(min(both)).name
        raise ValueError(
            f"{name}: learnt from and held out; part it by --end and --held-out-start, for example"
        )


def _use_all_cores():
    """A device for each core, which the work is shared out over."""
    import jax

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    with suppress(RuntimeError):  # a process that has computed already keeps its devices
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
    """`paramfile.Learning`: where to start, what to learn, in which bounds, with which priors."""
    from jaxslam.learning import fit, likelihood, transforms
    from jaxslam.parameter_file import Learning, load_learning
    from jaxslam.parameters import TABLE, default_params

    base = default_params(config.sensor, train[0])
    for log in train:
        if default_params(config.sensor, log) != base:
            warn(f"{log.name}: declares other values than {train[0].name}, whose are used")
            break
    told = load_learning(path, base) if path else Learning(base, None, {}, {})
    start, names = told.params, told.names
    if parameters:
        names = tuple(name.strip() for name in parameters.split(","))
    if names is None:  # what starts at 0 has no logarithm; who wants it learnt names it
        names = fit.default_names(config)
        names = tuple(n for n in names if getattr(start, n) > 0 or TABLE[n].scale == "linear")
    if len(set(names)) < len(names):
        raise ValueError(f"--parameters: {', '.join(names)}; name each once")
    with _without_clip_warning():
        likelihood.check(config, names=names)
    if "sigma_bearing" in names and start.extra_bearing_noise:
        note(
            f"extra_bearing_noise, {start.extra_bearing_noise:g} rad, becomes a part of sigma_bearing: it is learnt"
        )
        both = (start.sigma_bearing**2 + start.extra_bearing_noise**2) ** 0.5
        start = start._replace(sigma_bearing=both, extra_bearing_noise=0.0)
    transforms.free_vector(start, names)  # refuses a start at 0
    mine = [
        {name: pair for name, pair in pairs.items() if name in names}
        for pairs in (told.bounds, told.priors)
    ]
    return Learning(start, names, *mine)


def _run_fit(train, judges, config, task, seeds, steps, seed, files, resume):
    """The fit; a stopped one says how to go on."""
    from jaxslam.learning.fit import fit

    try:
        with _progress_printer("learning") as progress, _without_clip_warning():
            return fit(
                train, config, task.params, task.names, judges, task.bounds, task.priors,
                seeds=seeds, steps=steps, seed=seed, checkpoint=files["checkpoint"],
                resume=resume, progress=progress,
            )  # fmt: skip
    except KeyboardInterrupt:
        if files["checkpoint"].exists():
            warn("stopped; the same command with --resume goes on from here")
        raise


@contextmanager
def _without_clip_warning():
    """No warning of Python's about an association that biases: a line says so in the end."""
    from jaxslam.learning.likelihood import BIASED

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", re.escape(BIASED))
        yield


@contextmanager
def _progress_printer(what):
    """A function for the progress of a fit: a bar, or a line now and then."""
    with progress_bar(what, compiles=True) as show:
        if show:
            show(0, None)
        else:
            print(f"{what}: compiling… (once)", file=sys.stderr)

        def tell(done, total, record):
            values = ", ".join(f"{name} {value:.3g}" for name, value in record["params"].items())
            text = f"loss {record['loss']:.4f}, gradient {record['gradient_norm']:.2g}, {values}"
            if show:
                show(done, total, text)
            elif done % EVERY == 0 or done in (1, total):
                print(f"step {done}/{total}: {text}", file=sys.stderr)

        yield tell


def _assess(fit, train, judges, seed):
    """The fit after a last Newton step, its `Uncertainty`, and what held-out logs say (or None)."""
    from jaxslam.learning.fit import evidence
    from jaxslam.learning.report import Judged
    from jaxslam.learning.uncertainty import assess, improve

    with progress_bar("standard errors", compiles=True):
        errors = assess(fit, train, seed=seed + 1)
    fit = improve(fit, errors)
    if not judges:
        return fit, errors, None
    with progress_bar("judging", compiles=True):
        fresh = seed + 7919
        both = (evidence(judges, fit.config, p, FRESH, fresh) for p in (fit.start, fit.params))
        return fit, errors, Judged(*both)


def _write(fit, errors, task, files):
    """Write the parameters, the steps' table and their figure."""
    from jaxslam.learning import report as learn_report
    from jaxslam.parameter_file import save_params

    standard = learn_report.standard_errors(errors)
    # From the free scale and back, a value at its bound may be a rounding beyond it.
    at_bound = {n: min(max(getattr(fit.params, n), a), b) for n, (a, b) in task.bounds.items()}
    params = fit.params._replace(**at_bound)
    with progress_bar("writing"):
        save_params(files["params"], params, standard, task._replace(params=params))
        learn_report.save_csv(files["csv"], fit)
        learn_report.save_figure(learn_report.draw_learning(fit, errors), files["figure"])


def _print_fit(fit, errors, judged, dropped, files):
    """Print what was found; whether there were warnings."""
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
