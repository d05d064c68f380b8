"""What a name that does not exist may have meant, and how a record is written."""

import dataclasses
import difflib
import functools
from collections.abc import Iterable
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


def nearest(name: str, names: Iterable[str]) -> str:
    """Text that lists the names most similar to one that does not exist."""
    near = difflib.get_close_matches(str(name), sorted(names), n=3, cutoff=0.4)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else f"there are {', '.join(sorted(names))}"


def in_words(cls: Class) -> Class:
    """Make a dataclass say what is wrong with the names and places of its arguments, by a TypeError."""
    made: Any = cls
    init = made.__init__

    @functools.wraps(init)
    def called(self: Any, *args: Any, **given: Any) -> None:
        try:
            init(self, *args, **given)
        except TypeError:
            problem = _wrong_call(cls, args, given)
            if problem is None:
                raise
            raise TypeError(problem) from None

    made.__init__ = called
    return cls


def _wrong_call(cls: Any, args: tuple, given: dict[str, Any]) -> str | None:
    """What is wrong with the names or places of arguments; None: nothing."""
    name, fields = cls.__name__, [field for field in dataclasses.fields(cls) if not field.name.startswith("_")]
    first, names = [field.name for field in fields if not field.kw_only], [field.name for field in fields]
    if len(args) > len(first):
        whole = ", ".join([*first, *(f"{key}=..." for key in names if key not in {*first, *given})])
        return f"{name} takes {'only ' + ', '.join(first) if first else 'nothing'} without a name: {name}({whole})"
    if twice := sorted(given.keys() & set(first[: len(args)])):
        return f"{name}: {twice[0]} is given twice, first without its name"
    if unknown := sorted(given.keys() - {*names, "_class"}):
        return f"{name} has no {unknown[0]!r}: {nearest(unknown[0], names)}"
    needed = [f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING]
    lacks = [key for key in needed if key not in {*first[: len(args)], *given}]
    return f"{name} lacks {', '.join(lacks)}: {name}({', '.join(f'{key}=...' for key in lacks)})" if lacks else None
