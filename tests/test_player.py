"""The player in headless Chromium: what it draws, how it is used, and that it loads nothing. Skipped without one."""

import numpy as np
import pytest
from browser import EXECUTABLE, chromium
from motions import IMPACT, RADIUS, T, bounce, height

import diffrigid as dr

pytestmark = pytest.mark.skipif(EXECUTABLE is None, reason="needs Chromium")


@pytest.fixture(scope="module")
def page():
    with chromium() as page:
        yield page


def opened(page, tmp_path, player, **options):
    page.requests.clear()
    page.errors.clear()
    path = player.save(tmp_path / "motion.html")
    page.open(path, **options)
    page.wait("typeof player !== 'undefined'")
    return path


# The middle of the pixels of a colour that is nearer to `wanted` than any other body's, in CSS pixels.
CENTRE = """(test) => {
  const from = document.querySelector(".stage canvas"), to = document.createElement("canvas");
  [to.width, to.height] = [from.width, from.height];
  const pen = to.getContext("2d");
  pen.drawImage(from, 0, 0);
  const { data } = pen.getImageData(0, 0, to.width, to.height);
  let n = 0, x = 0, y = 0;
  for (let k = 0; k < data.length; k += 4) if (test(data[k], data[k + 1], data[k + 2])) {
    n++; x += ((k / 4) % to.width) + 0.5; y += Math.floor(k / 4 / to.width) + 0.5;
  }
  return [n, x / n, y / n];
}"""


def test_drawn_pixels_are_where_the_trajectory_is(page, tmp_path):
    opened(page, tmp_path, dr.play(bounce(spin=0.0), show=[]))
    for t in (0.0, T[10], T[20] + 0.004, IMPACT, T[40], T[-1]):
        page.run(f"player.show({t})")
        blue = "(r, g, b) => b > r + 30"
        count, x, y = page.run(f"({CENTRE})({blue})")
        wanted = page.run(f"player.view.at[0]([0, {height(t)}])")
        scale = page.run("player.view.grid.scale")
        assert count > np.pi * (RADIUS * scale) ** 2 * 0.9
        # the spoke and the smooth edge move the middle a little
        np.testing.assert_allclose([x, y], wanted, atol=1.5)
    assert len(page.requests) == 1 and not page.errors


def test_between_frames_bodies_fly_on_parabolas_with_a_corner_at_the_impact(page, tmp_path):
    run = bounce(t=np.linspace(0.0, 0.9, 16))
    opened(page, tmp_path, dr.play(run))
    times = np.linspace(0, 0.9, 91)
    got = np.array(
        page.run(f"{times.tolist()}.map((t) => player.scene.runs[0].pose(0, t)).map(({{ x, q }}) => [x[1], q[0]])")
    )
    wanted = np.array([height(t) for t in times])
    flying = np.abs(times - IMPACT) > 0.06
    np.testing.assert_allclose(got[flying, 0], wanted[flying], atol=3e-5)
    np.testing.assert_allclose(got[:, 0], wanted, atol=0.005)  # g h^2 / 8 beside the corner
    np.testing.assert_allclose(got[:, 1], 3.0 * times, atol=1e-4)


def test_controls_and_keys(page, tmp_path):
    path = opened(page, tmp_path, dr.play(bounce(), {"t": T, "block.x": np.ones((55, 2))}, speed=0.5))
    now = "player.scene.time"
    page.press(" ")
    page.wait(f"{now} > 0.05")
    page.press(" ")
    assert not page.run("player.isPlaying()")
    stopped = page.run(now)
    assert page.run(f"new Promise((done) => setTimeout(() => done({now}), 60))") == stopped
    page.run(
        "const range = document.querySelector('input[type=range]'); range.value = 0.31; range.dispatchEvent(new Event('input'))"
    )
    assert page.run(now) == pytest.approx(0.31)
    for key, wanted in (
        ("ArrowRight", T[19]),
        ("ArrowRight", T[20]),
        ("ArrowLeft", T[19]),
        ("End", 0.9),
        ("Home", 0.0),
        ("ArrowUp", 0.0),
    ):
        page.press(key)
        assert page.run(now) == pytest.approx(wanted)
    assert page.run("player.scene.speed") == 1.0
    scale = page.run("player.view.grid.scale")
    page.press("+")
    assert page.run("player.view.grid.scale") == pytest.approx(1.25 * scale)
    page.press("0")
    assert page.run("player.view.grid.scale") == pytest.approx(scale)
    page.run("[...document.querySelectorAll('.bar button')].find((b) => b.textContent === 'Measured').click()")
    assert not page.run("player.scene.show.has('data')")
    for name in ("speed", "angle", "vx", "", "energy"):
        page.run(
            f"const s = document.querySelector('select[title=graph]'); s.value = {name!r}; s.dispatchEvent(new Event('change'))".replace(
                "const s", "var s"
            )
        )
    unnamed = "[...document.querySelectorAll('button, select, input, canvas')].filter((e) => !(e.ariaLabel || e.textContent.trim()))"
    assert page.run(f"{unnamed}.length") == 0
    assert page.requests == [path.resolve().as_uri()] and not page.errors


def test_it_loops_and_ends(page, tmp_path):
    opened(page, tmp_path, dr.play(bounce(), speed=10.0))
    page.run("player.play(true)")
    page.wait("(window.seen ??= []).push(player.scene.time) && seen.some((t, k) => k && t < seen[k - 1])")
    page.run("document.querySelectorAll('.bar button')[1].click()")
    page.wait("!player.isPlaying()")
    assert page.run("player.scene.time") == pytest.approx(0.9)


def test_two_players_on_a_page_that_allows_no_load_do_not_meet(page, tmp_path):
    frame = (
        dr.play(bounce())._repr_html_().replace('"allow-scripts"', '"allow-scripts allow-same-origin"')
    )  # to look inside
    policy = "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'\">"
    path = tmp_path / "two.html"
    path.write_text(
        f"<!doctype html><html><head><meta charset=utf-8>{policy}</head><body>{frame}{frame}</body></html>",
        encoding="utf-8",
    )
    page.requests.clear()
    page.open(path)
    page.wait("[0, 1].every((n) => frames[n].document.querySelector('output'))")
    page.run("var said = (n) => frames[n].document.querySelector('output').textContent")
    assert page.run("[said(0), said(1)]") == ["0.000 s", "0.000 s"]
    page.run("frames[1].document.querySelector('button').click()")
    page.wait("said(1) > '0.05'")
    assert page.run("said(0)") == "0.000 s"
    assert [url for url in page.requests if not url.startswith(("about:", "file:"))] == []


def test_solids_are_drawn_where_the_trajectory_is(page, tmp_path):
    path = opened(page, tmp_path, dr.play(bounce(3), show=[], theme="light"), size=(500, 500))
    for t in (0.0, IMPACT + 0.1, T[-1]):
        page.run(f"player.show({t})")
        blue = "(r, g, b) => b > 1.5 * r && b > 30 && g < b"
        count, x, y = page.run(f"player.show({t}); ({CENTRE})({blue})")
        wanted = page.run(f"player.view.screen([0, 0, {height(t)}])")
        assert count > 300
        np.testing.assert_allclose(
            [x, y], wanted, atol=4.0
        )  # a sphere in perspective is an ellipse; its dark side counts less
        np.testing.assert_allclose(page.run("player.view.drawn[0][0]"), [0, 0, height(t)], atol=1e-3)
    half = page.run("player.scene.runs[0].pose(0, 0.25).q")  # slerp, though every second q has the other sign
    np.testing.assert_allclose(np.abs(half), [np.cos(0.375), 0, 0, np.sin(0.375)], atol=1e-4)
    page.press(" ")
    page.wait("player.scene.time > 0.02")
    assert page.requests == [path.resolve().as_uri()] and not page.errors


def test_dark_follows_the_browser_unless_told(page, tmp_path):
    shade = "getComputedStyle(document.body).backgroundColor"
    for theme, scheme, dark in (
        ("auto", "dark", True),
        ("auto", "light", False),
        ("light", "dark", False),
        ("dark", "light", True),
    ):
        opened(page, tmp_path, dr.play(bounce(), theme=theme), scheme=scheme)
        assert (page.run(shade) == "rgb(21, 24, 28)") == dark
