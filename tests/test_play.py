"""The player: what the page holds, and what it refuses."""

import base64
import html
import json
import re

import jax
import numpy as np
import pytest
from motions import DOWN, HEIGHT, IMPACT, MASS, RADIUS, E, G, T, bounce, trajectory

import diffrigid as dr
from diffrigid.view.frames import contacts, energies
from diffrigid.view.report import Curve, chart


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
    for player, limit in ((dr.play(bounce(2, t)), 35e3), (dr.play(bounce(3, t)), 250e3)):
        assert len(player.page) < limit and len(player._repr_html_()) < limit
        assert not re.search(r"(src|href|action)\s*=\s*[\"']?\s*(https?:|//)", player.page.split("<script>")[0])
        assert (
            "default-src 'none'" in player.page
            and "@import" not in player.page
            and "url(" not in player.page.split("<script")[0]
        )


def test_notebook_frame_holds_the_page_and_file_too(tmp_path):
    run = bounce()
    player = dr.play({"</script><b>": run, "b & 'c'": run}, title="<i>", show=iter(["trails"]))
    srcdoc = re.search(r'srcdoc="([^"]*)"', player._repr_html_())[1]
    assert html.unescape(srcdoc) == player.page == player.save(tmp_path / "a.html").read_text(encoding="utf-8")
    assert [part["name"] for part in content(player)["runs"]] == ["</script><b>", "b & 'c'"]
    assert content(player)["show"] == ["trails"]
    assert "<i>" not in player.page and 'sandbox="allow-scripts"' in run._repr_html_()


def test_turns_between_frames_are_counted():
    table, _ = unpacked(content(dr.play(bounce(spin=400.0), frames=10))["runs"][0]["poses"])
    np.testing.assert_allclose(table[:, 2], 400.0 * T[::6], atol=4e-3)


def test_few_frames_keep_the_ends_and_uneven_times():
    run = content(dr.play(bounce(2, T**1.5), frames=7))["runs"][0]
    kept = np.frombuffer(base64.b64decode(run["t"]), "<f8")
    np.testing.assert_array_equal(kept, T[::9] ** 1.5)
    assert run["poses"]["rows"] == 7
    assert content(dr.play(bounce()))["runs"][0]["t"] == [0.0, 0.9, 54]


def test_measured_columns_are_kept_with_what_is_missing(tmp_path):
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
    path = tmp_path / "drop.csv"
    path.write_text("t,ball.angle\n" + "\n".join(f"{a},{b}" for a, b in zip(t, 3 * t, strict=True)))
    for file in (path, str(path)):
        np.testing.assert_allclose(
            unpacked(content(dr.play(run, file))["runs"][0]["measured"]["poses"])[0][:, 2], 3 * t, atol=1e-4
        )
    by_run = content(dr.play({"a": run, "b": run}, {"b": {"t": t, "ball.angle": 3 * t + turns}}))["runs"]
    assert by_run[0]["measured"] is None and by_run[1]["measured"]["bodies"] == [0]
    np.testing.assert_allclose(unpacked(by_run[1]["measured"]["poses"])[0][:, 2], 3 * t, atol=1e-4)


# ---- contacts and energies


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_an_impact_is_found_at_its_time_with_its_impulse(dim, spin):
    run = bounce(dim, spin=spin)
    table = contacts(run, T)
    (impact,) = table[table[:, 1] == 1]
    # The flight to it is drawn without gravity: late by g h^2 / 8 v at most
    assert impact[0] == pytest.approx(IMPACT, abs=G * (T[1] - T[0]) ** 2 / 8 / DOWN)
    np.testing.assert_allclose(impact[2 : 2 + dim], np.zeros(dim), atol=1e-4)
    np.testing.assert_allclose(impact[2 + dim :], MASS * (1 + E) * DOWN * np.eye(dim)[-1], atol=1e-6 * MASS * DOWN)
    assert repr(dr.contacts(run)).splitlines()[2].startswith(f"{impact[0]:.5g}  ")


def test_a_clock_that_began_long_ago_shows_and_draws_the_same():
    """Seconds since 1970 have 2e-7 s of rounding; of the tick labels all are different."""
    run, long_ago = bounce(), 1.7e9
    late = dr.replace(run, t=T + long_ago)
    tables = contacts(run, T), contacts(late, T + long_ago)
    np.testing.assert_allclose(
        tables[1] - tables[0], np.broadcast_to(long_ago * np.eye(6)[0], tables[0].shape), atol=1e-5
    )
    drawn, _ = unpacked(content(dr.play(late))["runs"][0]["contacts"])
    np.testing.assert_allclose(drawn[:, 0], tables[1][:, 0], atol=1e-5)
    impact = f"{tables[1][tables[0][:, 1] == 1, 0][0]:.4f}"
    assert repr(dr.contacts(late)).splitlines()[2].startswith(impact) and "1700000000.9000 s" in repr(late)
    ticks = re.findall(r'text-anchor="middle">(17[^<]*)<', chart("", "", "", [Curve(late.t, T)]))
    assert ticks == [f"170000000{second}" for second in ("0", "0.2", "0.4", "0.6", "0.8")]


@pytest.mark.parametrize(("dim", "points"), [(2, 2), (3, 4)])
def test_points_that_carry_a_body_carry_its_weight(dim, points):
    run = bounce(dim)
    table = contacts(run, T)
    first = table[(table[:, 1] == 0) & (table[:, 0] < T[1] / 2)]
    assert len(first) == points
    np.testing.assert_allclose(first[:, 2 + dim :].sum(0), G * (T[1] - T[0]) * np.eye(dim)[-1], atol=1e-6)
    moment = (first[:, 2] - run.state.x[0, 1, 0]) @ first[:, -1]
    assert abs(moment) < 1e-6


def test_impacts_are_found_wherever_in_an_interval_they_are():
    """Just before its end too, where a flight without gravity would not have met the floor yet."""
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))
    for fall in np.linspace(0.2, 0.8, 60):  # [s] until the first impact
        ball = dr.Body(dr.Disc(radius=0.05), mass=0.2, x=(0.0, 0.05 + 0.5 * G * fall**2))
        scene = dr.scene({"ball": ball, "floor": floor}, gravity=(0.0, -G), restitution=0.3)
        found = dr.contacts(dr.rollout(*scene, dt=1 / 60, steps=80))
        strikes = fall * np.array([1.0, 1.6])
        np.testing.assert_allclose(found.t[found.impact][:2], strikes, atol=1e-5)


def pressed(bodies, joints, step=0.01, **scene):
    """The contact of a motion that stays as it is at the start: its force on the first body [N]."""
    world, state = dr.scene(bodies, joints=joints, **scene)
    run = trajectory(world, [0.0, step], *(np.stack([leaf] * 2) for leaf in (state.x, state.q, state.v, state.w)))
    found = dr.contacts(run)
    assert len(found.t) == 1 and not found.impact.any()
    return found.impulse[0] / step


def held_rod(**joint):
    """A rod of 1 m and 1 kg along x, on a hinge at the origin, and a peg that touches it at 0.9 m from below."""
    rod = dr.Body(dr.Box(half=(0.5, 0.05)), mass=1.0, x=(0.5, 0.05))
    peg = dr.Static(dr.Disc(radius=0.05), x=(0.9, -0.05))
    return {"rod": rod, "peg": peg}, {"hinge": dr.Revolute("rod", anchor_a=(-0.5, -0.05), **joint)}


def test_what_a_motor_presses_on_feels_its_torque():
    """As of a force that does the same; one that reaches its speed, here 0, does not press."""
    bodies, joints = held_rod(speed=-1.0, friction=1.8, damping=0.3)
    np.testing.assert_allclose(pressed(bodies, joints), [0.0, 1.8 / 0.9], atol=1e-6)
    bodies, joints = held_rod()
    turn = {"turn": dr.Torque("rod", tau=-1.8)}
    np.testing.assert_allclose(pressed(bodies, joints, forces=turn), [0.0, 1.8 / 0.9], atol=1e-6)
    bodies, joints = held_rod(speed=0.0, friction=1e3)
    weight = pressed(bodies, joints, gravity=(0.0, -G))[1]  # shared with the motor
    assert 0 < weight < 0.5 * G / 0.9


@pytest.mark.parametrize("limit", [{"lower": 0.0}, {"upper": 0.0}])
def test_a_hinge_at_its_limit_carries_what_lies_on_its_arm(limit):
    way = 1.0 if "lower" in limit else -1.0
    rod = dr.Body(dr.Box(half=(0.5, 0.05)), mass=1.0, x=(0.5, 0.0))
    ball = dr.Body(dr.Disc(radius=0.1), mass=0.5, x=(0.7, 0.15 * way))
    joints = {"hinge": dr.Revolute("rod", anchor_a=(-0.5, 0.0), **limit)}
    force = pressed({"rod": rod, "ball": ball}, joints, gravity=(0.0, -G * way))
    np.testing.assert_allclose(force, [0.0, -0.5 * G * way], atol=1e-6)


def test_a_door_lies_on_a_peg_with_its_moment_about_the_hinge():
    """Besides the force at its anchor a hinge in space transmits what keeps its axis."""
    door = dr.Body(dr.Box(half=(0.5, 0.1, 0.05)), mass=2.0, x=(0.5, 0.0, 0.05))
    peg = dr.Static(dr.Sphere(radius=0.05), x=(0.9, 0.05, -0.05))
    hinge = dr.Revolute("door", anchor_a=(-0.5, 0.0, -0.05), axis_a=(0.0, 1.0, 0.0))
    force = pressed({"door": door, "peg": peg}, {"hinge": hinge}, gravity=(0.0, 0.0, -G))
    np.testing.assert_allclose(force, [0.0, 0.0, 2.0 * G * 0.5 / 0.9], atol=1e-5)


def test_a_puck_that_hardly_moves_feels_no_friction_of_the_ground():
    puck = dr.Body(dr.Disc(radius=0.1), mass=1.0, x=(0.0, 0.1), v=(1e-9, 0.0))
    bodies = {"puck": puck, "wall": dr.Static(dr.HalfSpace(normal=(0.0, 1.0)))}
    forces = {"ice": dr.GroundFriction(friction=0.6), "push": dr.Force("puck", F=(0.0, -0.5))}
    np.testing.assert_allclose(pressed(bodies, {}, forces=forces), [0.0, 0.5], atol=1e-6)


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
        table = contacts(run, run.t)
        assert table[:, 1].all() and abs(table[0, 0] - 0.0035) < 1e-4
        np.testing.assert_allclose(np.abs(table[:, 2 + dim :].sum(0)), along, atol=1e-6)
        np.testing.assert_allclose(table[:, 2].mean(), 0.0035, atol=1e-3)


FLOOR, WALL = dr.Static(dr.HalfSpace(normal=(0.0, 1.0))), dr.Static(dr.HalfSpace(normal=(-1.0, 0.0), offset=-1.0))
DISC, SQUARE = dr.Disc(radius=0.1), dr.Box(half=(0.1, 0.1))


def total_impulses(bodies, steps=20, **law):
    """Times of the impacts of each pair, and their sum (D,), at 60 Hz."""
    found, total = dr.contacts(dr.rollout(*dr.scene(bodies, **law), dt=1 / 60, steps=steps)), {}
    for k in np.flatnonzero(found.impact):
        times, P = total.get((pair := f"{found.names[found.a[k]]}-{found.names[found.b[k]]}"), ([], 0.0))
        total[pair] = ([*times, found.t[k]], P + found.impulse[k])
    return {pair: (np.unique(np.round(times, 5)), P) for pair, (times, P) in total.items()}


def test_two_walls_struck_within_a_step_have_their_own_impulses():
    """A disc that slips on the floor, and with friction sticks to the wall (I = m r^2 / 2)."""
    for mu, e in ((0.0, 1.0), (0.1, 0.6)):
        bodies = {"a": dr.Body(DISC, mass=1.0, x=(0.804, 0.191), v=(1.0, -1.0)), "floor": FLOOR, "wall": WALL}
        found = total_impulses(bodies, steps=12, friction=mu, restitution=e)
        slows = mu * (1 + e)
        u, rim = 1.0 - slows, e - 2 * slows  # the speed to the wall, and of the rim along it
        (floor,), on_floor = found["a-floor"]
        (wall,), on_wall = found["a-wall"]
        np.testing.assert_allclose(on_floor, [-slows, 1 + e], atol=1e-6)
        np.testing.assert_allclose(on_wall, [-(1 + e) * u, -min(mu * (1 + e) * u, rim / 3)], atol=1e-6)
        np.testing.assert_allclose([floor, wall], [0.091, 0.091 + (0.096 - 0.091) / u], atol=1e-5)


def test_impacts_that_follow_each_other_within_a_step_are_all_found():
    """A cradle: only the first two come together on the free flight from the start of the step."""
    row = {name: dr.Body(DISC, mass=1.0, x=(0.202 * k - 0.048 * (k == 0), 0.0)) for k, name in enumerate("abc")}
    row["a"] = dr.replace(row["a"], v=(3.0, 0.0))
    found = total_impulses(row, steps=3, restitution=0.8)
    u, t = 3.0, 0.05 / 3.0
    for pair in ("a-b", "b-c"):
        np.testing.assert_allclose(found[pair][1], [-0.5 * 1.8 * u, 0.0], atol=1e-6)
        assert abs(found[pair][0][0] - t) < 1e-4
        u *= 0.9
        t += 0.002 / u


def test_discs_that_touch_pass_an_impact_on():
    """The momentum of those in the middle does not change."""
    row = {name: dr.Body(DISC, mass=1.0, x=(0.2 * k - 0.05 * (k == 0), 0.0)) for k, name in enumerate("abc")}
    row["a"] = dr.replace(row["a"], v=(3.0, 0.0))
    found = total_impulses(row, steps=3, restitution=1.0)
    for pair in ("a-b", "b-c"):
        np.testing.assert_allclose(found[pair][1], [-3.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(found[pair][0], 0.05 / 3, atol=1e-5)


@pytest.mark.parametrize("phase", [0.1, 0.5, 0.9])
def test_impacts_of_bodies_with_joints_are_found_wherever_in_an_interval_they_are(phase):
    """A disc that swings on a hinge, which bends its path."""
    turned, inertia = 2.0 * (6 + phase) / 60, 1.0 + 0.5 * 0.1**2
    wall = dr.Static(dr.HalfSpace(normal=(-1.0, 0.0), offset=-0.1 - np.sin(turned)))
    bob = dr.Body(DISC, mass=1.0, x=(0.0, -1.0), v=(2.0, 0.0), w=2.0)
    hinge = dr.Revolute("bob", anchor_a=(0.0, 1.0))
    found = total_impulses({"bob": bob, "wall": wall}, steps=9, restitution=0.5, joints=[hinge])
    ((t, P),) = found.values()
    np.testing.assert_allclose(P, [-1.5 * 2.0 * inertia / np.cos(turned), 0.0], atol=1e-2)
    np.testing.assert_allclose(t, (6 + phase) / 60, atol=2e-3 / 60)


def test_two_corners_that_strike_within_a_step_are_told_apart():
    """An almost level box: both slip, one forwards and then, as it turns, the other backwards."""
    box = dr.Body(dr.Box(half=(0.1, 0.06)), mass=1.0, x=(0.0, 0.5), v=(1.0, 0.0), w=0.05)
    scene = dr.scene({"a": box, "floor": FLOOR}, gravity=(0.0, -G), restitution=0.45, friction=0.35)
    run = dr.rollout(*scene, dt=1 / 60, steps=60)
    found = dr.contacts(run)
    first = slice(0, 2)
    assert found.impact[first].all() and 5e-4 < np.diff(found.t[first])[0] < 1e-3 and found.t[2] > 0.3
    np.testing.assert_allclose(found.impulse[first, 0] / found.impulse[first, 1], [0.35, -0.35], atol=1e-4)
    lost = run.state.v[18, 0] - run.state.v[17, 0] + np.array([0.0, G / 60])
    np.testing.assert_allclose(found.impulse[first].sum(0), lost, atol=1e-3)


def test_what_slides_into_something_pushes_it_and_not_the_floor():
    """The floor can only change momenta by its friction, and without any by nothing."""
    for mu in (0.0, 0.2):
        bodies = {"a": dr.Body(SQUARE, mass=1.0, x=(0.85, 0.1), v=(2.0, 0.0)), "floor": FLOOR, "wall": WALL}
        ((_, P),) = total_impulses(bodies, steps=3, gravity=(0.0, -G), restitution=0.5, friction=mu).values()
        u = np.sqrt(4.0 - 2 * mu * G * 0.05)
        np.testing.assert_allclose(P, [-1.5 * u, 0.0], atol=mu * G / 60 + 1e-9)


def test_a_corner_that_lands_beside_one_that_touches_is_found():
    """A box falls onto one corner and tips onto the other in the next step; all impulses of the floor lift it."""
    box = dr.Body(dr.Box(half=(0.1, 0.06)), mass=1.0, x=(0.0, 0.5), v=(1.0, 0.0), w=5.0)
    world, state = dr.scene({"a": box, "floor": FLOOR}, gravity=(0.0, -G))
    run = dr.rollout(world, state, dt=1 / 60, steps=60)
    found = dr.contacts(run)
    change = np.diff(run.state.v[:, 0], axis=0) + np.array([0.0, G / 60])
    given = np.zeros_like(change)
    within = np.where(
        found.impact, found.t - 1e-9, found.t + 1e-9
    )  # an impact may end an interval, and rest begins one
    np.add.at(given, np.searchsorted(run.t, within) - 1, found.impulse)
    assert (change[:, 1] > 0.01).sum() > 40 and found.impact.sum() == 4
    np.testing.assert_allclose(given, change, atol=3e-5)


@pytest.mark.parametrize("step", [0.01, 0.1])
def test_impulse_of_edge_on_edge(step):
    """Cubes on edges that cross at right angles: they are found also where the free flight goes deep into the other."""
    reach, c = 0.1 * np.sqrt(2.0), float(np.cos(np.pi / 8))
    turned = [(c, 0.0, float(np.sin(np.pi / 8)), 0.0), (c, 0.0, 0.0, float(np.sin(np.pi / 8)))]  # about y, about z
    places = [(-reach, 0.0, 0.0), (reach + 0.35 * step, 0.0, 0.0)]
    cube = dr.Box(half=(0.1, 0.1, 0.1))
    world, state = dr.scene(
        {n: dr.Body(cube, mass=1.0, x=x, q=q) for n, x, q in zip("ab", places, turned, strict=True)}
    )
    along, x0 = np.eye(3)[0], np.asarray(state.x)
    x1 = x0 + step * np.array([[0.35], [0.65]]) * along
    v0, v1 = np.array([along, 0 * along]), np.array([0 * along, along])
    run = trajectory(world, [0.0, step], [x0, x1], np.stack([state.q, state.q]), [v0, v1], np.zeros((2, 2, 3)))
    (impact,) = contacts(run, run.t)
    np.testing.assert_allclose(impact[:2], [0.35 * step, 1.0], atol=1e-3 * step)
    np.testing.assert_allclose(impact[2:5], [0.35 * step, 0.0, 0.0], atol=1e-3 * step)
    np.testing.assert_allclose(np.abs(impact[5:]), along, atol=1e-6)


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


@pytest.mark.slow
def test_a_plate_without_thickness_is_drawn_with_its_impacts():
    plate = dr.Body(dr.Box(half=(0.5, 0.3, 0.0)), mass=1.0, x=(0.0, 0.0, 0.6), q=(0.8, 0.0, 0.6, 0.0))
    floor = dr.Static(dr.HalfSpace(normal=(0.0, 0.0, 1.0)))
    world, state = dr.scene({"plate": plate, "floor": floor}, gravity=(0.0, 0.0, -G), restitution=0.5)
    run = dr.rollout(world, state, dt=1 / 60, steps=20)
    table = contacts(run, run.t)
    assert (table[:, 1] == 1).any() and content(dr.play(run))["runs"][0]["contacts"]["rows"] == len(table)


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
    of_many = dr.replace(run, state=front.state)  # states as `rollout_batch` returns them
    with pytest.raises(ValueError, match=r"leaf\[0\]"):
        dr.play(of_many)
    with pytest.raises(ValueError, match="`rollout_batch` pick a world"):
        dr.play(front.state)
    dr.play(dr.replace(of_many, state=jax.tree.map(lambda leaf: leaf[0], front.state)))
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda run: dr.play(run).height)(run)
    with pytest.raises(ValueError, match="one dimension"):
        dr.play({"flat": run, "solid": bounce(3)})
    with pytest.raises(ValueError, match="at least one"):
        dr.play({})
    with pytest.raises(ValueError, match="did you mean .ball.x"):
        dr.play(run, {"t": T, "bal.x": np.zeros((55, 2))})
    with pytest.raises(ValueError, match="expected names of trajectories"):
        dr.play({"a": run}, {"c": {"t": T}})
    for wrong in ({"show": ["trail"]}, {"theme": "blue"}, {"speed": 0.0}, {"frames": 1}, {"plot": "z"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            dr.play(run, **wrong)
