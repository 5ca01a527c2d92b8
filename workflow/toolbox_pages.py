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
    return ".".join(file.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")


def page_name(file: Path) -> str:
    """Give the page of a file, as the table of contents and links name it."""
    return f"toolbox/{module_name(file).replace('.', '/')}"


def page_text(title: str, above: str, lines: list[str]) -> str:
    """Write a page: title, a paragraph in Markdown, and directives of Sphinx."""
    return "\n".join([f"# {title}", "", above, "", "```{eval-rst}", *lines, "```", ""])


def table_of(docstrings: dict[str, str | None]) -> list[str]:
    """Write a table of full names, each linked and with the first sentence of its docstring."""
    lines = [".. list-table::", "   :header-rows: 1", "", "   * - name", "     - description"]
    for name, docstring in docstrings.items():
        paragraph = " ".join((docstring or "").split("\n\n")[0].split())
        lines += [f"   * - :py:obj:`{name}`", f"     - {re.split('(?<=[.?!]) (?=[A-Z])', paragraph)[0]}"]
    return [*lines, ""] if docstrings else []


def docstrings_of(files: list[Path]) -> dict[str, str | None]:
    """Read the docstrings of modules, by their names."""
    return {module_name(file): ast.get_docstring(ast.parse(read_text(file))) for file in files}


def module_page(file: Path, has_example: bool) -> str:
    """Write the page of one module: its docstring, a table of its public names, and each of them in full."""
    name, page = module_name(file), page_name(file)
    kinds = {ast.FunctionDef: "autofunction", ast.ClassDef: "autoclass"}
    body = ast.parse(read_text(file)).body
    members = [node for node in body if type(node) in kinds and not node.name.startswith("_")]
    above = f"File: `src/{file.relative_to(SOURCE).as_posix()}`."
    if has_example:
        above += f" [Example, and the files to copy]({'../' * page.count('/')}take.md#{file.stem})."
    table = table_of({f"~{name}.{member.name}": ast.get_docstring(member) for member in members})
    lines = [f".. automodule:: {name}", "", *table]
    for member in members:
        kind = kinds[type(member)]
        lines += [f".. {kind}:: {member.name}"] + ["   :members:"] * (kind == "autoclass") + [""]
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
    entries, packages = [], sorted(SOURCE.glob("[!.]*/__init__.py"))
    for package in packages:
        files = [file for file in sorted(package.parent.rglob("[!.]*.py")) if not file.name.startswith("__")]
        for file in files:
            write_text(book / f"{page_name(file)}.md", module_page(file, page_name(file) in examples))
        name = module_name(package)
        lines = [f".. automodule:: {name}", "", *table_of(docstrings_of(files))]
        write_text(book / f"{page_name(package)}.md", page_text(name, f"Folder: `src/{name}`.", lines))
        sections = [
            {"file": page_name(file), "title": module_name(file).removeprefix(f"{name}.")} for file in files
        ]
        entries.append({"file": page_name(package), "sections": sections})
    above = (
        "One page for each module, with signature, docstring and code of every public function and class."
        " [What can be copied, and how](../take.md#what-to-copy)."
    )
    index = page_text("All functions", above, table_of(docstrings_of(packages)))
    write_text(book / "toolbox" / "index.md", index)
    return entries
