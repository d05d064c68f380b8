"""Read XML elements with numbers in their attributes; error messages name both."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from diffrigid.convert import largest

DEEPEST = 200  # nested elements: a limit of Python, which reads them recursively


def read_xml(path: str | Path, root: str | None) -> ElementTree.Element:
    """Root element of a file; with `root` None it may have any tag.

    Raises:
        ValueError: it is not XML, its root has another tag, or elements are nested too deeply.
    """
    try:
        found = ElementTree.parse(Path(path)).getroot()  # a Path, for a number would be an open file
    except (ElementTree.ParseError, UnicodeDecodeError, LookupError) as error:
        raise ValueError(f"{path} is not an XML file: {error}") from None
    if root is not None and found.tag != root:
        raise ValueError(f"{path} starts with <{found.tag}>: expected <{root}>")
    level = [found]
    for _ in range(DEEPEST):
        level = [child for element in level for child in element]
    if level:
        raise ValueError(f"{path}: <{level[0].tag}> is nested in {DEEPEST} elements: expected fewer; divide the chain")
    return found


class Reader:
    """The attributes of one element; those never asked for are known to be left out of the scene."""

    def __init__(self, where: str, tag: str, attributes: dict[str, str]):
        self.where = f"{where}: <{tag}{_called(attributes)}>"
        self.label = f"{tag}{_called(attributes)}"
        self.attributes, self.asked = attributes, {"name", "class"}

    def text(self, name: str, default: str | None = None) -> str | None:
        self.asked.add(name)
        return self.attributes.get(name, default)

    def word(self, name: str, default: str, *others: str) -> str:
        """Value of an attribute that must be the default or one of some others."""
        text = self.text(name, default)
        if text not in (default, *others):
            raise ValueError(f"{self.where}: {name} is {text!r}: expected one of {', '.join((default, *others))}")
        return str(text)

    def given(self, name: str) -> bool:
        return name in self.attributes

    def numbers(self, name: str, count: int, default: Iterable[float] | None = None) -> np.ndarray:
        """Value of an attribute as `count` numbers, (count,)."""
        text = self.text(name)
        if text is None:
            if default is None:
                raise ValueError(f"{self.where} has no {name}: expected {_amount(count)}")
            return np.array(list(default), float)
        values = self.some(name)
        if len(values) != count:
            raise ValueError(f"{self.where}: {name} is {text!r}: expected {_amount(count)}")
        return values

    def some(self, name: str) -> np.ndarray:
        """Value of an attribute as numbers, at least one."""
        text = self.text(name) or ""
        try:
            values = np.array([float(part) for part in text.split()])
        except ValueError:
            values = np.zeros(0)
        if not len(values) or not (np.abs(values) < largest(float)).all():
            raise ValueError(f"{self.where}: {name} is {text!r}: expected finite numbers")
        return values

    def number(self, name: str, default: float | None = None) -> float:
        return float(self.numbers(name, 1, None if default is None else [default])[0])

    def left_out(self, *ignored: str) -> list[str]:
        """Attributes that were not asked for, except `ignored` ones, which change no motion."""
        return [f"{name} of {self.label}" for name in self.attributes if name not in {*self.asked, *ignored}]


def _called(attributes: dict[str, str]) -> str:
    return f" {attributes['name']!r}" if "name" in attributes else ""


def _amount(count: int) -> str:
    return "a number" if count == 1 else f"{count} numbers"
