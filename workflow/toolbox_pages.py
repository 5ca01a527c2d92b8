"""Pages of the toolbox: one for each package and each module under `src`, which Sphinx's autodoc fills.

A page names the functions and classes in the order of the file; signature, docstring and the link to the code are
taken from the imported module when the book is built.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

from chapters import SOURCE
from rol.files import read_text, write_text


def module_name(file: Path) -> str:
    """Give the name by which a file is imported."""
    parts = file.relative_to(SOURCE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def page_name(file: Path) -> str:
    """Give the page of a file, as the table of contents and links name it."""
    return f"toolbox/{module_name(file).replace('.', '/')}"


def page_text(title: str, above: str, lines: list[str]) -> str:
    """Write a page: title, a paragraph in Markdown, and directives of Sphinx."""
    return "\n".join([f"# {title}", "", above, "", "```{eval-rst}", *lines, "```", ""])


def table_of(names: list[str]) -> list[str]:
    """Write the directive for a table of names, each linked and with the first sentence of its docstring."""
    return (
        [".. autosummary::", "   :nosignatures:", "", *(f"   {name}" for name in names), ""] if names else []
    )


def module_page(file: Path, has_example: bool) -> str:
    """Write the page of one module: its docstring, a table of its public names, and each of them in full."""
    name, page = module_name(file), page_name(file)
    kinds = {ast.FunctionDef: "autofunction", ast.ClassDef: "autoclass"}
    body = ast.parse(read_text(file)).body
    members = {m.name: kinds[type(m)] for m in body if type(m) in kinds and not m.name.startswith("_")}
    above = f"File: `src/{file.relative_to(SOURCE).as_posix()}`."
    if has_example:
        above += f" [Example, and the files to copy]({'../' * page.count('/')}take.md#{file.stem})."
    lines = [f".. automodule:: {name}", "", *table_of(list(members))]
    for member, kind in members.items():
        lines += [f".. {kind}:: {member}"] + ["   :members:"] * (kind == "autoclass") + [""]
    return page_text(name, above, lines)


def stage_toolbox(book: Path) -> list[dict]:
    """Write a page for each package and each module, and their index.

    Returns
    -------
    entries : list of dict
        The packages for the table of contents, each with its modules as sections.
    """
    examples = set(
        re.findall(r"^### \[\w+\]\((toolbox/[\w/]+)\.md\)", read_text(book / "take.md"), re.MULTILINE)
    )
    packages = [file for file in sorted(SOURCE.glob("[!.]*/__init__.py"))]
    entries = []
    for package in packages:
        files = [file for file in sorted(package.parent.rglob("[!.]*.py")) if not file.name.startswith("__")]
        for file in files:
            write_text(book / f"{page_name(file)}.md", module_page(file, page_name(file) in examples))
        name = module_name(package)
        modules = [module_name(file).removeprefix(f"{name}.") for file in files]
        lines = [f".. automodule:: {name}", "", *table_of(modules)]
        write_text(book / f"{page_name(package)}.md", page_text(name, f"Folder: `src/{name}`.", lines))
        sections = [{"file": page_name(file)} for file in files]
        entries.append({"file": page_name(package), "sections": sections})
    above = (
        "One page for each module, with signature, docstring and code of every public function and class."
        " [What can be copied, and how](../take.md#what-to-copy)."
    )
    lines = table_of([module_name(package) for package in packages])
    write_text(book / "toolbox" / "index.md", page_text("All functions", above, lines))
    return entries
