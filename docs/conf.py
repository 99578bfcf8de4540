"""The documentation: pages of this folder, scripts that run while it is built, and the reference from the docstrings.

sphinx-build -W --keep-going docs docs/_build/html
"""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS / "_extensions"))

import scripts  # noqa: E402

project = "covocp"
author = "the covocp authors"
version = release = metadata.version("covocp")
project_copyright = author

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "scripts",  # before sphinx_gallery, which it gives its folders
    "sphinx_gallery.gen_gallery",
    "docstrings",
    "mathml",
]
exclude_patterns = ["_build", "_extensions", "scripts", "tutorial/index.rst"]
sphinx_gallery_conf = scripts.SETTINGS

# Every reference must lead somewhere. What is in single quotes is a name of covocp or plain code; of other packages no
# inventory is asked for, since nothing is loaded from elsewhere; and types of the package that nobody makes by hand are
# told by their names.
nitpicky = True
default_role = "py:obj"
nitpick_ignore_regex = [
    ("py:obj", "(?s:.*)"),
    ("py:.*", r"(?!covocp\.).*"),
    ("py:class", r"covocp\.\w+\..*"),
]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
html_math_renderer = "mathml"

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = False
autodoc_type_aliases = {name: name.rpartition(".")[2] for name in ("Array", "ArrayLike", "npt.ArrayLike")}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_attr_annotations = False
python_maximum_signature_line_length = 100

highlight_language = "text"  # unless a block says otherwise; equations are no Python
smartquotes_action = "D"  # dashes; M' is no apostrophe

html_theme = "furo"
html_title = "covocp"
html_static_path = ["_static"]
html_css_files = ["covocp.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
