"""How Sphinx makes these pages: `make docs`. DOCS_FAST=1 shows the notebooks without running them."""

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT), str(HERE)]
os.environ["PYTHONPATH"] = str(ROOT)  # of the notebooks' kernels

import shisd  # noqa: E402

project = "shisd"
author = "The shisd authors"
project_copyright = author
version = release = shisd.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "_stages"]
exclude_patterns = ["notebooks/.ipynb_checkpoints"]
html_theme = "furo"
html_title = f"shisd {version}"
html_copy_source = False
smartquotes = False

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "off" if os.environ.get("DOCS_FAST") == "1" else "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_typehints = "description"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 100
