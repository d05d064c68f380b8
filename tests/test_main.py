"""The whole job of `python -m diffrigid`, once, and the parts of it that have an exact answer."""

import base64
import contextlib
import html
import io
import json
import re

import numpy as np
import pytest
from pages import Page, parsed

from diffrigid.__main__ import main
from diffrigid.data import FRAME, square_drops
from diffrigid.tables import lined_up
from diffrigid.view.report import HEADER, Curve, chart, row

PUBLISHED = {  # range that the published values of the square, and their scatter, allow
    "square: restitution": (0.35, 0.6),
    "square: friction": (0.02, 0.2),
    "square: radius of gyration": (18.0, 27.0),
    "square: height of the floor": (-4.0, 3.0),
}
MARGIN = 1.5  # half widths of a 95 % interval within which a truth has to lie: 99.7 %, with the seed fixed


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """The page, and the table by name: value, low, high, reference."""
    path, said = tmp_path_factory.mktemp("report") / "report.html", io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["--out", str(path), "--quiet"]) == 0
    table = {}
    for line in said.getvalue().splitlines():
        cells = re.split(r"\s{2,}", line)
        if line.startswith(("square:", "discs:")):
            low, high = cells[2].split(" to ")
            table[cells[0]] = (float(cells[1]), float(low), float(high), cells[4])
    assert str(path) in said.getvalue()
    return path.read_text(encoding="utf-8"), table


def test_discs_give_back_what_was_put_in(job):
    rows = {name: values for name, values in job[1].items() if name.startswith("discs")}
    assert len(rows) == 4
    for value, low, high, reference in rows.values():
        truth = float(reference)
        assert abs(truth - value) < MARGIN * (high - low) / 2
        assert high - low < 0.01 * max(abs(truth), 0.5)  # 3 mm on 1 m, 121 times


def test_square_agrees_with_what_was_published(job):
    rows = {name: values for name, values in job[1].items() if name.startswith("square")}
    assert set(rows) == set(PUBLISHED)
    for name, (value, low, high, _) in rows.items():
        assert PUBLISHED[name][0] < value < PUBLISHED[name][1]
        assert low < value < high
    assert rows["square: restitution"][1] < 0.47 < rows["square: restitution"][2]
    assert rows["square: radius of gyration"][1] < 24.5 < rows["square: radius of gyration"][2]


def test_report_is_one_closed_page_that_loads_nothing(job):
    text, page = job[0], parsed(job[0])
    assert {"table", "svg", "figure", "details"} <= set(page.tags)
    assert "nan" not in re.sub(r"(?s)<script.*?</script>", "", text).lower().split()


def table(packed):
    """Packed columns as (T, K), NaN where missing."""
    whole = np.frombuffer(base64.b64decode(packed["data"]), "<u2").reshape(-1, packed["rows"]).T
    return np.where(whole == 65535, np.nan, np.array(packed["low"]) + np.array(packed["step"]) * whole)


def test_players_show_the_fit_over_what_was_measured(job):
    """Fitted and measured centres agree to 4 mm for the square, and to 5 sigma for the discs."""
    pages = [html.unescape(page) for page in re.findall(r'srcdoc="([^"]*)"', job[0])]
    data = [re.search(r'id="data">(.*?)</script>', page, re.S)[1] for page in pages]
    players = [json.loads(part)["runs"] for part in data]
    assert [[len(run["bodies"]) for run in runs] for runs in players] == [[1] * 8, [3]]
    for runs, tolerance in zip(players, (4e-3, 15e-3), strict=True):
        for run in runs:
            (first, last, steps), (begin, end, frames) = run["t"], run["measured"]["t"]
            t, t_measured = np.linspace(first, last, steps + 1), np.linspace(begin, end, frames + 1)
            fit, seen = table(run["poses"]), table(run["measured"]["poses"])
            for column in [5 * body + axis for body in run["measured"]["bodies"] for axis in (0, 1)]:
                known = np.isfinite(seen[:, column])
                assert known.sum() > 20
                wanted = np.interp(t_measured[known], t, fit[:, column])
                np.testing.assert_allclose(wanted, seen[known, column], atol=tolerance)


def test_square_drops_fall_freely_after_the_impact():
    """In metres and seconds: over the last 15 frames, a = -g - drag v; and the spin is steady, in radians."""
    record = square_drops()
    assert len(record.trial) == 8 and np.isnan(record.angle).sum() < 8
    t, missing = FRAME * np.arange(15), []
    for x, angle in zip(record.x, record.angle, strict=True):
        end = np.isfinite(angle).sum()
        curvature, slope, _ = np.polyfit(t, x[end - 15 : end, 1], 2)
        v = slope + 2 * curvature * t.mean()
        missing.append(2 * curvature + record.gravity + record.drag[1] * v)
        spin = np.polyval(np.polyfit(t, angle[end - 15 : end], 1), t)
        np.testing.assert_allclose(angle[end - 15 : end], spin, atol=np.radians(1.0))
    assert abs(np.mean(missing)) < 0.3  # 0.1 mm of noise is 0.2 m/s^2 in a drop, 0.08 in the mean


def test_tables_show_intervals_to_two_places():
    line = row("e", (0.45405, 0.4016, 0.5066), "-", "0.47")
    assert line[1:3] == ("0.454", "0.402 to 0.507")
    assert lined_up(HEADER, [line])[2] == "e          0.454  0.402 to 0.507  -     0.47"


def test_charts_break_at_nan_and_escape_names():
    x = np.arange(5.0)
    svg = chart("a < b", "t [s]", "x [m]", [Curve(x, np.array([0.0, 1.0, np.nan, 1.0, 2.0]), "a & b")])
    assert "a &lt; b" in svg and "a &amp; b" in svg
    assert re.search(r'class="line c0" d="M[^M]*M[^M]*"', svg)  # two pieces
    page = Page()
    page.feed(svg)
    assert page.open == []
