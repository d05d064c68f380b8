"""The sliders of `explore` in a notebook, by anywidget: `explore.js` shows them and the page of the player."""

from importlib.resources import files
from typing import Any

from diffrigid.view.explore import Explorer

try:
    import anywidget
    import traitlets
except ImportError:
    raise ImportError('explore needs anywidget: pip install "diffrigid[notebook]"') from None


class Sliders(anywidget.AnyWidget):
    """Sliders in the browser: one that is moved sends its name and value, and the motions are sent back."""

    _esm = (files(__package__) / "explore.js").read_text(encoding="utf-8")
    page = traitlets.Unicode().tag(sync=True)
    sliders: Any = traitlets.List().tag(sync=True)  # name, low, high, value, unit
    moved = traitlets.Dict().tag(sync=True)  # name and value
    runs: Any = traitlets.List().tag(sync=True)


def widget_of(explorer: Explorer) -> Sliders:
    """Make sliders that set the values of an explorer, and show its motions."""
    widget = Sliders(page=explorer.player().page, sliders=explorer.sliders(), runs=explorer.sources())

    def follow(change: Any) -> None:
        explorer.move(change["new"]["name"], change["new"]["value"])
        widget.runs = explorer.sources()

    widget.observe(follow, "moved")
    return widget
