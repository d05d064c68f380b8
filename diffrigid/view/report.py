"""A report of fits as one self-contained HTML file: tables, players, charts, text.

    write_report("report.html", "Title", "What this is.", [Section(title="...", player=play(...))])

Everything is drawn from numbers: charts are SVG made here, players are those of `play`, each in a frame of its own.
Colours follow the light or dark scheme of the browser (`report.css`).
"""

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from diffrigid.tables import as_html, digits, labels
from diffrigid.view.play import POLICY, Player

HEADER = ("parameter", "value", "95 % interval", "unit", "truth or published value")
WIDTH, HEIGHT = 460, 250  # [px] of a chart
LEFT, RIGHT, TOP, BOTTOM = 56, 12, 30, 42  # [px] its margins

Row = tuple[str, ...]


@dataclass(frozen=True)
class Section:
    """One part of a report, in the order in which it is shown."""

    title: str
    paragraphs: Sequence[str] = ()
    notes: Sequence[str] = ()  # a list, after the paragraphs
    table: Sequence[Row] = ()
    header: Row = HEADER
    player: Player | None = None
    charts: Sequence[str] = ()  # SVG, from `chart` and `matrix`
    details: Mapping[str, str] | None = None  # summary -> HTML, folded away


@dataclass(frozen=True)
class Curve:
    """Points, or a line, of a chart; NaN is skipped."""

    x: np.ndarray
    y: np.ndarray
    name: str = ""  # of the legend; "" is not listed
    colour: int = 0  # 0 to 2; 3 is grey
    points: bool = False


def write_report(path: str | Path, title: str, lead: str, sections: Sequence[Section]) -> Path:
    """Write the file and return its path. Text is escaped; charts and details are put in as they are."""
    style = (files(__package__) / "report.css").read_text(encoding="utf-8")
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<style>\n{style}</style></head>\n<body><main>\n<h1>{html.escape(title)}</h1>\n"
        f'<p class="lead">{html.escape(lead)}</p>\n' + "".join(map(_section, sections)) + "</main></body></html>\n"
    )
    path = Path(path)
    path.write_text(page, encoding="utf-8")
    return path


def row(name: str, values: Sequence[float] | np.ndarray, unit: str, reference: str) -> Row:
    """One row of a table: value, low, high with enough digits to show the interval to two places."""
    v, l, h = (float(number) for number in values)
    places = digits(v, l, h, 2)
    value, low, high = (f"{number:#.{places}g}".rstrip(".") for number in (v, l, h))
    return name, value, f"{low} to {high}", unit, reference


def chart(
    title: str, x_label: str, y_label: str, series: Sequence[Curve], events: Sequence[float] = (), margin: float = 0.0
) -> str:
    """Draw a chart as SVG: axes with ticks, lines and points, a legend above.

    Args:
        events: x of dashed lines across.
        margin: of the range of x, left free on both sides.
    """
    x_range = _range([s.x[np.isfinite(s.y)] for s in series], margin)
    y_range = _range([s.y for s in series], 0.06)
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM

    def place(x, y):
        across = LEFT + (right - LEFT) * (x - x_range[0]) / (x_range[1] - x_range[0])
        return across, bottom - (bottom - TOP) * (y - y_range[0]) / (y_range[1] - y_range[0])

    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">',
        _text("title", LEFT, 14, title, "start"),
        *_axes(place, x_range, y_range, (right, bottom)),
        _text("label", (LEFT + right) / 2, HEIGHT - 6, x_label, "middle"),
        f'<g transform="translate(13 {(TOP + bottom) / 2}) rotate(-90)">{_text("label", 0, 0, y_label, "middle")}</g>',
        *(f'<path class="event" d="M{place(x, 0)[0]:.1f} {TOP}V{bottom}"/>' for x in events),
        *(_marks(s, place) for s in series),
        _legend(series, right),
    ]
    return "".join(parts) + "</svg>\n"


def matrix(title: str, names: Sequence[str], values: np.ndarray) -> str:
    """Draw a square matrix of numbers from -1 to 1 as SVG, stronger for larger ones; colour 0 above zero, 1 below."""
    count, left = len(names), min(12 + 6.5 * max(map(len, names)), 0.45 * WIDTH)
    cell = min(46.0, (WIDTH - left - RIGHT) / count)
    height = TOP + cell * count + 24
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {height:.0f}" role="img" aria-label="{html.escape(title)}">',
        _text("title", 0, 14, title, "start"),
    ]
    for i, name in enumerate(names):
        y = TOP + cell * i
        parts.append(_text("tick", left - 8, y + 0.5 * cell + 4, name, "end"))
        parts.append(_text("tick", left + cell * (i + 0.5), TOP + cell * count + 14, str(i + 1), "middle"))
        for j in range(i + 1):
            x, value = left + cell * j, float(values[i, j])
            box = f'x="{x:.1f}" y="{y:.1f}" width="{cell - 1:.1f}" height="{cell - 1:.1f}"'
            parts.append(f'<rect class="c{int(value < 0)}" fill-opacity="{0.7 * abs(value):.2f}" {box}/>')
            if cell > 26:
                parts.append(_text("label", x + 0.5 * cell, y + 0.5 * cell + 4, f"{value:.2f}", "middle"))
    return "".join(parts) + "</svg>\n"


def _section(section: Section) -> str:
    parts = [f"<section><h2>{html.escape(section.title)}</h2>\n"]
    if section.table:
        parts.append(f'<div class="wide">{as_html(section.header, section.table)}</div>\n')
    if section.player is not None:
        parts.append(f"<figure>{section.player._repr_html_()}</figure>\n")
    parts += [f"<p>{html.escape(paragraph)}</p>\n" for paragraph in section.paragraphs]
    if section.notes:
        parts.append("<ul>" + "".join(f"<li>{html.escape(note)}</li>\n" for note in section.notes) + "</ul>\n")
    if section.charts:
        parts.append('<div class="charts">\n' + "".join(section.charts) + "</div>\n")
    for summary, content in (section.details or {}).items():
        parts.append(f"<details><summary>{html.escape(summary)}</summary>\n")
        parts.append(f'<div class="wide">{content}</div></details>\n')
    return "".join(parts) + "</section>\n"


def _range(columns: Sequence[np.ndarray], margin: float) -> tuple[float, float]:
    values = np.concatenate([np.ravel(column) for column in columns])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    pad = margin * (high - low) if high > low else 1.0
    return low - pad, high + pad


def _ticks(low: float, high: float) -> np.ndarray:
    """About five round numbers between two numbers."""
    raw = (high - low) / 5
    unit = 10 ** np.floor(np.log10(raw))
    step = unit * next(factor for factor in (1, 2, 5, 10) if factor * unit >= raw)
    return step * (np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) + 0.0)  # + 0: not -0


def _axes(place, x_range, y_range, corner) -> list[str]:
    """Grid, tick labels, and the zero line where there is one."""
    right, bottom = corner
    parts = []
    ticks = _ticks(*x_range)
    for tick, label in zip(ticks, labels(ticks), strict=True):
        x, _ = place(tick, y_range[0])
        parts.append(f'<path class="grid" d="M{x:.1f} {TOP}V{bottom}"/>')
        parts.append(_text("tick", x, bottom + 14, label, "middle"))
    ticks = _ticks(*y_range)
    for tick, label in zip(ticks, labels(ticks), strict=True):
        _, y = place(x_range[0], tick)
        kind = "grid zero" if abs(tick) < 1e-12 else "grid"
        parts.append(f'<path class="{kind}" d="M{LEFT} {y:.1f}H{right}"/>')
        parts.append(_text("tick", LEFT - 6, y + 3.5, label, "end"))
    return parts


def _marks(series: Curve, place) -> str:
    """Circles, or a line that is broken at NaN."""
    known = np.isfinite(series.x) & np.isfinite(series.y)
    x, y = place(series.x, series.y)
    if series.points:
        circles = [f'<circle cx="{x[i]:.1f}" cy="{y[i]:.1f}" r="2.2"/>' for i in np.flatnonzero(known)]
        return f'<g class="c{series.colour}">{"".join(circles)}</g>'
    begins = known & ~np.concatenate([[False], known[:-1]])
    path = "".join(f"{'M' if begins[i] else 'L'}{x[i]:.1f} {y[i]:.1f}" for i in np.flatnonzero(known))
    return f'<path class="line c{series.colour}" d="{path}"/>'


def _legend(series: Sequence[Curve], right: float) -> str:
    """Names of the series and their marks, at the top right."""
    named = [(f"c{s.colour}", "●" if s.points else "—", html.escape(s.name)) for s in series if s.name]
    spans = "&#160;&#160; ".join(f'<tspan class="mark {kind}">{mark}</tspan> {name}' for kind, mark, name in named)
    return f'<text class="tick" x="{right}" y="14" text-anchor="end">{spans}</text>'


def _text(kind: str, x: float, y: float, text: str, anchor: str) -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(text)}</text>'
