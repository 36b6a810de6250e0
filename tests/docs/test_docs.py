"""The documentation names code and tests: they must exist, and nothing may be missing."""

import ast
import functools
import importlib.util
import math
import re

import pytest
from pages import PAGES, ROOT, text

from jaxslam.config import ASSOCIATIONS, PROPOSALS, SENSORS, Config
from jaxslam.parameters import TABLE, Params, default_params

CONCEPTS = ("equations", "filter-step", "images", "smoothing", "score-and-gradients")
CONCEPTS = tuple(f"docs/concepts/{name}.md" for name in CONCEPTS)
REFERENCE = re.compile(r"`([\w./-]+\.py):([\w.]+)`")


@functools.cache
def names(path):
    """What a file defines at its top level, and its classes' methods as Class.method."""
    found = set()
    for node in ast.parse((ROOT / path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            inner = [n.name for n in node.body if isinstance(n, ast.FunctionDef)]
            found |= {f"{node.name}.{name}" for name in inner}
        if isinstance(node, ast.Assign):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return found


def exists(path, name):
    return (ROOT / path).is_file() and name in names(path)


def test_the_concepts_name_their_code():
    for page in CONCEPTS:
        assert len(REFERENCE.findall(text(page))) >= 10, page


@pytest.mark.parametrize("page", [*PAGES, "README.md", "CONTRIBUTING.md"])
def test_every_name_mentioned_exists(page):
    references = REFERENCE.findall(text(page))
    assert [f"{path}:{name}" for path, name in references if not exists(path, name)] == []


def test_the_check_finds_what_is_missing():
    assert exists("jaxslam/config.py", "Config.paper")
    assert not exists("jaxslam/config.py", "Config.thesis")
    assert not exists("jaxslam/nothing.py", "run")
    assert not exists("jaxslam/filter/step.py", "fastslam")


@pytest.mark.parametrize("page", [*PAGES, "README.md", "CONTRIBUTING.md"])
def test_files_mentioned_exist(page):
    files = re.findall(r"`((?:\w[\w.-]*/)+[\w.-]+\.(?:py|md))`", text(page))
    assert [f for f in files if not (ROOT / f).is_file()] == []


def rows():
    """The tables' rows, as lists of cells."""
    lines = [
        line for line in text("docs/concepts/equations.md").splitlines() if line.startswith("| ")
    ]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_equation_and_section_has_its_row():
    starts = [row[0] for row in rows()]
    for key in [f"({i})" for i in range(1, 8)]:
        assert sum(start.startswith(key) for start in starts) == 1, key
    for key in ("III-A", "III-B-1", "III-B-2", "III-B-3", "III-B-4", "III-C", "III-D", "IV-A",
                "IV-B", "IV-C", "V "):  # fmt: skip
        assert any(start.startswith(key) for start in starts), key


def test_what_is_built_has_code_and_a_test_and_what_is_not_says_so():
    for row in rows():
        if row[0] in ("Equation", "Section"):
            continue
        code, tests = row[-2], row[-1]
        if REFERENCE.search(code):
            references = REFERENCE.findall(tests)
            assert references, row[0]
            assert all(p.startswith("tests/") and n.startswith("test_") for p, n in references)
        else:
            assert "not in this version" in code and not tests, row[0]


def test_the_step_explains_every_parameter_and_switch():
    page = text("docs/concepts/filter-step.md")
    switches = [f for f in Config.__dataclass_fields__ if f != "block"]
    sizes = {"particles", "landmarks", "measurements", "sensor", "association"}
    words = set(re.findall(r"`(\w+)`", page))
    assert set(Params._fields) - words == set()
    assert set(switches) - sizes - words == set()
    assert {*SENSORS, *ASSOCIATIONS, *PROPOSALS} <= words


def hooks():
    """The module of the documentation's generated parts."""
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs/hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_defaults_are_the_tables():
    number = re.compile(r"[-+\d.e]+|-?pi")
    assert "<!-- generated: parameters -->" in text("docs/reference/parameters.md")
    lines = hooks().parameter_table().splitlines()
    head, _, *body = [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in lines]
    table = {row[0]: dict(zip(head, row, strict=True)) for row in body}
    assert tuple(table) == Params._fields  # in their order
    assert {name: row["Unit"] for name, row in table.items()} == {
        name: row.unit for name, row in TABLE.items()
    }
    for sensor in SENSORS:
        told = {name: row[sensor] for name, row in table.items()}
        assert all(map(number.fullmatch, told.values()))
        values = {k: float(v.replace("pi", str(math.pi))) for k, v in told.items()}
        assert values == default_params(sensor)._asdict(), sensor


def test_every_marker_of_the_pages_is_known():
    made = hooks()
    for page in PAGES:
        markers = re.findall(r"^<!-- generated.*$", text(page), re.MULTILINE)
        assert all(map(made.MARKER.fullmatch, markers)), page
        assert "<!-- generated" not in made.on_page_markdown(text(page)), page


def test_the_command_line_page_has_every_command():
    page = hooks().command_line()
    heads = re.findall(r"^#+ (jaxslam .*)$", page, re.MULTILINE)
    for name in ("run", "learn", "simulate planar", "simulate room", "calibrate sensor", "plot"):
        assert f"jaxslam {name}" in heads
    assert "--no-overwrite" not in page
    assert "```sh\njaxslam demo\n```" in page


def test_the_python_page_has_every_public_name():
    import jaxslam

    page = hooks().public_names("jaxslam")
    assert set(re.findall(r"^\| \[`jaxslam\.(\w+)`\]", page, re.MULTILINE)) == set(jaxslam.__all__)
