"""The site: ``make docs`` builds it to ``build/docs``, with warnings as errors."""

from __future__ import annotations

import sys
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent))
import pages

from sb3_fedguide import __version__

project = "sb3-fedguide"
copyright = "2026, the FedGuide for Stable-Baselines3 authors"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx_copybutton"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["examples"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]  # a page included from the repository's root starts where its own title ends

html_theme = "furo"
html_title = "sb3-fedguide"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = "$ "
pygments_style = "friendly"
pygments_dark_style = "monokai"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True


def fill_placeholders(app: Sphinx, page: str, source: list[str]) -> None:
    """Tables of parameters and links to results, in place of comments."""
    source[0] = pages.fill_placeholders(source[0], "../" * page.count("/"))


def setup(app: Sphinx) -> None:
    pages.write_pages()
    app.connect("source-read", fill_placeholders)
