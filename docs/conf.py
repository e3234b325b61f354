"""The documentation: `make docs` builds it with warnings as errors."""

import importlib.metadata
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "mavfi"
author = "the mavfi authors"
release = importlib.metadata.version("mavfi")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "sphinxcontrib.programoutput",
    "keys",
]
source_suffix = {".md": "markdown"}
root_doc = "index"


myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4  # the documents link to each other's headings, as on GitHub

autodoc_preserve_defaults = True  # else a function is shown as an object in memory
smartquotes = False  # options begin with two hyphens
napoleon_use_ivar = True
autodoc_typehints = "description"

html_theme = "furo"
html_title = f"mavfi {release}"
html_static_path = ["static"]
html_css_files = ["tables.css"]
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False

man_pages = [("reference/commands", "mavfi", "what a bit flip does to a flying robot", author, 1)]


def readable_defaults(_app, _ctx, lines):
    """Leave out the default of an option that has none, and show a path as text."""
    lines[:] = [
        re.sub(r"PosixPath\((.*)\)", r"\1", line)
        for line in lines
        if ":default: ``Sentinel.UNSET``" not in line
    ]


def setup(app):
    """Connect what mends the pages of commands."""
    app.connect("sphinx-click-process-options", readable_defaults)
