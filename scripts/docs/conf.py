"""Configuration of Sphinx; `docs.__main__` writes the source folder that it reads."""

import re
import sys
from html import unescape
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from docutils.nodes import SkipNode
from docutils.utils.math.latex2mathml import tex2mathml

sys.path.insert(0, str(Path(__file__).parent))

project = "softrig"
copyright = "the authors of softrig, Apache-2.0"
extensions = ["myst_nb", "sphinx_design", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "attrs_block", "attrs_inline"]
myst_heading_anchors = 5
nb_execution_mode = "off"  # the notebooks have been executed before
nb_merge_streams = True
html_math_renderer = "mathml"
myst_fence_as_directive = {"math"}
exclude_patterns = ["pictures"]
highlight_language = "text"
smartquotes = False  # -- in a command must not become a dash
html_theme = "furo"
html_title = "softrig"
html_static_path = [str(Path(__file__).parent / "static")]
html_css_files = ["softrig.css"]
html_js_files = ["gallery.js", "code.js"]
html_favicon = str(Path(__file__).parent / "static" / "favicon.svg")
html_search_scorer = str(Path(__file__).parent / "static" / "scorer.js")
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
pygments_style = "docs.style.Light"
pygments_dark_style = "docs.style.Dark"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
# Short names of types can belong to several packages, so they have no link.
suppress_warnings = ["ref.python"]


def plain_bars(app: object, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Keep reST from reading ``|e|`` and numbers of references as its own."""
    text = "\n".join(lines).replace("|", "\\|")
    text = re.sub(r"\[(\d+)\]_", r"[\1]", text)
    lines[:] = re.sub(r"^( *)(?:\.\. )?(\[\d+\] )", r"\n\1\2", text, flags=re.M).split("\n")


def mathml(formula: str, as_block: bool) -> str:
    """Typeset a formula; an index of a letter with a dot or hat is written beside it, where docutils writes it
    below.
    """
    made = tex2mathml(formula, as_block=as_block).replace(' xmlns="http://www.w3.org/1998/Math/MathML"', "")
    # HTML has names of characters that XML lacks.
    made = re.sub(r"&(?!(?:lt|gt|amp|quot|apos|#\w+);)\w+;", lambda match: unescape(match[0]), made)
    root = ElementTree.fromstring(made)
    for node in root.iter("munderover"):
        base, below, above = node
        if above.tag == "mo" and above.get("stretchy") == "false":
            accented = ElementTree.Element("mover", accent="true")
            accented.extend((base, above))
            node.tag, node[:] = "msub", (accented, below)
    return ElementTree.tostring(root, encoding="unicode")


def inline(translator: Any, node: Any) -> None:
    """Write a formula as MathML, which browsers set by themselves: no script, no network."""
    translator.body.append(mathml(node.astext(), as_block=False))
    raise SkipNode


def block(translator: Any, node: Any) -> None:
    """Write a formula in lines of its own."""
    translator.body.append(f'<div class="math" tabindex="0">{mathml(node.astext(), as_block=True)}</div>')
    raise SkipNode


def setup(app: Any) -> None:
    """Connect what this file defines."""
    app.connect("autodoc-process-docstring", plain_bars)
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
