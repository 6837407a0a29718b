"""Configuration of the documentation site: `make docs` builds it into build/site."""

from __future__ import annotations

import sys
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parent.parent
# Holds a link named levid to this checkout, whatever the folder of the checkout is named.
sys.path.insert(0, str(ROOT / "build" / "typecheck"))

from levid import __version__  # noqa: E402 - after the path

project = "levid"
author = "levid contributors"
copyright = author
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["examples/backend/[!R]*"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
# Notebooks run in the tests, with a time limit; the site shows their text and code.
nb_execution_mode = "off"

autodoc_typehints = "signature"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = f"levid {__version__}"
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0072b2", "color-brand-content": "#0072b2"},
    "dark_css_variables": {"color-brand-primary": "#4ba8e0", "color-brand-content": "#4ba8e0"},
}
html_show_sourcelink = False
html_copy_source = False

_PAGES = {
    "(CHANGELOG.md)": "(changelog.md)",
    "(CONTRIBUTING.md)": "(contributing.md)",
    "(docs/img/": "(img/",
    "(docs/": "(",
    "[tests/measured/qube](../tests/measured/qube/README.md)": "`tests/measured/qube`",
    "(tests/measured/qube/README.md)": "(real-data.md)",
}
"""Links as they are in the repository, and as they are on the site."""


def setup(app: Sphinx) -> None:
    """Translate links between files of the repository into links between pages."""
    app.connect("include-read", lambda *event: _translate(event[-1]))
    app.connect("source-read", lambda *event: _translate(event[-1]))


def _translate(content: list[str]) -> None:
    for link, page in _PAGES.items():
        content[0] = content[0].replace(link, page)
