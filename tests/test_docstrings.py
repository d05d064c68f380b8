"""Examples of the docstrings run, in the order of the reference, as one session; every public name has one."""

import doctest
import importlib.util
import inspect
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import diffrigid as dr

PAGE = (Path(__file__).parent.parent / "notebooks" / "api.md").read_text()
NAMES = re.findall(r"^\.\. auto(?:function|class):: (\w+)$", PAGE, flags=re.M)  # of what one imports; not of results
# What `dataclasses` and JAX describe, and what needs a crowd, in `tests/test_crowd.py`.
ELSEWHERE = {"replace", "QUICK", "missed_pairs"}
MORE = {"make_problem", "start_vector", "residual_vector", "jacobian_matrix", "first_order", "lbfgs", "best_launch"} | {
    "values_at", "missed_pairs", "fit_in_pieces", "jumps"
}  # fmt: skip


EXTRAS = {"sample": "blackjax"}  # what an example needs beside the package; where it is absent the example does not run


def examples():
    """Of every name on the page that has one, with those of its methods."""
    parser = doctest.DocTestParser()
    for name in NAMES:
        public = next(getattr(where, name) for where in (dr, dr.sysid, dr.paths) if hasattr(where, name))
        members = [part for key, part in vars(public).items() if inspect.isfunction(part) and key[0] != "_"]
        text = "\n\n".join(inspect.getdoc(part) or "" for part in (public, *members))
        example = parser.get_doctest(text, {}, name, None, 0)
        if example.examples:
            yield example


def test_every_public_name_has_one():
    assert set(dr.__all__) - {example.name for example in examples()} == ELSEWHERE
    assert set(NAMES) - {example.name for example in examples()} == MORE


def test_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session = {"dr": dr, "jax": jax, "jnp": jnp, "np": np, "Path": Path}
    runner, wrong = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS), []
    for example in examples():
        if example.name in EXTRAS and not importlib.util.find_spec(EXTRAS[example.name]):
            continue
        example.globs = session
        runner.run(example, out=wrong.append, clear_globs=False)
    assert not wrong, "".join(wrong)
