"""`play`: one or several trajectories as self-contained HTML.

The page is made of a style (`player.css`), the controls (`player.js`, `graph.js`), a way of drawing (`flat.js` on a
canvas in 2D, `solid.js` with three.js in 3D) and the data of `frames`. A notebook shows it in a frame of its own, so
that two players do not meet, and its policy allows no load of anything. `three/package.json` says how the bundled part
of three.js is made.
"""

import base64
import functools
import html
import json
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from diffrigid.trajectory import Trajectory, checked
from diffrigid.view.frames import record

POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"  # nothing is ever loaded
LAYERS = ("trails", "velocities", "contacts", "data")  # what can be shown or hidden
THEMES = ("auto", "light", "dark")
PLOTS = {
    2: ("energy", "speed", "x", "y", "angle", "vx", "vy", ""),
    3: ("energy", "speed", "x", "y", "z", "vx", "vy", "vz", ""),
}

UNPACK = """(async () => {
  const packed = Uint8Array.from(atob(document.getElementById("packed").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.body.append(script);
})();
"""


@dataclass(frozen=True)
class Player:
    """An HTML page with a player; a notebook shows it as it is.

    Example:
        >>> dr.play({"exact": trajectory, "smooth": dr.rollout(widths[0], state, dt=1 / 60, steps=30)}).height
        520
    """

    page: str  # HTML
    height: int  # [px] in a notebook

    def save(self, path: str | Path) -> Path:
        """Write the page as a file, which opens offline, and return its path."""
        path = Path(path)
        path.write_text(self.page, encoding="utf-8")
        return path

    def _repr_html_(self) -> str:
        page = self.page.replace("&", "&amp;").replace('"', "&quot;")
        return (
            f'<iframe title="player" sandbox="allow-scripts" style="width:100%;height:{self.height}px;border:0" '
            f'srcdoc="{page}"></iframe>'
        )

    def __repr__(self) -> str:
        return f"Player({len(self.page) / 1e3:.0f} kB; shown in a notebook, or .save('motion.html'))"


def play(
    trajectory: Trajectory | Mapping[str, Trajectory], data: Mapping[str, Any] | None = None, *,
    beside: bool = False, speed: float = 1.0, show: Iterable[str] = ("trails", "contacts", "data"),
    plot: str = "energy", frames: int = 600, height: int = 520, theme: str = "auto", title: str = "",
) -> Player:  # fmt: skip
    """Make a player of a trajectory, 2D or 3D, with measured data over it.

    Args:
        trajectory: what `rollout` returns; or several by name, drawn over each other.
        data: measured columns as `fit` takes them, "t" [s], "ball.x", "ball.angle" or "ball.q"; NaN is missing. Columns
            of joints are not drawn. For several trajectories also such columns by their names.
        beside: draw several trajectories side by side.
        speed: initial speed; 1 is real time.
        show: what is shown at first, of "trails", "velocities", "contacts", "data".
        plot: "energy", "speed", "x", "y", "z" (3D), "angle" (2D), "vx", "vy", "vz", or "" for none.
        frames: largest number of times that are kept, evenly; between them bodies move on curves through positions and
            velocities, with a corner at an impact.
        height: [px] of the player in a notebook.
        theme: "light", "dark", or "auto", that of the browser.
        title: of the page.

    Returns:
        A `Player`: HTML by itself in a notebook, a file by `.save(path)`. Numbers of a column are rounded to 1/131068
        of what they span. Contacts are found as `diffrigid.impacts` says.

    Raises:
        ValueError: a batch of trajectories, dimensions that differ, unknown columns or names.

    Example:
        >>> page = dr.play(trajectory, measured, plot="y")  # shown by itself in a notebook
        >>> page.save("motion.html").name
        'motion.html'
    """
    runs = (
        {str(name): checked(run, f"trajectory[{name!r}]") for name, run in trajectory.items()}
        if isinstance(trajectory, Mapping)
        else {"": checked(trajectory)}
    )
    show = frozenset(show)
    _check(runs, show, theme, speed, frames)
    by_run = _data_by_run(runs, data, beside)
    dim = next(iter(runs.values())).world.dim
    if plot not in PLOTS[dim]:
        raise ValueError(f"plot is {plot!r}: expected one of {PLOTS[dim]}")
    content = {
        "dim": dim, "beside": bool(beside), "speed": float(speed), "show": sorted(show), "plot": plot,
        "runs": [record(run, name, by_run[name], frames) for name, run in runs.items()],
    }  # fmt: skip
    return Player(page=_page(content, dim, theme, title), height=int(height))


def _check(runs: Mapping[str, Trajectory], show: frozenset[str], theme: str, speed: float, frames: int) -> None:
    dims = {name: run.world.dim for name, run in runs.items()}
    if len(set(dims.values())) != 1:
        raise ValueError(f"play: expected trajectories of one dimension, at least one, got {dims}")
    if unknown := show - set(LAYERS):
        raise ValueError(f"show has {sorted(unknown)}: expected some of {LAYERS}")
    if theme not in THEMES:
        raise ValueError(f"theme is {theme!r}: expected one of {THEMES}")
    if not speed > 0 or frames < 2:
        raise ValueError(f"play: expected speed > 0 and frames >= 2, got {speed} and {frames}")


def _data_by_run(runs: Mapping[str, Trajectory], data: Any, beside: bool) -> dict[str, Any]:
    """Columns of each trajectory: by name, or the same for all, then drawn once."""
    by_name = isinstance(data, Mapping) and "t" not in data and data
    if by_name and all(isinstance(part, Mapping) for part in data.values()):
        if unknown := set(data) - set(runs):
            raise ValueError(f"data has {sorted(unknown)}: expected names of trajectories, {sorted(runs)}")
        return {name: data.get(name) for name in runs}
    return {name: data if beside or n == 0 else None for n, name in enumerate(runs)}


def _page(content: Mapping[str, Any], dim: int, theme: str, title: str) -> str:
    data = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    return (
        f'<!doctype html>\n<html lang="en" data-theme="{theme}"><head><meta charset="utf-8">\n'
        f"<title>{html.escape(title or 'diffrigid')}</title>\n"
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>\n{_file('player.css')}</style></head>\n<body>\n"
        f'<script type="application/json" id="data">{data}</script>\n'
        f'<script type="text/plain" id="packed">{_packed_scripts(dim)}</script>\n'
        f"<script>\n{UNPACK}</script>\n</body></html>\n"
    )


@functools.cache
def _packed_scripts(dim: int) -> str:
    """The scripts, compressed, in base64, so that notebooks stay small."""
    names = ("player.js", "graph.js", *(("flat.js",) if dim == 2 else ("three/three.min.js", "solid.js")))
    licence = "" if dim == 2 else f"/* three.js:\n{_file('three/LICENSE-three')}*/\n"
    text = licence + "\n".join(map(_file, names))
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode()


def _file(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8")
