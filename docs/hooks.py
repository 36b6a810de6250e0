"""Generated parts of the documentation site, put in place of `<!-- generated: KIND [ARGUMENT] -->`.

They are made from the program itself, so that they cannot go stale: the table of parameters, the
command line, the lists of public names and of modules, and pages kept at the repository's root.
"""

import ast
import math
import re
from pathlib import Path

import jaxslam
from jaxslam.config import SENSORS
from jaxslam.parameters import PARAMETERS, default_params

ROOT = Path(__file__).resolve().parents[1]
MARKER = re.compile(r"^<!-- generated: ([\w-]+) ?([\w./,]*) -->$", re.MULTILINE)


def on_page_markdown(markdown, **_):
    """Called by mkdocs with the text of every page."""
    return MARKER.sub(lambda found: MAKERS[found[1]](found[2]), markdown)


def parameter_table(_=""):
    """A row for each of `PARAMETERS`: defaults by sensor, unit, range, likelihoods, meaning."""
    head = ("Parameter", *SENSORS, "Unit", "Allowed", "Learned by")
    lines = [_row((*head, "Meaning")), "|---|" + "--:|" * len(SENSORS) + "---|" * 4]
    defaults = [default_params(sensor) for sensor in SENSORS]
    for row in PARAMETERS:
        values = (_number(getattr(params, row.name)) for params in defaults)
        former = row.former and f"in version 0.1 `{row.former}`"
        meaning = "; ".join(filter(None, (row.meaning, row.note, former)))
        learned = "sensor" if row.learned_by == SENSORS else ", ".join(row.learned_by)
        lines.append(_row((f"`{row.name}`", *values, row.unit, _allowed(row), learned, meaning)))
    return "\n".join(lines)


def _row(cells):
    return f"| {' | '.join(cells)} |"


def _number(value):
    return {math.pi: "pi", -math.pi: "-pi"}.get(value, f"{value:g}")


def _allowed(row):
    """The range of a parameter in words."""
    low, high = _number(row.low), _number(row.high)
    if row.high < math.inf:
        return f"{low} to {'below ' if row.below_high else ''}{high}"
    if row.low > -math.inf:
        return f"above {low}" if row.above_low else f"{low} or more"
    return "any"


def command_line(_=""):
    """Every command with its help, as cyclopts writes it, each example in a block of its own."""
    from jaxslam.cli.main import app

    text = app.generate_docs(heading_level=1)
    text = text[text.index("\n## ", text.index("**Commands**")) :]
    text = "\n".join(sorted(re.split(r"\n(?=## )", text)))
    text = re.sub(r", --no-[\w-]+", "", text)  # the program has no such options
    text = re.sub(r"jaxslam ((?:[a-z]+ )+)\1", r"jaxslam \1", text)
    example = re.compile(r"^Example: (jaxslam .*(?:\n(?!\n|\*\*).+)*)", re.MULTILINE)
    text = example.sub(lambda found: f"```sh\n{' '.join(found[1].split())}\n```", text)
    return text.replace("**Parameters**:", "**Options**:")


def public_names(packages="jaxslam"):
    """A table of `jaxslam`'s public names that are defined in these modules or sub-packages."""
    packages = tuple(f"{package}." for package in packages.split(","))
    lines = ["| Name | Meaning |", "|---|---|"]
    for name, where in jaxslam._PUBLIC.items():
        module, _, attribute = where.partition(":")
        if not f"jaxslam.{module}.".startswith(packages):
            continue
        target = f"jaxslam.{module}.{attribute}".rstrip(".")
        sentence = _first_sentence(f"jaxslam.{module}", attribute)
        lines.append(_row((f"[`jaxslam.{name}`][{target}]", sentence)))
    return "\n".join(lines) if len(lines) > 2 else "None of the names of `jaxslam` itself."


def _first_sentence(module, name):
    tree = ast.parse(_source(module).read_text(encoding="utf-8"))
    nodes = [node for node in tree.body if getattr(node, "name", None) == name] if name else [tree]
    text = " ".join((ast.get_docstring(nodes[0]) or "").split("\n\n")[0].split())
    return re.split(r"(?<=[.:]) (?=[A-Z`])", text)[0].rstrip(":").replace("|", "&#124;")


def _source(module):
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def modules(name):
    """Directives of mkdocstrings: the module, or the package's modules, public ones first."""
    folder = ROOT / name.replace(".", "/")
    if not folder.is_dir():
        return f"::: {name}\n"
    public = {f"jaxslam.{where.partition(':')[0]}" for where in jaxslam._PUBLIC.values()}
    paths = (path for path in folder.rglob("*.py") if ast.parse(path.read_text("utf-8")).body[1:])
    found = (".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths)
    found = [module.removesuffix(".__init__") for module in found]
    return "\n".join(f"::: {m}\n" for m in sorted(found, key=lambda m: (m not in public, m)))


def root_file(name):
    """A page kept at the repository's root, its links seen from `docs/`."""
    return (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")


MAKERS = {
    "parameters": parameter_table,
    "command-line": command_line,
    "public-names": public_names,
    "modules": modules,
    "file": root_file,
}
