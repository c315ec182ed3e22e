"""How Sphinx builds the guide: ``make docs``."""

import re
from collections.abc import Iterable
from typing import Any

from docutils import nodes
from sphinx.addnodes import desc_annotation, pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext.napoleon import Config, GoogleDocstring
from sphinx.util.nodes import make_refnode

from shepherd_phys import __version__

project = "shepherd_phys"
author = "The shepherd_phys developers"
copyright = author
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_heading_anchors = 3

default_role = "py:obj"  # `Scenario` in a docstring is a link wherever there is such an object
add_module_names = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True  # as the source says them

html_theme = "furo"
html_title = "shepherd_phys"
html_static_path = ["_static"]
html_css_files = ["guide.css"]
html_copy_source = False
html_show_sphinx = False

SECTIONS = Config(napoleon_numpy_docstring=False, napoleon_use_rtype=False, napoleon_use_ivar=True)
LONGEST_VALUE = 100
"""Of what a name is shown to stand for, in characters."""
LITERAL = re.compile(r"(``.+?``)")
RULE = re.compile(r"\|[-:| ]+\|")


def setup(app: Sphinx) -> None:
    """What autodoc and Sphinx do not do of themselves."""
    app.connect("autodoc-process-docstring", read_docstring)
    app.connect("autodoc-process-signature", leave_out_protocols)
    app.connect("doctree-read", leave_out_long_values)
    app.connect("missing-reference", find_by_last_name)


def read_docstring(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Make a docstring reStructuredText: our headings and tables are Markdown's, our bars are those of a norm.

    Napoleon is not loaded as an extension, since it takes what stands before a colon in a field's docstring for a type.
    """
    text = list(escaped(tables(lines)))
    if what not in ("attribute", "data"):
        text = GoogleDocstring(
            text, SECTIONS, app, "method" if what == "property" else what, name, thing, options
        ).lines()
    lines[:] = text


def tables(lines: Iterable[str]) -> Iterable[str]:
    """Headings become rubrics, tables list-tables."""
    before = ""
    for line in lines:
        if line.startswith("## "):
            yield from (f".. rubric:: {line[3:]}", "")
        elif RULE.fullmatch(line):
            pass
        elif line.startswith("| "):
            if not before.startswith("| "):
                yield from (".. list-table::", "   :header-rows: 1", "")
            for k, cell in enumerate(line.strip("| ").split(" | ")):
                yield f"   {'-' if k else '* -'} {cell}".replace("   -", "     -", 1)
        else:
            yield line
        before = line if not RULE.fullmatch(line) else before


def escaped(lines: Iterable[str]) -> Iterable[str]:
    """No |x| is a substitution."""
    for line in lines:
        parts = LITERAL.split(line)
        yield "".join(part if k % 2 else part.replace("|", r"\|") for k, part in enumerate(parts))


def leave_out_protocols(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, signature: str | None, answer: str | None
) -> tuple[str | None, str | None]:
    """Nobody calls a protocol."""
    return ("" if getattr(thing, "_is_protocol", False) else signature), answer


def leave_out_long_values(app: Sphinx, tree: nodes.document) -> None:
    """A value that fills a page (all presets, say) is none that anybody reads."""
    for node in list(tree.findall(desc_annotation)):
        if node.astext().lstrip().startswith("=") and len(node.astext()) > LONGEST_VALUE:
            node.parent.remove(node)


def find_by_last_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.Element | None:
    """Where a name in backticks leads: to the one object of the guide that is called so, with or without its class."""
    if node.get("refdomain") != "py":
        return None
    wanted = f".{node['reftarget']}"
    objects = env.domains.python_domain.objects
    found = [(full, entry) for full, entry in objects.items() if full.endswith(wanted) and not entry.aliased]
    module = node.get("py:module") or ""
    own = [pair for pair in found if pair[0].startswith(f"{module}.")] if module else []
    if len(own or found) != 1:
        return None
    ((full, entry),) = own or found
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, full)
