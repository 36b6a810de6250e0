"""Pages of the documentation, and the blocks of code in them; for the tests beside this file."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md"))
TUTORIALS = [page for page in PAGES if page.startswith("docs/tutorials/")]
HOW_TO = [page for page in PAGES if page.startswith("docs/how-to/")]


def text(page):
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page, language):
    """The blocks of a language in a page."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text(page), re.DOTALL | re.MULTILINE)


def commands(page):
    """The arguments of every `jaxslam` command in the page's blocks of sh, comments included."""
    lines = "\n".join(blocks(page, "sh")).splitlines()
    lines = [line.removeprefix("# ") for line in lines]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("jaxslam ")]
