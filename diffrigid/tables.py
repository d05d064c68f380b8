"""Tables of numbers with intervals, as text and as HTML."""

import html
from collections.abc import Sequence

import numpy as np


def digits(value: float, low: float, high: float, least: int) -> int:
    """Number of significant digits that show the width of an interval to two places, at least `least`."""
    width, size = abs(high - low), max(abs(value), abs(low), abs(high))
    if not np.isfinite(width) or width == 0 or size == 0:
        return 4
    return int(np.clip(np.ceil(np.log10(size / width)) + 2, least, 12))


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
