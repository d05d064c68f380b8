"""What the README shows works as it stands."""

import re
from pathlib import Path

import numpy as np

import diffrigid as dr

README = (Path(__file__).parent.parent / "README.md").read_text()
FROM_A_FILE, EXAMPLE = re.findall(r"```python\n(.*?)```", README, flags=re.S)


def test_example_runs(capsys):
    made = {}
    exec(compile(EXAMPLE, "README.md", "exec"), made)
    slopes = np.array(re.findall(r"[-+.\de]+", capsys.readouterr().out), float)
    ends = [made["end"](heavier(made["world"], k, by)) for k in (0, 1) for by in (-1e-5, 1e-5)]
    np.testing.assert_allclose(slopes, np.diff(ends)[::2] / 2e-5, rtol=1e-5)


def heavier(world, body, by):
    return dr.replace(world, bodies=dr.replace(world.bodies, mass=world.bodies.mass.at[body].add(by)))


def test_example_with_a_file_finds_what_made_it(tmp_path, monkeypatch):
    """A ball that bounces once, with 2 mm of noise."""
    monkeypatch.chdir(tmp_path)
    t, e, fall = np.arange(55) / 60, 0.75, np.sqrt(2 * 1.15 / 9.81)
    height = np.where(t < fall, 1.15 - 4.905 * t**2, 9.81 * e * fall * (t - fall) - 4.905 * (t - fall) ** 2)
    seen = np.stack([0.4 * t, 0.05 + height], axis=1) + 2e-3 * np.random.default_rng(0).normal(size=(55, 2))
    head = re.search(r"t,ball.*", README)[0]
    np.savetxt("drop.csv", np.column_stack([12.5 + t, seen]), delimiter=",", header=head, comments="", fmt="%.4f")
    found = {}
    exec(compile(FROM_A_FILE, "README.md", "exec"), found)
    values = found["fit"]["restitution"]
    assert values.low < e < values.high < values.low + 0.01 and Path("fit.html").exists()
