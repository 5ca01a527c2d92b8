"""Write the pages of the API: one for each package and each module under `src`, and a list of functions by task.

The page of a module names its functions and classes in the order of the file; Sphinx's autodoc takes signature, docstring
and code from the imported module when the book is built. The tasks are those of `book/api.yml`.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import yaml

from chapters import SOURCE
from rol.files import read_text, write_text


def module_name(file: Path) -> str:
    """Return the name by which a file is imported."""
    return ".".join(file.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")


def page_name(file: Path) -> str:
    """Return the page of a file, as named in the table of contents and in links."""
    return f"toolbox/{module_name(file).replace('.', '/')}"


def page_text(title: str, above: str, lines: list[str]) -> str:
    """Write a page: title, a paragraph in Markdown, and directives of Sphinx."""
    return "\n".join([f"# {title}", "", above, "", "```{eval-rst}", *lines, "```", ""])


def table_of(docstrings: dict[str, str | None]) -> list[str]:
    """Write a table of targets of Sphinx's role `py:obj`, each with the first sentence of its docstring."""
    lines = [".. list-table::\n   :class: names\n   :header-rows: 1", "", "   * - name", "     - description"]
    for name, docstring in docstrings.items():
        paragraph = " ".join((docstring or "").split("\n\n")[0].split())
        lines += [f"   * - :py:obj:`{name}`", f"     - {re.split('(?<=[.?!]) (?=[A-Z])', paragraph)[0]}"]
    return [*lines, ""] if docstrings else []


def modules_in(place: Path) -> list[Path]:
    """List the files of the modules of a package; for a module without its suffix, its file."""
    files = sorted(place.rglob("[!.]*.py")) if place.is_dir() else [place.with_suffix(".py")]
    return [file for file in files if not file.name.startswith("__")]


def public_members(file: Path) -> list[ast.FunctionDef | ast.ClassDef]:
    """List the public functions and classes of a module."""
    body = ast.parse(read_text(file)).body
    return [n for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef) and not n.name.startswith("_")]


def docstrings_of(files: list[Path]) -> dict[str, str | None]:
    """Read the docstrings of modules, keyed by module name."""
    return {module_name(file): ast.get_docstring(ast.parse(read_text(file))) for file in files}


def module_page(file: Path, has_example: bool) -> str:
    """Write the page of one module: its docstring, a table of its public names, and each of them in full."""
    name, page = module_name(file), page_name(file)
    kinds = {ast.FunctionDef: "autofunction", ast.ClassDef: "autoclass"}
    members = public_members(file)
    above = f"File: `src/{file.relative_to(SOURCE).as_posix()}`."
    if has_example:
        above += f" [Example, and the files to copy]({'../' * page.count('/')}take.md#{file.stem})."
    table = table_of({f"~{name}.{member.name}": ast.get_docstring(member) for member in members})
    lines = [f".. automodule:: {name}", "", *table]
    for member in members:
        kind = kinds[type(member)]
        lines += [f".. {kind}:: {member.name}"] + ["   :members:"] * (kind == "autoclass") + [""]
    return page_text(name, above, lines)


def task_section(task: str, modules: dict[str, list[str] | None]) -> str:
    """Write the table of one task: functions and classes of `rol`, then whole modules of the other packages."""
    listed: dict[str, str | None] = {}
    for module, names in modules.items():
        place = SOURCE / module.replace(".", "/")
        if names is None:
            listed |= docstrings_of(modules_in(place))
        else:
            found = {node.name: ast.get_docstring(node) for node in public_members(place.with_suffix(".py"))}
            listed |= {f"{place.name}.{name} <{module}.{name}>": found[name] for name in names}
    return "\n".join([f"## {task}", "", "```{eval-rst}", *table_of(listed), "```", ""])


def stage_toolbox(book: Path) -> list[dict]:
    """Write a page for each package and each module, and the page that lists their functions by task.

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
        files = modules_in(package.parent)
        for file in files:
            write_text(book / f"{page_name(file)}.md", module_page(file, page_name(file) in examples))
        name = module_name(package)
        lines = [f".. automodule:: {name}", "", *table_of(docstrings_of(files))]
        write_text(book / f"{page_name(package)}.md", page_text(name, f"Folder: `src/{name}`.", lines))
        sections = [
            {"file": page_name(file), "title": module_name(file).removeprefix(f"{name}.")} for file in files
        ]
        entries.append({"file": page_name(package), "sections": sections})
    above = "Functions of `rol` by task, then modules of the other packages; each name links to its documentation and code."
    above += " [](../take.md) shows how to copy a module of `rol`."
    tasks = yaml.safe_load(read_text(book / "api.yml"))
    sections = [task_section(task, modules) for task, modules in tasks.items()]
    index = "\n".join([page_text("API", above, table_of(docstrings_of(packages))), *sections])
    write_text(book / "toolbox" / "index.md", index)
    return entries
