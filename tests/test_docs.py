"""The documentation site builds without a warning, names everything that is public, and loads nothing."""

import importlib
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import diffrigid as dr

ROOT = Path(__file__).parent.parent
COMING_FROM = (ROOT / "notebooks" / "coming_from.md").read_text()
SECTIONS = re.split(r"\n## ", COMING_FROM)
ATTRIBUTES = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src", "object": "data"}


class Loads(HTMLParser):
    """What a page asks for when it is opened; not what it links to."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.addresses += [found[name] for name in [ATTRIBUTES.get(tag)] if name in found]
        self.addresses += re.findall(r"url\(([^)]*)\)", found.get("style") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder with the pages. Every warning is an error: links to functions that are not there, too."""
    for name in ("myst_nb", "furo"):
        pytest.importorskip(name, reason='the site is built by the extra: pip install -e ".[docs]"')
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", out / "trees", ROOT / "notebooks", out]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0 and not built.stderr, built.stderr
    return out


def test_every_function_that_the_pages_name_is_there():
    """Without the tools that build the site."""
    text = "".join((ROOT / "notebooks" / f"{page}.md").read_text() for page in ("equations", "inside", "coming_from"))
    named = re.findall(r"\{py:\w+\}`~?(diffrigid[\w.]*)`|auto(?:function|class):: (diffrigid[\w.]*)", text)
    for module, members in re.findall(r"automodule:: (diffrigid[\w.]*)\n +:members: (.*)", text):
        named += [(f"{module}.{member}", "") for member in members.split(", ")]
    assert len(named) > 50
    missing = [name for pair in named for name in pair if name and not found(name)]
    assert missing == []


def found(name):
    """Whether there is such a module, or such a name in one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            thing = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            thing = getattr(thing, part, None)
        return thing is not None
    return False


def test_every_public_name_has_an_entry(site):
    page = (site / "api.html").read_text()
    assert [name for name in dr.__all__ if f'id="diffrigid.{name}"' not in page] == []


def test_pages_load_nothing_from_elsewhere(site):
    pages = [*site.glob("*.html")]
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} < {page.stem for page in pages}
    for page in pages:
        loads = Loads()
        loads.feed(page.read_text())
        assert not [address for address in loads.addresses if re.match(r"\w+:|//", address)], page.name
    for style in site.rglob("*.css"):
        text = style.read_text()
        assert "@import" not in text and not re.search(r"url\(['\"]?(https?:)?//", text), style.name


def test_formulas_are_drawn_and_nothing_was_executed(site):
    page = (site / "equations.html").read_text()
    assert page.count("<math") > 50 and "$" not in re.sub(r"<(script|style).*?</\1>", "", page, flags=re.S)
    assert not [*site.rglob("reports")]


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.splitlines()[0])
def test_the_same_scene_elsewhere_gives_what_the_page_says(section):
    """Where the simulator is installed; in a process of its own, with its own settings."""
    code = "".join(re.findall(r"```python\n(.*?)```", section, flags=re.S))
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if missing := re.search(r"^(?:ModuleNotFound|Import)Error: (.*)", run.stderr, flags=re.M):
        pytest.skip(f"its simulator is not installed: {missing[1]}")
    assert run.returncode == 0, run.stderr
    said = re.findall(r"# ([\d.]+) m$", code, flags=re.M)
    printed = re.findall(r"^[\d.]+$", run.stdout, flags=re.M)
    assert said and [f"{float(height):.4f}" for height in printed] == said
