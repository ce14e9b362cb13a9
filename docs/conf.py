"""Configuration of the documentation site: `make docs` builds it with Sphinx."""

import os
import tomllib
from pathlib import Path
from typing import Any

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]

project = "imagination"
author = "The imagination developers"
project_copyright = author
version = release = PROJECT["version"]

extensions = [
    "myst_parser",
    "sphinx.ext.apidoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.intersphinx",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
default_role = "py:obj"  # `name` in docstrings links to what it names, if that is documented

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

apidoc_modules = [
    {
        "path": "../imagination",
        "destination": "reference/api",
        "exclude_patterns": ["../imagination/__main__.py", "../imagination/conf", "../imagination/plugins/*"],
        "separate_modules": True,
        "module_first": True,
        "include_private": False,
        "automodule_options": {"members", "show-inheritance"},
    }
]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_mock_imports = ["rerun", "litdata", "rosbags", "onnxruntime", "onnx"]  # optional extras
python_use_unqualified_type_names = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True  # attributes as fields of their class, not twice
napoleon_attr_annotations = False  # shapes such as "*b v v" are no reStructuredText
autodoc_inherit_docstrings = False  # those of Lightning have labels of their own site
suppress_warnings = ["ref.python"]  # a name in backticks that several classes have links to one of them

# Without network by default; `make docs INTERSPHINX=1` adds links to these projects.
intersphinx_mapping = (
    {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "lightning": ("https://lightning.ai/docs/pytorch/stable", None),
    }
    if os.environ.get("INTERSPHINX")
    else {}
)

html_theme = "furo"
html_title = f"imagination {release}"
html_theme_options = {"sidebar_hide_name": False}
html_show_sphinx = False
pygments_style = "friendly"


def keep_colons(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Begin the docstring of a constant with an empty line, so that napoleon takes no "text: more" for a type."""
    if what in ("data", "attribute", "property"):
        lines.insert(0, "")


def setup(app: Any) -> None:
    """Register the handler of docstrings before that of napoleon, whose priority is 500."""
    app.connect("autodoc-process-docstring", keep_colons, priority=400)
