"""Shared by the commands: declaration of options, progress, messages, errors and exit codes."""

import os
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import CycloptsError, Parameter
from cyclopts.validators import Number

from jaxslam.config import SENSORS
from jaxslam.files import NO_SPACE
from jaxslam.runs import cluster

DEMO = "lost-in-the-woods"
FULL, BUSY = 74, 75  # exit codes: no space left; the folder is in use


def option(kind, text, group=(), **more):
    """Type of an option with its help text; `group`: heading in the help (none: the first)."""
    more |= {"group": group} if group else {}
    return Annotated[kind, Parameter(help=text, **more)]


def at_least(text, least=1, most=10**9, group=()):
    """`option` for a whole number from `least` to `most`."""
    return option(int, text, group, validator=Number(gte=least, lte=most))


def show_default(value):
    """Text of a default in the help: none for what is off or empty."""
    return None if value is None or value is False or value == () else str(value)


Seed = at_least("Seed of the random numbers; the same seed gives the same result.", 0, 2**32 - 1)
LogName = option(str, f"Log to read: a .npz file, or {DEMO}.")
Overwrite = option(bool, "Replace existing output.")
Sensors = Literal[SENSORS]
Sensor = option(Sensors, "Measurements to use (default: the first kind that the log has).") | None
START = "Use the log from this time on, in seconds after its start."
END = "Use the log up to this time, in seconds after its start (default: to its end)."
Start = option(float, START)
End = option(float, END) | None
OutLog = option(Path, "Log to write, a .npz file.")
ParamFile = option(Path, "TOML file of parameters; those not in it keep their defaults.") | None
PAPER = "Follow the paper: position measurements, each matched by itself, no clutter."


@contextmanager
def progress_bar(what, compiles=False, shown=True):
    """Show a progress bar on stderr.

    Yields a function of (done, total, text to show), where `total` may be None (unknown), or None
    if stderr is not a terminal. `compiles`: until the first unit is done, JAX compiles.
    """
    if not (shown and sys.stderr.isatty()):
        yield None
        return
    from rich import console, progress

    with progress.Progress(console=console.Console(stderr=True), transient=True) as display:
        bar = display.add_task(what, total=None)

        def show(done, total, detail=""):
            detail = "compiling… (once)" if compiles and not done else detail
            text = f"{what}: {detail}" if detail else what
            length = total if done else None  # None: the bar pulses
            display.update(bar, description=text, completed=done, total=length, refresh=True)

        yield show


def check_new(out, overwrite, what="a log", suffix=".npz"):
    """Raise `ValueError` for an output path with another suffix, in use, or without a folder."""
    if out.suffix != suffix:
        raise ValueError(f"{out}: {what} is a {suffix} file; name it like {out.stem}{suffix}")
    if out.exists() and not overwrite:
        raise ValueError(f"{out}: exists; choose another name or add --overwrite")
    if not out.parent.is_dir():
        raise ValueError(f"{out}: cannot write: there is no folder {out.parent}")


def warn(text):
    print(f"warning: {text}", file=sys.stderr)


def note(text):
    print(f"note: {text}", file=sys.stderr)


def run_command(command, at_once=False):
    """Call a command, print an error as one line on stderr, and return the exit code.

    `at_once`: end the process directly after an interrupt.
    """
    code = 2
    try:
        result = command()
        sys.stdout.flush()
        return result or 0
    except CycloptsError as error:
        names = " ".join(["jaxslam", *(error.command_chain or ())])
        problem = f"{error} See: {names} --help"
    except KeyboardInterrupt as error:
        print("jaxslam: interrupted" + "".join(error.args), file=sys.stderr, flush=True)
        if at_once:  # interrupted while compiling, JAX would crash at Python's exit
            os._exit(130)
        return 130
    except BrokenPipeError:  # the reader of the output has ended, e.g. `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        code = BUSY if isinstance(error, BlockingIOError) else code
        code = FULL if error.errno in NO_SPACE else code
        code = cluster.LOST if isinstance(error, ConnectionError) else code
        problem = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except ValueError as error:
        problem = str(error)
    except (MemoryError, RuntimeError) as error:
        # XLA's error of a failed allocation has no type of its own, only this status code.
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise  # a bug: show the traceback
        problem = "not enough memory; ask for fewer --particles or --landmarks"
    print("jaxslam:", problem.split("\n")[0], file=sys.stderr)
    return code
