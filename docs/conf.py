# SPDX-License-Identifier: Apache-2.0
"""Settings of Sphinx; `docs/build_site.py` prepares the pages and starts it."""

from pathlib import Path

from jinja2 import FileSystemLoader
from numpydoc import docscrape_sphinx

project = "flexarm"
author = "the flexarm developers"
copyright = author
extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
html_theme = "furo"
html_title = "flexarm"
html_show_sourcelink = False
html_copy_source = False
master_doc = "index"
exclude_patterns = []

# Markdown: as GitHub reads it, anchors of headings included, with formulas in dollars.
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 4
myst_links_external_new_tab = False
suppress_warnings = [
    "myst.header",  # a page taken from a part of another one may begin below level 1
]

# Docstrings: numpydoc; members in the order of the source, where each comes after what it needs.
autodoc_member_order = "bysource"
autodoc_default_options = {
    "members": True,
    "show-inheritance": True,
    "exclude-members": "Lock",  # threading's own text confuses numpydoc
}
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
numpydoc_xref_param_type = False

# numpydoc compiles its template anew for every docstring, a third of a build: one is enough.
_templates = Path(docscrape_sphinx.__file__).parent / "templates"
_environment = docscrape_sphinx.SandboxedEnvironment(loader=FileSystemLoader(_templates))
docscrape_sphinx.SandboxedEnvironment = lambda loader: _environment

# What -n complains of and cannot be resolved offline: base classes of packages whose pages are on the web, and what
# docstrings inherited from them refer to.
nitpick_ignore_regex = [
    (
        r"py:.*",
        r"(rclpy|numpy|launch|launch_ros|threading|argparse|multiprocessing|enum|abc|ast)\..*",
    ),
    (r"py:.*", r"(Exception|ValueError|object|tuple|dict|NamedTuple|Enum|IntEnum|ABC|Thread)"),
    (r"py:.*", r"CallbackGroup\..*|create_\w+"),
]
