"""Notebooks as they are committed; and run afresh: the first one, the others where slow tests are."""

import ast
import json
import re
from pathlib import Path

import pytest

BOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
ALLOWED = {"diffrigid", "jax", "matplotlib", "numpy", "time"}
LIMIT = 300  # [kB]
SECONDS = 600  # for one cell, on a machine that is busy


def cells(path, kind):
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


def source(cell):
    return "".join(cell["source"])


def test_there_are_notebooks():
    assert len(BOOKS) >= 8


def imported(code):
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module


each = pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)


@each
def test_it_asks_a_question_and_answers_in_prose(path):
    code, prose = cells(path, "code"), cells(path, "markdown")
    first = source(prose[0]).splitlines()[0]
    assert first.startswith("# ") and first.endswith("?")
    assert 5 <= len(code) <= 12
    assert len(prose) >= len(code)


@each
def test_cells_are_short_and_import_only_what_the_extra_holds(path):
    for cell in cells(path, "code"):
        lines = source(cell).splitlines()
        assert len(lines) <= 25 and max(map(len, lines)) <= 100
        assert {name.split(".")[0] for name in imported(source(cell))} <= ALLOWED


@each
def test_it_is_committed_executed_and_small(path):
    code = cells(path, "code")
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert not [o for o in outputs if o["output_type"] == "error" or o.get("name") == "stderr"]
    assert any("image/png" in o.get("data", {}) for o in outputs), "a figure"
    assert any(re.search(r"\d", "".join(o.get("text", ""))) for o in code[-1]["outputs"]), "a number at the end"
    assert path.stat().st_size < 1000 * LIMIT


@each
def test_it_says_nothing_of_the_machine(path):
    outputs = [output for cell in cells(path, "code") for output in cell["outputs"]]
    shown = ["".join(o.get("text", o.get("data", {}).get("text/plain", ""))) for o in outputs]
    said = [*shown, *map(source, cells(path, "code")), *map(source, cells(path, "markdown"))]
    assert not [text for text in said if re.search(r"(^|[\s\"'=(])/[A-Za-z]+/", text)], "an absolute path"
    metadata = json.loads(path.read_text())["metadata"]
    assert metadata["kernelspec"]["name"] == "python3"
    assert not [cell for cell in cells(path, "code") if "execution" in cell["metadata"]], "times of execution"


def slow_but_the_first(number, path):
    return pytest.param(path, marks=[pytest.mark.slow] if number else [], id=path.stem)


@pytest.mark.parametrize("path", [slow_but_the_first(number, path) for number, path in enumerate(BOOKS)])
def test_it_runs(path):
    """Needs the extra `notebook`. All of them take about eight minutes."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    book = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(book, timeout=SECONDS, kernel_name="python3").execute()
