"""Tables of numbers with intervals, as text and as HTML."""

import html
from collections.abc import Sequence

import numpy as np

LONG = 1e4  # [s] on a clock that began long ago


def digits(value: float, low: float, high: float, least: int) -> int:
    """Number of significant digits that show the width of an interval to two places, at least `least`."""
    width, size = abs(high - low), max(abs(value), abs(low), abs(high))
    if not np.isfinite(width) or width == 0 or size == 0:
        return 4
    return int(np.clip(np.ceil(np.log10(size / width)) + 2, least, 12))


def moment(t: float, least: int = 5) -> str:
    """A time [s] as text: to `least` digits, and to 0.1 ms where its clock began long ago."""
    return f"{t:.{least}g}" if abs(t) < LONG else f"{t:.4f}"


def labels(numbers: np.ndarray) -> list[str]:
    """Numbers as text, with enough digits to tell them apart, at least six."""
    span = np.ptp(numbers)
    more = np.log10(max(np.abs(numbers).max() / span, 1.0)) if span > 0 else 0.0
    return [f"{number:.{6 + int(more)}g}" for number in numbers]


def lined_up(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table with aligned columns, between rules."""
    table = [header, *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]
    rule = "-" * max(map(len, lines))
    return [lines[0], rule, *lines[1:], rule]


def as_html(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as an HTML element."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    lines = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    body = "".join(f"<tr>{line}</tr>\n" for line in lines)
    return f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table>"
