"""How Sphinx makes the guide: `python -m sphinx -W -n --keep-going -b html docs OUTPUT`, from the repository's root."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "factors"), str(HERE)]

import gtsam_rwhec  # noqa: E402

project = "gtsam-rwhec"
author = "The gtsam-rwhec authors"
release = version = gtsam_rwhec.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "building.repository_pages",
    "building.command_pages",
    "building.api_pages",
    "building.docstrings",
    "building.formulas",
    "building.names",
]
exclude_patterns = ["building"]
nitpicky = True

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # the anchors that links on a repository's page have too

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("ArrayLike", "PosesLike")}
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
python_maximum_signature_line_length = 100
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
default_role = "py:obj"

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "gtsam-rwhec"
html_show_sourcelink = False
html_copy_source = False
