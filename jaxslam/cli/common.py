"""What the commands share: how options are declared, progress, warnings, refusing a taken name."""

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

DEMO = "lost-in-the-woods"


def option(kind, text):
    # A flag's default says nothing.
    return Annotated[kind, Parameter(help=text, show_default=False if kind is bool else None)]


def at_least(text, least=1, most=10**9):
    return Annotated[int, Parameter(help=text, validator=Number(gte=least, lte=most))]


Seed = at_least("of the random draws: the same seed, the same run", 0, 2**32 - 1)
LogName = option(str, f"a .npz file, or {DEMO}")
Overwrite = option(bool, "replace what is there")
Sensors = Literal["range_bearing", "position", "bearing"]
Sensor = option(Sensors, "what is used (the first that the log has)") | None
Start = option(float, "use the log from here on [s after its start]")
End = option(float, "use the log up to here [s after its start] (all)") | None
OutLog = option(Path, "the log to write, a .npz file")


@contextmanager
def progress_bar(what, compiles=False, shown=True):
    """A progress bar on stderr; gives a function of (done, total, text to show), or None without a
    terminal.

    `total` is None where no one knows. `compiles`: until the first is done, JAX compiles.
    """
    if not (shown and sys.stderr.isatty()):
        yield None
        return
    from rich import console, progress

    with progress.Progress(console=console.Console(stderr=True), transient=True) as shown:
        task = shown.add_task(what, total=None)

        def show(done, total, more=""):
            more = "compiling… (once)" if compiles and not done else more
            text = f"{what}: {more}" if more else what
            length = total if done else None  # None: it swings to and fro
            shown.update(task, description=text, completed=done, total=length, refresh=True)

        yield show


def check_new(out, overwrite, what="a log", suffix=".npz"):
    """Refuse a file's name that ends wrongly, is taken or in no folder, before the work is done."""
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
