"""What Sphinx is told; docs/build calls it."""

import re
from pathlib import Path
from typing import Any

from pygments.lexers.special import TextLexer
from sphinx.domains.python import PyObject

from remodel_fenicsx import __version__

project = "remodel_fenicsx"
author = "The remodel_fenicsx developers"
release = version = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
napoleon_google_docstring = False
napoleon_use_ivar = True
default_role = (
    "py:obj"  # what docstrings have in backticks: a link where it is a public name, else code
)
autodoc_typehints = "none"
autodoc_preserve_defaults = True  # as the source says, without paths of this machine
autodoc_member_order = "bysource"
toc_object_entries_show_parents = "hide"  # else they are wider than their column
suppress_warnings = ["misc.highlighting_failure"]  # shells' prompts and shortened TOML in examples
html_theme = "pydata_sphinx_theme"
html_title = "remodel_fenicsx"
html_search_scorer = str(Path(__file__).with_name("scorer.js"))
html_copy_source = html_show_sourcelink = False
html_context = {"default_mode": "auto"}  # dark and light as the reader's system
html_theme_options = {
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": ["page-toc"],
}
# KaTeX in the site's own folder: formulas need no network
mathjax_path = "katex/katex.min.js"
html_css_files = ["katex/katex.min.css", "site.css"]
html_js_files = [
    ("katex/contrib/auto-render.js", {"defer": "defer"}),
    (
        None,
        {
            "body": "addEventListener('load', () => window.renderMathInElement && renderMathInElement(document.body))"
        },
    ),
]


def link(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Pages that a docstring names."""
    lines[:] = [re.sub(r"docs/(\w+)\.md", r":doc:`\1`", line) for line in lines]


def without_paths(app: Any, *about: Any) -> tuple[str | None, str | None]:
    """A signature in which modules and objects that are defaults have their names, no path and no address."""
    *_, signature, returns = about
    name = r"<(?:module '|function )?[\w.]*?(\w+)(?:' from '[^']*'| object)?(?: at 0x\w+)?>"
    return re.sub(name, r"\1", signature or "") or None, returns


def setup(app: Any) -> None:
    """Tables in pages: Pygments knows no CSV. Attributes of classes: under the name that they have in docstrings."""
    app.add_lexer("csv", TextLexer)
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
    app.connect("autodoc-process-docstring", link)
    app.connect("autodoc-process-signature", without_paths)
