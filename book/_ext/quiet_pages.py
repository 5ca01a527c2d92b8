"""Remove from the pages what a book on disk cannot use, and set numbers with their units.

Sphinx loads this file as an extension, see `local_extensions` in `_config.yml`.
"""

from __future__ import annotations

import re
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx

# Preloading asks for each file by a rule that a page from the file system cannot keep; the second script only draws the
# icons, which the style sheet before it draws already, and is larger than all else on a page.
USELESS = re.compile(
    r'\s*<link rel="preload"[^>]*>|\s*<script src="[^"]*/fontawesome/[^"]*\.js[^"]*"></script>', re.IGNORECASE
)
# A number and its unit stay on one line. The first alternative skips code, scripts and attributes.
UNIT = re.compile(
    r"(<(?:pre|script|style)\b.*?</(?:pre|script|style)>|<[^>]+>)|(\d(?:</span>)*)\s(?=(?:%|m/s|[mk]?m|deg|m?s|Hz|MB)(?![\w/]))",
    re.DOTALL,
)
MINUS = re.compile(r'(?<=class="pasted-text">)-(?=\d)')


def leave_out_scripts(app: Sphinx, pagename: str, templatename: str, context: dict, doctree: object) -> None:
    """Remove thebe, which runs code on a server, and every script that a page loads twice (in place)."""
    kept = {}
    for script in context.get("script_files", []):
        words = (str(script.filename or ""), str(script.attributes.get("body") or ""))
        if "thebe" not in "".join(words).lower():
            kept.setdefault(words, script)
    context["script_files"] = list(kept.values())
    context["css_files"] = [
        sheet for sheet in context.get("css_files", []) if "thebe" not in str(sheet.filename)
    ]


def clean_pages(app: Sphinx, exception: Exception | None) -> None:
    """Remove from the finished pages what is of no use on disk, and set numbers with their signs and units."""
    if exception or app.builder.format != "html":
        return
    for page in Path(app.outdir).rglob("*.html"):
        before = page.read_text(encoding="utf-8")
        after = MINUS.sub("−", USELESS.sub("", before))
        after = UNIT.sub(lambda match: match[1] or f"{match[2]}\N{NO-BREAK SPACE}", after)
        if page.name == "search.html" and page.parent == Path(app.outdir):
            head, mark, rest = after.partition('id="search-input"')
            after = head + mark + rest.replace('id="search-input"', 'id="search-input-of-page"')
        if after != before:
            page.write_text(after, encoding="utf-8")


def forget_parts(app: Sphinx, doctree: nodes.document) -> None:
    """Let every node name the page as its document (in place).

    The content of `eval-rst` was parsed as a document of its own, whose settings hold all that Sphinx knows. It would be
    written to disk and read again with each of these pages.
    """
    for node in doctree.findall():
        node.document = doctree


def readable_defaults(
    app: Sphinx, what: str, name: str, obj: object, options: dict, arguments: str, returns: str
) -> tuple:
    """Replace a default that is created anew for each call by `...`, which Sphinx can parse."""
    return arguments and arguments.replace("<factory>", "..."), returns


def setup(app: Sphinx) -> dict:
    """Connect the functions to the events of Sphinx."""
    app.connect("html-page-context", leave_out_scripts, priority=900)
    app.connect("autodoc-process-signature", readable_defaults)
    app.connect("doctree-read", forget_parts)
    app.connect("build-finished", clean_pages)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
