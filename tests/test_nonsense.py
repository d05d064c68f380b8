"""Arguments and files that are nonsense, as hypothesis draws them, are refused in words; see `drawn.py` for how many."""

import gc
import itertools
import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest
import test_invalid as invalid
import test_models as models
from drawn import few_or_many, for_all
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

import diffrigid as dr
from diffrigid.scene_file import read_scene

# ---- each argument of `test_invalid`, with whatever hypothesis can think of

words = st.text(st.characters(exclude_characters="\0"))  # as a path that is refused by the system, in its own words
odd_numbers = st.one_of(
    st.floats(), st.integers(), st.booleans(), st.complex_numbers(), st.sampled_from((1e300, 1e-300, 5e-324, 10**400))
)
odd_arrays = arrays(
    st.sampled_from((np.float64, np.float32, np.int32, np.bool_, np.complex128, np.dtype("U2"), np.dtype("M8[s]"))),
    array_shapes(min_dims=0, min_side=0, max_side=4),
)
odd_objects = st.one_of(
    st.none(), words, st.binary(), st.dictionaries(words, odd_numbers, max_size=2), st.sets(st.integers(), max_size=2),
    st.sampled_from((object(), dr.Disc, dr.Disc(radius=1.0), Path("nowhere"), len, Ellipsis, slice(None), np.ma.masked)),
)  # fmt: skip
some = st.one_of(odd_numbers, odd_objects, odd_arrays)
few = st.lists(some, max_size=3)
anything = st.one_of(some, few, few.map(tuple), st.lists(few, max_size=3))
SCENES_OF = invalid.SHAPES | invalid.BODIES | invalid.SCENES | invalid.FORCES | invalid.JOINTS
CHEAP = {name: entry for name, entry in SCENES_OF.items() if name != "names"}  # those, and columns, are keys of a dict
# Where what is right costs a program or a fit, nothing is drawn that could be right, as what is empty, or a function.
COSTLY = {name: entry for name, entry in invalid.TABLE.items() if name not in (*SCENES_OF, "column names")}
wrong = odd_objects.filter(lambda value: value not in (None, len, "", b"", {}))


def refuse_or_make(call, value):
    """Refused in words of the library, or made of finite numbers."""
    problem = invalid.refused(lambda: invalid.check_finite(call(value)))
    assert problem in (None, "made bool"), problem


@few_or_many
@pytest.mark.parametrize("table, values", [(CHEAP, anything), (COSTLY, wrong)], ids=["scenes", "runs"])
def test_nonsense_is_refused_in_words(table, values, count):
    tried = itertools.count(1)

    def check(drawn):
        if next(tried) % 200 == 0:  # what some of them compile fills gigabytes
            jax.clear_caches()
            gc.collect()
        name, value = drawn
        refuse_or_make(table[name][0], value)

    for_all(check, st.tuples(st.sampled_from(sorted(table)), values), 5 * count)


@few_or_many
def test_names_of_bodies_are_refused_or_read(count):
    """Whatever they are called, every path to a number of theirs leads there."""

    def check(name):
        try:
            world, state = dr.scene({name: dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.0))}, gravity=(0.0, -9.81))
        except ValueError as error:
            assert "is not a name" in str(error)
            return
        for path in dr.paths.catalogue(world):
            dr.paths.read(world, state, path)
        assert dr.paths.read(world, state, f"{name}.x[1]") == 1.0

    for_all(check, st.text(min_size=1) | st.text("ab.[]=0 ", min_size=1, max_size=6), count)


# ---- files

CSV = "t,ball.x[0],ball.x[1]\n0,1,0\n0.1,1.5,\n0.2,2,-1\n"
FILES = {
    "scene": (read_scene, invalid.SCENE),
    "fit": (dr.load_fit, json.dumps(invalid.SAVED)),
    "csv": (dr.sysid.columns.read_csv, CSV),
    "mjcf": (dr.load_mjcf, models.TREE),
    "mjcf of links": (dr.load_mjcf, models.LINKS),
    "urdf": (dr.load_urdf, models.ROBOT),
    "saved scene": (dr.load_scene, invalid.saved_scene()),
}
PIECES = (
    "3", "-1", "0 0 0", "0 0 0 0 0 0", "1e300", "1e-300", "nan", "inf", '"a"', "[]", "{}", "null", "=", "\n", "-", "<a>",
    "/>", "é", "\0", "joint", "body",
)  # fmt: skip


@st.composite
def spoiled(draw, text):
    """Bytes of a file that is cut short, of which some pieces are left out, or that has others in their place."""
    for _ in range(draw(st.integers(1, 3))):
        ends = [match.end() - 1 for match in re.finditer(r"\w+|[^\w\s]", text)]  # of words
        places = ends if draw(st.booleans()) else range(len(text))
        a = draw(st.sampled_from(places)) + 1 if places else 0
        b = a + draw(st.integers(0, 12))
        piece = draw(st.sampled_from(("", *PIECES)) | st.text(max_size=3))
        text = text[:a] if draw(st.integers(0, 3)) == 0 else text[:a] + piece + text[b:]
    data = text.encode()
    return data[: draw(st.sampled_from((len(data), len(data) - 1)))]


@few_or_many
@pytest.mark.parametrize("kind", FILES)
def test_spoiled_files_are_refused_or_read(kind, count, tmp_path):
    read, text = FILES[kind]
    path = tmp_path / "file"

    def finite(path):
        made = read(path)
        made = (made.world, made.state) if kind == "scene" else made
        return made if kind in ("fit", "csv") else invalid.check_finite(made)  # a column may have gaps

    path.write_text(text)
    assert invalid.refused(finite, path).startswith("made")

    def check(data):
        path.write_bytes(data)
        problem = invalid.refused(finite, path)
        assert problem is None or problem.startswith("made"), problem

    for odd in (b"\xff\xfe\x00", b"a = " + b"[" * 10**5, b"[" * 10**5):
        check(odd)
    for_all(check, spoiled(text), 2 * count)


@few_or_many
@pytest.mark.parametrize("kind", FILES)
def test_paths_to_nothing_are_refused(kind, count, tmp_path):
    def check(path):
        path = tmp_path / "nowhere" / path if isinstance(path, str) else path
        with pytest.raises((OSError, TypeError, ValueError)):
            FILES[kind][0](path)

    for_all(check, words | odd_numbers | odd_objects.filter(lambda value: not isinstance(value, bytes | str)), count)
