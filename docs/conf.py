"""The documentation: `make docs` builds it with warnings as errors."""

import importlib.metadata
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
