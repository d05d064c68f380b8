"""The player: what the page holds, what it draws in a browser, and what it refuses."""

import base64
import html
import json
import re

import jax
import numpy as np
import pytest
from browser import EXECUTABLE, chromium

import diffrigid as dr
from diffrigid.view.contacts import find_contacts
from diffrigid.view.frames import energies

G, E, MASS, RADIUS = 9.81, 0.5, 2.0, 0.4
HEIGHT = 1.0  # [m] under the ball at the start
IMPACT = np.sqrt(2 * HEIGHT / G)
DOWN = G * IMPACT  # [m/s] at the impact
T = np.linspace(0.0, 0.9, 55)
browser_only = pytest.mark.skipif(EXECUTABLE is None, reason="needs Chromium")


def trajectory(world, t, x, q, v, w):
    state = dr.State(**{name: np.asarray(value, float) for name, value in dict(x=x, q=q, v=v, w=w).items()})
    return dr.Trajectory(t=np.asarray(t), state=state, world=world)


def bounce(dim=2, t=T, spin=3.0):
    """A ball that falls, bounces once and turns about the last axis; a solid at rest on the floor beside it. Closed form."""
    up = np.eye(dim)[-1]
    floor = dr.Static(dr.HalfSpace(normal=up))
    solid = dr.Polygon(vertices=((0.0, 0.0), (0.6, 0.0), (0.0, 0.3))) if dim == 2 else dr.Box(half=(0.2, 0.2, 0.1))
    rest = np.array([1.2, 0.1]) if dim == 2 else np.array([1.2, 0.0, 0.1])
    ball = dr.Disc(radius=RADIUS) if dim == 2 else dr.Sphere(radius=RADIUS)
    bodies = {
        "ball": dr.Body(ball, mass=MASS, x=(HEIGHT + RADIUS) * up),
        "block": dr.Body(solid, mass=1.0, x=rest),
        "floor": floor,
    }
    world, _ = dr.scene(bodies, gravity=-G * up, restitution=E, friction=0.0)
    after = np.maximum(t - IMPACT, 0.0)
    height = np.where(t < IMPACT, HEIGHT - G * t**2 / 2, E * DOWN * after - G * after**2 / 2)
    speed = np.where(t < IMPACT, -G * t, E * DOWN - G * after)
    x = np.stack([np.outer(height + RADIUS, up), np.tile(rest, (len(t), 1))], axis=1)
    v = np.stack([np.outer(speed, up), np.zeros((len(t), dim))], axis=1)
    half = spin * t / (1 if dim == 2 else 2)
    turn = np.zeros((len(t), 2 if dim == 2 else 4))
    turn[:, 0], turn[:, -1] = np.cos(half), np.sin(half)
    turn *= 1 if dim == 2 else np.where(np.arange(len(t)) % 2, -1.0, 1.0)[:, None]  # q and -q are one orientation
    q = np.stack([turn, np.tile(np.eye(turn.shape[1])[0], (len(t), 1))], axis=1)
    w = np.zeros((len(t), 2, 1 if dim == 2 else 3))
    w[:, 0, -1] = spin
    return trajectory(world, t, x, q, v, w)


def content(player):
    """The data in a page."""
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', player.page, re.S)[1])


def unpacked(packed):
    """Table (T, K) of packed columns, and the largest error of each by rounding."""
    whole = np.frombuffer(base64.b64decode(packed["data"]), "<u2").reshape(-1, packed["rows"]).T
    low, step = np.array(packed["low"]), np.array(packed["step"])
    return np.where(whole == 65535, np.nan, low + step * whole), step / 2 + 1e-9


# ---- what the page holds


@pytest.mark.parametrize("dim", [2, 3])
def test_poses_are_those_of_the_trajectory_to_the_stated_rounding(dim):
    run = bounce(dim)
    table, error = unpacked(content(dr.play(run))["runs"][0]["poses"])
    x, q, v = (np.asarray(leaf) for leaf in (run.state.x, run.state.q, run.state.v))
    turn = np.unwrap(np.arctan2(q[..., 1:], q[..., :1]), axis=0) if dim == 2 else q
    wanted = np.concatenate([x, turn, v], axis=2).reshape(len(x), 2, -1)
    got, error = table.reshape(wanted.shape), error.reshape(wanted.shape[1:])
    if dim == 3:
        sign = np.sign((got[..., 3:7] * q).sum(2, keepdims=True))
        wanted[..., 3:7] *= sign
        assert ((got[1:, :, 3:7] * got[:-1, :, 3:7]).sum(2) > 0.9).all()  # the short way round
    assert (np.abs(got - wanted) <= error).all()
    span = np.ptp(wanted, axis=0)
    assert (error <= span / 131068 * 1.001 + 2e-9).all()


def test_page_is_small_and_loads_nothing():
    t = np.linspace(0, 2, 121)
    for player, limit in ((dr.play(bounce(2, t)), 50e3), (dr.play(bounce(3, t)), 1.2e6)):
        assert len(player.page) < limit and len(player._repr_html_()) < limit
        assert not re.search(r"(src|href|action)\s*=\s*[\"']?\s*(https?:|//)", player.page.split("<script>")[0])
        assert (
            "default-src 'none'" in player.page
            and "@import" not in player.page
            and "url(" not in player.page.split("<script")[0]
        )


def test_notebook_frame_holds_the_page_and_file_too(tmp_path):
    run = bounce()
    player = dr.play({"</script><b>": run, "b & 'c'": run}, title="<i>")
    srcdoc = re.search(r'srcdoc="([^"]*)"', player._repr_html_())[1]
    assert html.unescape(srcdoc) == player.page == player.save(tmp_path / "a.html").read_text(encoding="utf-8")
    assert [part["name"] for part in content(player)["runs"]] == ["</script><b>", "b & 'c'"]
    assert "<i>" not in player.page and 'sandbox="allow-scripts"' in run._repr_html_()


def test_few_frames_keep_the_ends_and_uneven_times():
    run = content(dr.play(bounce(2, T**1.5), frames=7))["runs"][0]
    kept = np.frombuffer(base64.b64decode(run["t"]), "<f8")
    np.testing.assert_array_equal(kept, T[::9] ** 1.5)
    assert run["poses"]["rows"] == 7
    assert content(dr.play(bounce()))["runs"][0]["t"] == [0.0, 0.9, 54]


def test_measured_columns_are_kept_with_what_is_missing():
    run = bounce()
    t = T[::3] + 1e-3
    x = np.where(np.arange(len(t))[:, None] == 4, np.nan, np.stack([t, 2 * t], axis=1))
    turns = 2 * np.pi * (np.arange(len(t)) % 2)  # of a measured angle do not count
    seen = content(dr.play(run, {"t": t, "block.x": x, "block.q": np.stack([np.cos(t), np.sin(t)], axis=1)}))["runs"][
        0
    ]["measured"]
    table, error = unpacked(seen["poses"])
    assert seen["bodies"] == [1]
    np.testing.assert_allclose(table[:, :3], np.column_stack([x, t]), atol=error.max())
    assert np.isnan(table[:, 3:]).all() and np.isnan(table[4, :2]).all()
    by_run = content(dr.play({"a": run, "b": run}, {"b": {"t": t, "ball.angle": 3 * t + turns}}))["runs"]
    assert by_run[0]["measured"] is None and by_run[1]["measured"]["bodies"] == [0]
    np.testing.assert_allclose(unpacked(by_run[1]["measured"]["poses"])[0][:, 2], 3 * t, atol=1e-4)


# ---- contacts and energies


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_an_impact_is_found_at_its_time_with_its_impulse(dim, spin):
    run = bounce(dim, spin=spin)
    table = find_contacts(run, T)
    (impact,) = table[table[:, 1] == 1]
    # The flight to it is drawn without gravity: late by g h^2 / 8 v at most
    assert impact[0] == pytest.approx(IMPACT, abs=G * (T[1] - T[0]) ** 2 / 8 / DOWN)
    np.testing.assert_allclose(impact[2 : 2 + dim], np.zeros(dim), atol=1e-4)
    np.testing.assert_allclose(impact[2 + dim :], MASS * (1 + E) * DOWN * np.eye(dim)[-1], atol=1e-6 * MASS * DOWN)


@pytest.mark.parametrize(("dim", "points"), [(2, 2), (3, 4)])
def test_points_that_carry_a_body_carry_its_weight(dim, points):
    run = bounce(dim)
    table = find_contacts(run, T)
    first = table[(table[:, 1] == 0) & (table[:, 0] < T[1] / 2)]
    assert len(first) == points
    np.testing.assert_allclose(first[:, 2 + dim :].sum(0), G * (T[1] - T[0]) * np.eye(dim)[-1], atol=1e-6)
    moment = (first[:, 2] - run.state.x[0, 1, 0]) @ first[:, -1]
    assert abs(moment) < 1e-6


@pytest.mark.parametrize("dim", [2, 3])
def test_impulse_between_two_bodies_is_found_at_corner_edge_and_round(dim):
    """Central impacts of equal masses at t = 0.35 h: the first gives its velocity to the second."""
    pad = (0.0,) * (dim - 2)
    ball = dr.Disc(radius=0.1) if dim == 2 else dr.Sphere(radius=0.1)
    box, rod = dr.Box(half=(0.1,) * dim), dr.Capsule(radius=0.05, half_length=0.05)
    for first, second in ((ball, ball), (ball, box), (rod, box), (box, ball), (rod, rod)):
        bodies = {
            "a": dr.Body(first, mass=1.0, x=(-0.1, 0.0, *pad)),
            "b": dr.Body(second, mass=1.0, x=(0.1035, 0.0, *pad)),
        }
        world, state = dr.scene(bodies)
        h, along = 0.01, np.eye(dim)[0]
        x0, x1 = np.asarray(state.x), np.asarray(state.x) + np.array([[0.0035], [0.0065]]) * along
        v0, v1 = np.array([along, 0 * along]), np.array([0 * along, along])
        still = np.zeros((2, *state.w.shape))
        run = trajectory(world, [0.0, h], [x0, x1], np.stack([state.q, state.q]), [v0, v1], still)
        table = find_contacts(run, run.t)
        assert table[:, 1].all() and abs(table[0, 0] - 0.0035) < 1e-4
        np.testing.assert_allclose(np.abs(table[:, 2 + dim :].sum(0)), along, atol=1e-6)
        np.testing.assert_allclose(table[:, 2].mean(), 0.0035, atol=1e-3)


def test_energy_of_a_fall_is_constant_until_the_impact():
    run = bounce()
    kinetic, potential, total = energies(run.world, run.state).T
    spin = 0.5 * (0.5 * MASS * RADIUS**2) * 3.0**2
    before, h = T < IMPACT, run.state.x[:, 0, 1]
    np.testing.assert_allclose(potential, G * (MASS * h + run.state.x[:, 1, 1]), rtol=1e-12)
    np.testing.assert_allclose(kinetic[before], spin + MASS * G * (HEIGHT + RADIUS - h[before]), rtol=1e-9)
    lost = MASS * DOWN**2 / 2 * (1 - E**2)
    np.testing.assert_allclose(total - total[0], np.where(before, 0.0, -lost), atol=1e-9)


def test_energy_counts_springs():
    bodies = {"ball": dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.3, 0.4))}
    spring = dr.SpringDamper(a="ball", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), stiffness=8.0, length=0.1)
    world, state = dr.scene(bodies, forces=[spring])
    one = jax.tree.map(lambda leaf: np.asarray(leaf)[None], state)
    np.testing.assert_allclose(energies(world, one), [[0.0, 0.5 * 8 * 0.4**2, 0.5 * 8 * 0.4**2]], rtol=1e-9)


# ---- what is refused


def test_what_cannot_be_drawn_is_an_error_that_says_how():
    run = bounce()
    batch = dr.replace(run, state=jax.tree.map(lambda leaf: np.stack([leaf] * 3, axis=-1), run.state))
    front = jax.tree.map(lambda leaf: np.stack([leaf] * 3), run)
    with pytest.raises(ValueError, match=r"leaf\[\.\.\., 0\]"):
        dr.play(batch)
    with pytest.raises(ValueError, match=r"leaf\[0\]"):
        dr.play({"many": front})
    assert batch._repr_html_() is None and front._repr_html_() is None
    dr.play(jax.tree.map(lambda leaf: leaf[0], front))
    with pytest.raises(ValueError, match="rollout"):
        dr.play(run.state)
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda run: dr.play(run).height)(run)
    with pytest.raises(ValueError, match="one dimension"):
        dr.play({"flat": run, "solid": bounce(3)})
    with pytest.raises(ValueError, match="at least one"):
        dr.play({})
    with pytest.raises(ValueError, match="did you mean ball.x"):
        dr.play(run, {"t": T, "bal.x": np.zeros((55, 2))})
    with pytest.raises(ValueError, match="expected names of trajectories"):
        dr.play({"a": run}, {"c": {"t": T}})
    for wrong in ({"show": ["trail"]}, {"theme": "blue"}, {"speed": 0.0}, {"frames": 1}, {"plot": "z"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            dr.play(run, **wrong)


# ---- in a browser


@pytest.fixture(scope="module")
def page():
    with chromium() as page:
        yield page


def opened(page, tmp_path, player, **options):
    page.requests.clear()
    page.errors.clear()
    path = player.save(tmp_path / "motion.html")
    page.open(path, **options)
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


def at(t):
    """Height of the ball's centre, in closed form."""
    after = t - IMPACT
    return RADIUS + (HEIGHT - G * t**2 / 2 if after < 0 else E * DOWN * after - G * after**2 / 2)


@browser_only
def test_drawn_pixels_are_where_the_trajectory_is(page, tmp_path):
    opened(page, tmp_path, dr.play(bounce(spin=0.0), show=[]))
    for t in (0.0, T[10], T[20] + 0.004, IMPACT, T[40], T[-1]):
        page.run(f"player.show({t})")
        blue = "(r, g, b) => b > r + 30"
        count, x, y = page.run(f"({CENTRE})({blue})")
        wanted = page.run(f"player.view.at[0]([0, {at(t)}])")
        scale = page.run("player.view.grid.scale")
        assert count > np.pi * (RADIUS * scale) ** 2 * 0.9
        # the spoke and the smooth edge move the middle a little
        np.testing.assert_allclose([x, y], wanted, atol=1.5)
    assert len(page.requests) == 1 and not page.errors


@browser_only
def test_between_frames_bodies_fly_on_parabolas_with_a_corner_at_the_impact(page, tmp_path):
    run = bounce(t=np.linspace(0.0, 0.9, 16))
    opened(page, tmp_path, dr.play(run))
    times = np.linspace(0, 0.9, 91)
    got = np.array(
        page.run(f"{times.tolist()}.map((t) => player.scene.runs[0].pose(0, t)).map(({{ x, q }}) => [x[1], q[0]])")
    )
    wanted = np.array([at(t) for t in times])
    flying = np.abs(times - IMPACT) > 0.06
    np.testing.assert_allclose(got[flying, 0], wanted[flying], atol=3e-5)
    np.testing.assert_allclose(got[:, 0], wanted, atol=0.005)  # g h^2 / 8 beside the corner
    np.testing.assert_allclose(got[:, 1], 3.0 * times, atol=1e-4)


@browser_only
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


@browser_only
def test_it_loops_and_ends(page, tmp_path):
    opened(page, tmp_path, dr.play(bounce(), speed=10.0))
    page.run("player.play(true)")
    page.wait("(window.seen ??= []).push(player.scene.time) && seen.some((t, k) => k && t < seen[k - 1])")
    page.run("document.querySelectorAll('.bar button')[1].click()")
    page.wait("!player.isPlaying()")
    assert page.run("player.scene.time") == pytest.approx(0.9)


@browser_only
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
    page.run("var said = (n) => frames[n].document.querySelector('output').textContent")
    assert page.run("[said(0), said(1)]") == ["0.000 s", "0.000 s"]
    page.run("frames[1].document.querySelector('button').click()")
    page.wait("said(1) > '0.05'")
    assert page.run("said(0)") == "0.000 s"
    assert [url for url in page.requests if not url.startswith(("about:", "file:"))] == []


@browser_only
def test_solids_are_drawn_where_the_trajectory_is(page, tmp_path):
    path = opened(page, tmp_path, dr.play(bounce(3), show=[], theme="light"), size=(500, 500))
    for t in (0.0, IMPACT + 0.1, T[-1]):
        page.run(f"player.show({t})")
        blue = "(r, g, b) => b > 1.5 * r && b > 30 && g < b"
        count, x, y = page.run(f"player.show({t}); ({CENTRE})({blue})")
        wanted = page.run(f"player.view.screen([0, 0, {at(t)}])")
        assert count > 300
        np.testing.assert_allclose(
            [x, y], wanted, atol=4.0
        )  # a sphere in perspective is an ellipse; its dark side counts less
        np.testing.assert_allclose(page.run("player.view.drawn[0][0]"), [0, 0, at(t)], atol=1e-3)
    half = page.run("player.scene.runs[0].pose(0, 0.25).q")  # slerp, though every second q has the other sign
    np.testing.assert_allclose(np.abs(half), [np.cos(0.375), 0, 0, np.sin(0.375)], atol=1e-4)
    page.press(" ")
    page.wait("player.scene.time > 0.02")
    assert page.requests == [path.resolve().as_uri()] and not page.errors


@browser_only
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
