"""The pages of the toolbox: one for each file of the package, made from its docstrings and from the page on taking.

A page shows what the file needs, an example, a list of what it holds, and for each function its signature, what its
docstring says, and its code. Nothing is imported for that; the files are only read.
"""

from __future__ import annotations

import ast
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from chapters import SOURCE, ChapterError
from rol.files import read_text, write_text

PACKAGE = SOURCE / "rol"
SECTION = re.compile(r"^(Parameters|Attributes|Returns|Yields|Raises|Notes)\n-+$", re.MULTILINE)
FOLDER = "Part of the folder `virtual`, which is copied whole: [what it needs, and an example](../take.md#virtual)."


# ---- examples -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Example:
    """A file of the package as the page on taking presents it.

    Attributes
    ----------
    needs : str
        The line that names packages and the files beside it.
    code, printed : str
        The example, and what it prints.
    """

    needs: str
    code: str
    printed: str

    @property
    def packages(self) -> set[str]:
        """Packages that the example needs."""
        return set(self.needs.removeprefix("Packages: ").partition(". Beside")[0].split(", "))

    @property
    def files(self) -> list[str]:
        """Files that the example needs beside it."""
        beside = self.needs.partition("Beside it: ")[2]
        return re.findall(r"`(\w+\.py)`", beside.partition(". ")[0])


def read_examples(page: Path) -> dict[str, Example]:
    """Read the examples of a page: headings that link to a file's page, a line of needs, code, and what it prints."""
    parts = re.split(r"^### \[(\w+)\]\(.*\)\n", read_text(page), flags=re.MULTILINE)[1:]
    found = {}
    for name, text in zip(parts[::2], parts[1::2], strict=True):
        needs = re.search(r"^Packages: .*$", text, re.MULTILINE)
        code = re.search(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        printed = re.search(r"^```text\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        if not (needs and code and printed):
            raise ChapterError(f"{page}: {name}: its packages, its example or what that prints is missing")
        found[name] = Example(needs[0], code[1], printed[1])
    return found


# ---- docstrings -----------------------------------------------------------------------------------------------


def as_text(text: str, links: dict[str, str]) -> str:
    """Make MyST show a docstring's words as they stand; names in backticks stay code, and link where they are known."""
    parts = re.split(r"(``?[^`]+``?)", text)
    for i, part in enumerate(parts):
        if i % 2 == 0:
            parts[i] = re.sub(r"([\\*_|<>\[\]{}$#~])", r"\\\1", part)
        elif (name := part.strip("`").removeprefix("rol.")) in links:
            parts[i] = f"[`{part.strip('`')}`]({links[name]})"
    return "".join(parts)


def first_sentence(docstring: str) -> str:
    """Give the first sentence of a docstring, or all of its first paragraph where that is none."""
    paragraph = " ".join(docstring.split("\n\n")[0].split())
    return re.split(r"(?<=[.?!]) (?=[A-Z])", paragraph)[0]


def item_lines(section: str, text: str, links: dict[str, str]) -> list[str]:
    """Turn a section of a docstring into a list: each name with its type, and what it means below."""
    if section == "Notes":
        return [as_text(text.strip(), links), ""]
    lines = [f"**{section}**", ""]
    for item in re.split(r"\n(?=\S)", text.strip("\n")):
        head, _, body = item.partition("\n")
        names, _, kind = head.partition(" : ")
        meaning = as_text(" ".join(body.split()), links)
        lines.append(
            f"- `{names}`" + (f" : *{as_text(kind, {})}*" if kind else "") + ("\\" if meaning else "")
        )
        lines += [f"  {meaning}"] if meaning else []
    return [*lines, ""]


def docstring_lines(docstring: str, links: dict[str, str]) -> list[str]:
    """Turn a docstring in numpydoc form into Markdown."""
    said, *sections = SECTION.split(docstring)
    lines = [as_text(said.strip(), links), ""]
    for section, text in zip(sections[::2], sections[1::2], strict=True):
        lines += item_lines(section, text, links)
    return lines


# ---- signatures -----------------------------------------------------------------------------------------------


def arguments_of(arguments: ast.arguments) -> list[str]:
    """List the arguments of a function as they are written, without `self`."""
    plain = arguments.posonlyargs + arguments.args
    defaults = [None] * (len(plain) - len(arguments.defaults)) + arguments.defaults
    written = [
        ast.unparse(a) + (f" = {ast.unparse(d)}" if d else "") for a, d in zip(plain, defaults, strict=True)
    ]
    if arguments.vararg or arguments.kwonlyargs:
        written.append("*" + (ast.unparse(arguments.vararg) if arguments.vararg else ""))
    written += [
        ast.unparse(a) + (f" = {ast.unparse(d)}" if d else "")
        for a, d in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    ]
    written += [f"**{ast.unparse(arguments.kwarg)}"] if arguments.kwarg else []
    return [one for one in written if one != "self"]


def signature(node: ast.FunctionDef | ast.ClassDef) -> str:
    """Write how a function is called, or a class made; one argument to a line where it is long."""
    returns, arguments = "", []
    if isinstance(node, ast.FunctionDef):
        arguments, returns = (
            arguments_of(node.args),
            f" -> {ast.unparse(node.returns)}" if node.returns else "",
        )
    elif any("Error" in base.id for base in node.bases if isinstance(base, ast.Name)):
        return f"class {node.name}({ast.unparse(node.bases[0])})"
    else:
        for part in node.body:
            if isinstance(part, ast.FunctionDef) and part.name == "__init__":
                arguments = arguments_of(part.args)
            elif isinstance(part, ast.AnnAssign):
                value = f" = {ast.unparse(part.value)}" if part.value else ""
                arguments.append(f"{ast.unparse(part.target)}: {ast.unparse(part.annotation)}{value}")
    line = f"{node.name}({', '.join(arguments)}){returns}"
    return line if len(line) < 90 else f"{node.name}(\n    " + ",\n    ".join(arguments) + f",\n){returns}"


def method_lines(node: ast.ClassDef, links: dict[str, str]) -> list[str]:
    """List the public methods and properties of a class, each with its first sentence."""
    lines = []
    for part in node.body:
        if isinstance(part, ast.FunctionDef) and not part.name.startswith("_"):
            is_value = any(ast.unparse(mark).endswith("property") for mark in part.decorator_list)
            call = part.name if is_value else f"{part.name}({', '.join(arguments_of(part.args))})"
            said = as_text(first_sentence(ast.get_docstring(part) or ""), links)
            lines += [f"- `{call}`" + ("\\" if said else "")] + ([f"  {said}"] if said else [])
    return ["**Methods**", "", *lines, ""] if lines else []


# ---- pages ----------------------------------------------------------------------------------------------------


def page_name(file: Path) -> str:
    """Name the page of a file."""
    return "-".join(file.relative_to(PACKAGE).with_suffix("").parts)


def public_members(file: Path) -> list[ast.FunctionDef | ast.ClassDef]:
    """List the public functions and classes of a file."""
    kinds = ast.FunctionDef | ast.ClassDef
    body = ast.parse(read_text(file)).body
    return [node for node in body if isinstance(node, kinds) and not node.name.startswith("_")]


def find_links(files: list[Path], here: Path) -> dict[str, str]:
    """Give the place of every function as seen from one page: by its own name on that page, else by its file's too."""
    links = {}
    for file in files:
        name = ".".join(file.relative_to(PACKAGE).with_suffix("").parts)
        links[name] = f"{page_name(file)}.md"
        for node in public_members(file):
            place = f"{page_name(file)}.md#{node.name.lower()}"
            links |= {f"{name}.{node.name}": place, f"{file.stem}.{node.name}": place}
    links |= {node.name: f"#{node.name.lower()}" for node in public_members(here)}
    return links


def member_lines(node: ast.FunctionDef | ast.ClassDef, place: str, links: dict[str, str]) -> list[str]:
    """Write what stands about one function or class."""
    lines = [f"## {node.name}", "", "```python", signature(node), "```", ""]
    lines += docstring_lines(ast.get_docstring(node) or "", links)
    lines += method_lines(node, links) if isinstance(node, ast.ClassDef) else []
    lines += ["````{dropdown} The code", "", f"```{{literalinclude}} ../src/rol/{place}"]
    return [*lines, f":pyobject: {node.name}", ":language: python", "```", "````", ""]


def module_page(file: Path, files: list[Path], example: Example | None) -> str:
    """Write the page of one module: what it needs, an example, a list of what it holds, and each function."""
    place, links = file.relative_to(PACKAGE).as_posix(), find_links(files, file)
    members = public_members(file)
    lines = [f"# {page_name(file).replace('-', '.')}", ""]
    lines += docstring_lines(ast.get_docstring(ast.parse(read_text(file))) or "", links)
    lines += [f"File: `src/rol/{place}`. [How to copy it](../take.md#what-to-copy).", ""]
    if example:
        lines += [
            example.needs,
            "",
            "```python",
            example.code + "```",
            "",
            "```text",
            example.printed + "```",
            "",
        ]
    else:
        lines += [FOLDER, ""]
    lines += ["| name | what it is or does |", "|---|---|"]
    for node in members:
        said = as_text(first_sentence(ast.get_docstring(node) or ""), links)
        lines.append(f"| [`{node.name}`](#{node.name.lower()}) | {said} |")
    lines.append("")
    for node in members:
        lines += member_lines(node, place, links)
    return "\n".join(lines)


def index_page(files: list[Path]) -> str:
    """Write the list of all pages, those of the folder `virtual` apart."""
    rows: dict[str, list[str]] = {"": [], "virtual": []}
    for file in files:
        said = as_text(first_sentence(ast.get_docstring(ast.parse(read_text(file))) or ""), {})
        row = f"| [{page_name(file).replace('-', '.')}]({page_name(file)}.md) | {said} |"
        rows["virtual" if file.parent != PACKAGE else ""].append(row)
    head = "One page for each file of `src/rol`: what it needs, an example, and every public function with its code."
    table = ["| file | what is in it |", "|---|---|"]
    lines = ["# All functions", "", head, "", *table, *rows[""], ""]
    lines += ["## Virtual sessions", "", FOLDER, "", *table, *rows["virtual"], ""]
    return "\n".join(lines)


def stage_toolbox(book: Path) -> list[str]:
    """Write a page for each module and their index; give the names of the pages."""
    files = [file for file in sorted(PACKAGE.rglob("[!.]*.py")) if not file.name.startswith("__")]
    files.sort(key=lambda file: (len(file.relative_to(PACKAGE).parts), file))
    shutil.copytree(PACKAGE, book / "src" / "rol", ignore=shutil.ignore_patterns("__pycache__", "._*"))
    examples = read_examples(book / "take.md")
    for file in files:
        example = examples.get(file.stem) if file.parent == PACKAGE else None
        write_text(book / "toolbox" / f"{page_name(file)}.md", module_page(file, files, example))
    write_text(book / "toolbox" / "index.md", index_page(files))
    return [page_name(file) for file in files]
