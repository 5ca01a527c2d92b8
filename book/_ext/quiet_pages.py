"""Pages that ask nothing of a network and say nothing to the console: what the theme adds and a book on disk cannot use.

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
# A glued sentence is plain text to Sphinx; the code in it stands in backticks.
GLUED = re.compile(r'(<span class="pasted-text">)([^<]*`[^<]*)(?=</span>)')


def leave_out_scripts(app: Sphinx, pagename: str, templatename: str, context: dict, doctree: object) -> None:
    """Take thebe, which runs code on a server of others, from a page, and every script that is there twice (in place)."""
    kept = {}
    for script in context.get("script_files", []):
        words = (str(script.filename or ""), str(script.attributes.get("body") or ""))
        if "thebe" not in "".join(words).lower():
            kept.setdefault(words, script)
    context["script_files"] = list(kept.values())
    context["css_files"] = [
        sheet for sheet in context.get("css_files", []) if "thebe" not in str(sheet.filename)
    ]


def show_code(match: re.Match) -> str:
    """Set what stands in backticks in a glued sentence as code."""
    return match[1] + re.sub(r"`([^`]+)`", r'<code class="docutils literal notranslate">\1</code>', match[2])


def clean_pages(app: Sphinx, exception: Exception | None) -> None:
    """Take what is of no use on disk from the finished pages, set code as code, and let no name stand there twice."""
    if exception or app.builder.format != "html":
        return
    for page in Path(app.outdir).rglob("*.html"):
        before = page.read_text()
        after = GLUED.sub(show_code, USELESS.sub("", before))
        if page.name == "search.html" and page.parent == Path(app.outdir):
            head, mark, rest = after.partition('id="search-input"')
            after = head + mark + rest.replace('id="search-input"', 'id="search-input-of-page"')
        if after != before:
            page.write_text(after)


def forget_parts(app: Sphinx, doctree: nodes.document) -> None:
    """Let every node name the page as its document (in place).

    What stands in `eval-rst` was parsed as a document of its own, whose settings hold all that Sphinx knows; it would be
    written to disk and read again with each of these pages.
    """
    for node in doctree.findall():
        node.document = doctree


def readable_defaults(
    app: Sphinx, what: str, name: str, obj: object, options: dict, arguments: str, returns: str
) -> tuple:
    """Give a signature in which a default that is made anew each time is `...`, which Sphinx can parse."""
    return arguments and arguments.replace("<factory>", "..."), returns


def setup(app: Sphinx) -> dict:
    """Tell Sphinx when to call what."""
    app.connect("html-page-context", leave_out_scripts, priority=900)
    app.connect("autodoc-process-signature", readable_defaults)
    app.connect("doctree-read", forget_parts)
    app.connect("build-finished", clean_pages)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
