"""The documentation site: `sphinx-build -W notebooks build/docs`, after `pip install -e ".[docs]"`.

Built from the docstrings and the notebooks as they were committed: nothing is executed. Its pages
load nothing from elsewhere: formulas are MathML, which Docutils makes. Docstrings of this project
are plain text, in which a star is a star and `x` is code; `plain` makes reStructuredText of them.
"""

import inspect
import re

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

project = "diffrigid"
author = "the authors of diffrigid"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx.ext.autosectionlabel",
]
exclude_patterns = ["ruff.toml"]
html_theme = "furo"
html_title = "diffrigid"
html_show_copyright = html_show_sphinx = html_copy_source = False
html_math_renderer = "mathml"
smartquotes = False
nitpicky = True  # a link to a function that is not there is a warning, and with -W an error

nb_execution_mode = "off"
nb_merge_streams = True
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

default_role = "code"
autodoc_typehints = "none"  # the docstrings give shapes and units, which say more
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autosectionlabel_prefix_document = True
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_custom_sections = [("Fields", "params_style")]

SECTION = re.compile(r"\w+:$")  # Args:, Returns:, Raises:, Example:
FIELD = re.compile(
    r"^    (\w+): [^#\n]+#\s*(.+)$", re.M
)  # of a record: its shape, unit and meaning


def plain(app, what, name, obj, options, lines):
    """A docstring as reStructuredText; of a record, with the comments of its fields."""
    if inspect.isclass(obj):
        fields = dict(FIELD.findall(inspect.getsource(obj)))
        lines += (
            ["", "Fields:", *(f"    {field}: {said}" for field, said in fields.items())]
            if fields
            else []
        )
    lines[:] = list(marked(lines))


def marked(lines):
    """Lines: indented blocks are formulas or code, unless a section is; the rest is text."""
    section = example = block = False
    for before, line in zip(["", *lines], lines):
        indented = line.startswith("  ")
        if line.strip() and not indented:
            section, block = bool(SECTION.match(line)), False
        example = bool(line.strip()) and (example or line.lstrip().startswith(">>>"))
        if indented and not before.strip() and not section and not block and not example:
            block = True
            yield from ("::", "")
        yield line if block or example else re.sub(r"`([^`]+)`|([*|_\\])", escaped, line)


def without_class(app, what, name, obj, options, signature, returns):
    """The signature of a record without what only `jax.tree_util` passes."""
    return (signature and re.sub(r", _class='\w+'", "", signature)), returns


def escaped(match):
    return f"``{match[1]}``" if match[1] else "\\" + match[2]


def inline_math(self, node):
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def block_math(self, node):
    self.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app):
    app.connect("autodoc-process-docstring", plain, priority=100)  # before napoleon
    app.connect("autodoc-process-signature", without_class)
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
