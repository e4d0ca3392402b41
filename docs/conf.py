"""The site: `make docs`. Neither the build nor a reader's browser fetches anything from elsewhere."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

import impactopt  # noqa: E402  the checkout beside this file, not one that is installed

project = "impactopt"
author = "the impactopt authors"
copyright = "the impactopt authors, BSD-2-Clause"
version = release = impactopt.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "commands", "docstrings", "families", "mathml", "notebooks"]
exclude_patterns = ["_ext"]

# pages
myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # `make notebooks` executes them
highlight_language = "text"
html_math_renderer = "mathml"

# reference
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "__init__"}
autodoc_class_signature = "mixed"
python_maximum_signature_line_length = 90
python_use_unqualified_type_names = True
add_module_names = False
default_role = "py:obj"  # links where it can, code where it cannot

# looks: furo ships its styles and uses the reader's fonts
html_theme = "furo"
html_title = "impactopt"
html_show_sourcelink = False
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
