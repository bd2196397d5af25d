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

# Markdown as GitHub reads it, with anchors of headings, and formulas between dollars.
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 4
myst_links_external_new_tab = False
suppress_warnings = [
    "myst.header",  # a page made from part of another one may begin below level 1
]

# Docstrings: numpydoc; members in the order of the source, where definitions precede their use.
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

# numpydoc compiles its template for every docstring, which takes a third of a build: compile it once.
_templates = Path(docscrape_sphinx.__file__).parent / "templates"
_environment = docscrape_sphinx.SandboxedEnvironment(loader=FileSystemLoader(_templates))
docscrape_sphinx.SandboxedEnvironment = lambda loader: _environment

# References that -n cannot resolve offline: base classes of other packages, and the references in docstrings that are
# inherited from them.
nitpick_ignore_regex = [
    (
        r"py:.*",
        r"(rclpy|numpy|launch|launch_ros|threading|argparse|multiprocessing|enum|abc|ast)\..*",
    ),
    (r"py:.*", r"(Exception|ValueError|object|tuple|dict|NamedTuple|Enum|IntEnum|ABC|Thread)"),
    (r"py:.*", r"CallbackGroup\..*|create_\w+"),
]
