"""The table of a fit, as text and as HTML."""

import html
from typing import TYPE_CHECKING, Any

import numpy as np

from diffrigid.sysid.orders import in_words
from diffrigid.tables import as_html, digits, lined_up

if TYPE_CHECKING:
    from diffrigid.sysid.summary import Summary

HEADER = ("parameter", "value", "95 % interval", "unit", "")
BLIND = "not determined, see below"  # note of a parameter with a number that has no interval
STICKS = "larger values fit as well, see below"  # likewise of a friction that ended where what slipped sticks
ENDED = " ended where what slips begins to stick"  # behind its name, the beginning of the remark on it
ZERO = 1e-6  # [-] of an inertia: what is smaller, with its interval, is rounding
BOUND = "at its bound"  # note of a parameter that ended there
FAILED = "the fit failed"  # beginning of the note of a fit whose numbers mean nothing
FLAT = "what was measured is constant"  # beginning of the note of an exact fit of columns that do not change
LONG = "the steps are too long"  # likewise where shorter ones would change the numbers
CORRELATED = "residuals are autocorrelated"  # likewise of one that misses something
# Beginnings of notes that concern every number.
DOUBTS = (FAILED, "not converged", "the cost jumps", FLAT, LONG, CORRELATED)
TABLE_RECORDS = 3  # records whose own numbers are in the table


def rows(summary: "Summary") -> list[tuple[str, ...]]:
    """One row for every number: name, value, interval, unit, note."""
    return [row for p in summary.parameters for row in rows_of(p)]


def rows_of(p: Any) -> list[tuple[str, ...]]:
    """Rows of one parameter; if each record has its own, those of the first three, {0}, {1}, ..., or of all four."""
    out: list[tuple[str, ...]] = []
    shown = p.records if p.records <= TABLE_RECORDS + 1 else TABLE_RECORDS  # a line that hides one record saves none
    for index in np.ndindex(p.value.shape):
        if (p.records and index[0] >= shown) or _says_nothing(p, index):
            continue
        name, value, low, high, unit, note = _number(p, index)
        places = digits(value, low, high, 3)
        interval = f"{low:.{places}g} .. {high:.{places}g}"
        out.append((name, f"{value:.{places}g}", interval, unit or "-", note))
    if p.records > shown:
        out.append((p.name, "...", "", "", f"and {p.records - shown} more records"))
    return out


def _says_nothing(p: Any, index: tuple[int, ...]) -> bool:
    """Whether a number of an inertia repeats another, the matrix being symmetric, or is a zero between its axes."""
    if not p.name.endswith(".inertia") or p.value.ndim < 2:
        return False
    row, column = index[-2:]
    return row > column or bool(np.max(np.abs([p.value[index], p.low[index], p.high[index]])) < ZERO * p.value.max())


def _number(p: Any, index: tuple[int, ...]) -> tuple[str, float, float, float, str, str]:
    """Name, value, ends of the interval, unit and note of one number of a parameter."""
    record, part = (index[:1], index[1:]) if p.records else ((), index)
    name = p.name + "".join(f"{{{k}}}" for k in record) + (f"[{', '.join(map(str, part))}]" if part else "")
    value, low, high = float(p.value[index]), float(p.low[index]), float(p.high[index])
    note = "" if p.note == BLIND and np.isfinite(low) and np.isfinite(high) else p.note
    return name, value, low, high, p.unit, note


def numbers(summary: "Summary") -> list[dict[str, Any]]:
    """Every number, those of all records too, unrounded: a dictionary of parameter, value, low, high, unit, note."""
    names = ("parameter", "value", "low", "high", "unit", "note")
    doubts = doubts_of(summary)
    found = [_number(p, index) for p in summary.parameters for index in np.ndindex(p.value.shape)]
    return [
        dict(zip(names, (*number, "; ".join(filter(None, (note, *doubts)))), strict=True)) for *number, note in found
    ]


def doubts_of(summary: "Summary") -> tuple[str, ...]:
    """Beginnings of the notes that concern every number."""
    return tuple(doubt for doubt in DOUBTS if any(note.startswith(doubt) for note in summary.notes))


def below(summary: "Summary") -> list[str]:
    """Lines under the table: on the starts, the noise and the time; and on the order of impacts."""
    impacts = in_words(summary.orders, len(summary.costs))
    return [_starts(summary), *([impacts] if impacts else [])]


def _starts(summary: "Summary") -> str:
    noise = ", ".join(f"{name} {value:.3g}" for name, value in summary.noise.items())
    parts = [f"{summary.agree} of {len(summary.costs)} starts agree{_others(summary)}"]
    parts += [f"noise: {noise}"] if len(summary.noise) <= 6 else []
    return "; ".join([*parts, f"{summary.seconds:.1f} s"])


def _others(summary: "Summary") -> str:
    """Say where the starts that do not agree ended."""
    others = summary.costs[summary.agree :]
    finite = others[np.isfinite(others)]
    texts = []
    if len(finite):
        texts.append(
            f"{len(finite)} ended elsewhere, at a cost of {finite[0]:.4g} or more, the best at {summary.costs[0]:.4g}"
        )
    if len(finite) < len(others):
        texts.append(f"{len(others) - len(finite)} diverged")
    return f" ({', '.join(texts)})" if texts else ""


def summary_text(summary: "Summary") -> str:
    """The table in plain text, with the notes under it."""
    return "\n".join([*lined_up(HEADER, rows(summary)), *below(summary), *(f"! {note}" for note in summary.notes)])


def summary_html(summary: "Summary") -> str:
    """The table for a notebook."""
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in summary.notes)
    lines = "".join(f"<p>{html.escape(line)}</p>" for line in below(summary))
    return as_html(HEADER, rows(summary)) + lines + (f"<ul>{notes}</ul>" if notes else "")
