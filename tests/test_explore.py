"""Sliders: the motion and its slope follow them, in Python and in headless Chromium (skipped without one)."""

import json
import sys

import jax
import numpy as np
import pytest
from browser import EXECUTABLE, chromium
from numpy.testing import assert_allclose

import diffrigid as dr
from diffrigid.view.explore import AHEAD

G, STEPS, RATE = 9.81, 40, 60


def made():
    ball = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 1.1), v=(0.5, 0.0))
    world, state = dr.scene(
        {"ball": ball, "floor": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}, gravity=(0.0, -G), restitution=0.8
    )
    return dr.explore(world, state, {"restitution": (0.0, 1.0), "ball.v[0]": (-2.0, 2.0)}, dt=1 / RATE, steps=STEPS)


@pytest.fixture(scope="module")
def explorer():
    return made()


def height(e):
    """Of the ball over where it bounces, at the end, by its restitution: one bounce from 1 m."""
    falls, t = np.sqrt(2.0 / G), STEPS / RATE
    return e * G * falls * (t - falls) - 0.5 * G * (t - falls) ** 2


def test_motion_and_slope_are_those_of_the_values(explorer):
    explorer.move("ball.v[0]", 1.5)
    explorer.move("restitution", 0.6)
    assert explorer.values == {"restitution": 0.6, "ball.v[0]": 1.5}
    end, slope = (run.state.x[-1, 0] for run in (explorer.trajectory, explorer.slope))
    assert_allclose(end, [1.5 * STEPS / RATE, 0.1 + height(0.6)], atol=1e-9)
    assert_allclose(slope - end, [0.0, height(0.6 + AHEAD) - height(0.6)], atol=1e-9)  # it is linear in e
    explorer.move("ball.v[0]", 9.0)  # beyond its range
    assert explorer.values["ball.v[0]"] == 2.0
    assert_allclose(explorer.slope.state.x[-1, 0, 0] - 2.0 * STEPS / RATE, AHEAD * 4.0 * STEPS / RATE, atol=1e-9)
    assert list(explorer.runs())[1] == "its slope by ball.v[0], + 0.2 m/s"
    world, state = explorer.scene
    again = dr.rollout(world, state, dt=1 / RATE, steps=STEPS)
    jax.tree.map(lambda a, b: assert_allclose(a, b, atol=1e-12), again.state, explorer.trajectory.state)


def test_mistakes_are_named():
    world, state = made().scene
    for ranges, message in (
        ({}, "ranges is {}: expected a dict of parameters"),
        (["restitution"], "expected a dict of parameters"),
        ({"restitution": (1.0, 0.0)}, r"ranges\['restitution'\] is \(1, 0\): expected low < high"),
        ({"restitution": 1.0}, r"expected two numbers, \(low, high\)"),
        ({"restitution": (0.0, 0.5)}, r"restitution is 0.8, outside its range \(0, 0.5\)"),
        ({"ball.v": (0.0, 1.0)}, r"ball.v is not a number .* choose one, as 'ball.v\[0\]'"),
        ({"ball.v[2]": (0.0, 1.0)}, r"ball.v\[2\] is not a number"),
        ({"bal.v[0]": (0.0, 1.0)}, "did you mean"),
    ):
        with pytest.raises(ValueError, match=message):
            dr.explore(world, state, ranges, dt=0.1, steps=2)
    with pytest.raises(ValueError, match="no slider 'mass'"):
        made().move("mass", 1.0)


def test_without_anywidget_it_says_what_to_install(explorer, monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    monkeypatch.delitem(sys.modules, "diffrigid.view.widget", raising=False)
    with pytest.raises(ImportError, match=r"diffrigid\[notebook\]"):
        explorer.widget  # noqa: B018


def test_a_slider_of_the_widget_moves_the_motion(explorer):
    pytest.importorskip("anywidget")
    widget = explorer.widget
    assert [slider["name"] for slider in widget.sliders] == ["restitution", "ball.v[0]"]
    widget.moved = {"name": "restitution", "value": 0.25}
    assert explorer.values["restitution"] == 0.25
    assert [run["name"] for run in widget.runs] == ["motion", "its slope by restitution, + 0.05"]
    assert not widget.runs[1]["contacts"]["rows"]
    shown, _ = explorer._repr_mimebundle_()
    assert "<iframe" in shown["text/html"] and "application/vnd.jupyter.widget-view+json" in shown


MODEL = """
const kept = %s, listeners = {};
const model = {
  get: (name) => kept[name], set: (name, value) => { kept[name] = value; }, save_changes: () => { window.sent = kept.moved; },
  on: (name, listener) => { listeners[name] = listener; },
};
window.receive = (runs) => { kept.runs = runs; listeners["change:runs"](); };
"""

INSIDE = """(() => {
  const page = document.querySelector("iframe").contentWindow, script = page.document.createElement("script");
  script.textContent = %s;
  page.document.body.append(script);
  return page.answer;
})()"""


@pytest.mark.skipif(EXECUTABLE is None, reason="needs Chromium")
@pytest.mark.parametrize("dim", [2, 3])
def test_in_a_browser(explorer, tmp_path, dim):
    """The script with a model of its own in place of a kernel: what a slider sends, and what the player then draws."""
    widget = pytest.importorskip("diffrigid.view.widget")
    if dim == 3:
        ball = dr.Body(dr.Sphere(radius=0.1), mass=1.0, x=(0.0, 0.0, 1.1))
        world, state = dr.scene({"ball": ball}, gravity=(0.0, 0.0, -G))
        explorer = dr.explore(world, state, {"ball.v[0]": (-2.0, 2.0)}, dt=1 / RATE, steps=STEPS)
    name = "ball.v[0]"
    start = {"page": explorer.player().page, "sliders": explorer.sliders(), "runs": explorer.sources()}
    script = widget.Sliders._esm if isinstance(widget.Sliders._esm, str) else str(widget.Sliders._esm)
    model = MODEL % json.dumps(start).replace("</", "<\\/")
    page = tmp_path / "explore.html"
    page.write_text(
        '<!doctype html><meta charset="utf-8"><body><script type="module">\n'
        + script.replace("export default { render };", "").replace("allow-scripts", "allow-scripts allow-same-origin")
        + model
        + "render({ model, el: document.body });\n</script></body>",
        encoding="utf-8",
    )

    def inside(what):  # of the player, whose page allows scripts of its own only
        return INSIDE % json.dumps(f"window.answer = {what};")

    with chromium() as browser:
        browser.open(page)
        browser.wait(inside("typeof player !== 'undefined'"))
        browser.run(
            "(() => { const slider = [...document.querySelectorAll('input')].at(-1); slider.value = 1.5;"
            " slider.dispatchEvent(new Event('input')); })()"
        )
        assert browser.run("window.sent") == {"name": name, "value": 1.5}
        explorer.move(name, 1.5)
        browser.run(f"window.receive({json.dumps(explorer.sources())})")
        wanted = explorer.trajectory.state.x[-1, 0, 0]
        browser.wait(inside(f"Math.abs(player.scene.runs[0].pose(0, {STEPS / RATE}).x[0] - {wanted}) < 1e-3"))
        browser.run(inside(f"player.show({STEPS / RATE})"))
        drawn = browser.run(inside("player.view.drawn[1]"))
        ahead = float(explorer.slope.state.x[-1, 0, 0])
        if dim == 2:
            assert_allclose(drawn[0][0], browser.run(inside(f"player.view.at[0]([{ahead}, 0])[0]")), atol=0.5)  # [px]
        else:
            assert_allclose(drawn[0][0], ahead, atol=1e-3)
        assert not browser.errors
