"""The site: ``make docs`` builds it to ``build/docs``, with warnings as errors."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.inspect import stringify_signature
from sphinx.util.nodes import make_refnode

sys.path.insert(0, str(Path(__file__).parent))
import notebook_pages
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

html_theme = "furo"
html_title = "sb3-fedguide"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = "$ "
highlight_language = "text"  # what is not marked as code of a language is for a terminal
pygments_style = "friendly"
pygments_dark_style = "monokai"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True


def complete_page(app: Sphinx, page: str, source: list[str]) -> None:
    """Tables of parameters and links to results in place of comments; the repository's own pages in place of links to them."""
    if page in pages.ROOT_PAGES:
        app.env.note_dependency(str(pages.ROOT / f"{page.upper()}.md"))
        source[0] = pages.root_page(page)
    if pages.PLACEHOLDER.search(source[0]):
        app.env.note_dependency(str(pages.RESULTS))
    if page == "results":
        source[0] = pages.unbroken(source[0])
    source[0] = pages.fill_placeholders(source[0], "../" * page.count("/"))


def constructor_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None] | None:
    """Algorithms check unknown keywords in their metaclass, whose own signature says nothing."""
    if what != "class" or signature is None or not signature.startswith("(*args"):
        return None
    parameters = list(inspect.signature(obj.__init__).parameters.values())[1:]
    parameters = [parameter for parameter in parameters if not parameter.name.startswith("_")]
    return stringify_signature(inspect.Signature(parameters), unqualified_typehints=True), returns


def resolve_short_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.Node | None:
    """Docstrings name what their own module imports; here it is found by its last part, where only one object has it."""
    if node.get("refdomain") != "py":
        return None
    objects = env.domains.python_domain.objects
    name = node["reftarget"].rpartition(".")[2]
    found = {entry for full, entry in objects.items() if full.rpartition(".")[2] == name and entry.objtype != "module"}
    if len(found) != 1:
        return None
    (entry,) = found
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, name)


def setup(app: Sphinx) -> None:
    pages.write_pages()
    notebook_pages.write_pages()
    app.connect("source-read", complete_page)
    app.connect("autodoc-process-signature", constructor_signature)
    app.connect("missing-reference", resolve_short_name)
